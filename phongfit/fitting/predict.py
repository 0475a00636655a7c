"""Standard errors of a fit, predicted before photographs are taken."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Unpack

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from phongfit.checks import untraced
from phongfit.edge import checked
from phongfit.fitting.problem.layout import first_values
from phongfit.fitting.problem.posing import set_up
from phongfit.fitting.problem.problem import Problem, evaluate
from phongfit.fitting.problem.specification import (
    Specification,
    SpecificationOptions,
    specified,
)
from phongfit.fitting.result import as_materials
from phongfit.fitting.solve.edges import off_edges
from phongfit.fitting.solve.jpeg import foresee
from phongfit.fitting.uncertainty.estimate import estimates
from phongfit.fitting.uncertainty.numbers import parameter_rows
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
    - `covariance`: covariance of the estimates; NaN rows for those not identifiable.
    - `unidentified`: true where the images would not determine the value.
    - `warnings`: sentences, each with what to try and a code.
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
    specification: Specification | None = None,
    *,
    mask: Any = None,
    weights: Any = None,
    **options: Unpack[SpecificationOptions],
) -> Prediction:
    r"""Standard errors that [`fit`][] would state for photographs not yet taken.

    Without clipping and rounding this is the Cramér-Rao bound $\sigma^2 (J^\top
    J)^{-1}$: no unbiased estimate from these images has smaller errors. So lights and
    views can be compared before they are set up.

    If an exponent is not identifiable, errors of the other unknowns hold for any
    exponent, as those of a fit do. Where noise looks like a broad highlight, a fit may
    still deviate by several such errors, once in some ten photographs.

    **Arguments:**

    - `scene`: a scene, or a sequence of scenes of one material. Their arrays that will
        be unknown have the true values here.
    - `material`: the true one.
    - `noise`: standard deviation in linear light, as for [`fit`][].
    - `specification`, and options beside it: as for [`fit`][]. The loss must be linear;
        parameters that a specification has as `known` have the values of `material`.
        `film`: how light will become numbers, one or one a scene; default a clamp
        alone. The rounding of a JPEG file is simulated, as in [`fit`][].
    - `mask`, `weights`: as for [`fit`][].

    **Returns:** a [`Prediction`][].

    **Raises:** `ValueError` that names the argument, as [`fit`][] does; `TypeError` for
    an unknown option.
    """
    instead = "call predict_errors outside of what JAX traces"
    data = {"mask": mask, "weights": weights, "noise": noise}
    untraced(instead, scene=scene, material=material, **data)
    specification = specified(specification, options, instead)
    specification.refuse("loss", "predict_errors")
    if "known" in options:
        raise ValueError("known: expected none, since material has all parameters")
    for name in ("max_steps", "tolerance"):
        if name in options:
            raise ValueError(f"{name}: expected none, since nothing is solved")
    single = isinstance(scene, Scene)
    scenes = [scene] if single else list(scene)
    film = Film() if specification.film is None else specification.film
    films = as_films(film, len(scenes), "scene")
    images = [
        _photograph(one, material, how) for one, how in zip(scenes, films, strict=True)
    ]
    setting = set_up(
        # Nothing is solved to a tolerance.
        dataclasses.replace(specification, known=material, film=films, tolerance=None),
        scene,
        images[0] if single else images,
        **data,
    )
    unknowns = setting.unknowns
    sources = off_edges(unknowns, setting.sources)
    problem = dataclasses.replace(setting, sources=sources).problem()
    entries = first_values(unknowns.parameters, scenes, material)
    y = jnp.asarray(unknowns.position(entries))
    if any(one.jpeg is not None for one in films):
        problem = foresee(problem, y, sources, films)
    estimated = estimates(_expected(problem, y), y)
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
    """The problem with the film's mean values as targets, so that the truth is optimal.

    Clipping at black raises the mean of noisy values, which an image without noise
    lacks. White samples stay white, since they contribute little.
    """
    target = problem.samples.target
    shown = target + jnp.where(target < 1, evaluate(problem, y).difference, 0)
    return eqx.tree_at(lambda p: p.samples.target, problem, shown)


def _photograph(scene: Scene, material: Material, film: Film) -> np.ndarray:
    """The image without noise, as read from a file."""
    shown = np.asarray(render(scene, material, film=film))
    return np.asarray(decode(shown, film.encoding))
