r"""Residuals, and the sums over all images that a step needs, in one pass.

Pixels are the last axis, so that each sum adds long rows. Images are processed one by
one: a compiler would otherwise repeat intermediate computations for every sum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.maps.normals.unknowns import Point, Unknowns, tangents
from phongfit.maps.pixel.lamps import Lamps, at_pixels
from phongfit.maps.pixel.robust import loss_weights
from phongfit.maps.pixel.samples import Samples
from phongfit.maps.pixel.small import (
    Numbers,
    Triangle,
    optimization_barrier,
)
from phongfit.reflectance import AbstractSpecular
from phongfit.vectors import Scalar, Vec3, dot


class Sums(NamedTuple):
    r"""Sums over all samples with the weights of the loss, in units of squared noise.

    With the derivatives $J$ of the model with respect to the unknowns, and the
    residuals r:

    - `own`: $J^\top W J$ of the reflectances of a channel, (channels, pixels) each.
    - `cross`: for each shared unknown, its products with those reflectances.
    - `shared`: $J^\top W J$ of the shared unknowns, (pixels,) each.
    - `pull_own`, `pull_shared`: $J^\top W r$.
    - `cost`: sum of the loss over the residuals.
    """

    own: Triangle
    cross: tuple[Numbers, ...]
    shared: Triangle
    pull_own: Numbers
    pull_shared: Numbers
    cost: Array


class Shade(NamedTuple):
    """One light on pixels: Lambert's D and the lobe S, and their derivatives.

    `d1`, `d2`, `s1`, `s2` are derivatives along the two tangents of the normal, `st`
    that of S with respect to log f; (pixels,) each.
    """

    d: Array
    d1: Array
    d2: Array
    s: Array
    s1: Array
    s2: Array
    st: Array


class Peak(NamedTuple):
    """A lobe's height at its centre, and the slope of its logarithm in log f."""

    height: Float[Array, " pixels"]
    slope: Float[Array, " pixels"]


def peak_of(model: AbstractSpecular, log_exponent: Float[Array, " pixels"]) -> Peak:
    """Peaks of pixels' lobes: a lobe is its peak times a power of the cosine."""
    one = jnp.ones_like(log_exponent)

    def height(t: Array) -> Array:
        return model.lobe(one, jnp.exp(t))

    top, slope = jax.jvp(height, (log_exponent,), (one,))
    return optimization_barrier(Peak(top, slope / top))


def shade(
    model: AbstractSpecular,
    normal: Float[Array, "3 pixels"],
    log_exponent: Float[Array, " pixels"],
    peak: Peak,
    to_light: Float[Array, "3 #pixels"],
    to_viewer: Float[Array, "3 #pixels"],
) -> Shade:
    """Shade of one light, for a specular model whose lobe is a power of the cosine.

    The derivatives of the cosine along the tangents are automatic. The derivatives of
    the power are written out, since XLA would otherwise compute three powers.
    """

    def pixel(
        normal: Vec3, first: Vec3, second: Vec3, light: Vec3, viewer: Vec3
    ) -> tuple[Scalar, ...]:
        # Not renormalised: a step along a tangent keeps the length to first order.
        def cosine(turned: Vec3) -> Scalar:
            return model.cosine(turned, light, viewer)

        c, c1 = jax.jvp(cosine, (normal,), (first,))
        _, c2 = jax.jvp(cosine, (normal,), (second,))
        return c, c1, c2, dot(normal, light), dot(first, light), dot(second, light)

    vectors = normal, *tangents(normal), to_light, to_viewer
    c, c1, c2, d, d1, d2 = at_pixels(pixel, *vectors)
    lit, shiny = d > 0, c > 0
    scale = jnp.where(lit, model.diffuse_scale(), 0)
    base = jnp.where(shiny, c, 1)
    exponent, logarithm = jnp.exp(log_exponent), jnp.log(base)
    s = jnp.where(shiny, peak.height * jnp.exp(exponent * logarithm), 0)
    steep = exponent * s / base
    st = (exponent * logarithm + peak.slope) * s
    return optimization_barrier(
        Shade(scale * d, scale * d1, scale * d2, s, steep * c1, steep * c2, st)
    )


class Image(NamedTuple):
    """The model of one image, (channels, pixels) each: its basis and derivatives."""

    light: Array
    own: Numbers
    shared: Numbers


