"""Lamps from their highlights in chrome spheres, by a joint least squares fit."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.calibration.highlights import Highlight
from phongfit.calibration.least_squares import Solution, differentiated, least_squares
from phongfit.calibration.matte import (
    AnyDistanceLight,
    Matte,
    Place,
    Shading,
    shade,
)
from phongfit.calibration.outlines import View, mirrored, unit
from phongfit.fitting.problem.charts import tangents
from phongfit.rendering.jpeg import namespace

Lamps = Literal["distant", "near"]

MISSED = 12.0
"""χ² penalty for a sphere without a highlight."""

COMPARABLE, ALIKE = 0.6, 0.8
"""Smallest score of a second lamp's highlight relative to the first's: with several
spheres that agree on it, and with a single sphere."""

APART = np.radians(5.0)
"""Highlights nearer to a lamp than this belong to it (its frame or glare), radians."""

AGREE = 2.5
"""Spheres agree on a lamp up to this many standard deviations."""

ROUNDS = 8
"""Maximum number of linearisations of the shading."""

SCALINGS = 12
"""Maximum number of updates of the variance components."""


class Chrome(NamedTuple):
    """Outlines of the chrome spheres in the photographs, and their common radius.

    - `outlines`: x, y and radius in pixels, one row a sphere.
    - `covariances`: of the outlines.
    - `radius`: of all spheres, in the unit of the lamps' positions.
    """

    outlines: Float[np.ndarray, "spheres 3"]
    covariances: Float[np.ndarray, "spheres 3 3"]
    radius: float


class Candidates(NamedTuple):
    """Highlights of all photographs and spheres, with rays towards their lamps.

    - `photograph`, `sphere`: by number.
    - `pixel`, `error`, `score`: as in [`Highlight`][].
    - `position`, `direction`: ray from the sphere's surface.
    - `tangent`: two unit vectors perpendicular to it; the next two are in this basis.
    - `by_pixel`: derivatives of the direction.
    - `covariance`: of the direction, radians².
    """

    photograph: Int[np.ndarray, " count"]
    sphere: Int[np.ndarray, " count"]
    pixel: Float[np.ndarray, "count 2"]
    error: Float[np.ndarray, " count"]
    score: Float[np.ndarray, " count"]
    position: Float[np.ndarray, "count 3"]
    direction: Float[np.ndarray, "count 3"]
    tangent: Float[np.ndarray, "count 2 3"]
    by_pixel: Float[np.ndarray, "count 2 2"]
    covariance: Float[np.ndarray, "count 2 2"]


def follow(
    highlights: Sequence[Sequence[Sequence[Highlight]]], chrome: Chrome, view: View
) -> Candidates:
    """Highlights as rays with their covariances.

    **Arguments:** `highlights`: by sphere and photograph.
    """
    found = [
        (photograph, sphere, *one)
        for sphere, photographs in enumerate(highlights)
        for photograph, ones in enumerate(photographs)
        for one in ones
    ]
    photograph, sphere = np.array([one[:2] for one in found], int).reshape(-1, 2).T
    pixel = np.array([one[2] for one in found], float).reshape(-1, 2)
    error, _, score = np.array([one[3:] for one in found], float).reshape(-1, 3).T

    def rays(step: Any, pixel: Any, outline: Any) -> Any:
        return mirrored(pixel + step[:2], outline + step[2:], view, chrome.radius)

    found, by_step = differentiated(rays)(np.zeros(5), pixel, chrome.outlines[sphere])
    position, direction = found
    tangent = tangents(direction)
    slopes = tangent @ by_step.direction
    by_pixel, by_outline = slopes[..., :2], slopes[..., 2:]
    covariance = error[:, None, None] ** 2 * by_pixel @ by_pixel.swapaxes(1, 2)
    spread = chrome.covariances[sphere]
    covariance += by_outline @ spread @ by_outline.swapaxes(1, 2)
    ray = position, direction, tangent, by_pixel, covariance
    return Candidates(photograph, sphere, pixel, error, score, *ray)


def choose(
    candidates: Candidates,
    size: tuple[int, int],
    lamps: Lamps,
    shaded: Float[np.ndarray, "count 3"] | None = None,
) -> Int[np.ndarray, "photographs spheres"]:
    """For each photograph, the highlights on the spheres that belong to its lamp.

    The chosen combination has the best agreement of rays and the highest scores of
    highlights. A sphere may have none, since its highlight may be hidden.

    **Arguments:**

    - `size`: numbers of photographs and spheres.
    - `shaded`: the lamp's direction from the shading of a matte sphere, or zeros.

    **Returns:** numbers of candidates; −1 for none.
    """
    count, spheres = size
    most = max(int(2000 ** (1 / max(spheres, 1))) - 1, 1)
    chosen = []
    for number in range(count):
        options = [
            [-1, *on_sphere[:most]] for on_sphere in _each(candidates, number, spheres)
        ]
        hint = None if shaded is None or not shaded[number].any() else shaded[number]

        def cost(picks: tuple[int, ...], hint: np.ndarray | None = hint) -> float:
            return _disagreement(np.array(picks, int), candidates, lamps, hint)

        chosen.append(min(itertools.product(*options), key=cost))
    return np.array(chosen, int).reshape(size)


def _each(candidates: Candidates, photograph: int, spheres: int) -> list[list[int]]:
    """Numbers of a photograph's candidates, by sphere."""
    here = candidates.photograph == photograph
    return [
        np.flatnonzero(here & (candidates.sphere == sphere)).tolist()
        for sphere in range(spheres)
    ]


