"""Situations with kinds of noise, of files, and of samples that are left out."""

from collections.abc import Mapping
from typing import Any

import numpy as np

import phongfit as pf
from experiments.honesty.situations.base import (
    NOISE,
    Image,
    Photograph,
    Situation,
    alike,
    clamped,
    fits,
    noisy,
    usual_material,
    usual_subject,
)
from experiments.honesty.situations.models import random_material
from phongfit.rendering.film import decode, encode

# Variance of shot noise at white (1), and standard deviation of the read noise.
SHOT, READ = 4e-4, 0.003


def situations() -> list[Situation]:
    """All situations with kinds of noise, of files, and of masks."""
    right: dict[str, Any] = {
        "noise 0.0001": fits(usual_subject(), noisy(1e-4)),
        "noise 0.05": fits(usual_subject(), noisy(0.05)),
        "noise 0.01, given": fits(usual_subject(), noisy(), noise=NOISE),
        "noise 0.2, clamped": fits(
            usual_subject(usual_material(shininess=8.0)), clamped(noisy(0.2))
        ),
        "uniform noise": fits(usual_subject(), uniform),
        "Laplace's noise": fits(usual_subject(), laplace),
        "shot noise, its map given": fits(
            usual_subject(), shot_noise, draw_options=shot_map
        ),
        "weights": fits(usual_subject(), shot_noise, draw_options=shot_weights),
        "a hole in the mask": fits(usual_subject(), noisy(), draw_options=hole),
        "mosaic": fits(usual_subject(), noisy(), draw_options=mosaic),
        "8 bits": fits(usual_subject(), film("linear", 8, 0.005)),
        "8 bits, sRGB": fits(usual_subject(), film("srgb", 8, 0.005)),
        "8 bits, sRGB, noise given": fits(
            usual_subject(), film("srgb", 8, 0.005), noise=0.005
        ),
        "8 bits, sRGB, two channels near black": fits(
            usual_subject(pf.preset("ruby")), film("srgb", 8, 0.01)
        ),
        "16 bits": fits(usual_subject(), film("linear", 16, 0.002)),
        "16 bits, sRGB": fits(usual_subject(), film("srgb", 16, 0.002)),
    }
    doubtful: dict[str, Any] = {
        "noise 0.2": fits(usual_subject(), noisy(0.2)),
        "noise given is half": fits(usual_subject(), noisy(), noise=NOISE / 2),
        "noise given is twice": fits(usual_subject(), noisy(), noise=2 * NOISE),
        "noise of neighbours alike": fits(usual_subject(), smoothed),
        "shot noise, not given": fits(usual_subject(), shot_noise),
        "shot noise, not given, cauchy": fits(
            usual_subject(), shot_noise, loss="cauchy"
        ),
        "dark noise in one channel": fits(usual_subject(), red_noise),
        "dark noise in one channel, tukey": fits(
            usual_subject(), red_noise, loss="tukey"
        ),
    }
    exact: dict[str, Any] = {
        "no noise": fits(random_material, noisy(0.0)),
        "noise below a level of 8 bits": fits(random_material, film("srgb", 8, 5e-4)),
        "no noise, 8 bits, sRGB": fits(random_material, film("srgb", 8, 0.0)),
    }
    return [
        *alike("right", right),
        *alike("doubtful", doubtful, wide=True),
        *alike("right", exact, wide=True),
    ]


def film(encoding: Any, bits: int, level: float) -> Photograph:
    """A `Photograph` that adds noise, clips, encodes, rounds to `bits`, and decodes.

    **Arguments:** `level`: standard deviation of the noise in linear light.
    """
    highest = 2**bits - 1

    def photograph(light: Image, rng: np.random.Generator) -> Image:
        shown = np.clip(noisy(level)(light, rng), 0, 1)
        return decode(np.round(encode(shown, encoding) * highest) / highest, encoding)

    return photograph


def uniform(light: Image, rng: np.random.Generator) -> Image:
    """Add uniform noise, which has no large deviations."""
    # ± √3 σ has the standard deviation σ.
    return light + NOISE * rng.uniform(-np.sqrt(3), np.sqrt(3), light.shape)


def laplace(light: Image, rng: np.random.Generator) -> Image:
    """Add Laplace's noise, with more large deviations than Gaussian noise."""
    # The standard deviation of Laplace's distribution is √2 times its scale.
    return light + rng.laplace(0, NOISE / np.sqrt(2), light.shape)


def shot_variance(light: Image) -> Image:
    """Variance of shot noise and read noise."""
    return SHOT * np.maximum(light, 0) + READ**2


def shot_noise(light: Image, rng: np.random.Generator) -> Image:
    """Add noise whose variance grows with the light."""
    return light + np.sqrt(shot_variance(light)) * rng.normal(size=light.shape)


def shot_map(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
    """The option `noise` of a fit: the standard deviation of each sample."""
    del rng
    return {"noise": np.sqrt(shot_variance(light))}


def shot_weights(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
    """The option `weights` of a fit: inverse variances, in an arbitrary unit."""
    del rng
    return {"weights": NOISE**2 / shot_variance(light)}


def smoothed(light: Image, rng: np.random.Generator) -> Image:
    """Add noise that neighbours share, as after a camera's interpolation of colours."""
    independent = rng.normal(size=light.shape)
    # Sums of two neighbours along each axis, of the same variance.
    rows = (independent + np.roll(independent, 1, axis=0)) / np.sqrt(2)
    return light + NOISE * (rows + np.roll(rows, 1, axis=1)) / np.sqrt(2)


def red_noise(light: Image, rng: np.random.Generator) -> Image:
    """Add noise with a standard deviation in red three times that in green and blue."""
    return light + NOISE * np.array([3.0, 1.0, 1.0]) * rng.normal(size=light.shape)


def hole(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
    """Options with a mask that leaves out a disc, with a part of the highlight."""
    del rng
    rows, columns = np.indices(light.shape[:2])
    row, column = np.array(light.shape[:2]) * (0.42, 0.6)
    squared_distance = (rows - row) ** 2 + (columns - column) ** 2
    return {"mask": squared_distance > (0.06 * len(light)) ** 2}


def mosaic(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
    """Options with a mask of one channel for each pixel, as behind a Bayer filter."""
    del rng
    mask = np.zeros(light.shape, bool)
    mask[::2, ::2, 0] = mask[1::2, 1::2, 2] = True
    mask[::2, 1::2, 1] = mask[1::2, ::2, 1] = True
    return {"mask": mask}
