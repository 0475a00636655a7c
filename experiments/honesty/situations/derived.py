"""Errors from predictions before a photograph, and from profiles after a fit."""

from collections.abc import Callable
from typing import Any

import numpy as np

import phongfit as pf
from experiments.honesty.answers import LEVEL, Answers, Said, gather
from experiments.honesty.situations.base import (
    NOISE,
    UNCLAMPED,
    Draws,
    Situation,
    Subject,
    Take,
    ball,
    changed,
    fits,
    noisy,
    usual,
)
from experiments.honesty.situations.noise import film
from phongfit.fitting.uncertainty.quantiles import student_reach


def situations() -> list[Situation]:
    """All situations with predictions and profiles."""
    predictions = {
        "predicted errors": (usual(), NOISE),
        "predicted errors at a bound": (
            usual(changed(ambient=(0.0, 0.4, 0.3))),
            NOISE,
        ),
        "predicted errors, f = 1.5, noise 0.2": (
            usual(changed(shininess=1.5), ball(size=24)),
            0.2,
        ),
        "predicted errors without a highlight": (
            usual(changed(specular=0.0)),
            NOISE,
        ),
    }
    brass = pf.preset("brass")
    levels = film("linear", 8, NOISE)
    faint = usual(changed(specular=0.03))
    profiles: dict[str, Any] = {
        "profile of f": profiled(usual(), noisy(), "shininess", 20.0),
        "profile of f, brass in 8 bits": profiled(
            usual(brass), levels, "shininess", float(brass.shininess)
        ),
        "profile of ρ_s, a faint highlight": profiled(
            faint, noisy(), "specular.red", 0.03
        ),
    }
    return [
        *(
            Situation(name, "doubtful", predicted(*asked), wide=True)
            for name, asked in predictions.items()
        ),
        *(
            Situation(name, "right", ask, wide=True, share=0.5)
            for name, ask in profiles.items()
        ),
    ]


def predicted(subject: Subject, noise: float) -> Callable[[Draws], Answers]:
    """Answers that pair the estimates of fits with predicted errors."""

    def ask(draws: Draws) -> Answers:
        (scene,) = subject.scenes
        said = pf.predict_errors(scene, subject.material, noise, film=UNCLAMPED)
        found = fits(subject, noisy(noise))(draws)
        error = np.broadcast_to(said.errors, found.estimate.shape)
        ends = found.estimate + 1.96 * error * [[[-1.0]], [[1.0]]]
        low, high = np.clip(ends, *found.box.T)
        return Answers(
            labels=found.labels,
            truth=found.truth,
            estimate=found.estimate,
            error=error,
            low=low,
            high=high,
            at_bound=np.broadcast_to(said.at_bound, error.shape),
            box=found.box,
            warnings=(said.warnings,) * len(draws),
        )

    return ask


def profiled(
    subject: Subject, take: Take, label: str, truth: float
) -> Callable[[Draws], Answers]:
    """Profile-likelihood intervals of one parameter."""

    def ask(draws: Draws) -> Answers:
        (scene,) = subject.scenes
        fits = (pf.fit(scene, take(subject.light[0], rng)) for rng in draws)
        said = [of_profile(fit, label, truth) for fit in fits]
        return gather((label,), np.array([[-np.inf, np.inf]]), said)

    return ask


def of_profile(fit: pf.Fit, label: str, truth: float) -> Said:
    """A profile's interval, and the standard error that a symmetric one would have."""
    low, high = fit.profile(label, levels=(LEVEL,)).intervals[LEVEL]
    error = (high - low) / 2 / student_reach(LEVEL, fit.degrees_of_freedom)
    found = fit[label]
    truths, values, errors, lows, highs = np.array(
        [[truth], [found.value], [error], [low], [high]], float
    )
    bound = np.array([found.at_bound])
    return Said(truths, values, errors, lows, highs, bound, fit.warnings)