def show_two_lamps(
    candidates: Candidates,
    chosen: Int[np.ndarray, "photographs spheres"],
    lamps: Lamps,
) -> Bool[np.ndarray, " photographs"]:
    """Photographs in which the spheres agree on a second lamp.

    The second lamp is about as bright as the first, and elsewhere. With a single sphere
    its highlight must be brighter, since it may be the image of another object.
    """
    return np.array(
        [_second(candidates, number, row, lamps) for number, row in enumerate(chosen)]
    )


def _second(
    candidates: Candidates, photograph: int, first: np.ndarray, lamps: Lamps
) -> bool:
    if not len(first) or (first < 0).any():
        return False
    least = COMPARABLE if len(first) > 1 else ALIKE
    others = []
    for one, found in zip(
        first, _each(candidates, photograph, len(first)), strict=True
    ):
        found = np.array(found)
        bright = candidates.score[found] > least * candidates.score[one]
        apart = angles(candidates.direction[found], candidates.direction[one])
        others.append(found[bright & (apart > APART)])
    return any(
        _scatter(np.array(picks), candidates, lamps) < AGREE**2 * len(picks)
        for picks in itertools.product(*others)
    )


def _disagreement(
    picks: np.ndarray, candidates: Candidates, lamps: Lamps, hint: np.ndarray | None
) -> float:
    """χ² of some candidates as highlights of one lamp; −1 marks a missing one."""
    shown = picks[picks >= 0]
    cost = MISSED * (len(picks) - len(shown))
    if not len(shown):
        return cost
    cost -= 4 * float(np.sum(np.log(candidates.score[shown])))
    cost += _scatter(shown, candidates, lamps)
    if hint is not None:
        # For near lamps the direction from shading is biased.
        error = 0.1 if lamps == "distant" else 0.6
        towards = unit(_towards(shown, candidates, lamps).mean(axis=0))
        cost += float((angles(hint, towards) / error) ** 2)
    return cost


def _scatter(picks: np.ndarray, candidates: Candidates, lamps: Lamps) -> float:
    """χ² of the rays of some candidates as rays of one lamp."""
    # Real spheres are not accurate to better than half a degree.
    spread = np.trace(candidates.covariance[picks], axis1=1, axis2=2) / 2
    variances = np.radians(0.5) ** 2 + spread
    apart = angles(candidates.direction[picks], _towards(picks, candidates, lamps))
    return float(np.sum(apart**2 / variances))


