"""A matte sphere, whose shading determines the place and strength of each lamp.

Its light is Lambertian, plus light of the room: at a point P with normal n,

$$I = E \\, \\frac{\\max(n \\cdot l, 0)}{1 - κ + κ (d / d_0)^2} + a,$$

where l is the direction and d the distance from P to the lamp, and $d_0$ the distance
from the reference point, so that E is the lamp's strength there. The fall-off κ is 1
for a bulb, less for a lamp with a reflector or a lens, and 0 for distant lamps.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.calibration.least_squares import (
    blocks,
    clamped_mean,
    compiled,
    differentiated,
    robust_scale,
    summed_by_block,
    thinned,
    tukey_weight,
)
from phongfit.calibration.outlines import View, seen, unit
from phongfit.lights import AbstractLight, Illumination
from phongfit.reflectance import lambert
from phongfit.rendering.film import Film, decode, encode
from phongfit.rendering.jpeg import compressed, namespace
from phongfit.vectors import Vec3, dot, normalize

LIT = 0.1
"""Smallest n·l of the pixels that are used: near n·l = 0 shading is uncertain."""

WITHIN = 0.94
"""Fraction of the outline's radius within which pixels are used."""

WHITE = 0.98
"""Samples from this value on may have been cut off."""

ENOUGH = 60
"""Smallest number of pixels for the estimate of a lamp."""

DARK = 0.03
"""A sphere is unlit below this brightness relative to its median over photographs."""

MOST = 4000
"""Approximate number of pixels used: errors of more would be correlated."""

EVEN = 0.002
"""Smallest relative error of a strength, from unevenness of the sphere's paint."""

DRAWS = 32
"""Number of simulated roundings of files, for a covariance with about 20 % error."""

SHRUNK = 96
"""Maximum diameter of a simulated sphere, pixels: rounding of more averages out."""

BRIGHTER = 0.03
"""Each simulation is darker by up to this fraction."""


class AnyDistanceLight(AbstractLight):
    """A lamp at any distance from a reference point, infinity included.

    Its strength is 1 at that point, and it falls off as in the module's formula.
    """

    direction: Float[Array, "3"]
    inverse_distance: Float[Array, ""]
    reference: Float[Array, "3"]
    falloff: Float[Array, ""]

    def illuminate(self, position: Vec3) -> Illumination:
        # Scaled by the inverse distance to the reference point, so that it is finite.
        offset = self.inverse_distance * (self.reference - position) + self.direction
        squared = dot(offset, offset)
        light = jnp.full(3, 1 / (1 - self.falloff + self.falloff * squared))
        distance = jnp.sqrt(squared) / self.inverse_distance
        return Illumination(normalize(offset), light, light, 0 * light, distance)


class Place(NamedTuple):
    """Position of the matte sphere, and the fall-off of the lamps' light.

    - `outline`: x, y and radius in pixels.
    - `radius`: of the sphere, in the unit of the reference; determines its depth.
    - `falloff`: κ of the module's formula, common to all lamps.
    """

    outline: Any
    radius: Any
    falloff: Any

    def moved(self, step: Any) -> "Place":
        """The place after a step of its outline, of log radius and of κ."""
        xp = namespace(step)
        falloff = xp.maximum(self.falloff + step[4], 0)
        return Place(self.outline + step[:3], self.radius * xp.exp(step[3]), falloff)


class Points(NamedTuple):
    """Pixels of a sphere, and their light in each photograph.

    - `block`: number of the block of pixels with correlated errors.
    - `white`: samples that may have been cut off, and their neighbours: near a clipped
        area noise selects the samples below white, which are then biased.
    """

    pixel: Float[np.ndarray, "points 2"]
    block: Int[np.ndarray, " points"]
    light: Float[np.ndarray, "count points 3"]
    white: Bool[np.ndarray, "count points 3"]


