"""A matte sphere: by its shading, where each lamp is, and how strong.

Its light is Lambert's, and that of the room beside: at a point P with normal n,

$$I = E \\, \\frac{\\max(n \\cdot l, 0)}{1 - κ + κ (d / d_0)^2} + a,$$

where l and d lead from P to the lamp and $d_0$ to the lamp from the reference point, so
that E is the lamp's strength there. The fall-off κ is 1 for a bulb, less for a lamp
with a reflector or a lens, and 0 for distant lamps.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.calibration.outlines import Seen, View, across, seen, unit
from phongfit.rendering.film import Film, decode, encode
from phongfit.rendering.jpeg import compressed

LIT = 0.1
"""Smallest n·l of the pixels that are used: nearer to its edge, shade is uncertain."""

WITHIN = 0.94
"""Share of the outline's radius within which pixels are used."""

WHITE = 0.98
"""Brighter samples may have been cut off."""

ENOUGH = 60
"""Fewer pixels than this tell nothing."""

DARK = 0.03
"""A sphere this bright, of what it is in other photographs, is lit by no lamp."""

MOST = 4000
"""Pixels that are looked at: more of them err alike."""

EVEN = 0.002
"""No strength is stated to be better, as a share of it."""

TUKEY = 4.7
"""Residuals of so many standard deviations count no more (Tukey's biweight)."""

BLOCK = 16
"""Neighbours up to this many pixels apart, and JPEG's blocks of colour, err alike."""


class Place(NamedTuple):
    """How the matte sphere lies, and how light falls off on the way there.

    - `outline`: x, y and radius in pixels.
    - `radius`: of the sphere, in the unit of the reference, which tells its depth.
    - `falloff`: κ above, of all lamps.
    """

    outline: Float[np.ndarray, "3"]
    radius: float
    falloff: float

    def moved(self, step: Float[np.ndarray, "5"]) -> "Place":
        """With its outline, the logarithm of its radius and κ moved."""
        return Place(
            self.outline + step[:3],
            float(self.radius * np.exp(step[3])),
            float(np.clip(self.falloff + step[4], 0, 1.5)),
        )


class Matte(NamedTuple):
    """A matte sphere in the photographs.

    - `light`: its surroundings in each photograph, linear.
    - `corner`: x and y of that part's upper left corner, pixels.
    - `place`: as far as it is known.
    - `covariance`: of what moves the place.
    - `view`: the camera.
    - `reference`: the point that lamps' directions are counted from.
    - `ambient`, `ambient_error`: light of the room on it.
    - `film`: how light became the numbers of the photographs' files.
    """

    light: Float[np.ndarray, "count height width 3"]
    corner: Float[np.ndarray, "2"]
    place: Place
    covariance: Float[np.ndarray, "5 5"]
    view: View
    reference: Float[np.ndarray, "3"]
    ambient: Float[np.ndarray, "3"] = np.zeros(3)
    ambient_error: Float[np.ndarray, "3"] = np.zeros(3)
    film: Film = Film(clamp=False)


class Shading(NamedTuple):
    """What shading says of the lamps, to first order about an estimate.

    Of each lamp's direction along two tangents, its inverse distance, and what moves
    the sphere's place; these last are the same for all lamps.

    - `directions`, `inverse_distances`, `place`: about which it is said.
    - `information`: inverse covariances; zeros where a photograph tells nothing.
    - `pull`: information times the step to the best place.
    """

    directions: Float[np.ndarray, "lamps 3"]
    inverse_distances: Float[np.ndarray, " lamps"]
    place: Place
    information: Float[np.ndarray, "lamps 8 8"]
    pull: Float[np.ndarray, "lamps 8"]


class _Points(NamedTuple):
    """Which pixels are looked at, and the block that each lies in.

    - `light`: without that of the room.
    - `white`: what of it may have been cut off, and what is next to that: noise decides
        which samples at the edge are white, and those that are not are darker than
        they should be.
    """

    pixel: Float[np.ndarray, "points 2"]
    block: np.ndarray
    light: Float[np.ndarray, "count points 3"]
    white: Bool[np.ndarray, "count points 3"]


