r"""Residuals, and the sums over all images that a step needs, in one pass.

Pixels are the last axis, so that each sum adds long rows. Images are processed one by
one: a compiler would otherwise repeat intermediate computations for every sum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from phongfit.maps.pixel.lighting import Lamps, at_pixels
from phongfit.maps.pixel.lobes import Lobe
from phongfit.maps.pixel.samples import Samples
from phongfit.maps.pixel.scale import loss_weights
from phongfit.maps.pixel.settings import MapSettings, Point, Unknowns, tangents
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
    """Light on pixels: Lambert's D, the lobe S, and their derivatives.

    `d_turned`, `s_turned` are derivatives along the two tangents of the normal, if it
    is unknown; `st` is that of S with respect to log f.
    """

    d: Array
    d_turned: Numbers
    s: Array
    s_turned: Numbers
    st: Array


def shade(
    model: AbstractSpecular,
    normal: Float[Array, "3 pixels"],
    lobe: Lobe,
    directions: tuple[Float[Array, "3 pixels"], ...],
    to_light: Float[Array, "3 #pixels"],
    to_viewer: Float[Array, "3 #pixels"],
) -> Shade:
    """Shade of one light; `directions` are the tangents of an unknown normal."""

    def pixel(normal: Vec3, light: Vec3, viewer: Vec3, *directions: Vec3) -> tuple:
        # Not renormalised: a step along a tangent keeps the length to first order.
        def cosine(turned: Vec3) -> PyTree[Scalar]:
            return model.cosine(turned, light, viewer)

        turned = [jax.jvp(cosine, (normal,), (one,))[1] for one in directions]
        along = [dot(one, light) for one in directions]
        return cosine(normal), turned, dot(normal, light), along

    vectors = normal, to_light, to_viewer, *directions
    cosine, turned, d, along = at_pixels(pixel, *vectors)
    scale = jnp.where(d > 0, model.diffuse_scale(), 0)
    s, steep, st = lobe(cosine, turned)
    tilted = tuple(scale * one for one in along)
    return optimization_barrier(Shade(scale * d, tilted, s, steep, st))


class Image(NamedTuple):
    """The model of one image, (channels, pixels) each: its basis and derivatives."""

    light: Array
    own: Numbers
    shared: Numbers


def model_image(
    point: Point,
    lobe: Lobe,
    lamps: Lamps,
    image: Array,
    model: AbstractSpecular,
    which: Unknowns,
) -> Image:
    """Light of one image at a point, and its derivatives in all unknowns."""
    nothing = jnp.zeros_like(point.diffuse)
    directions = tangents(point.normal) if which.normal else ()
    still = (nothing,) * len(directions)
    total = Shade(nothing, still, nothing, still, nothing)
    diffuse, specular = lamps.diffuse[image], lamps.specular[image]
    lights = lamps.to_light[image]
    for j in range(lights.shape[0]):
        one = shade(model, point.normal, lobe, directions, lights[j], lamps.to_viewer)
        e, h = diffuse[j], specular[j]
        strength = Shade(e, (e,) * len(still), h, (h,) * len(still), h)
        total = jax.tree.map(
            lambda sum_, each, shape: sum_ + each * shape[None], total, strength, one
        )
    if lamps.around is not None:
        total = total._replace(d=total.d + lamps.around[image])
    ambient = lamps.ambient[image] + nothing
    light = point.ambient * ambient + point.diffuse * total.d + point.specular * total.s
    basis = {"ambient": ambient, "diffuse": total.d, "specular": total.s}
    shared = [
        point.diffuse * d + point.specular * s
        for d, s in zip(total.d_turned, total.s_turned, strict=True)
    ]
    if which.exponent:
        shared.append(point.specular * total.st)
    if which.one_specular:
        shared.append(total.s)
    if which.each_specular:
        channels = jnp.eye(3, dtype=total.s.dtype)
        shared.extend(total.s * channel[:, None] for channel in channels)
    own = tuple(basis[name] for name in which.own)
    return Image(light, own, tuple(shared))


def gather(
    point: Point,
    samples: Samples,
    scale: Float[Array, " pixels"],
    settings: MapSettings,
    which: Unknowns,
) -> Sums:
    """All sums at a point, with residuals in units of `scale`."""
    loss, model = settings.loss, settings.model
    lobe = settings.lobe(point.log_exponent)

    def add(image: Array, totals: _Totals) -> _Totals:
        made = model_image(point, lobe, samples.lamps, image, model, which)
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
    point: Point, samples: Samples, settings: MapSettings, which: Unknowns
) -> Float[Array, "images channels pixels"]:
    """Residuals (measured − model) · share; 0 for unused samples."""

    lobe, model = settings.lobe(point.log_exponent), settings.model

    def image(_: None, number: Array) -> tuple[None, Array]:
        made = model_image(point, lobe, samples.lamps, number, model, which)
        return None, samples.share[number] * (samples.target[number] - made.light)

    return jax.lax.scan(image, None, jnp.arange(samples.target.shape[0]))[1]
