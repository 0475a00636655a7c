"""Checks of the data of a fit: scenes, images, masks, weights and noise."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from phongfit.checks import NOISE, as_array, is_noise, unmasked
from phongfit.scene import Scene


@dataclasses.dataclass(frozen=True)
class Observation:
    """One image, its scene, and the weights of its samples.

    The weight has shape (1, 1, 1) if it is the same for all samples, which saves
    memory.
    """

    name: str
    scene: Scene
    image: np.ndarray
    weight: np.ndarray

    def used(self) -> np.ndarray:
        """Values of the samples with a weight above 0, in any shape."""
        used = self.weight > 0
        if used.all():
            return self.image
        return self.image[np.broadcast_to(used, self.image.shape)]


def as_scenes(scene: Scene | Sequence[Scene]) -> tuple[Scene, ...]:
    """The scenes as a tuple, checked to share specular model, shading and the like.

    **Raises:** `ValueError` that names the argument.
    """
    scenes = tuple(scene) if isinstance(scene, Iterable) else (scene,)
    if not scenes or not all(isinstance(s, Scene) for s in scenes):
        raise ValueError("scene: expected a Scene, or a sequence of at least one")
    _check_alike(scenes)
    return scenes


def as_photographs(
    scene: Scene | Sequence[Scene], image: Any, mask: Any, weights: Any, noise: Any
) -> list[Observation]:
    """Arguments of [`fit`][] as a list of photographs.

    **Raises:** `ValueError` that names the argument, with its index if there are
    several.
    """
    single, scenes = isinstance(scene, Scene), as_scenes(scene)
    images = [image] if single else entries("image", image, len(scenes))
    masks, weightings, noises = (
        [given] * len(scenes)
        if single or given is None or (name == "noise" and is_number(given))
        else entries(name, given, len(scenes))
        for name, given in (("mask", mask), ("weights", weights), ("noise", noise))
    )
    return [
        _photograph("" if single else f"[{k}]", *parts)
        for k, parts in enumerate(
            zip(scenes, images, masks, weightings, noises, strict=True)
        )
    ]


def _check_alike(scenes: Sequence[Scene]) -> None:
    """Check that scenes differ in lights and views only, not in their models."""
    for what, of in (
        ("specular model", lambda s: s.specular_model),
        ("shading", lambda s: s.shading),
        ("number of materials", lambda s: s.surface.materials),
        ("use of fog", lambda s: s.fog is not None),
    ):
        if any(of(scene) != of(scenes[0]) for scene in scenes[1:]):
            raise ValueError(f"scene: all scenes must have the same {what}")


def is_number(given: Any) -> bool:
    """Whether the argument is one number for all samples."""
    # NumPy would make an array of a list first, which fails for images of two sizes.
    return not isinstance(given, list | tuple) and not as_array("noise", given).ndim


def entries(name: str, given: Any, count: int | None = None) -> list[Any]:
    """An argument for several scenes as a list; `ValueError` names `name`."""
    try:
        found = list(given)
    except Exception as error:
        # Iteration runs code of the object's class, which may raise anything.
        many = "" if count is None else f" of {count}"
        raise ValueError(
            f"{name}: expected a sequence{many}, one a scene, got "
            f"{type(given).__name__}"
        ) from error
    if count is not None and len(found) != count:
        raise ValueError(f"{name}: expected {count}, one a scene, got {len(found)}")
    return found


def _photograph(
    which: str, scene: Scene, image: Any, mask: Any, weights: Any, noise: Any
) -> Observation:
    shape = (scene.camera.height, scene.camera.width, 3)
    pixels = as_array(f"image{which}", image)
    if pixels.dtype.kind != "f":
        raise ValueError(
            f"image{which}: expected linear light as floats, where white is 1 (see "
            f"read_image), got {pixels.dtype}"
        )
    if pixels.shape != shape:
        raise ValueError(
            f"image{which}: expected shape {shape}, as the scene's camera has, got "
            f"{pixels.shape}"
        )
    pixels = pixels.astype(jnp.result_type(float), copy=False)
    weight = np.ones((1, 1, 1), pixels.dtype)
    if np.ma.is_masked(image):
        # NumPy's masks are true where a sample is left out.
        weight = weight * ~np.ma.getmaskarray(image)
    if mask is not None:
        values = _per_sample(f"mask{which}", mask, shape)
        if not np.isfinite(values).all():
            raise ValueError(
                f"mask{which}: expected true or false, got NaN or infinity"
            )
        weight = weight * values.astype(bool)
    if weights is not None:
        values = _where_used(f"weights{which}", weights, weight, shape)
        if not np.all(np.isfinite(values) & (values >= 0)):
            raise ValueError(f"weights{which}: expected finite numbers ≥ 0")
        weight = weight * values
    if noise is not None:
        values = _where_used(f"noise{which}", noise, weight, shape)
        if not np.all(is_noise(values)):
            low, high = NOISE
            raise ValueError(
                f"noise{which}: expected finite numbers > 0, from {low:g} to {high:g}"
            )
        weight = weight / values**2
    if not weight.any():
        raise ValueError(f"mask{which}: mask and weights leave no pixel")
    weight = weight.astype(pixels.dtype, copy=False)
    finite = np.isfinite(pixels)
    if finite.all():
        return Observation(f"image{which}", scene, pixels, weight)
    wrong = ~finite & (weight > 0)
    if wrong.any():
        y, x, c = np.argwhere(wrong)[0]
        raise ValueError(
            f"image{which}: {np.count_nonzero(wrong)} samples are NaN or infinite, the "
            f"first in row {y}, column {x}, channel {c}; mask them out"
        )
    return Observation(f"image{which}", scene, np.where(finite, pixels, 0), weight)


def _where_used(
    name: str, given: Any, weight: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """As `_per_sample`, with 1 in place of the values of samples without weight."""
    values = _per_sample(name, given, shape)
    return values if weight.all() else np.where(weight > 0, values, 1)


def _per_sample(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An argument of shape (), (H, W) or (H, W, 3) as (H, W, 3)."""
    unmasked(name, given)
    values = as_array(name, given)
    if values.dtype.kind not in "bfiu":
        raise ValueError(f"{name}: expected numbers, got {values.dtype} values")
    if values.shape == shape[:2]:
        values = values[..., None]
    elif values.shape not in ((), shape):
        raise ValueError(
            f"{name}: expected shape {shape[:2]} or {shape}, got {values.shape}"
        )
    return np.broadcast_to(values, shape)