def model_image(
    point: Point,
    peak: Peak,
    lamps: Lamps,
    image: Array,
    model: AbstractSpecular,
    which: Unknowns,
) -> Image:
    """Light of one image at a point, and its derivatives in all unknowns."""
    nothing = jnp.zeros_like(point.diffuse)
    total = Shade(*[nothing] * 7)
    diffuse, specular = lamps.diffuse[image], lamps.specular[image]
    lights = lamps.to_light[image]
    for j in range(lights.shape[0]):
        one = shade(
            model, point.normal, point.log_exponent, peak, lights[j], lamps.to_viewer
        )
        e, h = diffuse[j], specular[j]
        strength = Shade(e, e, e, h, h, h, h)
        total = Shade(
            *(
                sum_ + each * shape[None]
                for sum_, each, shape in zip(total, strength, one, strict=True)
            )
        )
    ambient = lamps.ambient[image] + nothing
    light = point.ambient * ambient + point.diffuse * total.d + point.specular * total.s
    basis = {"ambient": ambient, "diffuse": total.d, "specular": total.s}
    shared = [
        point.diffuse * total.d1 + point.specular * total.s1,
        point.diffuse * total.d2 + point.specular * total.s2,
    ]
    if which.exponent:
        shared.append(point.specular * total.st)
    if which.one_specular:
        shared.append(total.s)
    own = tuple(basis[name] for name in which.own)
    return Image(light, own, tuple(shared))


def gather(
    point: Point,
    samples: Samples,
    scale: Float[Array, " pixels"],
    loss: AbstractLoss,
    model: AbstractSpecular,
    which: Unknowns,
) -> Sums:
    """All sums at a point, with residuals in units of `scale`."""
    peak = peak_of(model, point.log_exponent)

    def add(image: Array, totals: _Totals) -> _Totals:
        made = model_image(point, peak, samples.lamps, image, model, which)
        share = samples.share[image] / scale[None]
        residual = share * (samples.target[image] - made.light)
        weight = loss_weights(loss, residual) * share
        cost = over_channels(loss.root(residual) ** 2)
        columns, whole, pull, cost = optimization_barrier(
            ((*made.own, *made.shared), weight * share, weight * residual, cost)
        )
        # Stacked, so that one fused loop computes all products of a kind.
        table = optimization_barrier(jnp.stack(columns))
        return totals.add(table, whole, pull, cost)

    images = samples.target.shape[0]
    return jax.lax.fori_loop(0, images, add, _no_totals(samples, which)).sums()


class _Totals(NamedTuple):
    """Running sums over samples, with each kind in one array.

    - `own`: products of all columns with those of each channel's own unknowns.
    - `shared`: products of the shared unknowns' columns, over all channels.
    - `pull`: of all columns with the residuals; `cost`: as in [`Sums`][].
    """

    own: Float[Array, "unknowns own channels pixels"]
    shared: Float[Array, "shared shared pixels"]
    pull: Float[Array, "unknowns channels pixels"]
    cost: Float[Array, " pixels"]

    def add(
        self,
        columns: Float[Array, "unknowns channels pixels"],
        weight: Float[Array, "channels pixels"],
        pull: Float[Array, "channels pixels"],
        cost: Float[Array, " pixels"],
    ) -> "_Totals":
        """The totals plus the products of one image."""
        own = self.own.shape[1]
        weighed = weight[None] * columns
        products = [
            weighed[own:, None, channel] * columns[None, own:, channel]
            for channel in range(len(pull))
        ]
        return _Totals(
            self.own + weighed[:, None] * columns[None, :own],
            self.shared + sum(products[1:], products[0]),
            self.pull + columns * pull[None],
            self.cost + cost,
        )

    def sums(self) -> Sums:
        """The totals as [`Sums`][], with one array for each entry."""
        unknowns, own = self.own.shape[:2]
        shared = range(unknowns - own)
        return Sums(
            tuple(tuple(self.own[i, j] for j in range(i + 1)) for i in range(own)),
            tuple(tuple(self.own[own + i, j] for j in range(own)) for i in shared),
            tuple(tuple(self.shared[i, j] for j in range(i + 1)) for i in shared),
            tuple(self.pull[:own]),
            tuple(over_channels(each) for each in self.pull[own:]),
            self.cost,
        )


def no_sums(samples: Samples, which: Unknowns) -> Sums:
    """Sums over no samples."""
    return _no_totals(samples, which).sums()


def _no_totals(samples: Samples, which: Unknowns) -> _Totals:
    nothing = jnp.zeros_like(samples.target[0])
    own, shared = len(which.own), which.n_shared

    def many(*numbers: int) -> Array:
        return jnp.broadcast_to(nothing, (*numbers, *nothing.shape))

    return _Totals(
        many(own + shared, own),
        many(shared, shared)[:, :, 0],
        many(own + shared),
        nothing[0],
    )


def over_channels(values: Float[Array, "channels pixels"]) -> Float[Array, " pixels"]:
    """Sum over the channels, added row by row."""
    total, *others = values
    for other in others:
        total = total + other
    return total


def residuals(
    point: Point, samples: Samples, model: AbstractSpecular, which: Unknowns
) -> Float[Array, "images channels pixels"]:
    """Residuals (measured − model) · share; 0 for unused samples."""

    peak = peak_of(model, point.log_exponent)

    def image(_: None, number: Array) -> tuple[None, Array]:
        made = model_image(point, peak, samples.lamps, number, model, which)
        return None, samples.share[number] * (samples.target[number] - made.light)

    return jax.lax.scan(image, None, jnp.arange(samples.target.shape[0]))[1]
