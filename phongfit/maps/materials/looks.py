"""Fits of blocks of sampled pixels under a given material, compiled once."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.maps.materials.bases import as_known, everything, held, reduce, sought
from phongfit.maps.pixel.block import samples_of
from phongfit.maps.pixel.samples import Known, Outside, Samples, Tile
from phongfit.maps.pixel.scale import count_used, final_scale, loss_weights
from phongfit.maps.pixel.search import descend, search
from phongfit.maps.pixel.settings import MapSettings, Point, unknowns_of
from phongfit.maps.pixel.small import KEEP_BARRIERS, curvatures
from phongfit.maps.pixel.step import (
    Move,
    edges_of,
    free_to_move,
    moved,
    reduce_sums,
)
from phongfit.maps.pixel.sums import gather, residuals

# Maximum number of evaluated points from a start nearby, and limits of convergence.
STEPS = 12
ROUGH, FINE = 0.1, 1e-4

compiled = functools.partial(
    jax.jit, static_argnames=("settings",), compiler_options=KEEP_BARRIERS
)


class Alone(NamedTuple):
    """Fits of pixels with separate highlights and one ρ_s for all channels.

    - `level`: root mean square of the residuals per degree of freedom.
    - `used`: number of samples in use; `sound`: whether the pixel is reliable.
    """

    samples: Samples
    point: Point
    level: Float[Array, " pixels"]
    used: Float[Array, " pixels"]
    sound: Float[Array, " pixels"]


@compiled
def fit_alone(tile: Tile, outside: Outside, settings: MapSettings) -> Alone:
    """Fit each pixel with a separate highlight."""
    settings = dataclasses.replace(settings, one_specular=True)
    samples, _ = samples_of(tile, outside, settings)
    which = unknowns_of(settings)
    found = search(samples, outside.known.spread(), outside.noise, settings, which)
    unknowns, count = settings.unknowns(), count_used(samples.share)
    level = final_scale(found.left, samples.share, found.scale, settings.loss, unknowns)
    lit = jnp.any(samples.target > 0, axis=(0, 1))
    return Alone(samples, found.point, level, count, lit & (count > unknowns))


class Row(NamedTuple):
    r"""Pixels at one exponent, with costs $c + h (\rho_s - \hat\rho_s)^2$."""

    point: Point
    cost: Float[Array, " pixels"]
    strength: Float[Array, " pixels"]
    curvature: Float[Array, " pixels"]


@compiled
def fit_row(
    samples: Samples,
    start: Point,
    scale: Float[Array, " pixels"],
    log_exponent: Float[Array, ""],
    settings: MapSettings,
) -> Row:
    """Fit all other unknowns at an exponent, from a start."""
    settings = dataclasses.replace(settings, one_specular=True)
    which = unknowns_of(settings)._replace(exponent=False)
    t = jnp.full_like(start.log_exponent, log_exponent)
    begin = start._replace(log_exponent=t)
    end = descend(begin, samples, scale, STEPS, ROUGH, settings, which)
    free = free_to_move(end.point, end.sums, which, edges_of(settings, which))
    shared = (*free.shared[:2], jnp.ones_like(free.shared[0]))
    reduced = reduce_sums(end.sums, jnp.zeros_like(scale), free._replace(shared=shared))
    return Row(
        end.point, end.cost, end.point.specular[0], curvatures(reduced.shared)[2]
    )


class Look(NamedTuple):
    """Fits of pixels under one material, with gradient and curvature of its unknowns.

    - `pull`, `curvature`, `log_det`: as in [`Reduced`][]; the pull is corrected for the
        bias by errors of the normals.
    - `kept`, `steepness`: sums over the samples of the loss's weights, and of the slope
        of weight times residual.
    """

    point: Point
    cost: Float[Array, " pixels"]
    pull: Float[Array, "unknowns pixels"]
    curvature: Float[Array, "unknowns unknowns pixels"]
    log_det: Float[Array, " pixels"]
    kept: Float[Array, " pixels"]
    steepness: Float[Array, " pixels"]


@compiled
def look_at(
    samples: Samples,
    start: Point,
    scale: Float[Array, " pixels"],
    values: Float[Array, " unknowns"],
    known: Known,
    settings: MapSettings,
) -> Look:
    """Fit each pixel's own unknowns under a material, from a start."""
    mine, which = sought(settings), everything(settings)
    given = as_known(values, known)
    begin = start._replace(
        log_exponent=jnp.full_like(start.log_exponent, values[0]),
        specular=jnp.broadcast_to(given.specular[:, None], start.diffuse.shape),
    )
    end = descend(begin, samples, scale, STEPS, FINE, held(settings), mine)
    sums = gather(end.point, samples, scale, settings, which)
    free = free_to_move(end.point, sums, mine, edges_of(settings, mine))
    reduced = reduce(sums, free)
    bent = _bent(end.point, reduced.turns, samples, settings)
    more = reduce(gather(end.point, bent, scale, settings, which), free).pull
    left = residuals(end.point, samples, settings, mine) / scale[None, None]
    used = samples.share > 0
    _, slope = settings.loss.score(left)
    weight = loss_weights(settings.loss, left)
    return Look(
        end.point,
        sums.cost,
        reduced.pull + _strayed(settings.loss) * more,
        reduced.curvature,
        reduced.log_det,
        jnp.sum(jnp.where(used, weight, 0), axis=(0, 1)),
        jnp.sum(jnp.where(used, slope, 0), axis=(0, 1)),
    )


