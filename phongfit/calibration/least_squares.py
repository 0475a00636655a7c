"""Least squares of residuals in JAX: exact Jacobians, solved by SciPy.

All computations are in double precision, independent of JAX's setting.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.fitting.problem.losses import Tukey
from phongfit.programs import compiler_options

TUKEY = Tukey().k
"""Residuals from this many standard deviations on have weight 0."""


BLOCK = 16
"""Side of squares in which errors of pixels are correlated, as in JPEG's chroma blocks.
"""


class Solution(NamedTuple):
    """Unknowns at the minimum, with the residuals and their Jacobian there."""

    values: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, " m"]
    jacobian: Float[np.ndarray, "m n"]

    @property
    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Covariance for residuals of variance 1; 0 for directions without data."""
        return np.linalg.pinv(self.jacobian.T @ self.jacobian)

    @property
    def hat(self) -> Float[np.ndarray, " m"]:
        """Leverage of each residual: degrees of freedom that the unknowns use."""
        return np.vecdot(self.jacobian @ self.covariance, self.jacobian)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """A JAX function that takes and returns NumPy arrays, in double precision.

    Its compiled programs are freed together with it, so that a process which calibrates
    many captures does not accumulate them.
    """
    program = jax.jit(function, compiler_options=compiler_options())

    def run(*args: Any) -> Any:
        # Python and NumPy numbers have different types: JAX would compile twice.
        args = jax.tree.map(np.asarray, args)
        with (
            jax.enable_x64(True),
            # Functions that also run in NumPy need NumPy's promotion rules.
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
        ):
            return jax.tree.map(np.array, program(*args))

    return run


def differentiated(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that also returns its Jacobian by its first argument, a vector."""

    def both(values: Any, *args: Any) -> Any:
        result = function(values, *args)
        return result, result

    program = compiled(jax.jacfwd(both, has_aux=True))

    def run(values: Any, *args: Any) -> Any:
        jacobian, value = program(np.asarray(values, float), *args)
        return value, jacobian

    return run


def least_squares(
    residual: Callable[..., Any],
    start: Float[np.ndarray, " n"],
    *args: Any,
    upper: Float[np.ndarray, " n"] | float = np.inf,
) -> Solution:
    """Minimise the sum of squares of a [`differentiated`][] residual.

    **Arguments:**

    - `residual`: called with the unknowns and `args`.
    - `upper`: bounds of the unknowns.
    """
    from scipy import optimize

    # SciPy needs the Jacobian at a point right after the residuals there.
    @functools.lru_cache(maxsize=1)
    def at(values: bytes) -> Any:
        return residual(np.frombuffer(values), *args)

    found = optimize.least_squares(
        lambda values: at(values.tobytes())[0],
        start,
        lambda values: at(values.tobytes())[1],  # pyright: ignore[reportArgumentType]
        (-np.inf, upper),
        # MINPACK decomposes large Jacobians faster, but does not support bounds.
        "lm" if np.isinf(upper).all() else "trf",
    )
    return Solution(found.x, found.fun, found.jac)


def robust_scale(residual: Float[np.ndarray, " m"]) -> float:
    """Robust standard deviation of residuals, from their median absolute value."""
    return 1.4826 * float(np.median(np.abs(residual)))


def tukey_weight(
    residual: Float[np.ndarray, "*m"], sigma: float
) -> Float[np.ndarray, "*m"]:
    """Weights of Tukey's biweight, for residuals with standard deviation `sigma`."""
    return np.clip(1 - (residual / (TUKEY * sigma)) ** 2, 0, None) ** 2


def summed_by_block(
    scores: Float[np.ndarray, "m n"], block: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "blocks n"]:
    """Sums over samples whose errors are correlated, for a sandwich covariance."""
    _, group = np.unique(block, return_inverse=True)
    sums = np.zeros((np.max(group, initial=-1) + 1, scores.shape[1]))
    np.add.at(sums, group, scores)
    return sums


def blocks(
    height: int, width: int, side: int = BLOCK
) -> Int[np.ndarray, "height width"]:
    """The number of each pixel's block of correlated errors."""
    rows, columns = np.mgrid[:height, :width] // side
    return rows * (width // side + 1) + columns


def thinned(
    mask: Bool[np.ndarray, "height width"], most: int
) -> Bool[np.ndarray, "height width"]:
    """An even sample of about `most` pixels of a mask."""
    stride = max(1, round(np.sqrt(mask.sum() / most)))
    kept = np.zeros_like(mask)
    kept[::stride, ::stride] = True
    return mask & kept


def clamped_mean(light: Any, sigma: float) -> Any:
    """Mean of noisy light after the clamp at black."""
    from scipy.special import ndtr

    ratio = light / sigma
    density = np.exp(-(ratio**2) / 2) / np.sqrt(2 * np.pi)
    return light * ndtr(ratio) + sigma * density
