r"""Covariance of the scores where noise varies over an image or is shared by samples.

A fit with equal weights is unbiased for any noise, but its errors depend on it. They
follow from the covariance of the sum of scores, $\sum_i J_i^\top \psi(r_i)$. It is the
sum of squares of each pixel's score, so that channels may share their noise, and noise
may differ between channels or with light. Samples of one level round alike.

??? cite "Source"
    White, *A heteroskedasticity-consistent covariance matrix estimator*, Econometrica
    48(4), 1980; Liang and Zeger, *Longitudinal data analysis using generalized linear
    models*, Biometrika 73(1), 1986: clusters of residuals. MacKinnon and White, *Some
    heteroskedasticity-consistent covariance matrix estimators with improved finite
    sample properties*, J. Econometrics 29(3), 1985: HC3.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.noise import shared_rounding_variance
from phongfit.fitting.problem.problem import Evaluation, Problem
from phongfit.fitting.solve.sums import EXACT, linearize, linearized
from phongfit.programs import program

# Least difference of 1 and a sample's leverage.
LEAST = 0.1


def with_noise_as_found(problem: Problem, y: Float[Array, " n"]) -> Problem:
    """The problem with a covariance of scores that is estimated from its residuals."""
    covariance, variance, gram = (np.asarray(p, float) for p in _by_pixel(problem, y))
    if problem.samples.step is not None:
        covariance = covariance + variance * shared_rounding(problem, y)
    root = np.sqrt(np.diag(gram))
    root = np.where(root > 0, root, 1)
    scatter = jnp.asarray(covariance / np.outer(root, root), y.dtype)
    return dataclasses.replace(problem, scatter=scatter)


@program()
def _by_pixel(problem: Problem, y: Float[Array, " n"]) -> tuple[Array, Array, Array]:
    r"""Sum of squared scores of pixels, mean square of a score, and $J^\top J$.

    A fit shrinks the residual of a sample that determines much of the answer, by its
    leverage $h$; the score is therefore divided by $1 - h$ (HC3).
    """
    found = linearize(problem, y)
    jacobian, used = found.jacobian, problem.samples.weight > 0
    score = jnp.where(used, problem.loss.score(found.at.residual)[0], 0)
    select, gram = jacobian.select, jacobian.gram()
    inverse = jnp.linalg.pinv(gram, hermitian=True)
    apart = jnp.einsum("gcki,ij,gclj->gckl", select, inverse, select, precision=EXACT)
    leverage = jnp.einsum(
        "ckn,gckl,cln,gn->cn",
        jacobian.local,
        apart,
        jacobian.local,
        jacobian.members(),
        precision=EXACT,
    )
    weighed = score / jnp.maximum(1 - leverage, LEAST)
    share, count = jacobian.local * weighed[:, None], jnp.sum(used).astype(y.dtype)
    products = jnp.einsum(
        "ckn,dln,gn->gcdkl",
        share,
        share,
        jacobian.members(),
        precision=EXACT,
        optimize="optimal",
    )
    covariance = jnp.einsum(
        "gcki,gcdkl,gdlj->ij", select, products, select, precision=EXACT
    )
    # A fit makes its residuals smaller than the noise.
    free = int(np.count_nonzero(~problem.unknowns.y_nuisance))
    freedom = jnp.maximum(count - free, 1)
    return covariance * count / freedom, jnp.sum(score**2) / count, gram


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
