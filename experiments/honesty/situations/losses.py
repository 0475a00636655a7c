"""Each loss, on clean data and with samples that have nothing to do with the model."""

import numpy as np

import phongfit as pf
from experiments.honesty.situations.base import (
    NOISE,
    Image,
    Situation,
    Subject,
    Take,
    ball,
    changed,
    fits,
    lamp,
    noisy,
    usual,
)
from phongfit.fitting.problem.losses import LOSSES


def situations() -> list[Situation]:
    """All situations with losses."""
    sharp = usual(changed(shininess=600.0, specular=0.5))
    found: list[Situation] = []
    for loss in LOSSES:
        for share in (0.05, 0.2):
            name = f"{loss}, {share:.0%} garbage"
            ask = fits(usual(), garbage(share), loss=loss)
            found.append(Situation(name, "doubtful", ask, wide=True))
    for loss in LOSSES:
        if loss != "linear":
            ask = fits(usual(), noisy(), loss=loss)
            found.append(Situation(f"{loss}, clean", "right", ask))
        ask = fits(sharp, noisy(), loss=loss)
        found.append(Situation(f"{loss}, a narrow highlight", "right", ask))
        ask = fits(sharp, with_lobe(), loss=loss)
        found.append(Situation(f"{loss}, a highlight of two lobes", "wrong", ask))
    for loss in ("linear", "cauchy", "tukey"):
        ask = fits(usual(), scratch, loss=loss)
        # Tukey's loss rejects the scratch completely, so no warning is due.
        kind = "right" if loss == "tukey" else "doubtful"
        found.append(Situation(f"{loss}, a scratch", kind, ask, wide=True))
        ask = fits(lit_twice(), noisy(), fitted=ball(), loss=loss)
        found.append(Situation(f"{loss}, a second highlight", "doubtful", ask))
    return found


def lit_twice() -> Subject:
    """A ball with a second highlight, of a lamp without diffuse light."""
    shine = pf.DirectionalLight((-1.0, -0.5, 1.5), 0.0, specular=0.6)
    return usual(changed(shininess=60.0), ball(lamp(), shine))


def with_lobe() -> Take:
    """A function that adds a fainter, wider highlight, and noise."""
    wide = usual(pf.Material(0.0, 0.05, 15.0, 0.0))

    def take(light: Image, rng: np.random.Generator) -> Image:
        return noisy()(light + wide.light[0], rng)

    return take


def garbage(share: float) -> Take:
    """A function that adds noise and replaces some samples by random numbers."""

    def take(light: Image, rng: np.random.Generator) -> Image:
        random_values = rng.random(light.shape)
        bad = rng.random(light.shape) < share
        return np.where(bad, random_values, noisy(NOISE)(light, rng))

    return take


def scratch(light: Image, rng: np.random.Generator) -> Image:
    """A noisy photograph with a white scratch in two rows of pixels."""
    image = noisy()(light, rng)
    image[34:36, 12:30] = 0.95
    return image
