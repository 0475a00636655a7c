r"""Materials by maximum likelihood, where each pixel is of one unknown material.

Expectation-maximisation alternates between the probability of each material in each
pixel, and Gauss-Newton steps of the materials with the weighted sum over all pixels,
$\sum_p r_{pk} H_p$. For the probabilities, the normal is integrated over by Laplace's
approximation, so that a material is not preferred because it determines the normal
less.

??? cite "Source"
    Dempster, Laird and Rubin, *Maximum likelihood from incomplete data via the EM
    algorithm*, J. R. Stat. Soc. B 39(1), 1977; Louis, *Finding the observed information
    matrix when using the EM algorithm*, J. R. Stat. Soc. B 44(2), 1982; Schwarz,
    *Estimating the dimension of a model*, Ann. Stat. 6(2), 1978; White, *Maximum
    likelihood estimation of misspecified models*, Econometrica 50(1), 1982.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from phongfit.fitting.uncertainty.identifiability import SEEN, stands_out

# Maximum number of rounds, and the square of a step in standard errors that ends them.
ROUNDS = 30
SMALL = 1e-3
# Longest steps in log f and in ρ_s.
LONGEST = np.array([0.5, 0.2, 0.2, 0.2])
# Standard error of log f above which f is not identified.
LOST = 1.0


class Told(NamedTuple):
    """Cost, gradient and curvature of each pixel for one material: see [`Reduced`][].

    `steepness` is the ratio of the mean slope of weight times residual to the mean
    weight of the loss.
    """

    cost: Float[np.ndarray, " pixels"]
    log_det: Float[np.ndarray, " pixels"]
    pull: Float[np.ndarray, "pixels unknowns"]
    curvature: Float[np.ndarray, "pixels unknowns unknowns"]
    steepness: float


class Mixture(NamedTuple):
    r"""K materials, and how well they explain the pixels.

    - `values`: (K, unknowns), $\log f$ and $\rho_s$.
    - `shares`: (K,), fractions of the pixels.
    - `criterion`: BIC; less is better.
    - `covariance`: (K, unknowns, unknowns), of each material.
    """

    values: Float[np.ndarray, "materials unknowns"]
    shares: Float[np.ndarray, " materials"]
    criterion: float
    covariance: Float[np.ndarray, "materials unknowns unknowns"]


def maximize(
    values: Float[np.ndarray, "materials unknowns"],
    look: Callable[[int, np.ndarray], Told],
    edges: tuple[np.ndarray, np.ndarray],
    free: int | None = None,
) -> Mixture:
    """Maximise the likelihood of materials from start values.

    **Arguments:**

    - `look`: function from a material's number and values to the pixels' `Told`.
    - `edges`: low and high of each unknown.
    - `free`: number of fitted numbers, for BIC; default: all values and the shares.
    """
    count, unknowns = values.shape
    shares = np.full(count, 1 / count)
    told: list[Told] = []
    odds, total = np.zeros((0, 0)), 0.0
    converged = False
    for _ in range(ROUNDS):
        told = [look(k, values[k]) for k in range(count)]
        odds, total = _odds(told, shares)
        shares = odds.mean(axis=1)
        if converged:
            break
        moved = np.zeros(count)
        for k in range(count):
            pull, curvature = odds[k] @ told[k].pull, _summed(odds[k], told[k])
            step = np.linalg.pinv(curvature, rcond=1e-10, hermitian=True) @ pull
            step = np.clip(step, -LONGEST[:unknowns], LONGEST[:unknowns])
            new = np.clip(values[k] + step, *edges)
            moved[k] = (new - values[k]) @ curvature @ (new - values[k])
            values = np.concatenate([values[:k], new[None], values[k + 1 :]])
        converged = bool(moved.max() < SMALL)
    pixels = odds.shape[1]
    if free is None:
        free = count * unknowns + count - 1
    criterion = -2 * total + free * np.log(pixels)
    return Mixture(values, shares, criterion, _covariance(told, odds, values))


def _odds(
    told: list[Told], shares: np.ndarray
) -> tuple[Float[np.ndarray, "materials pixels"], float]:
    """Probability of each material in each pixel, and the total log-likelihood."""
    with np.errstate(divide="ignore"):
        share = np.log(shares)
    logs = np.stack(
        [s - (one.cost + one.log_det) / 2 for s, one in zip(share, told, strict=True)]
    )
    top = logs.max(axis=0)
    whole = np.exp(logs - top)
    summed = whole.sum(axis=0)
    return whole / summed, float((top + np.log(summed)).sum())


def _summed(odds: np.ndarray, told: Told) -> np.ndarray:
    return np.einsum("p,pij->ij", odds, told.curvature)


def _covariance(
    told: list[Told], odds: np.ndarray, values: np.ndarray
) -> Float[np.ndarray, "materials unknowns unknowns"]:
    """Covariance of each material, by a sandwich estimate over the pixels.

    The variance of an exponent that is not identified is infinite, for example if the
    highlight is not significant.
    """
    count, unknowns = len(told), told[0].pull.shape[1]
    each = list(zip(odds, told, strict=True))
    scores = np.concatenate([o[:, None] * one.pull for o, one in each], axis=1)
    spread = scores.T @ scores
    blocks = [one.steepness * _summed(o, one) for o, one in each]
    lost = [np.einsum("p,pi,pj->ij", o, one.pull, one.pull) for o, one in each]
    information = block_diag(*np.subtract(blocks, lost)) + spread
    alone = np.concatenate([np.diag(block) for block in blocks])
    seen = alone > 0
    seen[::unknowns] &= alone[::unknowns] > 1 / LOST**2
    root = np.sqrt(np.where(seen, alone, 1))
    inner = np.where(seen[:, None] & seen, information / np.outer(root, root), 0)
    inverse = np.linalg.pinv(inner, rcond=1e-6, hermitian=True)
    inverse = inverse / np.outer(root, root)
    covariance = inverse @ spread @ inverse
    own = range(count)
    blocks = covariance.reshape(count, unknowns, count, unknowns)[own, :, own]
    hidden = ~seen.reshape(count, unknowns)
    hidden[:, 0] |= [
        not stands_out(own[1:], block[1:, 1:], SEEN, chosen=1)
        for own, block in zip(values, blocks, strict=True)
    ]
    blocks[hidden] = 0
    blocks[:, :, 0][hidden[:, 0]] = 0
    blocks[np.nonzero(hidden)[0], np.nonzero(hidden)[1], np.nonzero(hidden)[1]] = np.inf
    return blocks
