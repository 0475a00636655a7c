"""Situations with errors from predictions before a photograph, and from profiles."""

from collections.abc import Callable
from typing import Any

import numpy as np

import phongfit as pf
from experiments.honesty.answers import LEVEL, Answers, DrawAnswer, join_draws
from experiments.honesty.situations.base import (
    NOISE,
    UNCLAMPED,
    Draws,
    Photograph,
    Situation,
    Subject,
    alike,
    ball_scene,
    fits,
    noisy,
    usual_material,
    usual_subject,
)
from experiments.honesty.situations.noise import film
from phongfit.fitting.uncertainty.quantiles import student_reach


def situations() -> list[Situation]:
    """All situations with predicted errors and with profiles."""
    at_bound = usual_subject(usual_material(ambient=(0.0, 0.4, 0.3)))
    broad = usual_subject(usual_material(shininess=1.5), ball_scene(size=24))
    matte = usual_subject(usual_material(specular=0.0))
    predictions = {
        "predicted errors": predicted(usual_subject(), NOISE),
        "predicted errors at a bound": predicted(at_bound, NOISE),
        "predicted errors, f = 1.5, noise 0.2": predicted(broad, 0.2),
        "predicted errors without a highlight": predicted(matte, NOISE),
    }
    brass = pf.preset("brass")
    levels = film("linear", 8, NOISE)
    faint = usual_subject(usual_material(specular=0.03))
    profiles: dict[str, Any] = {
        "profile of f": profiled(usual_subject(), noisy(), "shininess", 20.0),
        "profile of f, brass in 8 bits": profiled(
            usual_subject(brass), levels, "shininess", float(brass.shininess)
        ),
        "profile of ρ_s, a faint highlight": profiled(
            faint, noisy(), "specular.red", 0.03
        ),
    }
    return [
        *alike("doubtful", predictions, wide=True),
        *alike("right", profiles, wide=True, draw_fraction=0.5),
    ]


def predicted(subject: Subject, noise: float) -> Callable[[Draws], Answers]:
    """A function that judges predicted errors: it pairs them with estimates of fits.

    **Arguments:** `subject`: of one scene; `noise`: standard deviation.
    """

    def answer(draws: Draws) -> Answers:
        (scene,) = subject.scenes
        prediction = pf.predict_errors(scene, subject.material, noise, film=UNCLAMPED)
        fitted = fits(subject, noisy(noise))(draws)
        error = np.broadcast_to(prediction.errors, fitted.estimate.shape)
        # A normal distribution has 95 % within ± 1.96 standard deviations. The first
        # axis is for the lower and the upper end.
        ends = fitted.estimate + 1.96 * error * [[[-1.0]], [[1.0]]]
        low, high = np.clip(ends, *fitted.bounds.T)
        return Answers(
            labels=fitted.labels,
            truth=fitted.truth,
            estimate=fitted.estimate,
            error=error,
            low=low,
            high=high,
            at_bound=np.broadcast_to(prediction.at_bound, error.shape),
            bounds=fitted.bounds,
            warnings=(prediction.warnings,) * len(draws),
        )

    return answer


def profiled(
    subject: Subject, photograph: Photograph, label: str, truth: float
) -> Callable[[Draws], Answers]:
    """A function that fits, and returns profile-likelihood intervals of a parameter.

    **Arguments:** `subject`: of one scene; `label`: of the parameter; `truth`: its true
    value.
    """

    def answer(draws: Draws) -> Answers:
        (scene,) = subject.scenes
        fits = (pf.fit(scene, photograph(subject.light[0], rng)) for rng in draws)
        answers = [answer_of_profile(fit, label, truth) for fit in fits]
        # Infinite bounds, since a profile's interval is not compared with bounds.
        return join_draws((label,), np.array([[-np.inf, np.inf]]), answers)

    return answer


def answer_of_profile(fit: pf.Fit, label: str, truth: float) -> DrawAnswer:
    """A profile's 95 % interval as an answer.

    The standard error is half the interval's length over the 97.5 % quantile of
    Student's t.
    """
    low, high = fit.profile(label, levels=(LEVEL,)).intervals[LEVEL]
    error = (high - low) / 2 / student_reach(LEVEL, fit.degrees_of_freedom)
    estimate = fit[label]
    truths, values, errors, lows, highs = np.array(
        [[truth], [estimate.value], [error], [low], [high]], float
    )
    bound = np.array([estimate.at_bound])
    return DrawAnswer(truths, values, errors, lows, highs, bound, fit.warnings)
