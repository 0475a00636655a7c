r"""The camera's angle of view, from photographs under known distant lamps.

Under distant lamps the view direction of a pixel affects only its highlight. So a
sample of pixels is fitted at several angles of view, with a noise level
$\sigma_p(\varphi)$ for each pixel. The estimate has the largest likelihood, which is
the minimum of

$$
C(\varphi) = \sum_p n_p \log \sigma_p(\varphi),
$$

with $n_p$ the number of samples of pixel p. Its standard error is a sandwich estimate,
since the lack of fit of neighbouring pixels is correlated: $\sqrt{\sum_b g_b^2} / C''$,
where $g_b$ is the derivative of the part of C that a block of pixels contributes.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.calibration.least_squares import blocks, summed_by_block
from phongfit.edge import checked
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
)
from phongfit.geometry.planes import plane_before
from phongfit.maps.layers import mask_layers
from phongfit.maps.run import fit_maps
from phongfit.maps.stacks import AbstractStack, KeptStack, as_stack
from phongfit.scene import Scene

SAMPLE = 600
"""Maximum number of pixels from which the angle is estimated, approximately."""

BRIGHT = 0.3
"""Least brightness of pixels in use, as a fraction of the median."""

ANGLES = (0.0, 10.0, 20.0, 30.0, 40.0, 55.0, 70.0)
"""Angles that are tried first, degrees; 0 stands for parallel rays."""

COARSE_ANGLES = (20.0, 40.0, 60.0)
"""Angles that `check_fov` compares with the given camera, degrees."""

STEPS = 3
"""Number of refinements by a parabola through the best angle and its neighbours."""

CLOSE = 0.5
"""The search ends at an angle this close to one that was tried, degrees."""

BLOCK = 8
"""Side of a block of pixels, in pixels, whose errors may be correlated."""

FLOOR = 1e-3
"""Least noise of a photograph, in linear light where white is 1."""

DETERMINED = 0.25
"""Largest standard error of an angle that counts as determined, relative to it."""

SIGNIFICANT = 3.0
"""Standard errors by which C must be below that of the given camera."""

LOWER = 0.9
"""Largest noise of an improvement, relative to that with the given camera."""


class FovFit(NamedTuple):
    """A camera's vertical angle of view.

    - `degrees`: the most likely angle; 0 for parallel rays.
    - `stderr`: its standard error, degrees; infinite if it is not determined.
    - `noise_ratio`: median noise of the pixels at this angle, over that with the camera
        of the scenes.
    - `better`: decrease of C from the camera of the scenes, in standard errors.
    """

    degrees: float
    stderr: float
    noise_ratio: float
    better: float

    @property
    def improves(self) -> bool:
        """True if the noise decreases significantly, and by at least a tenth.

        Smaller decreases may be caused by shadows and interreflections.
        """
        return self.noise_ratio < LOWER and self.better > SIGNIFICANT

    @property
    def determined(self) -> bool:
        """True if the angle improves the fit, with a relative error below a quarter."""
        return self.improves and self.stderr < DETERMINED * self.degrees

    def __str__(self) -> str:
        if not self.determined:
            return "angle of view: not identified"
        return (
            f"angle of view fitted: {self.degrees:.3g} ± {self.stderr:.2g} degrees "
            f"(noise {self.noise_ratio:.2g} times that of the camera given)"
        )


@checked
def fit_fov(
    scenes: Sequence[Scene], images: Any, *, mask: Any = None, **options: Any
) -> FovFit:
    """Estimate the angle of view with the least noise in maps of normals and materials.

    It needs highlights in many places: a matte surface looks equal from all directions.

    **Arguments:**

    - `scenes`, `images`, `mask`: as in [`fit_maps`][] with `normals="fit"`, under
        distant lamps whose directions are in the camera's axes.
    - `options`: further options of [`fit_maps`][], such as `per_channel`.

    **Returns:** [`FovFit`][]; see its `determined`. [`seen_over`][] makes scenes with
    that angle.

    **Raises:** `ValueError` as [`fit_maps`][] does.
    """
    return _fit_among(ANGLES, STEPS, scenes, images, mask, options)


def check_fov(
    scenes: Sequence[Scene], images: Any, *, mask: Any = None, **options: Any
) -> FovFit:
    """Check whether one of a few angles of view gives less noise than the scenes'.

    The arguments are those of [`fit_fov`][], which is slower and more precise.
    """
    return _fit_among(COARSE_ANGLES, 0, scenes, images, mask, options)


def _fit_among(
    angles: Sequence[float],
    steps: int,
    scenes: Sequence[Scene],
    images: Any,
    mask: Any,
    options: dict[str, Any],
) -> FovFit:
    stack = KeptStack(as_stack(images))
    sample = _sample(scenes, stack, mask)
    options = options | {"normals": "fit", "passes": 1, "progress": False}

    def fitted(some: Sequence[Scene]) -> _Noise:
        maps = fit_maps(some, stack, mask=sample, **options)
        return _Noise(maps.noise[sample].astype(float), maps.samples[sample])

    block = blocks(*sample.shape, side=BLOCK)[sample]
    given = fitted(scenes)
    noise = {degrees: fitted(seen_over(scenes, degrees)) for degrees in angles}
    for _ in range(steps):
        degrees = _next_angle(noise)
        if degrees is None:
            break
        noise[degrees] = fitted(seen_over(scenes, degrees))
    return _judge(noise, given, block)


def seen_over(scenes: Sequence[Scene], degrees: float) -> tuple[Scene, ...]:
    """Scenes of unknown normals with another vertical angle of view.

    **Arguments:** `degrees`: 0 for parallel rays.
    """
    height, width = scenes[0].camera.height, scenes[0].camera.width
    camera: AbstractCamera = OrthographicCamera(width, height)
    if degrees > 0:
        camera = PerspectiveCamera(width, height, fov_y=degrees, position=(0, 0, 0))
    plane = plane_before(camera)
    return tuple(
        dataclasses.replace(scene, camera=camera, surface=plane) for scene in scenes
    )


class _Noise(NamedTuple):
    """Noise level and number of samples of each sampled pixel."""

    level: Float[np.ndarray, " pixels"]
    samples: Int[np.ndarray, " pixels"]

    @property
    def cost(self) -> Float[np.ndarray, " pixels"]:
        """Negative log-likelihood of each pixel; NaN if it was not fitted."""
        return self.samples * np.log(np.hypot(self.level, FLOOR))


def _sample(
    scenes: Sequence[Scene], stack: AbstractStack, mask: Any
) -> Bool[np.ndarray, "height width"]:
    """Pixels evenly spread over the object, without the dark ones."""
    pixels = np.flatnonzero(mask_layers(mask, stack.shape).anywhere())
    pixels = pixels[:: max(1, len(pixels) // (3 * SAMPLE))]
    light = np.ma.getdata(stack.take(pixels, range(len(scenes)))).max(axis=(0, 2))
    pixels = pixels[light > BRIGHT * np.median(light)]
    chosen = np.zeros(stack.shape[1:], bool)
    chosen.ravel()[pixels[:: max(1, len(pixels) // SAMPLE)]] = True
    return chosen


def _next_angle(noise: dict[float, _Noise]) -> float | None:
    """The vertex of the parabola through the best angle and its neighbours.

    `None` if the best angle is the smallest or largest, or if the vertex is close to an
    angle that was tried.
    """
    angles = sorted(noise)
    together = np.all([np.isfinite(noise[a].cost) for a in angles], axis=0)
    costs = [noise[a].cost[together].sum() for a in angles]
    best = int(np.argmin(costs))
    if best in (0, len(angles) - 1):
        return None
    near = slice(best - 1, best + 2)
    second, first, _ = np.polyfit(angles[near], costs[near], 2)
    degrees = float(-first / (2 * second))
    return None if min(abs(degrees - a) for a in angles) < CLOSE else degrees


def _judge(
    noise: dict[float, _Noise], given: _Noise, block: Int[np.ndarray, " pixels"]
) -> FovFit:
    angles = sorted(noise)
    every = np.stack([noise[a].cost for a in angles] + [given.cost])
    together = np.isfinite(every).all(axis=0)
    costs = every[:, together].sum(axis=1)[:-1]
    best = int(np.argmin(costs))
    most_likely = noise[angles[best]]
    gain = given.cost - most_likely.cost
    gain = summed_by_block(gain[together, None], block[together])
    spread = np.sqrt(len(gain) * np.var(gain, ddof=1)) if len(gain) > 1 else np.inf
    better = float(gain.sum() / spread) if spread > 0 else 0.0
    ratio = np.inf
    if together.any():
        levels = most_likely.level[together] / given.level[together]
        ratio = float(np.median(levels))
    stderr = np.inf
    if 0 < best < len(angles) - 1:
        below, at, above = angles[best - 1 : best + 2]
        # Derivatives of the parabola through three angles, at the middle one.
        rows = np.vander(np.array([below, at, above]) - at, 3)
        second, first, _ = np.linalg.solve(rows, every[best - 1 : best + 2, together])
        curvature = 2 * second.sum()
        slopes = summed_by_block(first[:, None], block[together])
        if curvature > 0:
            stderr = float(np.sqrt(np.sum((slopes - slopes.mean()) ** 2)) / curvature)
    return FovFit(angles[best], stderr, ratio, better)
