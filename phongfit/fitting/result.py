"""The result of a fit."""

import dataclasses
import math
import os
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.edge import checked
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.search import SearchResult
from phongfit.fitting.uncertainty.bootstrap import Bootstrap, bootstrap
from phongfit.fitting.uncertainty.convergence import trace_convergence
from phongfit.fitting.uncertainty.diagnostics import (
    MOST_PROFILES,
    MOST_SAMPLES,
    Diagnostics,
    choose_profiles,
)
from phongfit.fitting.uncertainty.misfit import Misfit
from phongfit.fitting.uncertainty.numbers import parameter_rows
from phongfit.fitting.uncertainty.profile import LEVELS, profile, profile_pair
from phongfit.fitting.uncertainty.quantiles import student_reach
from phongfit.fitting.uncertainty.region import Region
from phongfit.material import Material
from phongfit.plain import plain
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Arrays (H, W, 3): one, or a tuple with one for each scene.
Images: TypeAlias = np.ndarray | tuple[np.ndarray, ...]


class Estimate(NamedTuple):
    """Estimate of a parameter, or of one of its numbers."""

    value: np.ndarray
    error: np.ndarray
    at_bound: np.ndarray
    unidentified: np.ndarray


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Fit:
    """A fitted material with its uncertainty, the residuals, and how the solver ended.

    `print` shows the table. Arrays are NumPy's; entries of `values`, `errors`,
    `covariance` and the flags are in the order of `labels`. `fit["diffuse"]` or
    `fit["diffuse.red"]` is an [`Estimate`][]. Fits are compared by identity.

    **Fields:**

    - `specification`: the options of the fit.
    - `films`: the film of each image, detected or given.
    - `material`, `stderr`: the estimate, and a material of its standard errors:
        infinite for numbers that are not identifiable, 0 for known ones.
    - `scene`, `exposure`: the scene or scenes with the fitted values of their unknowns,
        and the factor on each image's light.
    - `labels`, `values`, `errors`: the unknowns as vectors, such as `diffuse.red`. An
        error is the larger side of the interval in which Δχ² stays below 1.
    - `covariance`: covariance of `values`, with unknowns at a bound held there. Rows
        are NaN for unknowns at a bound or not identified. They are NaN too if a bound
        or a barely identified exponent makes an error more than a quarter larger than
        this.
    - `at_bound`: true where the estimate lies on its bound. Its error is then
        one-sided, towards the inside of the box.
    - `unidentified`: true where the data do not determine the value.
    - `bounds`: (n, 2), lower and upper bounds.
    - `tied`: true for entries that are tied to another one.
    - `photographs`: the given images (H, W, 3), linear light; one, or a tuple.
    - `fitted`, `residuals`: of the same shape; `residuals` is image − fitted, and 0
        where a sample was left out.
    - `noise`: standard deviation of a sample, in linear light where white is 1.
    - `noise_given`: whether the noise was given.
    - `arrays`: those of `mask`, `weights` and `noise` that were given as arrays.
    - `n_samples`, `n_images`: numbers of used samples and images; a sample is one
        channel of a pixel.
    - `degrees_of_freedom`: number of samples and priors minus number of free unknowns.
    - `chi_squared`: sum of the squared residuals in standard deviations.
    - `misfit`: a [`Misfit`][], which tests whether residuals are noise. If they are
        not, the model does not describe the image, and errors are widened.
    - `converged`, `steps`, `reason`: how the solver ended.
    - `warnings`: sentences, each with what to try and a code: see [`warning_code`][].
    - `region`: the region that the data allow, for [`Fit`][]`.intervals`.
    - `solution`: the solved problem, from which [`Fit`][]`.profile` and [`refit`][]
        start.
    """

    specification: Specification
    films: tuple[Film, ...]
    material: Material
    stderr: Material
    scene: Scene | tuple[Scene, ...]
    exposure: np.ndarray
    labels: tuple[str, ...]
    values: np.ndarray
    errors: np.ndarray
    covariance: np.ndarray
    at_bound: np.ndarray
    unidentified: np.ndarray
    bounds: np.ndarray
    tied: np.ndarray
    photographs: Images
    fitted: Images
    residuals: Images
    noise: float
    noise_given: bool
    arrays: tuple[str, ...]
    n_samples: int
    n_images: int
    degrees_of_freedom: int
    chi_squared: float
    misfit: Misfit
    model: str
    converged: bool
    steps: int
    reason: str
    warnings: tuple[str, ...]
    region: Region
    solution: SearchResult

    @checked
    def __getitem__(self, name: str) -> Estimate:
        """Estimate of a parameter by its name, or of one number by its label.

        **Raises:** `KeyError` that lists the labels.
        """
        entries = [
            k
            for k, label in enumerate(self.labels)
            if label == name or (label.startswith(name) and label[len(name)] in ".[")
        ]
        if not entries:
            raise KeyError(f"expected one of {', '.join(self.labels)}, got {name!r}")
        chosen = entries[0] if self.labels[entries[0]] == name else entries
        return Estimate(
            self.values[chosen],
            self.errors[chosen],
            self.at_bound[chosen],
            self.unidentified[chosen],
        )

    @checked
    def intervals(self, level: float = 0.95) -> np.ndarray:
        """Intervals that hold the truth with a chance of `level`, by Student's t.

        An interval ends where Δχ², minimised over all other unknowns within their
        bounds, reaches t². So it is asymmetric if a bound limits a correlated unknown,
        and it includes all values of an exponent that is barely identified. In such
        cases the chance is at least `level`, and larger if no highlight is seen.

        **Returns:** (n, 2), cut to the bounds. For an unknown that is not identifiable
        they are the bounds; at a bound they are one-sided.

        **Raises:** `ValueError` if `level` is not in (0, 1).
        """
        if not 0 < level < 1:
            raise ValueError(f"level: expected a number in (0, 1), got {level!r}")
        return self.region.ends(student_reach(level, self.degrees_of_freedom) ** 2)

    @property
    def identified(self) -> np.ndarray:
        """True for numbers that the data determine, and that are not at a bound."""
        return ~self.unidentified & ~self.at_bound & np.isfinite(self.errors)

    @property
    def sides(self) -> np.ndarray:
        """Distances from the estimates down and up to where Δχ² reaches 1, (n, 2)."""
        return np.abs(self.region.ends(1.0) - self.values[:, None])

    @checked
    def profile(
        self, name: str, other: str | None = None, *, levels: Sequence[float] = LEVELS
    ) -> Any:
        """Profile-likelihood intervals of one unknown, or regions of a pair.

        The unknown is held at values around its estimate and all others are fitted
        again: [`Profile`][], or [`ProfilePair`][] for two. This is more exact than a
        standard error where the model is not linear.

        **Arguments:**

        - `name`, `other`: labels, such as `"shininess"` or `"diffuse.red"`.
        - `levels`: chances, in (0, 1), that the intervals hold the truth.

        **Raises:** `ValueError` for a name that is not a free unknown, or a wrong
        level.
        """
        setting = (self.degrees_of_freedom, tuple(levels), self.misfit.inflation)
        if other is None:
            return profile(self.solution, name, *setting)
        return profile_pair(self.solution, (name, other), *setting)

    @checked
    def bootstrap(self, n: int = 200, *, key: Any) -> Bootstrap:
        """Parametric bootstrap: the spread of the estimates of simulated photographs.

        Draws n sets of photographs from the fitted material and scenes, with
        independent normal noise of the fit's level, and the films' clamp, rounding and
        JPEG compression. Each is fitted with the fit's own specification; means of
        priors, and of uncertain arrays, are drawn too, since they are measurements.

        The spread does not contain a lack of fit, which a simulation does not have.
        Beside a bound or with few samples it holds better than a standard error, which
        comes from the linearised fit. For an unknown that is not identified the
        spread depends on its bounds, and is no error.

        **Arguments:**

        - `n`: number of draws: the relative error of a standard deviation is
            1/√(2n). A draw takes about as long as a fit.
        - `key`: a key such as `jax.random.key(0)`; equal keys give equal results.

        **Returns:** a [`Bootstrap`][]. Fits that do not converge are counted and left
        out.

        **Raises:** `ValueError` that names the argument.
        """
        asked = dataclasses.replace(self.specification, film=self.films)
        scenes = (self.scene,) if isinstance(self.scene, Scene) else self.scene
        return bootstrap(self.solution, asked, scenes, self.noise_given, n, key)

    def diagnose(self) -> Diagnostics:
        """Profiles of a few unknowns, and the cost at each step of the solver.

        This solves the fit some fifty times more, which takes seconds. With millions of
        samples there are fewer profiles, or none.
        """
        identified = np.flatnonzero(self.identified)
        free = self.problem.unknowns.free_labels
        chosen = choose_profiles([self.labels[k] for k in identified], free)
        few = MOST_PROFILES * MOST_SAMPLES // self.n_samples
        convergence = trace_convergence(self.solution) if few else None
        chosen_few = chosen[:few] if self.converged else ()
        return Diagnostics(chosen, tuple(map(self.profile, chosen_few)), convergence)

    @checked
    def plot(
        self, names: Sequence[str | int | float | os.PathLike[str]] = ()
    ) -> "Figure":
        """Photograph, fit and residual of some images, as a matplotlib figure.

        **Arguments:** `names`: names of the images; default their numbers.
        """
        from phongfit.report.plots import plot

        return plot(self, names)

    def plot_residuals(self) -> "Figure":
        """Figure of the residuals: histogram, dependence on light, and images."""
        from phongfit.report.plots import plot_residuals

        return plot_residuals(self)

    def plot_correlations(self) -> "Figure":
        """The correlation matrix as a matplotlib figure."""
        from phongfit.report.plots import plot_correlations

        return plot_correlations(self)

    @checked
    def plot_profile(self, name: str, other: str | None = None) -> "Figure":
        """Figure of the profile of one unknown with its intervals, or of a pair.

        **Raises:** `ValueError` for a name that is not a free unknown.
        """
        from phongfit.report.profiles import plot_profile

        return plot_profile(self, name, other)

    @property
    def problem(self) -> Problem:
        """The solved problem, with the final noise level: see [`make_problem`][]."""
        return self.solution.problem

    @property
    def position(self) -> np.ndarray:
        """The solution as the vector that `problem`'s functions take."""
        return np.asarray(self.solution.y)

    @property
    def loss(self) -> str:
        """Name of the loss."""
        return type(self.specification.loss).__name__

    @property
    def film(self) -> str:
        """The images' films in words: clamp, rounding, encoding, JPEG."""
        return " / ".join(dict.fromkeys(map(film_words, self.films)))

    @property
    def neighbour_correlation(self) -> float:
        """Correlation of neighbouring residuals: well above 0 for a lack of fit."""
        return self.misfit.neighbour_correlation

    @property
    def reduced_chi_squared(self) -> float:
        """χ² for each degree of freedom: near 1 if model and given noise are right.

        NaN if the noise was estimated from the residuals, which would give about 1
        anyway. See `misfit.over_repeatability` instead.
        """
        if not self.noise_given:
            return math.nan
        return self.chi_squared / max(self.degrees_of_freedom, 1)

    @property
    def correlation(self) -> np.ndarray:
        """Correlations of the unknowns; NaN for those at a bound or not identified."""
        deviation = np.sqrt(np.diag(self.covariance))
        deviation = np.where(np.isfinite(deviation), deviation, np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / np.outer(deviation, deviation)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the images, as types that `json.dumps` accepts."""
        names = ("ambient", "diffuse", "specular", "shininess", "emission")
        numbers = {
            "material": {k: np.asarray(getattr(self.material, k)) for k in names},
            "stderr": {k: np.asarray(getattr(self.stderr, k)) for k in names},
            "labels": list(self.labels),
            "values": self.values,
            "errors": self.errors,
            "covariance": self.covariance,
            "at_bound": self.at_bound,
            "unidentified": self.unidentified,
            "tied": self.tied,
            "bounds": self.bounds,
            "intervals": self.intervals(),
            "parameters": self._rows(),
            "exposure": self.exposure,
            "noise": self.noise,
            "noise_given": self.noise_given,
            "n_samples": self.n_samples,
            "n_images": self.n_images,
            "degrees_of_freedom": self.degrees_of_freedom,
            "reduced_chi_squared": self.reduced_chi_squared,
            "neighbour_correlation": self.neighbour_correlation,
            "misfit_significance": self.misfit.significance,
            "residuals_over_repeatability": self.misfit.over_repeatability,
            "loss": self.loss,
            "model": self.model,
            "film": self.film,
            "converged": self.converged,
            "steps": self.steps,
            "reason": self.reason,
            "warnings": list(self.warnings),
        }
        return plain(numbers)

    def to_dataframe(self) -> Any:
        """A `pandas.DataFrame` with a row for each estimate; labels are the index.

        Columns: `value`, `error` (one standard error), `low` and `high` (the interval
        that holds the truth with a chance of 95 %), `at_bound`, `unidentified`, `tied`.

        **Raises:** `ImportError` if pandas is not installed.
        """
        try:
            import pandas  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError(
                "to_dataframe: pandas is not installed: pip install pandas; "
                'to_dict()["parameters"] has the same rows'
            ) from error
        return pandas.DataFrame(self._rows()).set_index("label")

    def _rows(self) -> list[dict[str, Any]]:
        columns = {
            "label": self.labels,
            "value": self.values,
            "error": self.errors,
            "low": self.intervals()[:, 0],
            "high": self.intervals()[:, 1],
            "at_bound": self.at_bound,
            "unidentified": self.unidentified,
            "tied": self.tied,
        }
        lists = (np.asarray(column).tolist() for column in columns.values())
        rows = zip(*lists, strict=True)
        return [dict(zip(columns, row, strict=True)) for row in rows]

    @checked
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole fit to one file, for [`load_fit`][]: see [`save_fit`][]."""
        from phongfit.files.saved import save_fit

        save_fit(path, self)

    def __str__(self) -> str:
        return fit_table(self)

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT CONVERGED"
        images = f"{self.n_images} image{'s' if self.n_images > 1 else ''}"
        many = len(self.warnings)
        count = f"{len(self.labels)} parameters, {many} warning{'s' * (many != 1)}"
        return f"<Fit of {images}: {count}, {state}>"

    def _repr_html_(self) -> str:
        from phongfit.report.notebook import of_fit

        return of_fit(self)


def film_words(film: Film) -> str:
    """A film in words: clamp, rounding, encoding, JPEG."""
    rounded = "not rounded" if film.bits is None else f"{film.bits}-bit {film.encoding}"
    kind = "" if film.jpeg is None else f" JPEG {film.jpeg.subsampling}"
    return f"{'clamped' if film.clamp else 'not clamped'}, {rounded}{kind}"


@program()
def as_materials(
    unknowns: Unknowns,
    entries: Float[np.ndarray | Array, " n"],
    errors: Float[np.ndarray | Array, " n"],
) -> tuple[Material, Material]:
    """All entries as a material, and their errors as another, with 0 for known ones."""
    none = jax.tree.map(jnp.zeros_like, unknowns.known)
    errors_alone = dataclasses.replace(unknowns, known=none)
    return unknowns.as_material(entries), errors_alone.as_material(errors)


def fit_table(fit: Fit, least_correlation: float = 0.1, most: int = 10) -> str:
    """Value ± standard error, correlations and warnings, for a fixed-width font."""
    rows = parameter_rows(
        fit.labels, fit.values, fit.errors, fit.at_bound, fit.unidentified
    )
    for k, words in lopsided(fit).items():
        rows[k + 1] += f"  {words}"
    lines = [*_head(fit), "", *rows]
    correlations = _correlations(fit, least_correlation, most)
    if correlations:
        title = f"correlations (of those ≥ {least_correlation:g}, the largest {most})"
        lines += ["", title, *correlations]
    if fit.warnings:
        lines += ["", "warnings"]
        for warning in fit.warnings:
            lines += textwrap.wrap(
                warning, 86, initial_indent="  ! ", subsequent_indent="    "
            )
    return "\n".join(lines)


def lopsided(fit: Fit) -> dict[int, str]:
    """Asymmetric errors in words, by entry, if one side is more than a fifth larger."""
    identified = np.flatnonzero(~fit.unidentified & ~fit.at_bound)
    sides = fit.sides[identified]
    return {
        int(k): f"+{up:.2g} −{down:.2g}"
        for k, (down, up) in zip(identified, sides, strict=True)
        if max(down, up) > 1.2 * min(down, up)
    }


def _head(fit: Fit) -> list[str]:
    images = f"{fit.n_images} image" + ("s" if fit.n_images > 1 else "")
    noise, size = "estimated", fit.misfit.over_repeatability
    judged = f", residuals {size:.3g} × repeatability" if size == size else ""
    if fit.noise_given:
        noise, judged = "given", f", reduced χ² {fit.reduced_chi_squared:.4g}"
    if fit.misfit.noise_differs:
        noise += ", not the same everywhere"
    state = "converged" if fit.converged else "NOT CONVERGED"
    return [
        f"phongfit: {images}, {fit.n_samples:,} samples, {fit.model}, {fit.film}",
        f"  {state} after {fit.steps} steps: {fit.reason}",
        f"  loss {fit.loss}, noise {fit.noise:.3g} ({noise}){judged}",
    ]


def _correlations(fit: Fit, least: float, most: int) -> list[str]:
    matrix = fit.correlation
    pairs = [
        (matrix[i, j], fit.labels[i], fit.labels[j])
        for i in range(len(fit.labels))
        for j in range(i)
        if abs(matrix[i, j]) >= least and not (fit.tied[i] or fit.tied[j])
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    width = max(len(label) for label in fit.labels)
    return [f"  {a:<{width}}  {b:<{width}}  {c:+.3f}" for c, a, b in pairs[:most]]
