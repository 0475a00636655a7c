"""A made-up stack: a bumpy surface, its own material in every pixel, many lights."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import imagecodecs
import jax.numpy as jnp
import numpy as np
import scipy.io

import phongfit as pf
from data_synth.lights import spread_directions
from phongfit.files.images import write_image
from phongfit.maps.result import PLAIN

FREE = pf.Film(clamp=False)


def dtype() -> np.dtype:
    """The type of floats in the precision that is set."""
    return np.dtype(jnp.result_type(float))


def shown(
    scenes: Sequence[pf.Scene], material: pf.Material, film: pf.Film = FREE, **options
) -> np.ndarray:
    """Renders of a material in several scenes, (L, H, W, 3)."""
    images = [pf.render(one, material, film=film, **options) for one in scenes]
    return np.stack([np.asarray(image) for image in images])


def noisy(
    images: np.ndarray, noise: float | np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Images with normal noise, in the precision that is set."""
    return (images + noise * rng.normal(size=images.shape)).astype(dtype())


class Stack(NamedTuple):
    """Scenes, images (L, H, W, 3) and the materials behind them."""

    scenes: tuple[pf.Scene, ...]
    images: np.ndarray
    truth: pf.Material


def make_stack(
    height: int = 16,
    width: int = 24,
    lights: int = 16,
    *,
    ambient: float = 0.3,
    noise: float = 0.01,
    seed: int = 0,
    model: pf.AbstractSpecular | None = None,
    color: tuple[float, float, float] = (1.0, 0.9, 0.8),
) -> Stack:
    """All materials are random and inside their box; highlights reach every pixel."""
    rng = np.random.default_rng(seed)
    size = (height, width)
    normals = np.concatenate(
        [rng.uniform(-0.4, 0.4, (*size, 2)), np.ones((*size, 1))], axis=-1
    )
    surface = pf.NormalMap(normals)
    camera = pf.OrthographicCamera(width, height)
    truth = pf.Material(
        diffuse=rng.uniform(0.15, 0.4, (*size, 3)),
        specular=rng.uniform(0.2, 0.4, (*size, 3)),
        shininess=np.exp(rng.uniform(np.log(6), np.log(30), (*size, 1))),
        ambient=rng.uniform(0.2, 0.6, (*size, 3)) if ambient else 0.0,
    )
    scenes = tuple(
        pf.Scene(
            surface,
            camera,
            pf.DirectionalLight(direction, color),
            ambient=ambient,
            specular_model=model,
        )
        for direction in spread_directions(lights)
    )
    gbuffer = pf.geometry.trace(surface, camera)
    clean = shown(scenes, truth, gbuffer=gbuffer)
    return Stack(scenes, noisy(clean, noise, rng), truth)


def pulls(maps: pf.Maps, truth: pf.Material, name: str) -> np.ndarray:
    """(estimate − truth) / predicted error, where identified and within the bounds."""
    sound = maps.identified & ~maps.flagged(pf.Flag.AT_BOUND)
    error = np.asarray(getattr(maps.stderr, name), float)
    value = np.asarray(getattr(maps, name), float)
    true = np.broadcast_to(np.asarray(getattr(truth, name), float), value.shape)
    return ((value - true) / error)[sound]


def spread(pull: np.ndarray) -> float:
    """Half of the width that holds 68 %: long tails would decide a mean square."""
    return float(np.diff(np.quantile(pull, [0.1587, 0.8413]))[0] / 2)


def write_diligent(folder: Path, stack: Stack, brightness: float = 1.0) -> None:
    """A stack in the layout of DiLiGenT; what is brighter than 1 is saturated."""
    surface, camera = stack.scenes[0].surface, stack.scenes[0].camera
    rng = np.random.default_rng(1)
    names = [f"{k + 1:03d}.png" for k in range(len(stack.scenes))]
    intensities = rng.uniform(0.7, 1.3, (len(names), 3))
    lights = [scene.lights[0].illuminate(jnp.zeros(3)) for scene in stack.scenes]
    directions = [np.asarray(light.to_light) for light in lights]
    for name, image, intensity in zip(names, stack.images, intensities, strict=True):
        write_image(folder / name, brightness * image * intensity, "linear", 16)
    (folder / "filenames.txt").write_text("\n".join(names))
    np.savetxt(folder / "light_directions.txt", directions)
    np.savetxt(folder / "light_intensities.txt", intensities)
    mask = np.full((camera.height, camera.width), 255, np.uint8)
    mask[:2] = 0
    (folder / "mask.png").write_bytes(imagecodecs.png_encode(mask))
    normals = np.asarray(pf.geometry.trace(surface, camera).normal, float)
    scipy.io.savemat(folder / "Normal_gt.mat", {"Normal_gt": normals})


def same(a: pf.Maps, b: pf.Maps) -> None:
    """Two maps agree bit for bit."""
    for name in ("ambient", "diffuse", "specular", "shininess"):
        for x, y in ((a, b), (a.stderr, b.stderr)):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))
    for name in PLAIN:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