class Matte(NamedTuple):
    """A matte sphere in the photographs.

    - `light`: the sphere and its surroundings in each photograph, linear.
    - `corner`: x and y of the upper left corner of `light`, pixels.
    - `points`: pixels on the sphere.
    - `place`: initial or refined place of the sphere.
    - `covariance`: of the numbers that move the place.
    - `view`: the camera.
    - `reference`: origin of the lamps' directions.
    - `film`: clamp, encoding and rounding of the photographs' files.
    - `model`: light of a lamp of strength 1, with its Jacobian: see `lit_by`.
    - `shaded`: lamps' directions from the shading, or zeros: `shaded_directions`.
    - `ambient`, `ambient_error`: light of the room on the sphere.
    """

    light: Float[np.ndarray, "count height width 3"]
    corner: Float[np.ndarray, "2"]
    points: Points
    place: Place
    covariance: Float[np.ndarray, "5 5"]
    view: View
    reference: Float[np.ndarray, "3"]
    film: Film
    model: Callable[..., Any]
    shaded: Float[np.ndarray, "count 3"]
    ambient: Float[np.ndarray, "3"]
    ambient_error: Float[np.ndarray, "3"]

    def of(self, photographs: Any) -> "Matte":
        """The sphere in some of the photographs."""
        light, white = self.points.light[photographs], self.points.white[photographs]
        points = self.points._replace(light=light, white=white)
        light, shaded = self.light[photographs], self.shaded[photographs]
        return self._replace(light=light, points=points, shaded=shaded)

    def lit_by(
        self,
        direction: Float[np.ndarray, "3"],
        tangents: Float[np.ndarray, "2 3"],
        inverse_distance: float,
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 8"]]:
        """Light of a lamp of strength 1, without that of the room, and its Jacobian.

        The Jacobian is by two turns along the tangents, the inverse distance, and the
        numbers that move the sphere's place.
        """
        lamp = direction, tangents, inverse_distance
        at = self.points.pixel, self.place, self.reference
        return self.model(np.zeros(8), *at, *lamp)


def matte_sphere(
    light: Float[np.ndarray, "count height width 3"],
    corner: Float[np.ndarray, "2"],
    place: Place,
    covariance: Float[np.ndarray, "5 5"],
    view: View,
    reference: Float[np.ndarray, "3"],
    film: Film,
) -> Matte:
    """A matte sphere, from its surroundings in each photograph."""
    points = points_on(light, corner, place.outline)
    normals = seen(points.pixel, place.outline, view, 1.0).normal
    shaded = shaded_directions(points, normals)
    model = differentiated(functools.partial(_lambertian, view))
    given = light, corner, points, place, covariance, view, reference, film
    return Matte(*given, model, shaded, *room_light(points, normals, shaded))


def _lambertian(
    view: View,
    step: Any,
    pixel: Any,
    place: Place,
    reference: Any,
    direction: Any,
    tangents: Any,
    inverse_distance: Any,
) -> Any:
    place = place.moved(step[3:])
    turned = normalize(direction + step[:2] @ tangents)
    inverse = inverse_distance + step[2]
    light = AnyDistanceLight(turned, inverse, reference, place.falloff)
    at = seen(pixel, place.outline, view, place.radius)
    arriving = jax.vmap(light.illuminate)(at.position)
    cosine = jax.vmap(lambert)(at.normal, arriving.to_light)
    return arriving.intensity[:, 0] * cosine


def points_on(
    light: Float[np.ndarray, "count height width 3"],
    corner: Float[np.ndarray, "2"],
    outline: Float[np.ndarray, "3"],
) -> Points:
    """An even sample of the pixels within an outline.

    **Arguments:** `light`, `corner`: as in [`Matte`][].
    """
    from scipy import ndimage

    height, width = light.shape[1:3]
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], axis=-1) + 0.5 + corner
    inside = np.linalg.norm(pixels - outline[:2], axis=-1) < WITHIN * outline[2]
    inside = thinned(inside, MOST)
    white = ndimage.maximum_filter(light >= WHITE, (1, 3, 3, 1))[:, inside]
    return Points(
        pixels[inside], blocks(height, width)[inside], light[:, inside], white
    )


def overexposed(points: Points) -> Bool[np.ndarray, " count"]:
    """Mask of photographs in which most of the sphere is white."""
    return points.white.any(axis=-1).mean(axis=1) > 0.5


