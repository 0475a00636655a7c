"""Situations with maps: every pixel, with a random material, counts as a draw."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.honesty.answers import LEVEL, Answers
from experiments.honesty.situations.base import (
    NOISE,
    UNCLAMPED,
    Draws,
    Situation,
    alike,
)
from phongfit.fitting.uncertainty.quantiles import student_reach

# Pixels of each draw: a map has one row of them for each draw.
PIXELS = 100
LIGHTS = 16
# Ambient light of all scenes.
AMBIENT = 0.3
PARAMETERS = ("ambient", "diffuse", "specular", "shininess")
CHANNELS = ("red", "green", "blue")

Stack = Float[np.ndarray, "lights height width 3"]
Materials = Callable[[np.random.Generator, tuple[int, int]], pf.Material]
"""Makes random materials for the pixels of a map, given its height and width."""

Degrade = Callable[[Stack, np.random.Generator], tuple[Stack, Mapping[str, Any]]]
"""Changes photographs; returns them, and options of the map such as a mask."""


def situations() -> list[Situation]:
    """All situations with maps."""
    # Maps with a `full_mask` share compiled programs with those with other masks.
    given: Any = {"noise": NOISE}
    right: dict[str, Any] = {
        "maps": maps(),
        "maps, noise 0.05": maps(level=0.05),
        "maps, noise given": maps(full_mask, **given),
        "maps, mosaic": maps(mosaic, **given),
        "maps, samples missing": maps(missing, **given),
        "maps, a saturated channel": maps(saturated, materials=bright_red),
        "maps, at bounds": maps(materials=at_bounds),
        "maps, at bounds, noise given": maps(full_mask, materials=at_bounds, **given),
        "maps, Cauchy, clean": maps(loss="cauchy"),
        "maps, Tukey, clean, noise given": maps(full_mask, loss="tukey", **given),
        "maps, Tukey, 10% garbage": maps(outliers, loss="tukey", **given),
        "maps, an exponent a channel": maps(per_channel=PARAMETERS),
        "maps, seven lights": maps(full_mask, lights=7, **given),
    }
    no_red = {"maps, a masked channel": maps(masked, **given)}
    red = ("ambient.red", "diffuse.red", "specular.red")
    dull = {"maps, no highlight": maps(materials=matte)}
    wide = ("0.05", "bounds", "garbage", "seven", "channel", "missing", "mosaic")
    return [
        *(
            Situation(name, "right", answer, wide=any(word in name for word in wide))
            for name, answer in right.items()
        ),
        *alike("open", no_red, unidentifiable=red, wide=True),
        Situation("maps, an unknown shadow", "wrong", maps(shadowed, **given)),
        *alike("open", dull, unidentifiable=("shininess",), wide=True),
    ]


def maps(
    degrade: Degrade | None = None,
    *,
    materials: Materials | None = None,
    lights: int = LIGHTS,
    level: float = NOISE,
    **options: Any,
) -> Callable[[Draws], Answers]:
    """A function that fits a map in which every pixel has its own random material.

    **Arguments:**

    - `degrade`: changes the photographs; `None`: they have noise only.
    - `materials`: `None`: [`random_material`][].
    - `level`: standard deviation of the noise.
    - `options`: of [`phongfit.fit_maps`][].
    """

    def answer(draws: Draws) -> Answers:
        # One map for all draws, from the first one's generator.
        rng = draws[0]
        size = (len(draws), PIXELS)
        scenes, images, truth = photographs(
            rng,
            size,
            lights,
            level,
            random_material if materials is None else materials,
        )
        extra: Mapping[str, Any] = {}
        if degrade is not None:
            images, extra = degrade(images, rng)
        fitted = pf.fit_maps(scenes, images, progress=False, **options, **extra)
        return answers_of_maps(fitted, truth)

    return answer


def photographs(
    rng: np.random.Generator,
    size: tuple[int, int],
    lights: int,
    level: float,
    materials: Materials,
) -> tuple[tuple[pf.Scene, ...], Stack, pf.Material]:
    """Scenes of random normals, one for each lamp; their noisy images; the materials.

    **Arguments:** `size`: height and width, pixels; `lights`: number of lamps; `level`:
    standard deviation of the noise.
    """
    normals = np.ones((*size, 3))
    normals[..., :2] = rng.uniform(-0.4, 0.4, (*size, 2))
    surface = pf.NormalMap(normals)
    camera = pf.OrthographicCamera(size[1], size[0])
    scenes = tuple(
        pf.Scene(surface, camera, pf.DirectionalLight(direction), AMBIENT)
        for direction in spread_directions(lights)
    )
    truth = materials(rng, size)
    gbuffer = pf.geometry.trace(surface, camera)
    clean = [pf.render(s, truth, film=UNCLAMPED, gbuffer=gbuffer) for s in scenes]
    images = np.stack([np.asarray(image) for image in clean])
    noise = level * rng.normal(size=images.shape)
    return scenes, images + noise.astype(images.dtype), truth


def random_material(rng: np.random.Generator, size: tuple[int, int]) -> pf.Material:
    """Random materials within the bounds, so broad that each pixel has a highlight."""
    return pf.Material(
        diffuse=rng.uniform(0.15, 0.4, (*size, 3)),
        specular=rng.uniform(0.2, 0.4, (*size, 3)),
        shininess=np.exp(rng.uniform(np.log(6), np.log(30), (*size, 1))),
        ambient=rng.uniform(0.2, 0.6, (*size, 3)),
    )


def at_bounds(rng: np.random.Generator, size: tuple[int, int]) -> pf.Material:
    """Random materials; a third of the reflectances ρ_d and ρ_a is 0."""
    inside = random_material(rng, size)

    def thinned(values: Any) -> np.ndarray:
        return np.where(rng.random((*size, 3)) < 1 / 3, 0, np.asarray(values))

    return pf.Material(
        thinned(inside.diffuse),
        inside.specular,
        inside.shininess,
        thinned(inside.ambient),
    )


def bright_red(rng: np.random.Generator, size: tuple[int, int]) -> pf.Material:
    """Random materials whose red channel exceeds white under some of the lamps."""
    usual = random_material(rng, size)
    diffuse, specular = np.array(usual.diffuse), np.array(usual.specular)
    # Channel 0 is red.
    diffuse[..., 0] = rng.uniform(0.6, 0.9, size)
    specular[..., 0] = rng.uniform(0.3, 0.6, size)
    return dataclasses.replace(
        usual, diffuse=jnp.asarray(diffuse), specular=jnp.asarray(specular)
    )


def matte(rng: np.random.Generator, size: tuple[int, int]) -> pf.Material:
    """Random materials without a highlight."""
    return dataclasses.replace(
        random_material(rng, size), specular=jnp.zeros((*size, 3))
    )


def full_mask(
    images: Stack, rng: np.random.Generator
) -> tuple[Stack, Mapping[str, Any]]:
    """Give a mask that is true for every sample: the programs of other masks serve."""
    del rng
    return images, {"mask": np.ones(images.shape[1:], bool)}


def mosaic(images: Stack, rng: np.random.Generator) -> tuple[Stack, Mapping[str, Any]]:
    """Keep one random channel of each pixel of each image, as a moved Bayer filter."""
    lights, *size, _ = images.shape
    channel = rng.choice(3, size=(lights, *size), p=(0.25, 0.5, 0.25))
    return images, {"mask": list(channel[..., None] == np.arange(3))}


def missing(images: Stack, rng: np.random.Generator) -> tuple[Stack, Mapping[str, Any]]:
    """Mask a random quarter of the samples; each channel of a pixel is one."""
    return images, {"mask": list(rng.random(images.shape) > 0.25)}


def masked(images: Stack, rng: np.random.Generator) -> tuple[Stack, Mapping[str, Any]]:
    """Mask all samples of red."""
    del rng
    return images, {"mask": np.broadcast_to([False, True, True], images.shape[1:])}


def saturated(
    images: Stack, rng: np.random.Generator
) -> tuple[Stack, Mapping[str, Any]]:
    """Clip the images at white."""
    del rng
    return np.minimum(images, 1), {}


def shadowed(
    images: Stack, rng: np.random.Generator
) -> tuple[Stack, Mapping[str, Any]]:
    """Halve the images of a quarter of the lamps, as if they were in partial shadow."""
    dark = images.copy()
    dark[: len(images) // 4] *= images.dtype.type(0.5)
    return full_mask(dark, rng)


def outliers(
    images: Stack, rng: np.random.Generator
) -> tuple[Stack, Mapping[str, Any]]:
    """Replace a tenth of the samples by random numbers in [0, 1)."""
    random_values = rng.random(images.shape).astype(images.dtype)
    changed = np.where(rng.random(images.shape) < 0.1, random_values, images)
    return full_mask(changed, rng)


def answers_of_maps(fitted: pf.Maps, truth: pf.Material) -> Answers:
    """Answers of a map, with every pixel as a draw and every flag as a warning."""
    columns = [
        column for name in PARAMETERS for column in _columns(fitted, truth, name)
    ]
    labels, value, error, true = zip(*columns, strict=True)
    estimate, error, true = (
        np.stack(one, axis=1).astype(float) for one in (value, error, true)
    )
    # The default bounds of maps.
    bounds = np.array(
        [(1.0, 1000.0) if "shininess" in one else (0.0, 1.0) for one in labels]
    )
    # Standard errors from an estimate to the end of its 95 % interval, if the noise is
    # given; otherwise it is estimated from the residuals of the pixel.
    reach = 1.959964
    if fitted.noise_given is None:
        freedom = int(np.median(fitted.samples)) - len(labels)
        reach = student_reach(LEVEL, freedom)
    low, high = np.clip(estimate + reach * error * [[[-1.0]], [[1.0]]], *bounds.T)
    # Estimates in single precision may be off their bound by rounding.
    near = 1e-5 * np.maximum(bounds, 1e-3)
    at_bound = estimate <= (bounds + near)[:, 0]
    at_bound |= estimate >= (bounds - near)[:, 1]
    flags = fitted.flags.ravel()
    sentences = {int(one): flag_words(int(one)) for one in np.unique(flags)}
    warnings = tuple(sentences[int(one)] for one in flags)
    return Answers(
        tuple(labels), true, estimate, error, low, high, at_bound, bounds, warnings
    )


def _columns(fitted: pf.Maps, truth: pf.Material, name: str) -> list[tuple[Any, ...]]:
    """Label, estimates, errors and truths of a parameter's channels, (pixels,) each."""
    value, error = getattr(fitted, name), getattr(fitted.stderr, name)
    true = np.broadcast_to(np.asarray(getattr(truth, name)), value.shape)
    labels = [name] if value.shape[-1] == 1 else [f"{name}.{c}" for c in CHANNELS]
    return [
        (label, value[..., k].ravel(), error[..., k].ravel(), true[..., k].ravel())
        for k, label in enumerate(labels)
    ]


def flag_words(flags: int) -> tuple[str, ...]:
    """Flags of a pixel, the bits of [`pf.Flag`][phongfit.Flag], as sentences."""
    names = [str(flag.name).lower().replace("_", " ") for flag in pf.Flag(flags)]
    return tuple(f"flag: {name}" for name in names)
