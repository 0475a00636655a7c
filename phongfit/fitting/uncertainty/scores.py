r"""Covariance of the scores if noise varies over an image or is shared by samples.

A fit with equal weights is unbiased for any noise, but its errors depend on it. They
follow from the covariance of the sum of scores, $\sum_i
J_i^\top \psi(r_i)$: here where samples of one level round alike, where the channels of
a pixel share their noise, and where noise differs between channels or with light.

??? cite "Source"
    White, *A heteroskedasticity-consistent covariance matrix estimator*, Econometrica
    48(4), 1980. Variances are a line along the light, as those of photons are: Carroll
    and Ruppert, *Transformation and Weighting in Regression*, 1988, chapter 3.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.noise import shared_rounding_variance
from phongfit.fitting.problem.problem import Evaluation, Problem
from phongfit.fitting.solve.sums import EXACT, linearize, linearized
from phongfit.fitting.uncertainty.sandwich import threshold
from phongfit.programs import program

# Iterations of the weighted fit of a line to squared scores.
PASSES = 8
# Lower limit of the line, relative to the mean.
LEAST = 0.02


def with_noise_as_found(
    problem: Problem, y: Float[Array, " n"], correlation: float, unequal: bool
) -> Problem:
    """The problem with a covariance of scores that is estimated from its residuals.

    **Arguments:**

    - `correlation`: correlation of the residuals of a pixel's channels.
    - `unequal`: whether noise differs between channels, or with light.
    """
    found = _scores(problem, y, jnp.asarray(correlation, y.dtype), unequal)
    covariance, steep, plain, variance = (np.asarray(part, float) for part in found)
    if problem.samples.step is not None:
        covariance = covariance + variance * shared_rounding(problem, y)
    root = np.sqrt(np.diag(plain))
    root = np.where(root > 0, root, 1)
    scale = np.outer(root, root)
    scatter = covariance / scale
    if problem.loss.robust:
        # The covariance is later divided by a curvature that assumes one mean slope.
        share = _quotient(plain / scale, steep / scale, float(jnp.finfo(y.dtype).eps))
        scatter = share @ scatter @ share.T
    return dataclasses.replace(problem, scatter=jnp.asarray(scatter, y.dtype))


def _quotient(plain: np.ndarray, steep: np.ndarray, resolution: float) -> np.ndarray:
    """plain · steep⁻¹ in the identified directions; 1 in others."""
    values, vectors = np.linalg.eigh(plain)
    identified = values > threshold(resolution)
    half = vectors[:, identified] * np.sqrt(values[identified])
    dual = vectors[:, identified] / np.sqrt(values[identified])
    rest = vectors[:, ~identified] @ vectors[:, ~identified].T
    return half @ np.linalg.inv(dual.T @ steep @ dual) @ dual.T + rest


@program("unequal")
def _scores(
    problem: Problem,
    y: Float[Array, " n"],
    correlation: Float[Array, ""],
    unequal: bool,
) -> tuple[Array, Array, Array, Array]:
    r"""Covariance of scores; $J^\top J$ with slopes and without; a score's variance."""
    found = linearize(problem, y)
    at, jacobian = found.at, found.jacobian
    used = (problem.samples.weight > 0).astype(y.dtype)
    score, slope = problem.loss.score(at.residual)
    square, own = used * score**2, used * independent_variance(problem, at)
    usual = jnp.sum(square) / jnp.maximum(jnp.sum(own), 1)
    variance = usual if problem.loss.robust else jnp.ones_like(usual)
    steepness, light = None, at.difference + problem.samples.target
    if unequal:
        own = own * jax.vmap(_along_light)(light, square / usual, own)
    if unequal and problem.loss.robust:
        mean = jnp.sum(used * slope) / jnp.maximum(jnp.sum(used), 1)
        steepness = jax.vmap(_along_light)(light, used * slope / mean, used)
    share = jacobian.local * jnp.sqrt(own)[:, None]
    alike = jnp.where(jnp.eye(3, dtype=bool), 1, correlation)
    member = jacobian.members()
    products = jnp.einsum(
        "ckn,dln,gn->gcdkl", share, share, member, precision=EXACT, optimize="optimal"
    )
    covariance = jnp.einsum(
        "gcki,gcdkl,gdlj,cd->ij",
        jacobian.select,
        products,
        jacobian.select,
        alike,
        precision=EXACT,
    )
    return variance * covariance, jacobian.gram(steepness), jacobian.gram(), variance


def _along_light(
    light: Float[Array, " samples"],
    square: Float[Array, " samples"],
    share: Float[Array, " samples"],
) -> Float[Array, " samples"]:
    """Mean of one channel's squared scores, as a linear function of the light.

    **Arguments:** `share`: expected squares up to a factor; 0 if not used.
    """
    total = jnp.maximum(jnp.sum(share), 1)
    mean = jnp.sum(square) / total
    middle = jnp.sum(share * light) / total
    width = jnp.sqrt(jnp.sum(share * (light - middle) ** 2) / total)
    place = (light - middle) / jnp.where(width > 0, width, 1)
    tiny = jnp.finfo(light.dtype).tiny

    def variance(line: tuple[Array, Array]) -> Array:
        return jnp.maximum(line[0] + line[1] * place, LEAST * mean + tiny)

    def fit_anew(_: Array, line: tuple[Array, Array]) -> tuple[Array, Array]:
        # The variance of a square is proportional to the variance squared.
        weight = (mean / variance(line)) ** 2
        total = jnp.sum(weight * share) + tiny
        center = jnp.sum(weight * share * place) / total
        spread = jnp.sum(weight * share * (place - center) ** 2)
        tilt = jnp.sum(weight * square * (place - center))
        slope = jnp.where(spread > 0, tilt / jnp.where(spread > 0, spread, 1), 0)
        return jnp.sum(weight * square) / total - slope * center, slope

    line = (mean, jnp.zeros_like(mean))
    return variance(jax.lax.fori_loop(0, PASSES, fit_anew, line))


def independent_variance(problem: Problem, at: Evaluation) -> Float[Array, "3 samples"]:
    """The part of each residual's variance that is independent of other samples."""
    step = problem.samples.step
    if step is None:
        return at.variance_share
    alone = at.noise**2 * at.variance_share + step**2 / 12
    return (alone - shared_rounding_variance(step, at.noise)) / at.deviation**2


def shared_rounding(problem: Problem, y: Float[Array, " n"]) -> np.ndarray:
    """Covariance of the sum of scores from rounding that samples share.

    Equal colours round equally, so samples of one channel and level are assumed to
    share the part of their rounding error that noise does not dither.
    """
    found, step = linearized(problem, y), problem.samples.step
    jacobian, at = found.jacobian, found.at
    assert step is not None
    common = shared_rounding_variance(step, at.noise) / at.deviation**2
    used = np.asarray(problem.samples.weight).ravel() > 0
    columns = jacobian.columns().reshape(len(y), -1)[:, used]
    share = np.sqrt(np.asarray(common, float))
    target = np.asarray(problem.samples.target).ravel()[used]
    channel = np.repeat(np.arange(3), len(used) // 3)[used]
    level = np.unique(target, return_inverse=True)[1]
    group = np.unique(level * 3 + channel, return_inverse=True)[1]
    sums = [
        np.bincount(group, weights=column * share.ravel()[used]) for column in columns
    ]
    return np.array(sums) @ np.array(sums).T