def _towards(picks: np.ndarray, candidates: Candidates, lamps: Lamps) -> np.ndarray:
    """Unit vectors from each ray's origin to the lamp that fits all rays best."""
    origins, directions = candidates.position[picks], candidates.direction[picks]
    if lamps == "distant" or len(picks) == 1:
        return np.broadcast_to(unit(directions.mean(axis=0)), directions.shape)
    return unit(nearest_point(origins, directions) - origins)


def nearest_point(
    origins: Float[np.ndarray, "count 3"], directions: Float[np.ndarray, "count 3"]
) -> Float[np.ndarray, "3"]:
    """The point nearest to several lines, by least squares."""
    beside = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    right = np.einsum("sij,sj->i", beside, origins)
    return np.linalg.lstsq(beside.sum(axis=0), right, rcond=None)[0]


def angles(
    a: Float[np.ndarray, "... 3"], b: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "..."]:
    """Angles between unit vectors, radians, accurate for small angles as well."""
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1)))


class LampEstimate(NamedTuple):
    """Lamps as directions and distances from a reference point, with covariance.

    - `directions`: unit vectors from the reference point to each lamp.
    - `tangents`: two unit vectors perpendicular to each.
    - `inverse_distances`: 1 / distance from the reference point; 0 for parallel rays.
    - `joint`: covariance of the turns of each direction along its tangents, in radians,
        and of its inverse distance, lamp by lamp, and of the numbers that move the
        matte sphere's place, since errors of a sphere are common to all lamps.
    - `residuals`: distance of each highlight from its prediction, in standard
        deviations; `nan` for missing highlights.
    - `scatter`: root mean square distance of highlights from their predictions, over
        their stated errors; 1 if nothing determines it.
    - `outlines`: of the spheres, refined by all highlights.
    - `place`: of the matte sphere, refined by all photographs.
    """

    directions: Float[np.ndarray, "lamps 3"]
    tangents: Float[np.ndarray, "lamps 2 3"]
    inverse_distances: Float[np.ndarray, " lamps"]
    joint: Float[np.ndarray, "lamps*3+5 lamps*3+5"]
    residuals: Float[np.ndarray, "lamps spheres"]
    scatter: float
    outlines: Float[np.ndarray, "spheres 3"]
    place: Place | None


class _Problem(NamedTuple):
    """Constants of the residuals, by lamp, highlight or sphere.

    Unknowns are two turns of each lamp along `tangents` from `start`, inverse distances
    (one for each, one for all, or none), and moves of the chrome spheres' outlines and
    of the matte sphere's place.

    - `lamp`, `sphere`: of each highlight.
    - `to_pixels`: from differences of directions to those of highlights, in σ.
    - `whiten`, `hold`: from moves of outlines and of the place to residuals.
    - `shading`: linearised at `about`, inverse distances and moves of the place.
    - `scales`: factors of the errors of highlights and of shading.
    """

    lamp: Any
    sphere: Any
    pixel: Any
    to_pixels: Any
    chrome: Chrome
    whiten: Any
    start: Any
    tangents: Any
    reference: Any
    hold: Any
    shading: Shading
    about: tuple[Any, Any]
    scales: Any


class _Unknowns(NamedTuple):
    directions: Any
    inverse_distances: Any
    moves: Any
    place: Any


def _unpack(values: Any, problem: _Problem) -> _Unknowns:
    xp, count = namespace(values), len(problem.start)
    spheres = len(problem.chrome.outlines)
    turns, inverse, moves = xp.split(values, (2 * count, len(values) - 3 * spheres - 5))
    turned = xp.einsum("li,lij->lj", turns.reshape(-1, 2), problem.tangents)
    each = xp.broadcast_to(inverse if len(inverse) else xp.zeros(1), (count,))
    moved = moves[:-5].reshape(-1, 3)
    return _Unknowns(unit(problem.start + turned), each, moved, moves[-5:])