def _strayed(loss: AbstractLoss) -> Float[Array, ""]:
    r"""Factor from the bias under least squares to the bias under a robust loss.

    It is $E\,\psi^2 \, E\,w / E\,\psi'$ for normal residuals: the variance of estimates
    has a factor of $E\,\psi^2 / (E\,\psi')^2$, the gradient one of $E\,\psi'$, and the
    weights of the sums have the mean $E\,w$.
    """
    r = jnp.linspace(-8, 8, 401)
    density = jnp.exp(-(r**2) / 2)
    value, slope = loss.score(r)
    square, weight, steep = (
        jnp.sum(density * each) for each in (value**2, loss_weights(loss, r), slope)
    )
    return square * weight / steep / jnp.sum(density)


def _bent(
    point: Point,
    turned: tuple[Move, Move],
    samples: Samples,
    settings: MapSettings,
) -> Samples:
    r"""Samples whose residuals are the bias of the light by errors of the normals.

    A highlight is curved: its mean over the normals within a pixel's error differs from
    the light at the mean normal by $\tfrac12 \operatorname{tr} V \mu''$. The estimates
    of pixels are therefore biased, and the bias of thousands of pixels does not cancel.

    ??? cite "Source"
        Box, *Bias in nonlinear estimation*, J. R. Stat. Soc. B 33(2), 1971.
    """
    which = sought(settings)
    edges = edges_of(settings, which)

    def left(moved_to: Point) -> Array:
        return residuals(moved_to, samples, settings, which)

    def aside(signed: tuple[Move, Array]) -> Array:
        move, sign = signed
        step = Move(*jax.tree.map(lambda leaf: sign * leaf, move))
        return left(moved(point, step, samples.lamps.to_viewer, which, edges))

    here = left(point)
    four = [(move, sign) for move in turned for sign in (1.0, -1.0)]
    moves = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[move for move, _ in four])
    signs = jnp.asarray([sign for _, sign in four], here.dtype)
    mean = jnp.sum(jax.lax.map(aside, (moves, signs)), axis=0) / 2 - 2 * here
    used = samples.share > 0
    off = jnp.where(used, (-mean - here) / jnp.where(used, samples.share, 1), 0)
    return samples._replace(target=samples.target + off)
