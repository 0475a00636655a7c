"""Start values of normals, from matte surfaces and from the brightest highlight."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.problem.losses import Cauchy
from phongfit.maps.pixel.lighting import facing, grey
from phongfit.maps.pixel.samples import Samples
from phongfit.maps.pixel.scale import loss_weights, median_scale
from phongfit.maps.pixel.settings import turned_to, unit
from phongfit.maps.pixel.small import Numbers, Triangle, factorize, solve

# Rounds of reweighting of a matte surface.
ROUNDS = 5


class Matte(NamedTuple):
    """A matte surface fitted to grey samples.

    - `normal`: (3, pixels); `diffuse`: (pixels,), ρ_d.
    - `scale`: (pixels,), robust standard deviation of its residuals.
    """

    normal: Float[Array, "3 pixels"]
    diffuse: Float[Array, " pixels"]
    scale: Float[Array, " pixels"]


class Starts(NamedTuple):
    """Start normals, (starts, 3, pixels), and the robust matte surface."""

    normals: Float[Array, "starts 3 pixels"]
    matte: Matte


def greyed(samples: Samples) -> Samples:
    """Samples with one channel, the sum of all; unused if any channel is unused."""
    share = samples.share
    whole = jnp.all(share > 0, axis=1, keepdims=True)
    variance = 1 / jnp.where(share > 0, share, 1) ** 2
    summed = 1 / jnp.sqrt(jnp.sum(variance, axis=1, keepdims=True))
    return Samples(
        jnp.where(whole, jnp.sum(samples.target, axis=1, keepdims=True), 0),
        jnp.where(whole, summed, 0),
        grey(samples.lamps),
    )


def make_starts(samples: Samples) -> Starts:
    """Start normals for grey samples.

    The three starts are a matte surface fitted by least squares, one fitted robustly to
    the lit samples, and a surface that mirrors the brightest light to the viewer.
    """
    vector = facing(samples.lamps)
    target, share = samples.target[:, 0], samples.share[:, 0]
    viewer = samples.lamps.to_viewer
    plain = _matte(vector, target, share)

    def again(_: Array, found: Array) -> Array:
        return _matte(vector, target, share * _kept(found, vector, target, share))

    robust = jax.lax.fori_loop(0, ROUNDS, again, plain)
    residual = share * (target - jnp.maximum(shown_by(robust, vector), 0))
    scale = median_scale(residual[:, None], share[:, None], 3)
    diffuse = jnp.sqrt(jnp.sum(robust**2, axis=0))
    mirror = _mirroring(vector, target, share, viewer)
    normals = [turned_to(one, viewer) for one in (plain, robust, mirror)]
    return Starts(jnp.stack(normals), Matte(normals[1], diffuse, scale))


def shown_by(
    vector: Float[Array, "3 pixels"], lights: Float[Array, "images 3 #pixels"]
) -> Float[Array, "images pixels"]:
    """Light ρ n · e s of a matte surface in all images.

    **Arguments:** `vector`: ρ n; `lights`: the light vectors e s.
    """
    return sum(
        (lights[:, k] * vector[k][None] for k in range(1, 3)),
        lights[:, 0] * vector[0][None],
    )


def _matte(lights: Array, target: Array, share: Array) -> Float[Array, "3 pixels"]:
    """Vector ρ n of a matte surface by weighted least squares."""
    weighed = [share**2 * lights[:, k] for k in range(3)]
    matrix: Triangle = tuple(
        tuple(jnp.sum(weighed[i] * lights[:, j], axis=0) for j in range(i + 1))
        for i in range(3)
    )
    side: Numbers = tuple(jnp.sum(row * target, axis=0) for row in weighed)
    return jnp.stack(solve(factorize(matrix), side))


def _kept(vector: Array, lights: Array, target: Array, share: Array) -> Array:
    """Square roots of robust weights of the lit samples; 0 for unlit ones."""
    shown = shown_by(vector, lights)
    lit = (shown > 0) & (share > 0)
    residual = jnp.where(lit, share * (target - shown), 0)
    scale = median_scale(residual[:, None], lit[:, None].astype(share.dtype), 0)
    relative = residual / jnp.where(scale > 0, scale, 1)[None]
    # Squared, since highlights and shadows are larger than the tails of a distribution.
    weight = loss_weights(Cauchy(), relative) ** 2
    return jnp.where(lit, jnp.sqrt(weight), 0)


def _mirroring(lights: Array, target: Array, share: Array, viewer: Array) -> Array:
    """Sum of unit vectors to the viewer and to the light of the brightest sample."""
    strength = jnp.sqrt(jnp.sum(lights**2, axis=1))
    bright = jnp.where(share > 0, target / jnp.where(strength > 0, strength, 1), -1)
    brightest = jnp.argmax(bright, axis=0)[None]
    lamp = [
        jnp.take_along_axis(jnp.broadcast_to(lights[:, k], target.shape), brightest, 0)
        for k in range(3)
    ]
    return unit(jnp.concatenate(lamp)) + viewer
