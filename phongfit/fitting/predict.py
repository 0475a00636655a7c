"""How well a fit could know each parameter, before any photograph is taken."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from phongfit.checks import untraced
from phongfit.codes import coded
from phongfit.edge import checked
from phongfit.fitting.problem.layout import first_values
from phongfit.fitting.problem.losses import Linear
from phongfit.fitting.problem.posing import set_up
from phongfit.fitting.problem.problem import Problem, evaluate
from phongfit.fitting.problem.samples import gather, seen_pixels
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.result import as_materials
from phongfit.fitting.solve.edges import off_edges
from phongfit.fitting.solve.jpeg import foresee
from phongfit.fitting.uncertainty.estimate import Estimates, estimates
from phongfit.fitting.uncertainty.inherited import beside, with_inherited
from phongfit.fitting.uncertainty.numbers import parameter_rows
from phongfit.fitting.uncertainty.scatter import scatter
from phongfit.fitting.uncertainty.warnings import coarse_words
from phongfit.material import Material
from phongfit.rendering.film import Film, as_films, decode
from phongfit.rendering.render import render
from phongfit.scene import Scene


@dataclasses.dataclass(frozen=True, repr=False)
class Prediction:
    """Standard errors that a fit would state, in the order of `labels`.

    **Arguments:**

    - `labels`, `values`, `errors`: the unknowns, their true values, and standard
        errors: infinite for what is not identifiable.
    - `stderr`: a material of these errors.
    - `covariance`: of the estimates; NaN rows for what is not identifiable.
    - `unidentified`: true where the images would leave the value open.
    - `warnings`: why, in words.
    - `n_samples`: pixels times channels that would be used.
    """

    labels: tuple[str, ...]
    values: np.ndarray
    errors: np.ndarray
    stderr: Material
    covariance: np.ndarray
    at_bound: np.ndarray
    unidentified: np.ndarray
    warnings: tuple[str, ...]
    n_samples: int

    def __str__(self) -> str:
        rows = parameter_rows(
            self.labels, self.values, self.errors, self.at_bound, self.unidentified
        )
        words = [f"  ! {warning}" for warning in self.warnings]
        head = f"phongfit: what {self.n_samples:,} samples could identify"
        return "\n".join([head, "", *rows, *(["", *words] if words else [])])

    def __repr__(self) -> str:
        return str(self)


@checked
def predict_errors(
    scene: Scene | Sequence[Scene],
    material: Material,
    noise: Any,
    *,
    film: Film | Sequence[Film] | None = None,
    **options: Any,
) -> Prediction:
    r"""Standard errors that [`fit`][] would state for photographs not yet taken.

    Where nothing is clipped or rounded this is the Cramér-Rao bound $\sigma^2 (J^\top
    J)^{-1}$: no unbiased estimate from these images can be better. So lights and views
    can be compared, and placed well.

    Where an exponent is not identifiable, fits end at any, and the bound at a single
    one says too little. Errors are then root mean squares of what 400 fits of drawn
    photographs, which know the noise, are off by. The draws are the same each time and
    take seconds; such an error is known to 4 %, less well where a few fits stray far.
    What a fit itself states is larger there, often twice: it holds for any exponent.

    **Arguments:**

    - `scene`: one, or a sequence of scenes of one material; arrays of theirs that will
        be unknown have their true values here.
    - `material`: the true one.
    - `noise`: standard deviation in linear light, as for [`fit`][].
    - `film`: how light will become numbers, one or one a scene; default a clamp alone.
        What a JPEG file will round is drawn, as [`fit`][] does.
    - `options`: of [`fit`][]: `unknowns`, `per_channel`, `per_image`, `bounds`,
        `fixed`, `ties`, `priors`, `uncertain`, `mask`, `weights`.

    **Returns:** a [`Prediction`][].

    **Raises:** `ValueError` that names the argument, as [`fit`][] does; `TypeError` for
    an option that is none.
    """
    instead = "predict_errors is no function that JAX can trace"
    untraced(instead, scene=scene, material=material, noise=noise, **options)
    film = Film() if film is None else film
    single = isinstance(scene, Scene)
    scenes = [scene] if single else list(scene)
    films = as_films(film, len(scenes), "a scene")
    images = [
        _photograph(one, material, how) for one, how in zip(scenes, films, strict=True)
    ]
    data = {name: options.pop(name, None) for name in ("mask", "weights")}
    setting = set_up(
        Specification.checked(
            "predict_errors",
            options,
            others=("mask", "weights"),
            known=material,
            film=tuple(films),
            loss="linear",
            max_steps=200,
        ),
        scene,
        images[0] if single else images,
        noise=noise,
        **data,
    )
    unknowns = setting.unknowns
    sources = off_edges(unknowns, setting.sources)
    samples = gather(sources, seen_pixels(sources))
    sigma = jnp.ones((), samples.target.dtype)
    problem = Problem(samples, unknowns, sigma, Linear(), setting.films[0].clamp)
    entries = first_values(unknowns.parameters, scenes, material)
    y = jnp.asarray(unknowns.position(entries))
    rounded = any(one.jpeg is not None for one in films)
    nuisance, scores = setting.nuisance, None
    if rounded:
        also = None if nuisance is None else beside(nuisance)
        problem, scores = foresee(problem, y, sources, films, also)
    expected = _expected(problem, y)
    if nuisance is not None:
        expected = with_inherited(expected, y, nuisance, scores=scores)
    estimated = estimates(expected, y)
    is_exponent = unknowns.entry_parameter[unknowns.reported] == "shininess"
    if (
        estimated.unidentified[is_exponent].any()
        and not estimated.unidentified[~is_exponent].all()
    ):
        ends = scatter(problem, sources, y)[:, unknowns.reported]
        estimated = _as_scattered(estimated, ends - estimated.values, rounded)
    errors = np.zeros_like(entries)
    errors[unknowns.reported] = estimated.errors
    return Prediction(
        labels=unknowns.labels,
        values=estimated.values,
        errors=estimated.errors,
        stderr=as_materials(unknowns, entries, errors)[1],
        covariance=estimated.covariance,
        at_bound=estimated.at_bound,
        unidentified=estimated.unidentified,
        warnings=(*estimated.reasons, *coarse_words(films)),
        n_samples=sum(source.count() for source in sources),
    )


def _expected(problem: Problem, y: Array) -> Problem:
    """The problem with what a film shows on average: without noise black is darker.

    So nothing pulls at the truth. White samples stay white: they say little.
    """
    target = problem.samples.target
    shown = target + jnp.where(target < 1, evaluate(problem, y).difference, 0)
    return eqx.tree_at(lambda p: p.samples.target, problem, shown)


def _as_scattered(estimated: Estimates, off: np.ndarray, rounded: bool) -> Estimates:
    """The same, with the errors that fits are seen to make, (draws, labels).

    **Arguments:** `rounded`: whether JPEG will round, which the draws do not know.
    """
    covariance = off.T @ off / len(off)
    errors = np.where(estimated.unidentified, np.inf, np.sqrt(np.diag(covariance)))
    # What is not identified, or lies at a bound, stays so.
    without = estimated.unidentified | estimated.at_bound
    unknown = without[:, None] | without[None]
    covariance = np.where(unknown, estimated.covariance, covariance)
    words = (
        f"the exponent may be any: the other errors are those of {len(off)} drawn fits"
    )
    if rounded:
        words += ", which know nothing of JPEG"
    reasons = (*estimated.reasons, coded("drawn-errors", words))
    return dataclasses.replace(
        estimated, errors=errors, covariance=covariance, reasons=reasons
    )


def _photograph(scene: Scene, material: Material, film: Film) -> np.ndarray:
    """The image without noise, as a file of it would be read."""
    shown = np.asarray(render(scene, material, film=film))
    return np.asarray(decode(shown, film.encoding))