def shaded_directions(
    points: Points, normals: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "count 3"]:
    """The lamp's direction in each photograph, for a distant lamp, without a start.

    Least squares of the light by the normal, over clearly lit pixels. Zeros if there
    are too few of these, as in a photograph without a lamp.
    """
    grey, found = points.light.mean(axis=-1), []
    brightness = np.percentile(grey, 98, axis=1)
    whole = np.asarray(~points.white.any(axis=-1))
    for light, bright, sound in zip(grey, brightness, whole, strict=True):
        lit, direction = sound & (light > 0.3 * bright), np.zeros(3)
        for _ in range(5):
            if lit.sum() < 30 or bright <= DARK * np.median(brightness):
                direction = np.zeros(3)
                break
            direction = unit(np.linalg.lstsq(normals[lit], light[lit], rcond=None)[0])
            lit = sound & (normals @ direction > 0.2) & (light > 0.1 * bright)
        found.append(direction)
    return np.array(found)


def room_light(
    points: Points,
    normals: Float[np.ndarray, "points 3"],
    directions: Float[np.ndarray, "lamps 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    r"""Light of the room on the matte sphere's side in shadow, and its standard error.

    The median of the photographs; 0 if none shows enough of that side. (As an unknown
    of the fit it would compensate for spheres that do not follow Lambert's law.)

    Values below black are clipped: noise of standard deviation $\sigma$ without light
    then has the mean $\sigma / \sqrt{2 \pi}$. This bias is subtracted, and
    added to the error, as it is uncertain by its own size. The error includes the
    scatter of the photographs, since lamps light the room differently.
    """
    found, noise = [], []
    for light, white, direction in zip(
        points.light, points.white, directions, strict=True
    ):
        cosine = normals @ direction
        dark, lit = cosine < -0.1, (cosine > 0.2) & ~white.any(axis=-1)
        if direction.any() and min(dark.sum(), lit.sum()) >= ENOUGH:
            found.append(np.median(light[dark], axis=0))
            shade = np.linalg.lstsq(normals[lit], light[lit], rcond=None)[0]
            rest = light[lit] - normals[lit] @ shade
            noise.append([robust_scale(channel) for channel in rest.T])
    if not found:
        return np.zeros(3), np.zeros(3)
    shown, sigma = np.median(found, axis=0), np.median(noise, axis=0)
    light = np.array([_unclipped(*one) for one in zip(shown, sigma, strict=True)])
    scatter = [robust_scale(channel) for channel in (found - shown).T]
    return light, np.hypot(shown - light, scatter)


def _unclipped(mean: float, sigma: float) -> float:
    """Light that gives this mean after noise and the clamp at 0; 0 if none does."""
    from scipy import optimize

    def excess(light: float) -> float:
        return clamped_mean(light, max(sigma, 1e-12)) - mean

    if excess(0) >= 0:
        return 0.0
    if excess(mean) <= 0:
        # No sample reaches the clamp, and the difference is rounding.
        return mean
    return optimize.root_scalar(excess, bracket=(0, mean)).root


class _Line(NamedTuple):
    """Result of a robust linear fit.

    - `inflation`: ratio of the covariance to that of independent samples of variance 1.
    """

    numbers: np.ndarray
    covariance: np.ndarray
    weights: np.ndarray
    inflation: float


def _line(light: np.ndarray, columns: np.ndarray, block: np.ndarray) -> _Line:
    weights, found = np.ones(len(light)), np.zeros(columns.shape[1])
    rest = light
    for _ in range(10):
        normal = columns.T @ (weights[:, None] * columns)
        found = np.linalg.lstsq(normal, columns.T @ (weights * light), rcond=None)[0]
        rest = light - columns @ found
        weights = tukey_weight(rest, max(robust_scale(rest), 1e-9))
    bread = np.linalg.pinv(columns.T @ (weights[:, None] * columns))
    scores = summed_by_block((weights * rest)[:, None] * columns, block)
    # Correction for few blocks: fitted residuals are smaller than errors.
    few = len(scores) / max(len(scores) - len(found), 1)
    covariance = few * bread @ scores.T @ scores @ bread
    inflation = float(np.mean(np.diag(covariance) / np.maximum(np.diag(bread), 1e-300)))
    return _Line(found, covariance, weights, max(inflation, 1e-12))


class Shading(NamedTuple):
    """Residuals of the shading, `root @ step - aim`, to first order in a step.

    A step of a lamp has two turns, a change of the inverse distance, and the move of
    the sphere's place, which is common to all lamps. Residuals have variance 1; they
    are 0 for a photograph without information.

    - `rank`: number of residuals with information.
    """

    root: Float[np.ndarray, "lamps 8 8"]
    aim: Float[np.ndarray, "lamps 8"]
    rank: int


def shade(
    matte: Matte,
    directions: Float[np.ndarray, "lamps 3"],
    tangents: Float[np.ndarray, "lamps 2 3"],
    inverse_distances: Float[np.ndarray, " lamps"],
) -> Shading:
    """Linearise the shading of all lamps at an estimate of them and of the place."""
    points, count = matte.points, len(directions)
    root, aim, rank = np.zeros((count, 8, 8)), np.zeros((count, 8)), 0
    for number, lamp in enumerate(
        zip(directions, tangents, inverse_distances, strict=True)
    ):
        model, slopes = matte.lit_by(*lamp)
        lit = (model > LIT) & ~points.white[number].any(axis=-1)
        if lit.sum() < ENOUGH:
            continue
        light = (points.light[number, lit] - matte.ambient).mean(axis=-1)
        model, block = model[lit], points.block[lit]
        strength = _line(light, model[:, None], block).numbers[0]
        slopes = strength * slopes[lit]
        # Estimate errors from residuals of a fit of this lamp's numbers alone.
        own = _line(light, np.column_stack([model, slopes[:, :3]]), block)
        weight = np.sqrt(own.weights / own.inflation)
        rows = weight[:, None] * np.column_stack([slopes, light - strength * model])
        # Project out the strength, which is a free unknown.
        axis = weight * model / np.linalg.norm(weight * model)
        rows -= axis[:, None] * (axis @ rows)
        left, values, right = np.linalg.svd(rows[:, :8], full_matrices=False)
        kept = values > 3e-5 * values.max()
        root[number] = (kept * values)[:, None] * right
        aim[number] = kept * (left.T @ rows[:, 8])
        rank += int(kept.sum())
    return Shading(root, aim, rank)


class Strengths(NamedTuple):
    """Strengths of lamps at the reference point, in linear light.

    Strengths include the sphere's unknown reflectance as a factor.

    - `intensity`: by lamp and channel; `nan` where a photograph has no information.
    - `covariance`: of intensities, lamp by lamp, with fixed places of lamps and sphere.
    - `slopes`: derivatives by these places, in the order of `joint` of
        [`LampEstimate`][].
    """

    intensity: Float[np.ndarray, "lamps 3"]
    covariance: Float[np.ndarray, "lamps*3 lamps*3"]
    slopes: Float[np.ndarray, "lamps*3 lamps*3+5"]


def find_strengths(
    matte: Matte,
    directions: Float[np.ndarray, "lamps 3"],
    tangents: Float[np.ndarray, "lamps 2 3"],
    inverse_distances: Float[np.ndarray, " lamps"],
) -> Strengths:
    """Strengths of lamps at given places, and their derivatives by the places.

    **Arguments:** as in [`LampEstimate`][].
    """
    points, count = matte.points, len(directions)
    intensity, noise, by_room = (np.full((count, 3), np.nan) for _ in range(3))
    slopes = np.zeros((count, 3, 3 * count + 5))
    lamps = list(zip(directions, tangents, inverse_distances, strict=True))
    for number, lamp in enumerate(lamps):
        model, by_step = matte.lit_by(*lamp)
        unknowns = np.append(3 * number + np.arange(3), 3 * count + np.arange(5))
        for channel in range(3):
            lit = (model > LIT) & ~points.white[number, :, channel]
            if lit.sum() < ENOUGH:
                continue
            shown, slope = model[lit], by_step[lit]
            light = points.light[number, lit, channel] - matte.ambient[channel]
            line = _line(light, shown[:, None], points.block[lit])
            squared = shown @ shown
            strength = shown @ light / squared
            # Derivative of the ratio of sums in the least squares solution.
            by_model = light @ slope - 2 * strength * (shown @ slope)
            slopes[number, channel, unknowns] = by_model / squared
            intensity[number, channel] = line.numbers[0]
            by_room[number, channel] = -shown.sum() / squared
            noise[number, channel] = line.covariance[0, 0]
    rounded = rounding(matte, lamps, intensity)
    own = np.diag(np.maximum(np.nan_to_num(noise.ravel()) - np.diag(rounded), 0))
    rooms = np.nan_to_num(by_room[:, :, None] * np.diag(matte.ambient_error))
    rooms = rooms.reshape(-1, 3)
    paint = np.kron(np.eye(count), np.ones((3, 1))) * intensity.reshape(-1, 1)
    paint = EVEN * np.nan_to_num(paint)
    covariance = own + rounded + rooms @ rooms.T + paint @ paint.T
    return Strengths(intensity, covariance, slopes.reshape(3 * count, -1))


def rounding(
    matte: Matte, lamps: Any, strengths: Float[np.ndarray, "lamps 3"]
) -> Float[np.ndarray, "lamps*3 lamps*3"]:
    """Covariance of strengths due to the rounding of the photographs' files.

    A sphere of one hue has few values of chroma, which all photographs round in the
    same way, so averaging over pixels does not reduce the error. It is simulated, as
    [`restore`][] does: the model under each lamp, at slightly different brightness, is
    rounded like its file.
    """
    film, size = matte.film, 3 * len(strengths)
    if film.jpeg is None and (film.bits or 16) > 8:
        return np.zeros((size, size))
    outline = matte.place.outline
    stride = max(1, int(np.ceil(2 * outline[2] / SHRUNK)))
    height, width = matte.light.shape[1:3]
    rows, columns = np.mgrid[:height:stride, :width:stride]
    pixels = np.stack([columns, rows], axis=-1) + 0.5 + matte.corner
    apart = np.linalg.norm(pixels - outline[:2], axis=-1)
    disc, inside = apart < outline[2], apart < WITHIN * outline[2]
    around = matte.light[:, ::stride, ::stride]
    rng, errors = np.random.default_rng(0), np.zeros((DRAWS, len(strengths), 3))
    model, models = compiled(functools.partial(_lambertian, matte.view)), []
    for lamp in lamps:
        shade = np.zeros((*disc.shape, 1))
        at = pixels[disc], matte.place, matte.reference
        shade[disc, 0] = model(np.zeros(8), *at, *lamp)
        models.append(shade)
    known = np.flatnonzero(np.isfinite(strengths).all(axis=1))
    for draw in errors:
        widest = 1.0 if film.jpeg is None else film.jpeg.widest
        shift = rng.uniform(-widest, widest, 3).astype(np.float32)
        share = np.float32(1 - BRIGHTER * rng.uniform())
        for number in known:
            shade, strength = models[number], strengths[number]
            own = shade * strength + matte.ambient
            canvas = np.where(disc[..., None], own, around[number])
            read = _read_back(film, canvas, share, shift) - matte.ambient
            weight = shade * (inside[..., None] & (shade > LIT) & (canvas < WHITE))
            squares = np.maximum((weight * shade).sum(axis=(0, 1)), 1e-12)
            draw[number] = (weight * (read - shade * strength)).sum(axis=(0, 1))
            draw[number] /= squares
    flat = errors.reshape(DRAWS, size)
    return flat.T @ flat / DRAWS


def _read_back(
    film: Film, light: np.ndarray, share: np.float32, shift: np.ndarray
) -> Float[np.ndarray, "height width 3"]:
    """Light after a round trip through a file with slightly different levels."""
    shown = np.clip(light, 0, 1).astype(np.float32)
    levels = share * 255 * np.asarray(encode(shown, film.encoding), np.float32) + shift
    stored = np.round(levels)
    if film.jpeg is not None:
        stored = compressed(levels, film.jpeg)
    return decode(np.clip((stored - shift) / share / 255, 0, 1), film.encoding)