def _residuals(view: View, values: Any, problem: _Problem) -> Any:
    """Residuals of highlights, outlines, shading and the matte sphere's place."""
    at = _unpack(values, problem)
    outlines = (problem.chrome.outlines + at.moves)[problem.sphere]
    ray = mirrored(problem.pixel, outlines, view, problem.chrome.radius)

    def towards(lamp: Any, position: Any) -> Any:
        where = at.directions[lamp], at.inverse_distances[lamp], problem.reference
        return AnyDistanceLight(*where, jnp.zeros(())).illuminate(position).to_light

    apart = ray.direction - jax.vmap(towards)(problem.lamp, ray.position)
    in_pixels = jnp.einsum("kij,kj->ki", problem.to_pixels, apart)
    held = jnp.einsum("sij,sj->si", problem.whiten, at.moves)
    inverse, place = problem.about
    turns = jnp.einsum("lij,lj->li", problem.tangents, at.directions)
    nearer = (at.inverse_distances - inverse)[:, None]
    moved = jnp.broadcast_to(at.place - place, (len(inverse), 5))
    step = jnp.concatenate([turns, nearer, moved], axis=1)
    shaded = jnp.einsum("lij,lj->li", problem.shading.root, step) - problem.shading.aim
    parts = in_pixels / problem.scales[0], held, shaded / problem.scales[1]
    return jnp.concatenate([*map(jnp.ravel, parts), problem.hold @ at.place])


def solve_lamps(
    candidates: Candidates,
    chosen: Int[np.ndarray, "photographs spheres"],
    chrome: Chrome,
    view: View,
    lamps: Lamps,
    reference: Float[np.ndarray, "3"],
    matte: Matte | None = None,
) -> LampEstimate:
    """Fit all lamps and the spheres' places jointly, by least squares.

    A highlight's residual is its distance, in pixels, from the predicted highlight;
    outlines have priors with their own errors. Distant lamps are all at one distance (a
    dome, or the end of the room), which is a further unknown. With several spheres,
    their agreement determines the errors of centroids and of the matte sphere's
    shading: variance components, each the sum of squares of its residuals over their
    degrees of freedom.

    **Arguments:**

    - `chosen`: as from [`choose`][]; each photograph has a highlight, or `matte`.
    - `reference`: origin of the directions, in the camera's axes.

    ??? cite "Source"
        Förstner, *Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten*,
        Allgemeine Vermessungs-Nachrichten 86, 1979.
    """
    count, spheres = chosen.shape
    lamp, sphere = np.nonzero(chosen >= 0)
    shown = chosen[lamp, sphere]
    to_pixels = np.linalg.inv(candidates.by_pixel[shown]) @ candidates.tangent[shown]
    whiten = np.linalg.inv(np.linalg.cholesky(chrome.covariances))
    hold = np.eye(5) if matte is None else np.linalg.cholesky(matte.covariance)
    several = len(lamp) > len(np.unique(lamp)) or matte is not None
    distances = count if lamps == "near" else int(several)
    shaded = np.zeros((count, 3)) if matte is None else matte.shaded
    directions, inverse = _start(lamp, candidates, shown, shaded, lamps, reference)
    problem = _Problem(
        lamp,
        sphere,
        candidates.pixel[shown],
        to_pixels / candidates.error[shown, None, None],
        chrome,
        whiten,
        directions,
        tangents(directions),
        reference,
        np.linalg.inv(hold),
        Shading(np.zeros((count, 8, 8)), np.zeros((count, 8)), 0),
        (inverse, np.zeros(5)),
        np.ones(2),
    )
    begin = np.zeros(2 * count + distances + 3 * spheres + 5)
    begin[2 * count : 2 * count + distances] = inverse[:distances]
    upper = np.full(len(begin), np.inf)
    if matte is not None and lamps == "near":
        # Light falls off at most with the square of the distance.
        upper[-1] = 1 - matte.place.falloff
    residuals = differentiated(functools.partial(_residuals, view))
    estimate = None
    for number in range(1 if matte is None else ROUNDS):
        place = problem.about[1]
        # The first estimate uses highlights only; shading is linearised there.
        looked = number > 0 or not len(lamp)
        if matte is not None and looked:
            here = matte._replace(place=matte.place.moved(place))
            shading = shade(here, problem.start, problem.tangents, problem.about[0])
            problem = problem._replace(shading=shading)
        solution, problem = _weighted(residuals, problem, begin, upper)
        estimate = _estimate(solution, problem, matte)
        moved = angles(problem.start, estimate.directions)
        variances = np.diag(estimate.joint)[:-5].reshape(-1, 3)
        near = moved < 0.02 * np.sqrt(variances[:, :2].sum(axis=1))
        if looked and near.all():
            break
        begin = np.concatenate([np.zeros(2 * count), solution.values[2 * count :]])
        problem = problem._replace(
            start=estimate.directions,
            tangents=tangents(estimate.directions),
            about=(estimate.inverse_distances, solution.values[-5:]),
        )
    assert estimate is not None
    return estimate


