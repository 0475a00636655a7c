"""What a fit gives back."""

import dataclasses
from typing import Any

import numpy as np

from phongfit.fitting.table import fit_table
from phongfit.material import Material


@dataclasses.dataclass(frozen=True, repr=False)
class Fit:
    """A material with its uncertainty, and how it came about.

    Arrays are NumPy's; entries of `values`, `errors`, `covariance` and the flags are in
    the order of `labels`.
    """

    material: Material
    stderr: Material
    labels: tuple[str, ...]
    values: np.ndarray
    errors: np.ndarray
    covariance: np.ndarray
    at_bound: np.ndarray
    untold: np.ndarray
    bounds: np.ndarray
    fitted: Any
    residuals: Any
    noise: float
    noise_given: bool
    samples: int
    images: int
    chi_squared: float
    neighbour_correlation: float
    loss: str
    model: str
    film: str
    converged: bool
    steps: int
    reason: str
    warnings: tuple[str, ...]

    @property
    def degrees_of_freedom(self) -> int:
        """Samples less unknowns that were free."""
        return self.samples - int(np.sum(~self.at_bound & ~self.untold))

    @property
    def reduced_chi_squared(self) -> float:
        """χ² a degree of freedom: near 1 where the noise given is right."""
        return self.chi_squared / max(self.degrees_of_freedom, 1)

    @property
    def correlation(self) -> np.ndarray:
        """Correlations of the unknowns; NaN for those at a bound or not told."""
        deviation = np.sqrt(np.diag(self.covariance))
        deviation = np.where(np.isfinite(deviation), deviation, np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / np.outer(deviation, deviation)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the images, in plain numbers, lists and strings."""
        leaves = ("ambient", "diffuse", "specular", "shininess", "emission")
        return {
            "material": {k: np.asarray(getattr(self.material, k)) for k in leaves},
            "stderr": {k: np.asarray(getattr(self.stderr, k)) for k in leaves},
            "labels": list(self.labels),
            "values": self.values,
            "errors": self.errors,
            "covariance": self.covariance,
            "at_bound": self.at_bound,
            "untold": self.untold,
            "noise": self.noise,
            "samples": self.samples,
            "reduced_chi_squared": self.reduced_chi_squared,
            "neighbour_correlation": self.neighbour_correlation,
            "loss": self.loss,
            "model": self.model,
            "film": self.film,
            "converged": self.converged,
            "steps": self.steps,
            "reason": self.reason,
            "warnings": list(self.warnings),
        }

    def __str__(self) -> str:
        return fit_table(self)

    def __repr__(self) -> str:
        return fit_table(self)


Fit.__init__.__doc__ = """**Arguments:**

- `material`, `stderr`: the estimate, and a material of its standard errors: infinite
    for what cannot be told, 0 for what was known.
- `labels`, `values`, `errors`: the unknowns as vectors, such as `diffuse.red`.
- `covariance`: of `values`. NaN rows for unknowns at a bound or not told.
- `at_bound`: true where the estimate lies on its bound. Its error is then one-sided:
    how far into the box the data let it go.
- `untold`: true where the data leave the value open.
- `bounds`: (n, 2), lower and upper.
- `fitted`, `residuals`: images (H, W, 3), linear light, one or a tuple as they were
    given; `residuals` is image − fitted, 0 where a sample was left out.
- `noise`: standard deviation of a sample, in linear light where white is 1.
- `samples`: pixels times channels used.
- `chi_squared`: sum of the squared residuals in standard deviations.
- `neighbour_correlation`: of residuals; well above 0 where the model does not describe
    the image. Errors are then widened.
- `converged`, `steps`, `reason`: how the solver ended.
- `warnings`: plain sentences.
"""
