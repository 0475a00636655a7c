"""Synthetic photographs of a known material."""

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from data_synth.lights import brightest_intensity, make_lights
from phongfit import (
    AbstractLight,
    AbstractSpecular,
    Film,
    Material,
    OrthographicCamera,
    Scene,
    Sphere,
    render,
)
from phongfit.files.dataset import Dataset
from phongfit.files.images import from_levels, to_levels
from phongfit.geometry import AbstractCamera, AbstractSurface, GBuffer, trace
from phongfit.rendering.film import Encoding


def make_dataset(
    material: Material,
    *,
    key: PRNGKeyArray,
    surface: AbstractSurface | None = None,
    camera: AbstractCamera | None = None,
    lights: Iterable[AbstractLight] | None = None,
    images: int | None = None,
    ambient: Any = 0.2,
    specular_model: AbstractSpecular | None = None,
    noise: float = 0.0,
    bits: Literal[8, 16] | None = 8,
    encoding: Encoding = "srgb",
    name: str = "synthetic",
) -> Dataset:
    """Synthetic photographs of `material` with noise, as if read from image files.

    **Arguments:**

    - `material`: the true material, which all images show.
    - `key`: JAX's random key for the noise.
    - `surface`, `camera`: default a ball of radius 1 that fills 256 × 256 pixels.
    - `lights`: default four directional ones of equal intensity, so bright that the
        brightest sample is 95 % of white.
    - `images`: number of images, 1 to the number of lights, among which the lights are
        distributed: image k of n has the lights k, k + n, k + 2n, … `None`: one image
        for each light.
    - `ambient`: the ambient light I_a, RGB or one number.
    - `specular_model`: model of the highlight; `None` is Blinn-Phong.
    - `noise`: standard deviation of Gaussian noise in linear light, where white is 1;
        added before light is clipped to [0, 1] and rounded.
    - `bits`, `encoding`: of the images' numbers. `bits=None`: they are not rounded.
    - `name`: name of the data set.

    **Returns:** a data set whose images are linear light in [0, 1], with `material` as
    its `truth`.

    **Raises:** `ValueError` that names the argument.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise ValueError(f"noise: expected a number ≥ 0, got {noise}")
    film = Film(encoding=encoding, bits=bits)
    if bits not in (None, 8, 16):
        raise ValueError(f"bits: expected 8, 16 or None, got {bits}")
    surface = Sphere() if surface is None else surface
    camera = OrthographicCamera() if camera is None else camera

    unlit = Scene(surface, camera, (), ambient, specular_model=specular_model)
    if lights is None:
        lit = distribute_lights(unlit, make_lights(), images)
        lights = make_lights(intensity=brightest_intensity(lit, material))
    scenes = distribute_lights(unlit, tuple(lights), images)
    gbuffer = trace(surface, camera)
    photographs = tuple(
        _photograph(
            scene, material, gbuffer, film, noise, jax.random.fold_in(key, index)
        )
        for index, scene in enumerate(scenes)
    )
    suffix = ".tif" if bits is None else ".png"
    return Dataset(
        name=name,
        scenes=scenes,
        images=photographs,
        masks=(np.ones((camera.height, camera.width), bool),) * len(scenes),
        names=tuple(f"{index + 1:03d}{suffix}" for index in range(len(scenes))),
        film=film,
        truth=material,
    )


def distribute_lights(
    scene: Scene, lights: tuple[AbstractLight, ...], images: int | None
) -> tuple[Scene, ...]:
    """Copies of `scene`, one for each image, among which the lights are distributed.

    **Arguments:**

    - `lights`: replace those of `scene`. Image k of n gets the lights k, k + n, …
    - `images`: number of images n; `None`: one for each light.

    **Raises:** `ValueError` if there are more images than lights, or no images.
    """
    count = len(lights) if images is None else images
    if not 1 <= count <= len(lights):
        raise ValueError(
            f"images: expected 1 … {len(lights)}, got {count} (each needs a light)"
        )
    return tuple(
        dataclasses.replace(scene, lights=lights[index::count])
        for index in range(count)
    )


def _photograph(
    scene: Scene,
    material: Material,
    gbuffer: GBuffer,
    film: Film,
    noise: float,
    key: PRNGKeyArray,
) -> Float[np.ndarray, "height width 3"]:
    """The rendered scene with Gaussian noise, as [`develop`][] returns it.

    **Arguments:** `gbuffer`: the traced scene; `noise`: standard deviation in linear
    light.
    """
    light = render(scene, material, film=Film(clamp=False), gbuffer=gbuffer)
    return develop(light + noise * jax.random.normal(key, light.shape), film)


def develop(
    light: Float[Array, "height width 3"], film: Film
) -> Float[np.ndarray, "height width 3"]:
    """Linear light after storage in an image file with this film: clipped and rounded.

    Light is clipped to [0, 1], encoded, rounded to `film.bits` and decoded. Where
    `film.bits` is `None`, it is only clipped.
    """
    if film.bits is None:
        return np.clip(np.asarray(light), 0, 1)
    return from_levels(to_levels(light, film.encoding, film.bits), film.encoding)
