r"""Errors that a fit inherits from what its scenes say.

A fit holds lights where a calibration found them. Were these off by $\delta$, the
solution would be off by $-B^{-1} C \delta$, to first order, where B is the curvature of
the cost in the unknowns and C the mixed one in unknowns and lights. So their covariance
$\Sigma$ adds $C \Sigma C^\top$ to the covariance of the cost's gradient.

??? cite "Source"
    Murphy and Topel, *Estimation and inference in two-step econometric models*, J.
    Business & Economic Statistics 3(4), 1985.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.uncertain import Nuisance
from phongfit.fitting.uncertainty.statistics import sandwich_sums


def with_inherited(
    problem: Problem, y: Float[Array, " n"], nuisance: Nuisance
) -> Problem:
    """The problem with the share of its scores' covariance that scenes bring."""
    wider, there = nuisance.beside(problem, y)
    bread = np.asarray(sandwich_sums(wider, there).bread, float)
    mixed = bread[: len(y), len(y) :]
    spread = nuisance.solver_covariance(there, len(y))
    inherited = mixed @ spread @ mixed.T
    return dataclasses.replace(problem, inherited=jnp.asarray(inherited, y.dtype))
