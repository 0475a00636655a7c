"""Situations for each loss: on clean data, and with samples unrelated to the model."""

import numpy as np

import phongfit as pf
from experiments.honesty.situations.base import (
    NOISE,
    Image,
    Photograph,
    Situation,
    Subject,
    ball_scene,
    fits,
    lamp,
    noisy,
    usual_material,
    usual_subject,
)
from phongfit.fitting.problem.losses import LOSSES


def situations() -> list[Situation]:
    """All situations with losses, clean or with unrelated samples."""
    sharp = usual_subject(usual_material(shininess=600.0, specular=0.5))
    result: list[Situation] = []
    for loss in LOSSES:
        for fraction in (0.05, 0.2):
            name = f"{loss}, {fraction:.0%} garbage"
            answer = fits(usual_subject(), outliers(fraction), loss=loss)
            result.append(Situation(name, "doubtful", answer, wide=True))
    for loss in LOSSES:
        if loss != "linear":
            answer = fits(usual_subject(), noisy(), loss=loss)
            result.append(Situation(f"{loss}, clean", "right", answer))
        answer = fits(sharp, noisy(), loss=loss)
        result.append(Situation(f"{loss}, a narrow highlight", "right", answer))
        answer = fits(sharp, with_second_lobe(), loss=loss)
        result.append(Situation(f"{loss}, a highlight of two lobes", "wrong", answer))
    for loss in ("linear", "cauchy", "tukey"):
        answer = fits(usual_subject(), scratch, loss=loss)
        # Tukey's loss rejects the scratch completely, so no warning is due.
        kind = "right" if loss == "tukey" else "doubtful"
        result.append(Situation(f"{loss}, a scratch", kind, answer, wide=True))
        answer = fits(lit_twice(), noisy(), fitted=ball_scene(), loss=loss)
        result.append(Situation(f"{loss}, a second highlight", "doubtful", answer))
    return result


def lit_twice() -> Subject:
    """A ball with a second highlight, from a lamp that adds specular light only."""
    lamp_without_diffuse = pf.DirectionalLight((-1.0, -0.5, 1.5), 0.0, specular=0.6)
    return usual_subject(
        usual_material(shininess=60.0), ball_scene(lamp(), lamp_without_diffuse)
    )


def with_second_lobe() -> Photograph:
    """A `Photograph` that adds a fainter, wider highlight, and noise."""
    wide = usual_subject(pf.Material(0.0, 0.05, 15.0, 0.0))

    def photograph(light: Image, rng: np.random.Generator) -> Image:
        return noisy()(light + wide.light[0], rng)

    return photograph


def outliers(fraction: float) -> Photograph:
    """A `Photograph` that adds noise and replaces some samples by random numbers.

    **Arguments:** `fraction`: of the samples; the numbers are uniform in [0, 1).
    """

    def photograph(light: Image, rng: np.random.Generator) -> Image:
        random_values = rng.random(light.shape)
        bad = rng.random(light.shape) < fraction
        return np.where(bad, random_values, noisy(NOISE)(light, rng))

    return photograph


def scratch(light: Image, rng: np.random.Generator) -> Image:
    """A noisy photograph with a scratch: 2 × 18 pixels of 0.95, nearly white."""
    image = noisy()(light, rng)
    image[34:36, 12:30] = 0.95
    return image