def _start(
    lamp: np.ndarray,
    candidates: Candidates,
    shown: np.ndarray,
    shaded: np.ndarray,
    lamps: Lamps,
    reference: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Initial directions from the reference point, and initial inverse distances.

    **Arguments:** `shown`: numbers of the highlights, each of a `lamp`.
    """
    directions, inverse = np.array(shaded), np.zeros(len(shaded))
    for number in np.unique(lamp):
        mine = shown[lamp == number]
        origins, towards = candidates.position[mine], candidates.direction[mine]
        directions[number] = unit(towards.mean(axis=0))
        if lamps == "near" and len(origins) > 1:
            offset = nearest_point(origins, towards) - reference
            if offset @ directions[number] > 0:
                directions[number] = unit(offset)
                inverse[number] = 1 / np.linalg.norm(offset)
    # Lamps with a single ray start at the median distance of the others.
    some = inverse > 0
    inverse[~some] = np.median(inverse[some]) if some.any() else 0
    return directions, inverse


def _weighted(
    residuals: Callable[..., Any],
    problem: _Problem,
    begin: np.ndarray,
    upper: np.ndarray,
) -> tuple[Solution, _Problem]:
    """The solution, iterated with the variance components of its residuals."""
    highlights, spheres = 2 * len(problem.lamp), 3 * len(problem.chrome.outlines)
    ranks = np.array([highlights, problem.shading.rank])
    groups = slice(0, highlights), slice(highlights + spheres, -5)
    solution = least_squares(residuals, begin, problem, upper=upper)
    for _ in range(SCALINGS):
        squared = [np.sum(solution.residual[group] ** 2) for group in groups]
        taken = [np.sum(solution.hat[group]) for group in groups]
        # The prior keeps factors near 1 if there are few degrees of freedom.
        squared = np.array(squared) * problem.scales**2 + 4
        scales = np.sqrt(squared / (np.maximum(ranks - taken, 0) + 4))
        scales[1] = max(scales[1], 1.0)
        if np.allclose(problem.scales, scales, rtol=0.02):
            break
        problem = problem._replace(scales=scales)
        solution = least_squares(residuals, solution.values, problem, upper=upper)
    return solution, problem


def _estimate(
    solution: Solution, problem: _Problem, matte: Matte | None
) -> LampEstimate:
    at = _unpack(solution.values, problem)
    count, spheres = len(problem.start), len(problem.chrome.outlines)
    distances = len(solution.values) - 2 * count - 3 * spheres - 5
    # Matrix from unknowns to the numbers of each lamp, and of the place.
    each, taken = np.arange(count), np.zeros((3 * count + 5, len(solution.values)))
    taken[3 * each, 2 * each] = taken[3 * each + 1, 2 * each + 1] = 1
    if distances:
        taken[3 * each + 2, 2 * count + np.minimum(each, distances - 1)] = 1
    if matte is not None:
        taken[-5:, -5:] = np.eye(5)
    apart = solution.residual[: 2 * len(problem.lamp)].reshape(-1, 2)
    distance = np.full((count, spheres), np.nan)
    distance[problem.lamp, problem.sphere] = np.hypot(*apart.T)
    return LampEstimate(
        at.directions,
        problem.tangents,
        at.inverse_distances,
        taken @ solution.covariance @ taken.T,
        distance,
        float(problem.scales[0]),
        problem.chrome.outlines + at.moves,
        None if matte is None else matte.place.moved(at.place),
    )
