r"""Estimates of the strength of each photograph's light from the photographs.

A matte point of unknown colour and normal, with irradiance vectors $E_l$ of the lamps
(their intensity times their direction), reflects $s_l (E_l \cdot b + h_l)$, where b is
its colour times its normal, h its highlight and $s_l$ the strength of the light in
photograph l relative to the scene. With more than four lamps in general directions,
only a common factor of all $s_l$ is not identified.

Gauss-Newton steps in $\log s$ and all b at once, with b eliminated point by point
(variable projection), and Tukey's biweight for robustness to shadows and other light
that is not matte.

??? cite "Source"
    Golub and Pereyra, *Separable nonlinear least squares*, Inverse Problems 19(2),
    2003. Unknown strengths of known directions: Alldrin and Kriegman, *Toward
    reconstructing surfaces with arbitrary isotropic reflectance*, ICCV 2007, section 3.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.calibration.least_squares import (
    blocks,
    robust_scale,
    summed_by_block,
    tukey_weight,
)
from phongfit.geometry.surfaces import GBuffer, NormalMap
from phongfit.maps.job import Job
from phongfit.maps.layers import Layers
from phongfit.maps.result import Maps, Strengths
from phongfit.maps.stacks import AbstractStack, KeptStack
from phongfit.material import Material
from phongfit.rendering.pixels import pixel_terms
from phongfit.scene import Scene

SAMPLE = 2000
"""Maximum number of pixels from which strengths are estimated, approximately."""

LIT = 0.15
"""Smallest cosine, or fraction of a pixel's brightest sample, of samples in use: in
more grazing light surfaces deviate from the model."""

BRIGHT = 0.3
"""Least brightness of pixels in use, relative to the median: noise dominates others."""

STEPS, SMALL = 50, 1e-5
"""Maximum number of Gauss-Newton steps, and the change of log s that ends them."""

ROUNDS, SETTLED = 12, 5e-4
"""Maximum number of fits of the highlights, and the change of log s that ends them."""

MOST = 0.9
"""Largest fraction of a change of strengths that refitted highlights are assumed to
follow."""

LEAST = 1e-3
"""Least relative standard error of a strength."""

DIRECTION = 2.0
"""Assumed standard error of the lamps' directions, degrees.

Two mirror balls differ by 1°, a mirror ball and a matte one by 2°, up to 6° for single
lamps. If the lamps have similar directions, small errors of the directions have the
effect of other strengths."""

FEWEST = 6
"""Least number of images for a check of given strengths."""

NOTABLE = 0.1
"""Errors of strengths below this give no warning.

