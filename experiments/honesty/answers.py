"""Estimates, errors and warnings of many draws of a situation, and the truth."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

import phongfit as pf
from phongfit.fitting.problem.layout import first_values

Scenes: TypeAlias = pf.Scene | Sequence[pf.Scene]
LEVEL = 0.95


@dataclasses.dataclass(frozen=True)
class Answers:
    """Numbers of every draw and parameter, and the warnings of every draw.

    - `labels`: the parameters;
    - `truth`, `estimate`, `error`: infinite errors for what was not identified;
    - `low`, `high`: ends of the intervals that hold the truth with a chance of `LEVEL`;
    - `at_bound`: whether an estimate lies on its bound;
    - `box`: lower and upper bounds of the parameters;
    - `warnings`: sentences. A draw that was refused says why, and has NaN and infinite
        errors.
    """

    labels: tuple[str, ...]
    truth: Float[np.ndarray, "draws parameters"]
    estimate: Float[np.ndarray, "draws parameters"]
    error: Float[np.ndarray, "draws parameters"]
    low: Float[np.ndarray, "draws parameters"]
    high: Float[np.ndarray, "draws parameters"]
    at_bound: Bool[np.ndarray, "draws parameters"]
    box: Float[np.ndarray, "parameters 2"]
    warnings: tuple[tuple[str, ...], ...]


class Shot(NamedTuple):
    """Arguments of one draw's fit, and the truth.

    - `scene`, `image`, `options`: of [`phongfit.fit`][];
    - `scenes`, `material`: the true ones;
    - `others`: label → truth of parameters of neither scenes nor material: exposures.
    """

    scene: Scenes
    image: Any
    options: Mapping[str, Any]
    scenes: Sequence[pf.Scene]
    material: pf.Material
    others: Mapping[str, float]


class Said(NamedTuple):
    """One draw's part of [`Answers`][]."""

    truth: np.ndarray
    estimate: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    at_bound: np.ndarray
    warnings: tuple[str, ...]


REFUSED = "refused: "


def fit_all(shots: Iterable[Shot]) -> Answers:
    """Fit many draws; a draw whose fit raises `ValueError` counts as refused."""
    said: list[Said | str] = []
    labels, box = (), np.zeros((0, 2))
    for shot in shots:
        try:
            fit = pf.fit(shot.scene, shot.image, **shot.options)
        except ValueError as error:
            said.append(f"{REFUSED}{error}")
            continue
        labels, box = fit.labels, fit.bounds
        said.append(of_fit(fit, shot))
    return gather(labels, box, said)


def of_fit(fit: pf.Fit, shot: Shot) -> Said:
    """Estimates, errors and warnings of one fit."""
    low, high = fit.intervals(LEVEL).T
    truth = true_values(fit, shot)
    parts = truth, fit.values, fit.errors, low, high, fit.at_bound
    return Said(*parts, fit.warnings)


def true_values(fit: pf.Fit, shot: Shot) -> np.ndarray:
    """The truth in the order of a fit's labels."""
    unknowns = fit.solution.problem.unknowns
    values = first_values(unknowns.parameters, shot.scenes, shot.material)
    known = {**dict(zip(unknowns.entry_labels, values, strict=True)), **shot.others}
    return np.array([known[label] for label in fit.labels])


def gather(
    labels: tuple[str, ...],
    box: Float[np.ndarray, "parameters 2"],
    said: Sequence[Said | str],
) -> Answers:
    """Join the draws; of a refused draw `said` has the message instead of numbers."""
    empty = np.full(len(labels), np.nan)
    refused = empty, empty, empty + np.inf, empty, empty, np.zeros(len(labels), bool)
    rows = [Said(*refused, (one,)) if isinstance(one, str) else one for one in said]
    *numbers, warnings = zip(*rows, strict=True)
    columns: Any = [np.array(column).reshape(len(rows), -1) for column in numbers]
    return Answers(labels, *columns, box=box, warnings=tuple(warnings))
