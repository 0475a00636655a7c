"""Fits in several passes, each on the surface of the last pass's normals."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from phongfit.geometry.cameras import OrthographicCamera
from phongfit.geometry.height import HeightField
from phongfit.geometry.surfaces import NormalMap
from phongfit.lights import PointLight, SpotLight
from phongfit.maps.blocks import Kept
from phongfit.maps.result import Maps
from phongfit.maps.stacks import AbstractStack, KeptStack
from phongfit.scene import Scene

SAMPLE = 512
"""Maximum number of pixels from which the distance of a surface is estimated."""

REACH, FINEST = 0.25, 1e-4
"""Range and tolerance of the search for the surface's offset, in distances of the
nearest lamp. The range is halved in each further pass."""

STEPS = 5
"""Number of offsets that are tried first."""


def fit_in_passes(
    once: Callable[..., Maps],
    scenes: Sequence[Scene],
    stack: AbstractStack,
    passes: int,
    kept: Kept | None,
    progress: bool,
) -> tuple[Maps, Sequence[Scene]]:
    """Fit maps with unknown normals, each pass on the surface of the last.

    **Arguments:**

    - `once`: one pass, as a function of scenes, images, `kept` and `progress`.
    - `kept`: the store of the last pass; those of earlier passes are inside.

    **Returns:** the maps, and the scenes of the last pass, with its surface.
    """

    def store(number: int) -> Kept | None:
        if kept is None or number == passes:
            return kept
        return kept.inside(f"pass_{number}")

    maps = once(scenes, stack, kept=store(1), progress=progress)
    for number in range(2, passes + 1):
        field = maps.height()
        quick = functools.partial(
            once, images=KeptStack(stack), kept=None, progress=False
        )
        reach = REACH * 0.5 ** (number - 2)
        offset = find_offset(quick, scenes, field, _sample(maps), reach)
        scenes = on_surface(scenes, field, field.mask, offset, shadows=True)
        maps = once(scenes, stack, kept=store(number), progress=progress)
    maps = dataclasses.replace(maps, misplacement=misplacement(maps, scenes))
    return maps, scenes


def find_offset(
    fit: Callable[..., Maps],
    scenes: Sequence[Scene],
    field: HeightField,
    sample: Bool[np.ndarray, "height width"],
    reach: float = REACH,
) -> float:
    """Estimate how much nearer to the camera a surface is than `field`, world units.

    Normals do not determine it, near lamps do: the noise of `sample` is least at the
    true offset. Its geometric mean is compared, which is the likelihood of pixels that
    each have their own level of noise.

    **Arguments:**

    - `fit`: function that fits maps to scenes.
    - `reach`: largest offset, in distances of the nearest lamp.
    """
    from scipy.optimize import minimize_scalar

    lamps = near_lamps(scenes)
    if not lamps:
        return 0.0
    middle = np.median(field.positions()[field.mask], axis=0)
    near = float(np.linalg.norm(np.stack(lamps) - middle, axis=-1).min())

    def noise(offset: float) -> float:
        found = fit(on_surface(scenes, field, sample, offset * near, shadows=False))
        return float(np.log(found.noise[found.noise > 0]).mean())

    places = np.linspace(-reach, reach, STEPS)
    levels = [noise(place) for place in places]
    best = int(np.argmin(levels))
    around = places[max(best - 1, 0)], places[min(best + 1, STEPS - 1)]
    options = {"xatol": FINEST}
    found: Any = minimize_scalar(
        noise, bounds=around, method="bounded", options=options
    )
    return near * float(found.x if found.fun < levels[best] else places[best])


def usual_passes(scenes: Sequence[Scene]) -> int:
    """Default number of passes of a fit with unknown normals.

    Shadows are computed from the second pass on; with near lamps each pass also
    improves the surface's position.
    """
    return 3 if near_lamps(scenes) else 2


def misplacement(maps: Maps, scenes: Sequence[Scene]) -> float:
    """Error of the directions to near lamps, from the pixels' assumed positions.

    The scenes' positions are compared with the surface that the fitted normals belong
    to, moved as a whole to the scenes' distance.

    **Returns:** root mean square over the pixels, degrees; 0 for distant lamps.
    """
    lamps = near_lamps(scenes)
    if not lamps:
        return 0.0
    field = maps.height()
    camera = field.camera
    assumed = camera.position @ np.asarray(camera.rotation, float)[:, 2] - maps.depth
    inside = field.mask & np.isfinite(assumed)
    if not inside.any():
        return 0.0
    off = (field.height - assumed)[inside]
    off -= np.median(off)
    middle = np.median(field.positions()[inside], axis=0)
    near = np.linalg.norm(np.stack(lamps) - middle, axis=-1).min()
    return math.degrees(math.sqrt(np.mean(off**2)) / near)


def near_lamps(scenes: Sequence[Scene]) -> list[Float[np.ndarray, "3"]]:
    """Positions of the lamps that have one, world units."""
    lamps = (light for scene in scenes for light in scene.lights)
    near = (x.position for x in lamps if isinstance(x, PointLight | SpotLight))
    return [np.asarray(position, float) for position in near]


def on_surface(
    scenes: Sequence[Scene],
    field: HeightField,
    mask: Bool[np.ndarray, "height width"],
    offset: float,
    *,
    shadows: bool,
) -> tuple[Scene, ...]:
    """Scenes whose pixels lie on a surface, moved to the camera by `offset`."""
    points = moved(field, offset)
    axis = np.asarray(field.camera.rotation)[:, 2]
    surface = NormalMap(np.broadcast_to(axis, points.shape), mask, points)
    replace = functools.partial(dataclasses.replace, surface=surface, shadows=shadows)
    return tuple(replace(scene) for scene in scenes)


def moved(field: HeightField, offset: float) -> Float[np.ndarray, "height width 3"]:
    """Points of a height field, moved by `offset` to the camera, world units.

    For a perspective camera the surface is scaled about the eye, which keeps its
    normals; `offset` is then that of the median depth.
    """
    points, camera = field.positions(), field.camera
    axis = np.asarray(camera.rotation, float)[:, 2]
    if isinstance(camera, OrthographicCamera):
        return points + offset * axis
    eye = np.asarray(camera.position, float)
    away = float(np.median((eye - points[field.mask]) @ axis))
    return eye + (1 - offset / away) * (points - eye)


def _sample(maps: Maps) -> Bool[np.ndarray, "height width"]:
    """Evenly chosen pixels that were fitted, and identified if there are any such."""
    fitted = np.isfinite(maps.noise)
    usable = maps.identified if maps.identified.any() else fitted
    pixels = np.flatnonzero(usable)
    sample = np.zeros(usable.shape, bool)
    sample.ravel()[pixels[:: math.ceil(len(pixels) / SAMPLE)]] = True
    return sample