Shadows and interreflections have a similar effect: on DiLiGenT's ball, whose lamps were
calibrated by its authors, strengths seem to be off by up to 5 %."""

EQUAL = 5.0
"""Strengths may be equal if all are within this many standard errors of their mean."""


class Points(NamedTuple):
    """Samples of some pixels, and the light that arrives there.

    - `light`: linear light of the photographs, 0 for samples that may not be used.
    - `usable`: samples that may be used.
    - `irradiance`: E, the intensity of the light times the direction towards it.
    - `block`: number of the block of pixels with correlated errors.
    """

    light: Float[np.ndarray, "images pixels 3"]
    usable: Bool[np.ndarray, "images pixels 3"]
    irradiance: Float[np.ndarray, "images pixels 3 axes"]
    block: Int[np.ndarray, " pixels"]


def find_strengths(
    once: Callable[..., Maps], job: Job, *, per_channel: bool
) -> Strengths:
    """Estimate strengths of the light of all images, for maps with unknown normals.

    **Arguments:**

    - `once`: function that fits maps to scenes and a stack, with the job's settings.
    - `per_channel`: whether each channel has its own strength.

    **Raises:** `ValueError` if no pixel is bright enough in three images.
    """
    scenes, kept = job.scenes, KeptStack(job.stack)
    buffer = scenes[0].trace()
    white, glossy = job.settings.cutoff, "specular" in job.settings.names
    pixels, points = sample_points(scenes, kept, buffer, job.masks, white)
    values = np.ones((len(scenes), 3 if per_channel else 1))
    found, likely = solve(points, np.zeros(points.light.shape), values)
    mask = np.zeros(buffer.mask.shape, bool)
    mask.ravel()[pixels] = True

    def improved(last: Strengths) -> tuple[Strengths, np.ndarray]:
        """Strengths for highlights of maps fitted with the last ones; their change."""
        some = [_only(scene, buffer, mask) for scene in last.lit(scenes)]
        maps = once(some, kept, kept=None, progress=False)
        highlight = _highlights(maps, scenes, buffer, pixels)
        found, _ = solve(points, highlight, last.values)
        return found, np.log(found.values / last.values)

    if glossy:
        before = None
        for _ in range(ROUNDS):
            found, change = improved(found)
            if np.abs(change).max() < SETTLED:
                break
            if before is not None:
                # Refitted highlights follow a fraction of a change of strengths, so
                # that the changes are a geometric series: add its sum.
                slope = _share(change, before)
                further = np.exp(slope / (1 - slope) * change)
                found = found._replace(values=found.values * further)
            before = None if before is not None else change
        _, change = improved(found._replace(values=found.values * np.exp(likely)))
        slope = _share(change + likely, likely)
        found = found._replace(stderr=found.stderr / (1 - slope))
    return found if per_channel else Strengths(*(one[:, 0] for one in found))


def strength_error(maps: Maps, scenes: Sequence[Scene], job: Job) -> float:
    """Error of the strengths of the scenes' lights, from finished maps.

    The strengths are solved for once, with the highlights of the maps held.

    **Arguments:** `scenes`: those of the last pass, with its surface.

    **Returns:** the largest deviation of a factor on the strengths from their mean,
    relative to it; 0 if all may be right, if it is below [`NOTABLE`][], or if the
    images are too few or too dark.
    """
    if len(scenes) < FEWEST or "ambient" in job.settings.names:
        return 0.0
    buffer = scenes[0].trace()
    white = job.settings.cutoff
    try:
        stack = KeptStack(job.stack)
        pixels, points = sample_points(scenes, stack, buffer, job.masks, white)
        highlight = _highlights(maps, scenes, buffer, pixels)
        found, _ = solve(points, highlight, np.ones((len(scenes), 1)))
    except ValueError:
        # Too dark for strengths, or their equations are singular.
        return 0.0
    error = float(np.abs(found.values - 1).max())
    notable = np.isfinite(error) and error >= NOTABLE and not may_be_equal(found)
    return error if notable else 0.0


def _share(following: np.ndarray, wrong: np.ndarray) -> float:
    """Fraction of a change of strengths that refitted highlights follow."""
    return float(np.clip(np.sum(following * wrong) / np.sum(wrong**2), 0, MOST))


def may_be_equal(found: Strengths) -> bool:
    """True if all strengths are equal within their errors."""
    return bool((np.abs(found.values - 1) < EQUAL * found.stderr).all())


def sample_points(
    scenes: Sequence[Scene],
    stack: AbstractStack,
    buffer: GBuffer,
    masks: Layers,
    white: float,
) -> tuple[Int[np.ndarray, " pixels"], Points]:
    """Evenly chosen pixels that see the surface, without dark ones, and their samples.

    **Raises:** `ValueError` if none is bright enough in three images.
    """
    seen = np.asarray(buffer.mask) & masks.anywhere()
    pixels = np.flatnonzero(seen)
    pixels = pixels[:: max(1, len(pixels) // SAMPLE)]
    order = range(len(scenes))
    taken = stack.take(pixels, order)
    light = np.ma.getdata(taken).astype(float)
    free = ~np.ma.getmaskarray(taken) & (light < white) & masks.take(pixels, order)
    free &= np.isfinite(light)
    # A weight of 0 does not remove a sample that is NaN.
    light = np.where(free, light, 0)
    brightest = light.max(axis=(0, 2))
    enough = (free & (light > LIT * brightest[:, None])).all(axis=2).sum(axis=0) >= 3
    kept = enough & (brightest > BRIGHT * np.median(brightest))
    if not kept.any():
        raise ValueError(
            "strengths: no pixel is bright enough in three images to find them from"
        )
    pixels, light, free = pixels[kept], light[:, kept], free[:, kept]
    points = np.asarray(buffer.position).reshape(-1, 3)[pixels]
    irradiance = np.stack([_irradiance(scene, points) for scene in scenes])
    block = blocks(*seen.shape).ravel()[pixels]
    return pixels, Points(light, free, irradiance, block)


def solve(
    points: Points,
    highlight: Float[np.ndarray, "images pixels 3"],
    values: Float[np.ndarray, "images channels"],
) -> tuple[Strengths, Float[np.ndarray, "images channels"]]:
    """Solve for the strengths of smallest residuals, starting from `values`.

    **Arguments:** `highlight`: h, of light of strength 1.

    **Returns:** strengths, and the principal component of the errors of their
    logarithms that errors of the lights' directions cause.
    """
    images, pixels, _ = points.light.shape
    bright = np.maximum(points.light.max(axis=0), 1e-6)
    found = []
    for k in range(values.shape[1]):
        # A strength for all channels has those of a pixel as separate points.
        some = slice(None) if values.shape[1] == 1 else slice(k, k + 1)
        light, usable, shiny = (
            each[..., some].reshape(images, -1)
            for each in (points.light / bright, points.usable, highlight / bright)
        )
        irradiance = points.irradiance[:, :, some].reshape(*light.shape, -1)
        block = np.repeat(points.block, light.shape[1] // pixels)
        flat = _Flat(light, usable, irradiance, shiny, block)
        found.append(_solve(flat, np.log(values[:, k])))
    logs, errors, likely = np.stack(found, axis=-1)
    return Strengths(np.exp(logs), np.exp(logs) * errors), likely


class _Flat(NamedTuple):
    """Samples of one channel each, in units of the brightest of a pixel's channel."""

    light: Float[np.ndarray, "images points"]
    usable: Bool[np.ndarray, "images points"]
    irradiance: Float[np.ndarray, "images points axes"]
    highlight: Float[np.ndarray, "images points"]
    block: Int[np.ndarray, " points"]


