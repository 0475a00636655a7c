"""Estimates, errors and warnings of many draws of a situation, and the truth.

A draw is one repetition: data with fresh noise, and the fit of them.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

import phongfit as pf
from phongfit.fitting.problem.layout import first_values

Scenes: TypeAlias = pf.Scene | Sequence[pf.Scene]
LEVEL = 0.95
"""Confidence of the intervals that are judged."""


@dataclasses.dataclass(frozen=True)
class Answers:
    """Numbers of every draw and parameter, and the warnings of every draw.

    - `labels`: of the parameters, as fits have them, such as `"diffuse.red"`;
    - `truth`, `estimate`; `error`: the standard error, infinite if not identified;
    - `low`, `high`: ends of the intervals with a confidence of 95 % (`LEVEL`);
    - `at_bound`: whether an estimate lies on its bound;
    - `bounds`: lower and upper bound of each parameter;
    - `warnings`: sentences, for each draw. A draw whose fit raised an error has its
        message here, after `REFUSED`; its errors are infinite, its other numbers NaN.
    """

    labels: tuple[str, ...]
    truth: Float[np.ndarray, "draws parameters"]
    estimate: Float[np.ndarray, "draws parameters"]
    error: Float[np.ndarray, "draws parameters"]
    low: Float[np.ndarray, "draws parameters"]
    high: Float[np.ndarray, "draws parameters"]
    at_bound: Bool[np.ndarray, "draws parameters"]
    bounds: Float[np.ndarray, "parameters 2"]
    warnings: tuple[tuple[str, ...], ...]


class Trial(NamedTuple):
    """Arguments of one draw's fit, and the truth.

    - `scene`, `image`, `options`: arguments of [`phongfit.fit`][];
    - `scenes`, `material`: the true ones, of which `image` was made;
    - `others`: true values by label, of unknowns whose truth is not in scenes or
        material, such as exposures.
    """

    scene: Scenes
    image: Any
    options: Mapping[str, Any]
    scenes: Sequence[pf.Scene]
    material: pf.Material
    others: Mapping[str, float]


class DrawAnswer(NamedTuple):
    """One draw's part of [`Answers`][]: arrays of shape (parameters,)."""

    truth: np.ndarray
    estimate: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    at_bound: np.ndarray
    warnings: tuple[str, ...]


REFUSED = "refused: "
"""Beginning of the message of a draw whose fit raised an error."""


def fit_trials(trials: Iterable[Trial]) -> Answers:
    """Fit many draws; a fit that raises `ValueError` gives a message, not estimates."""
    draws: list[DrawAnswer | str] = []
    labels, bounds = (), np.zeros((0, 2))
    for trial in trials:
        try:
            fit = pf.fit(trial.scene, trial.image, **trial.options)
        except ValueError as error:
            draws.append(f"{REFUSED}{error}")
            continue
        labels, bounds = fit.labels, fit.bounds
        draws.append(answer_of_fit(fit, trial))
    return join_draws(labels, bounds, draws)


def answer_of_fit(fit: pf.Fit, trial: Trial) -> DrawAnswer:
    """Estimates, errors, intervals and warnings of one fit, with the truth."""
    low, high = fit.intervals(LEVEL).T
    truth = true_values(fit, trial)
    parts = truth, fit.values, fit.errors, low, high, fit.at_bound
    return DrawAnswer(*parts, fit.warnings)


def true_values(fit: pf.Fit, trial: Trial) -> np.ndarray:
    """The true values in the order of `fit.labels`."""
    unknowns = fit.solution.problem.unknowns
    values = first_values(unknowns.parameters, trial.scenes, trial.material)
    truths = {**dict(zip(unknowns.table.label, values, strict=True)), **trial.others}
    return np.array([truths[label] for label in fit.labels])


def join_draws(
    labels: tuple[str, ...],
    bounds: Float[np.ndarray, "parameters 2"],
    draws: Sequence[DrawAnswer | str],
) -> Answers:
    """Join the answers of draws; a draw whose fit raised an error is its message."""
    empty = np.full(len(labels), np.nan)
    refused = empty, empty, empty + np.inf, empty, empty, np.zeros(len(labels), bool)
    rows = [
        DrawAnswer(*refused, (one,)) if isinstance(one, str) else one for one in draws
    ]
    *numbers, warnings = zip(*rows, strict=True)
    # If no draw has an answer there are no labels, and the shape is (draws, 0).
    columns: Any = [np.array(column).reshape(len(rows), -1) for column in numbers]
    return Answers(labels, *columns, bounds=bounds, warnings=tuple(warnings))