def _points(matte: Matte) -> _Points:
    from scipy import ndimage

    height, width = matte.light.shape[1:3]
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], axis=-1) + 0.5 + matte.corner
    outline = matte.place.outline
    inside = np.linalg.norm(pixels - outline[:2], axis=-1) < WITHIN * outline[2]
    stride = max(1, round(np.sqrt(inside.sum() / MOST)))
    inside &= (rows % stride == 0) & (columns % stride == 0)
    block = (rows // BLOCK) * (width // BLOCK + 1) + columns // BLOCK
    light = matte.light[:, inside] - matte.ambient
    white = ndimage.maximum_filter(matte.light >= WHITE, (1, 3, 3, 1))[:, inside]
    return _Points(pixels[inside], block[inside], light, white)


def overexposed(matte: Matte) -> Bool[np.ndarray, " count"]:
    """In which photographs most of the sphere is white, and says little."""
    white = _points(matte).white.any(axis=-1)
    return white.mean(axis=1) > 0.5


def shaded_directions(matte: Matte) -> Float[np.ndarray, "count 3"]:
    """The lamp's direction in each photograph, as if it were far: no start is needed.

    Least squares of the light by the normal, over what is clearly lit. Zeros where
    nothing is, as in a photograph without a lamp.
    """
    points, found = _points(matte), []
    normals = seen(points.pixel, matte.place.outline, matte.view, 1.0).normal
    grey = points.light.mean(axis=-1)
    brightness = np.percentile(grey, 98, axis=1)
    whole = np.asarray(~points.white.any(axis=-1))
    for light, bright, sound in zip(grey, brightness, whole, strict=True):
        lit, direction = sound & (light > 0.3 * bright), np.zeros(3)
        for _ in range(5):
            if lit.sum() < 30 or bright <= DARK * np.median(brightness):
                direction = np.zeros(3)
                break
            vector = np.linalg.lstsq(normals[lit], light[lit], rcond=None)[0]
            direction = unit(vector)
            lit = sound & (normals @ direction > 0.2) & (light > 0.1 * bright)
        found.append(direction)
    return np.array(found)


def _model(
    at: Seen,
    reference: np.ndarray,
    falloff: float,
    direction: np.ndarray,
    inverse: float,
) -> Float[np.ndarray, " points"]:
    """Light of a lamp of strength 1 on a surface, ambient light apart."""
    offset = inverse * (reference - at.position) + direction
    # Distances are in units of the lamp's own from the reference point.
    squared = np.vecdot(offset, offset)
    cosine = np.vecdot(at.normal, offset) / np.sqrt(squared)
    return np.maximum(cosine, 0) / (1 - falloff + falloff * squared)


class _Line(NamedTuple):
    """A robust linear fit: numbers, their covariance by blocks, and weights."""

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
        scale = max(1.4826 * np.median(np.abs(rest)), 1e-9)
        weights = np.clip(1 - (rest / (TUKEY * scale)) ** 2, 0, None) ** 2
    bread = np.linalg.pinv(columns.T @ (weights[:, None] * columns))
    _, group = np.unique(block, return_inverse=True)
    scores = np.zeros((group.max() + 1, columns.shape[1]))
    np.add.at(scores, group, (weights * rest)[:, None] * columns)
    # Few blocks leave less than they err: numbers were fitted to them.
    few = len(scores) / max(len(scores) - len(found), 1)
    covariance = few * bread @ scores.T @ scores @ bread
    # How much larger than the covariance of independent samples of variance 1.
    inflation = float(np.mean(np.diag(covariance) / np.maximum(np.diag(bread), 1e-300)))
    return _Line(found, covariance, weights, max(inflation, 1e-12))


def _about(
    matte: Matte, points: _Points
) -> Callable[[np.ndarray, float, np.ndarray], np.ndarray]:
    """A lamp's [`_model`][] by its direction, inverse distance and a step from both.

    The step has two turns along `across(direction)`, a change of the inverse distance,
    and what moves the sphere's place.
    """

    # The same few for all lamps.
    @functools.cache
    def surface(*moves: float) -> tuple[Seen, float]:
        place = matte.place.moved(np.array(moves))
        at = seen(points.pixel, place.outline, matte.view, place.radius)
        return at, place.falloff

    def model(direction: np.ndarray, inverse: float, step: np.ndarray) -> np.ndarray:
        at, falloff = surface(*step[3:])
        turned = unit(direction + step[:2] @ across(direction))
        return _model(at, matte.reference, falloff, turned, inverse + step[2])

    return model


def shade(
    matte: Matte,
    directions: Float[np.ndarray, "lamps 3"],
    inverse_distances: Float[np.ndarray, " lamps"],
) -> Shading:
    """What shading says of lamps, about an estimate of them and the sphere's place."""
    points = _points(matte)
    information = np.zeros((len(directions), 8, 8))
    pull = np.zeros((len(directions), 8))
    steps = np.diag([1e-4, 1e-4, 1e-5, 1e-2, 1e-2, 1e-2, 1e-3, 1e-3])
    about = _about(matte, points)
    for number, light in enumerate(points.light.mean(axis=-1)):
        at = functools.partial(about, directions[number], inverse_distances[number])
        here = at(np.zeros(8))
        lit = (here > LIT) & ~points.white[number].any(axis=-1)
        if lit.sum() < ENOUGH:
            continue
        slopes = [(at(s) - at(-s)) / (2 * s.sum()) for s in steps]
        plain = here[lit, None]
        first = _line(light[lit], plain, points.block[lit])
        columns = np.stack(
            [here[lit], *(first.numbers[0] * np.array(slopes)[:, lit])], 1
        )
        # What the lamp's own numbers leave over tells how samples err.
        own = _line(light[lit], columns[:, :4], points.block[lit])
        weighted = own.weights[:, None] * columns
        normal = weighted.T @ columns / own.inflation
        right = weighted.T @ (light[lit] - plain @ first.numbers) / own.inflation
        # The strength is free: the rest is what it leaves.
        taken = normal[1:, 0] / normal[0, 0]
        information[number] = normal[1:, 1:] - np.outer(taken, normal[0, 1:])
        pull[number] = right[1:] - taken * right[0]
    return Shading(directions, inverse_distances, matte.place, information, pull)


class Strengths(NamedTuple):
    """How strong lamps are at the reference point, and the light of the room.

    In units of the mean of all lamps and channels: linear light has the sphere's
    reflectance in it, which nothing tells.

    - `intensity`: by lamp and channel; `nan` where a photograph tells nothing.
    - `covariance`: of these, lamp by lamp; places of lamps and of the sphere are held.
    - `slopes`: by these and by what they depend on, as [`LampEstimate`][] has it in
        `joint`.
    - `ambient`, `ambient_error`: by channel.
    """

    intensity: Float[np.ndarray, "lamps 3"]
    covariance: Float[np.ndarray, "lamps*3 lamps*3"]
    slopes: Float[np.ndarray, "lamps*3 lamps*3+5"]
    ambient: Float[np.ndarray, "3"]
    ambient_error: Float[np.ndarray, "3"]


def find_strengths(
    matte: Matte,
    directions: Float[np.ndarray, "lamps 3"],
    inverse_distances: Float[np.ndarray, " lamps"],
) -> Strengths:
    """Strengths of lamps whose places are known, and how they move with these.

    **Arguments:** as of [`LampEstimate`][].
    """
    points, count = _points(matte), len(directions)
    intensity, noise, by_room = (np.full((count, 3), np.nan) for _ in range(3))
    slopes = np.zeros((count, 3, 3 * count + 5))
    small, about = 1e-4 * np.eye(8), _about(matte, points)
    for number, direction in enumerate(directions):
        at = functools.partial(about, direction, inverse_distances[number])
        here = at(np.zeros(8))
        # The same for all channels.
        beside = [(at(step), at(-step)) for step in small]
        moves = np.append(3 * number + np.arange(3), 3 * count + np.arange(5))
        for channel in range(3):
            light = points.light[number, :, channel]
            lit = (here > LIT) & ~points.white[number, :, channel]
            if lit.sum() < ENOUGH:
                continue
            line = _line(light[lit], here[lit, None], points.block[lit])
            # How the strength moves with the lamp's direction and distance, and with
            # the sphere's place.
            slopes[number, channel, moves] = [
                (_strength(one[lit], light[lit]) - _strength(other[lit], light[lit]))
                / 2e-4
                for one, other in beside
            ]
            intensity[number, channel] = line.numbers[0]
            by_room[number, channel] = -_strength(here[lit], np.ones(lit.sum()))
            noise[number, channel] = line.covariance[0, 0]
    mean = float(np.nanmean(intensity))
    mean = mean if mean > 0 else 1.0
    rounded = rounding(matte, directions, inverse_distances, intensity)
    known = np.isfinite(intensity).ravel()
    own = np.diag(np.maximum(np.nan_to_num(noise.ravel()) - np.diag(rounded), 0))
    rooms = (by_room[:, :, None] * np.diag(matte.ambient_error)).reshape(-1, 3)
    rooms = np.nan_to_num(rooms)
    # Nor is any sphere painted more evenly than this.
    paint = np.kron(np.eye(count), np.ones((3, 1))) * intensity.reshape(-1, 1)
    paint = EVEN * np.nan_to_num(paint)
    spread = own + rounded + rooms @ rooms.T + paint @ paint.T
    # Strengths are over their mean, so that what all share alike is no error: most of
    # what is wrong with the room's light, or with the sphere's place.
    share = np.nan_to_num(intensity.ravel() / mean)
    relative = (np.eye(3 * count) - share[:, None] * known / max(known.sum(), 1)) / mean
    return Strengths(
        intensity / mean,
        relative @ spread @ relative.T,
        relative @ slopes.reshape(3 * count, -1),
        matte.ambient / mean,
        matte.ambient_error / mean,
    )


DRAWS = 32
"""How often what files round is drawn; covariances of lamps err by a fifth."""

SHRUNK = 96
"""A sphere is drawn with up to this many pixels across: on more, more is averaged."""

BRIGHTER = 0.03
"""Each draw is up to this much brighter or darker."""


def rounding(
    matte: Matte,
    directions: Float[np.ndarray, "lamps 3"],
    inverse_distances: Float[np.ndarray, " lamps"],
    strengths: Float[np.ndarray, "lamps 3"],
) -> Float[np.ndarray, "lamps*3 lamps*3"]:
    """How strengths err by what the photographs' files round, as a covariance.

    Of one hue a sphere has few values of chroma, and all photographs round them alike:
    that is no noise, which pixels would average. Drawn, as [`restore`][] does: the
    model under each lamp, as its file would have it, a little brighter or darker.
    """
    film, size = matte.film, 3 * len(strengths)
    if film.jpeg is None and (film.bits or 16) > 8:
        return np.zeros((size, size))
    stride = max(1, int(np.ceil(2 * matte.place.outline[2] / SHRUNK)))
    height, width = matte.light.shape[1:3]
    rows, columns = np.mgrid[:height:stride, :width:stride]
    pixels = np.stack([columns, rows], axis=-1) + 0.5 + matte.corner
    apart = np.linalg.norm(pixels - matte.place.outline[:2], axis=-1)
    disc = apart < matte.place.outline[2]
    inside = apart < WITHIN * matte.place.outline[2]
    around = matte.light[:, ::stride, ::stride]
    rng, errors = np.random.default_rng(0), np.zeros((DRAWS, len(strengths), 3))
    place, models = matte.place, []
    at = seen(pixels[disc], place.outline, matte.view, place.radius)
    for direction, inverse in zip(directions, inverse_distances, strict=True):
        shade = np.zeros(disc.shape)
        shade[disc] = _model(at, matte.reference, place.falloff, direction, inverse)
        models.append(shade)
    for draw in errors:
        widest = 1.0 if film.jpeg is None else film.jpeg.widest
        shift = rng.uniform(-widest, widest, 3).astype(np.float32)
        share = np.float32(1 - BRIGHTER * rng.uniform())
        for number, (shade, strength) in enumerate(zip(models, strengths, strict=True)):
            if not np.isfinite(strength).all():
                continue
            own = shade[..., None] * strength
            canvas = np.where(disc[..., None], own + matte.ambient, around[number])
            read = _read_back(film, canvas, share, shift) - matte.ambient
            for channel in range(3):
                lit = inside & (shade > LIT) & (canvas[..., channel] < WHITE)
                if lit.sum() > 0:
                    found = _strength(shade[lit], read[..., channel][lit])
                    draw[number, channel] = found - strength[channel]
    flat = errors.reshape(DRAWS, size)
    return flat.T @ flat / DRAWS


def _read_back(
    film: Film, light: np.ndarray, share: np.float32, shift: np.ndarray
) -> Float[np.ndarray, "height width 3"]:
    """Light as it is read from a file of a little other levels."""
    shown = np.clip(light, 0, 1).astype(np.float32)
    levels = share * 255 * np.asarray(encode(shown, film.encoding), np.float32) + shift
    stored = np.round(levels)
    if film.jpeg is not None:
        stored = compressed(levels, film.jpeg)
    return decode(np.clip((stored - shift) / share / 255, 0, 1), film.encoding)


def _strength(model: np.ndarray, light: np.ndarray) -> float:
    return float(model @ light / (model @ model))


class RoomLight(NamedTuple):
    """Light of the room on a sphere, by channel, and its standard deviation."""

    light: Float[np.ndarray, "3"]
    error: Float[np.ndarray, "3"]


def room_light(matte: Matte, directions: Float[np.ndarray, "lamps 3"]) -> RoomLight:
    r"""Light of the room on the matte sphere: what is there on its side in shadow.

    The median of the photographs; 0 where none shows enough of that side. (As one more
    number of a fit it could not be told from a sphere that is not quite Lambert's.)

    Nothing is darker than black: noise of standard deviation $\sigma$ makes of no light
    at all $\sigma / \sqrt{2 \pi}$ on average. What clipping added is taken off, and is
    the error, too, as that is known to no better than its size; so is how photographs
    scatter, which light that comes from the lamps by way of the room makes differ.
    """
    points = _points(matte._replace(ambient=np.zeros(3)))
    normals = seen(points.pixel, matte.place.outline, matte.view, 1.0).normal
    found, noise = [], []
    for light, white, direction in zip(
        points.light, points.white, directions, strict=True
    ):
        cosine = normals @ direction
        dark, lit = cosine < -0.1, (cosine > 0.2) & ~white.any(axis=-1)
        if direction.any() and min(dark.sum(), lit.sum()) >= ENOUGH:
            found.append(np.median(light[dark], axis=0))
            shade = np.linalg.lstsq(normals[lit], light[lit], rcond=None)[0]
            rest = np.abs(light[lit] - normals[lit] @ shade)
            noise.append(1.4826 * np.median(rest, axis=0))
    if not found:
        return RoomLight(np.zeros(3), np.zeros(3))
    shown, sigma = np.median(found, axis=0), np.median(noise, axis=0)
    light = _unclipped(shown, sigma)
    scatter = 1.4826 * np.median(np.abs(found - shown), axis=0)
    return RoomLight(light, np.hypot(shown - light, scatter))


def _unclipped(mean: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Light of which noise and the clamp at 0 make such means; 0 where none does."""
    from scipy.special import ndtr

    low, high = np.zeros_like(mean), mean
    for _ in range(40):
        middle = (low + high) / 2
        ratio = middle / np.maximum(sigma, 1e-12)
        density = np.exp(-(ratio**2) / 2) / np.sqrt(2 * np.pi)
        below = middle * ndtr(ratio) + sigma * density < mean
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return low