class _Sums(NamedTuple):
    """Normal equations of log s with all b eliminated.

    - `scores`: gradient, with a row for each block of pixels.
    - `turned`: function that returns the derivatives of the gradient by turns of each
        lamp about x, y and z; they are only needed at the solution.
    - `weight`: weights of the samples in the next step.
    """

    information: Float[np.ndarray, "images images"]
    scores: Float[np.ndarray, "blocks images"]
    turned: Callable[[], Float[np.ndarray, "images turns"]]
    weight: Float[np.ndarray, "images points"]


def _solve(
    points: _Flat, logs: Float[np.ndarray, " images"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logarithms of strengths, their errors, and the likely error by directions."""
    count = len(logs)
    weight = (points.usable & (points.light > LIT)).astype(float)
    sums = _sum_up(points, np.exp(logs), weight)
    for step in range(STEPS):
        weight, size = sums.weight, np.trace(sums.information) / count
        # A factor on all strengths is not identified, and does not change.
        firm = sums.information + size * (1 / count + 1e-9 * np.eye(count))
        change = np.linalg.solve(firm, sums.scores.sum(axis=0))
        logs = logs + np.clip(change, -1, 1)
        logs -= np.log(np.exp(logs).mean())
        sums = _sum_up(points, np.exp(logs), weight)
        if step > 3 and np.abs(change).max() < SMALL:
            break
    # Without the common factor, which held highlights would seem to determine.
    ratios = np.eye(count) - 1 / count
    inverse = np.linalg.pinv(ratios @ sums.information @ ratios, 1e-9, hermitian=True)
    several = len(sums.scores) / max(len(sums.scores) - 1, 1)
    variance = several * ((sums.scores @ inverse) ** 2).sum(axis=0)
    moved = np.radians(DIRECTION) * inverse @ sums.turned()
    directions, sizes, _ = np.linalg.svd(moved)
    errors = np.sqrt(variance + (moved**2).sum(axis=1) + LEAST**2)
    return logs, errors, sizes[0] * directions[:, 0]


def _sum_up(points: _Flat, values: np.ndarray, weight: np.ndarray) -> _Sums:
    irradiance, root = points.irradiance, np.sqrt(weight)
    scaled = root * values[:, None]
    # Orthonormal bases q of the light that b explains.
    q, triangle = np.linalg.qr(np.moveaxis(scaled[..., None] * irradiance, 0, 1))
    target = root * points.light - scaled * points.highlight
    # With too few samples, the pseudo-inverse gives the solution of least norm.
    inverse = np.linalg.pinv(triangle, rcond=1e-6)
    b = np.einsum("pab,plb,lp->pa", inverse, q, target, optimize=True)
    matte = np.einsum("lpa,pa->lp", irradiance, b)
    expected = matte + points.highlight
    left = points.light - values[:, None] * expected
    length = np.linalg.norm(irradiance, axis=-1) * np.linalg.norm(b, axis=-1)
    lit = points.usable & (matte > LIT * length)
    # Residuals are smaller than the noise by the degrees of freedom of b.
    images, axes = np.median(lit.sum(axis=0)), irradiance.shape[-1]
    free = max(images - axes - 1, 1) / max(images, 1)
    scale = robust_scale(left[lit]) / np.sqrt(free)
    column = scaled * expected
    own = column.T[..., None] * q

    def eliminated(other: np.ndarray) -> np.ndarray:
        products = np.diag((column * other).sum(axis=1))
        return products - np.einsum("pla,pma->lm", own, other.T[..., None] * q)

    def turned() -> np.ndarray:
        turns = [np.cross(axis, irradiance) for axis in np.eye(3)]
        moved = [scaled * np.einsum("lpa,pa->lp", turn, b) for turn in turns]
        return np.concatenate([eliminated(each) for each in moved], axis=1)

    scores = column * root * left
    scores = scores.T - np.einsum("pla,pma,mp->pl", own, q, root * left, optimize=True)
    return _Sums(
        eliminated(column),
        summed_by_block(scores, points.block),
        turned,
        lit * tukey_weight(left, max(scale, 1e-4)),
    )


def _irradiance(
    scene: Scene, points: Float[np.ndarray, "pixels 3"]
) -> Float[np.ndarray, "pixels 3 axes"]:
    """Sum of intensity times direction over all lights of a scene, without shadows."""
    total = np.zeros((len(points), 3, 3))
    for light in scene.lights:
        there = jax.vmap(light.illuminate)(jnp.asarray(points, jnp.result_type(float)))
        arriving = np.asarray(there.intensity, float)[:, :, None]
        total += arriving * np.asarray(there.to_light, float)[:, None, :]
    return total


def _only(scene: Scene, buffer: GBuffer, mask: np.ndarray) -> Scene:
    """The scene restricted to some pixels, without shadows."""
    normals = np.where(mask[..., None], np.asarray(buffer.normal), 0)
    surface = NormalMap(normals, mask, buffer.position)
    return dataclasses.replace(scene, surface=surface, shadows=False)


def _highlights(
    maps: Maps,
    scenes: Sequence[Scene],
    buffer: GBuffer,
    pixels: Int[np.ndarray, " pixels"],
) -> Float[np.ndarray, "images pixels 3"]:
    """Highlights of the maps in each image, under light of strength 1."""
    camera = scenes[0].camera
    dtype = buffer.normal.dtype

    def of(array: np.ndarray) -> np.ndarray:
        return array.reshape(-1, array.shape[-1])[pixels]

    normals = of(maps.normals) @ np.asarray(camera.rotation).T
    some = buffer.select(jnp.asarray(pixels))
    some = dataclasses.replace(
        some, normal=jnp.asarray(normals, dtype), visibility=None
    )
    material = Material(0.0, of(maps.specular), of(maps.shininess), 0.0)
    shown = [
        pixel_terms(dataclasses.replace(scene, shadows=False), some).radiance(material)
        for scene in scenes
    ]
    return np.stack([np.asarray(one, float) for one in shown])
