"""Situations with JPEG files, whose errors are shared by the pixels of a block."""

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np

import phongfit as pf
from experiments.honesty.answers import Answers, Trial, fit_trials
from experiments.honesty.situations.base import (
    LARGE,
    SIZE,
    Draw,
    Draws,
    Image,
    Situation,
    Subject,
    ball_scene,
    lamp,
    noisy,
    usual_subject,
)
from phongfit.files.formats import jpeg_compression
from phongfit.files.images import from_levels, to_levels
from phongfit.rendering.film import Film

# Standard deviation of the noise before compression, where white is 1.
NOISE = 0.003
# Pillow's numbers for chroma subsampling: a colour for each pixel, or for each 2 × 2.
SAMPLINGS = {"4:4:4": 0, "4:2:0": 2}


class Decoded(NamedTuple):
    """A photograph from a file, in linear light, and options of `pf.fit` for it."""

    image: Image
    options: Mapping[str, Any]


def situations() -> list[Situation]:
    """All situations with JPEG files: each quality and subsampling.

    Fits are given the file's compression, or only its pixels.
    """
    result = []
    for quality in (75, 90, 95):
        for sampling in SAMPLINGS:
            for known in (True, False):
                # Blocks can be detected only if there are more than a few dozen of
                # them.
                draw = functools.partial(random_ball, size=SIZE if known else LARGE)
                answer = jpeg_fits(draw, quality, sampling, known)
                origin = "its film known" if known else "of unknown origin"
                name = f"JPEG {quality}, {sampling}, {origin}"
                result.append(Situation(name, "doubtful", answer, wide=True))
    coarse = jpeg_fits(functools.partial(random_ball, size=SIZE), 30, "4:2:0", True)
    name = "JPEG 30, 4:2:0, its film known"
    required_warning = "[coarse-jpeg]"
    return [
        *result,
        Situation(
            name, "doubtful", coarse, wide=True, required_warning=required_warning
        ),
    ]


def random_ball(rng: np.random.Generator, size: int) -> Subject:
    """A ball of a random material under a random lamp, in `size` × `size` pixels.

    JPEG's rounding errors depend on both, so photographs of one ball would share them.
    """
    material = pf.Material(
        diffuse=rng.uniform(0.15, 0.6, 3),
        specular=rng.uniform(0.2, 0.4, 3),
        shininess=np.exp(rng.uniform(np.log(8), np.log(40))),
        ambient=rng.uniform(0.2, 0.6, 3),
    )
    return usual_subject(
        material, ball_scene(lamp((*rng.uniform(-1, 1, 2), 2)), size=size)
    )


def jpeg_fits(
    draw: Draw, quality: int, sampling: str, known: bool
) -> Callable[[Draws], Answers]:
    """A function that fits photographs read from JPEG files, one for each draw.

    **Arguments:** `quality`, `sampling`: of the files; `known`: whether fits are given
    the files' compression.
    """

    def trials(draws: Draws) -> Iterator[Trial]:
        for rng in draws:
            subject = draw(rng)
            light = noisy(NOISE)(subject.light[0], rng)
            read = through_jpeg(light, quality, sampling, known)
            scenes = subject.scenes
            yield Trial(
                scenes[0], read.image, read.options, scenes, subject.material, {}
            )

    return lambda draws: fit_trials(trials(draws))


def through_jpeg(light: Image, quality: int, sampling: str, known: bool) -> Decoded:
    """Linear light written as an 8-bit sRGB JPEG and read back.

    **Arguments:** `known`: whether to return options with the file's compression.
    """
    data = iio.imwrite(
        "<bytes>",
        to_levels(light, "srgb", 8),
        extension=".jpg",
        plugin="pillow",
        quality=quality,
        subsampling=SAMPLINGS[sampling],
    )
    jpeg = jpeg_compression(data)
    options = {"film": Film(encoding="srgb", jpeg=jpeg)} if known else {}
    return Decoded(from_levels(iio.imread(data, extension=".jpg"), "srgb"), options)
