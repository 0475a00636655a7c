"""Lamps from their highlights in chrome spheres: chosen, and solved for all at once."""

import itertools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.calibration.highlights import Highlight
from phongfit.calibration.matte import Matte, Place, Shading, shade, shaded_directions
from phongfit.calibration.outlines import View, across, mirrored, unit

Lamps = Literal["distant", "near"]

MISSED = 12.0
"""What it costs, in squared standard deviations, that a sphere shows no highlight."""

COMPARABLE, ALIKE = 0.6, 0.8
"""A second lamp stands out at least this much, of what the first does: where spheres
agree on it, and where one sphere alone shows it."""

APART = np.radians(5.0)
"""What is nearer to a lamp than this is the lamp: its frame, or its glare."""

AGREE = 2.5
"""Spheres agree on a lamp to so many standard deviations."""

ROUNDS = 8
"""How often shading is looked at anew about the last estimate, at most."""

HELD = 1e-6
"""Standard deviation of a fall-off that is at its bound."""

STEPS = 12
"""How many steps are made for one look at the shading, at most."""


class Chrome(NamedTuple):
    """Chrome spheres as the photographs show them.

    - `outlines`: x, y and radius in pixels, one row a sphere.
    - `covariances`: of these.
    - `radius`: of all of them, in the unit that lamps' places will have.
    """

    outlines: Float[np.ndarray, "spheres 3"]
    covariances: Float[np.ndarray, "spheres 3 3"]
    radius: float


class LampEstimate(NamedTuple):
    """Lamps as directions from one place, and how far they are.

    - `directions`: unit vectors from the reference point to each lamp.
    - `inverse_distances`: 1 / distance from there; 0 for parallel rays.
    - `joint`: covariance of two coordinates of each direction across it (see `across`
        of `outlines`), in radians, and of its inverse distance, lamp by lamp, and of
        the moves of the matte sphere's place: what is wrong with a sphere is wrong for
        all lamps.
    - `residuals`: distance of each highlight from where its lamp would show it, in
        standard deviations; `nan` where a sphere shows none.
    - `scatter`: how far highlights lie from there, over what their centroids' errors
        say, root mean square; 1 where nothing is left to tell it.
    - `outlines`: of the spheres, as all highlights together would have them.
    - `place`: of the matte sphere, likewise.
    """

    directions: Float[np.ndarray, "lamps 3"]
    inverse_distances: Float[np.ndarray, " lamps"]
    joint: Float[np.ndarray, "lamps*3+5 lamps*3+5"]
    residuals: Float[np.ndarray, "lamps spheres"]
    scatter: float
    outlines: Float[np.ndarray, "spheres 3"]
    place: Place | None

    @property
    def falloff_error(self) -> float:
        """Standard deviation of the place's κ."""
        return float(np.sqrt(max(self.joint[-1, -1], 0)))

    @property
    def covariances(self) -> Float[np.ndarray, "lamps 3 3"]:
        """Of each lamp alone."""
        count = len(self.directions)
        each = self.joint[:-5, :-5].reshape(count, 3, count, 3)
        return np.moveaxis(np.diagonal(each, axis1=0, axis2=2), -1, 0)


class _Rays(NamedTuple):
    """Highlights followed back to their lamps, and how well that is known."""

    position: Float[np.ndarray, "count 3"]
    direction: Float[np.ndarray, "count 3"]
    tangent: Float[np.ndarray, "count 2 3"]
    by_pixel: Float[np.ndarray, "count 2 2"]
    covariance: Float[np.ndarray, "count 2 2"]


def _follow(
    shown: Sequence[Highlight], sphere: np.ndarray, chrome: Chrome, view: View
) -> _Rays:
    """Highlights, each on the sphere of a number, as rays with their covariances."""
    pixels = np.array([one.pixel for one in shown]).reshape(-1, 2)
    errors = np.array([one.error for one in shown])[:, None, None]
    outlines, spread = chrome.outlines[sphere], chrome.covariances[sphere]
    ray = mirrored(pixels, outlines, view, chrome.radius)
    tangent = across(ray.direction)

    def turned(pixels: np.ndarray, outlines: np.ndarray) -> np.ndarray:
        moved = mirrored(pixels, outlines, view, chrome.radius).direction
        return np.einsum("kij,kj->ki", tangent, moved)

    by_pixel = _slope(lambda moved: turned(moved, outlines), pixels)
    by_outline = _slope(lambda moved: turned(pixels, moved), outlines)
    covariance = errors**2 * by_pixel @ by_pixel.swapaxes(1, 2)
    covariance = covariance + by_outline @ spread @ by_outline.swapaxes(1, 2)
    return _Rays(ray.position, ray.direction, tangent, by_pixel, covariance)


def _slope(
    function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: float = 1e-3
) -> np.ndarray:
    """Derivatives by pixels, (count, outputs, inputs), by central differences."""
    moves = step * np.eye(at.shape[-1])
    sides = [(function(at + move) - function(at - move)) / (2 * step) for move in moves]
    return np.stack(sides, axis=-1)


def choose(
    candidates: Sequence[Sequence[Sequence[Highlight]]],
    chrome: Chrome,
    view: View,
    lamps: Lamps,
    shaded: Float[np.ndarray, "count 3"] | None = None,
) -> list[list[Highlight | None]]:
    """For each photograph, the blobs on the spheres that are one and the same lamp.

    Of all combinations the one is taken whose rays agree best and whose blobs look most
    like lamps. A sphere may show none, where its highlight is hidden.

    **Arguments:**

    - `candidates`: by photograph and sphere.
    - `shaded`: the lamp's direction by the shading of a matte sphere, or zeros.
    """
    chosen = []
    spheres = len(chrome.outlines)
    most = max(int(2000 ** (1 / max(spheres, 1))) - 1, 1)
    for number, per_sphere in enumerate(candidates):
        rays = [
            _follow(found, np.full(len(found), sphere), chrome, view)
            for sphere, found in enumerate(per_sphere)
        ]
        options = [[None, *range(min(len(found), most))] for found in per_sphere]
        hint = None if shaded is None else shaded[number]
        costs = {
            picks: _disagreement(picks, per_sphere, rays, lamps, hint)
            for picks in itertools.product(*options)
        }
        best = min(costs, key=costs.__getitem__)
        chosen.append(
            [
                None if pick is None else found[pick]
                for pick, found in zip(best, per_sphere, strict=True)
            ]
        )
    return chosen


def show_two_lamps(
    candidates: Sequence[Sequence[Sequence[Highlight]]],
    chosen: Sequence[Sequence[Highlight | None]],
    chrome: Chrome,
    view: View,
    lamps: Lamps,
) -> list[bool]:
    """In which photographs the spheres agree on a second lamp, too.

    One about as bright as the first, and elsewhere. One sphere has nobody to agree
    with: what it shows must be brighter, and may yet be something that it mirrors.

    **Arguments:** as of [`choose`][], and what that chose.
    """
    return [
        _second(per_sphere, row, chrome, view, lamps)
        for per_sphere, row in zip(candidates, chosen, strict=True)
    ]


def _second(
    per_sphere: Sequence[Sequence[Highlight]],
    chosen: Sequence[Highlight | None],
    chrome: Chrome,
    view: View,
    lamps: Lamps,
) -> bool:
    if not chosen or any(one is None for one in chosen):
        return False
    least = COMPARABLE if len(chosen) > 1 else ALIKE
    first = [
        _follow([one], np.array([sphere]), chrome, view).direction[0]
        for sphere, one in enumerate(chosen)
        if one is not None
    ]
    others, rays = [], []
    for sphere, (found, one) in enumerate(zip(per_sphere, chosen, strict=True)):
        assert one is not None
        like = [h for h in found if h is not one and h.score > least * one.score]
        ray = _follow(like, np.full(len(like), sphere), chrome, view)
        apart = angles(ray.direction, np.broadcast_to(first[sphere], (len(like), 3)))
        others.append([h for h, far in zip(like, apart, strict=True) if far > APART])
        rays.append(_follow(others[-1], np.full(len(others[-1]), sphere), chrome, view))
    return any(
        _scatter(picks, rays, lamps) < AGREE**2 * len(picks)
        for picks in itertools.product(*[range(len(found)) for found in others])
    )


def _disagreement(
    picks: Sequence[int | None],
    found: Sequence[Sequence[Highlight]],
    rays: Sequence[_Rays],
    lamps: Lamps,
    hint: np.ndarray | None,
) -> float:
    """How badly some blobs agree on one lamp: squares of standard deviations."""
    shown = [(s, pick) for s, pick in enumerate(picks) if pick is not None]
    cost = MISSED * (len(picks) - len(shown))
    if not shown:
        return cost
    cost -= 4 * sum(float(np.log(found[s][pick].score)) for s, pick in shown)
    cost += _scatter(picks, rays, lamps)
    if hint is not None and hint.any():
        # Near lamps shade a sphere as if they stood elsewhere.
        error = 0.1 if lamps == "distant" else 0.6
        origins, directions = _picked(shown, rays)
        towards = _towards(origins, directions, lamps)
        cost += float((angles(hint, unit(towards.mean(axis=0))) / error) ** 2)
    return cost


def _picked(
    shown: Sequence[tuple[int, int]], rays: Sequence[_Rays]
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of the rays of some blobs."""
    origins = np.array([rays[s].position[pick] for s, pick in shown])
    return origins, np.array([rays[s].direction[pick] for s, pick in shown])


def _scatter(picks: Sequence[int | None], rays: Sequence[_Rays], lamps: Lamps) -> float:
    """How far the rays of some blobs are from one lamp: squares of deviations."""
    shown = [(s, pick) for s, pick in enumerate(picks) if pick is not None]
    origins, directions = _picked(shown, rays)
    # Half a degree is what spheres and their surroundings are never better than.
    variances = np.radians(0.5) ** 2 + np.array(
        [np.trace(rays[s].covariance[pick]) / 2 for s, pick in shown]
    )
    towards = _towards(origins, directions, lamps)
    return float(np.sum(angles(directions, towards) ** 2 / variances))


def _towards(origins: np.ndarray, directions: np.ndarray, lamps: Lamps) -> np.ndarray:
    """Unit vectors from each origin to the lamp that the rays agree on best."""
    if lamps == "distant" or len(origins) == 1:
        return np.broadcast_to(unit(directions.mean(axis=0)), directions.shape)
    return unit(nearest_point(origins, directions) - origins)


def nearest_point(
    origins: Float[np.ndarray, "count 3"], directions: Float[np.ndarray, "count 3"]
) -> Float[np.ndarray, "3"]:
    """The point that lies nearest to several lines, by least squares."""
    beside = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    right = np.einsum("sij,sj->i", beside, origins)
    return np.linalg.lstsq(beside.sum(axis=0), right, rcond=None)[0]


def angles(
    a: Float[np.ndarray, "... 3"], b: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "..."]:
    """Between unit vectors, radians, exact for small ones too."""
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1)))


def solve_lamps(
    highlights: Sequence[Sequence[Highlight | None]],
    chrome: Chrome,
    view: View,
    lamps: Lamps,
    reference: Float[np.ndarray, "3"],
    matte: Matte | None = None,
) -> LampEstimate:
    """All lamps and the spheres' places together, by least squares.

    A highlight's residual is its distance, in pixels, from where its lamp would show
    it; outlines are held by their own errors. Distant lamps are all equally far (a
    dome, or the end of the room), and how far is one unknown more. How well centroids,
    and the shading of the matte sphere, are known follows from how well spheres agree,
    where there are several: variance components, each the sum of its squares over the
    degrees of freedom that the solution leaves it.

    **Arguments:**

    - `highlights`: by photograph and sphere; each photograph has one, or `matte`.
    - `reference`: the point, in the camera's axes, that directions are counted from.

    ??? cite "Source"
        Förstner, *Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten*,
        Allgemeine Vermessungs-Nachrichten 86, 1979.
    """
    system = _System(highlights, chrome, view, lamps, reference)
    directions, inverse = system.start(matte)
    if matte is None:
        return system.solve(directions, inverse, None)
    if len(system.lamp):
        first = system.solve(directions, inverse, None)
        directions, inverse = first.directions, first.inverse_distances
    estimate, here = None, matte
    for _ in range(ROUNDS):
        shading = shade(here, directions, inverse)
        estimate = system.solve(directions, inverse, _Shaded(shading, matte))
        moved = angles(directions, estimate.directions)
        directions, inverse = estimate.directions, estimate.inverse_distances
        if (moved < 0.02 * _spread(estimate)).all() or estimate.place is None:
            break
        here = matte._replace(place=estimate.place)
    assert estimate is not None
    if estimate.place is not None and estimate.place.falloff > 1 + 10 * HELD:
        # No lamp's light falls off faster than a bulb's.
        bulb, held = matte.place._replace(falloff=1.0), matte.covariance.copy()
        held[4, :] = held[:, 4] = 0
        held[4, 4] = HELD**2
        matte = matte._replace(place=bulb, covariance=held)
        at_most = solve_lamps(highlights, chrome, view, lamps, reference, matte)
        at_most.joint[-1, -1] = estimate.joint[-1, -1]
        return at_most
    return estimate


def _spread(estimate: LampEstimate) -> Float[np.ndarray, " lamps"]:
    """Root mean square angle of each direction's error, radians."""
    return np.sqrt(np.abs(np.trace(estimate.covariances[:, :2, :2], 0, 1, 2)))


class _Shaded(NamedTuple):
    shading: Shading
    matte: Matte


class _System:
    """The least-squares problem of [`solve_lamps`][]; unknowns are one flat vector.

    In it: two turns of each lamp, how near each is, how near all are, moves of the
    chrome spheres' outlines, and of the matte sphere's place.
    """

    def __init__(
        self,
        highlights: Sequence[Sequence[Highlight | None]],
        chrome: Chrome,
        view: View,
        lamps: Lamps,
        reference: np.ndarray,
    ):
        self.count, self.spheres = len(highlights), len(chrome.outlines)
        is_shown = [[one is not None for one in row] for row in highlights]
        grid = np.array(is_shown, bool).reshape(self.count, self.spheres)
        self.lamp, self.sphere = np.nonzero(grid)
        shown = [one for row in highlights for one in row if one is not None]
        self.pixels = np.array([one.pixel for one in shown]).reshape(-1, 2)
        self.errors = np.array([one.error for one in shown])[:, None]
        self.chrome, self.view, self.lamps = chrome, view, lamps
        self.reference = reference
        self.rays = _follow(shown, self.sphere, chrome, view)
        self.to_pixels = np.linalg.inv(self.rays.by_pixel)
        self.whiten = np.linalg.inv(np.linalg.cholesky(chrome.covariances))
        sizes = [2 * self.count, self.count, 1, 3 * self.spheres, 5]
        self.parts = np.cumsum(sizes)

    def start(self, matte: Matte | None) -> tuple[np.ndarray, np.ndarray]:
        """Directions from the reference and inverse distances to begin with."""
        directions = np.zeros((self.count, 3))
        if matte is not None:
            directions = shaded_directions(matte)
        inverse = np.zeros(self.count)
        for number in np.unique(self.lamp):
            mine = self.lamp == number
            origins, towards = self.rays.position[mine], self.rays.direction[mine]
            directions[number] = unit(towards.mean(axis=0))
            if self.lamps == "near" and len(origins) > 1:
                offset = nearest_point(origins, towards) - self.reference
                if offset @ directions[number] > 0:
                    directions[number] = unit(offset)
                    inverse[number] = 1 / np.linalg.norm(offset)
        # A lamp that one ray leads to is as far as the others, to begin with.
        some = inverse > 0
        inverse[~some] = np.median(inverse[some]) if some.any() else 0
        return directions, inverse

    def solve(
        self, directions: np.ndarray, inverse: np.ndarray, shaded: _Shaded | None
    ) -> LampEstimate:
        problem = _Linearised(self, directions, inverse, shaded)
        free = problem.free
        begin = np.zeros(self.parts[-1])
        begin[2 * self.count : 3 * self.count] = inverse
        if self.lamps == "distant":
            begin[self.parts[1]] = inverse.mean()
            begin[2 * self.count : 3 * self.count] = 0
        if shaded is not None:
            begin[self.parts[3] :] = problem.place_moves()
        scales, some, covariance = np.ones(2), begin[free], np.zeros((0, 0))

        def residuals(some: np.ndarray) -> np.ndarray:
            flat = begin.copy()
            flat[free] = some
            return problem.residuals(flat) / problem.scale_of(scales)

        for _ in range(STEPS):
            # A step of Gauss and Newton's method, halved until it leads downwards.
            jacobian, rest = _steps(residuals, some), residuals(some)
            covariance = np.linalg.pinv(jacobian.T @ jacobian)
            step = -covariance @ (jacobian.T @ rest)
            while np.sum(residuals(some + step) ** 2) > np.sum(rest**2) + 1e-6:
                step = step / 2
                if not np.any(np.abs(step) > 1e-9):
                    break
            some, rest = some + step, residuals(some + step)
            hat = np.einsum("ki,ij,kj->k", jacobian, covariance, jacobian)
            before, scales = scales, problem.new_scales(scales, rest, hat)
            small = np.abs(step) < 0.02 * np.sqrt(np.abs(np.diag(covariance))) + 1e-12
            if small.all() and np.allclose(before, scales, rtol=0.02):
                break
        flat = begin.copy()
        flat[free] = some
        joint = np.zeros((len(free), len(free)))
        joint[np.ix_(free, free)] = covariance
        return problem.estimate(flat, joint, scales)


class _Linearised:
    """The same about a start, and with shading in first order about it."""

    def __init__(
        self,
        system: _System,
        directions: np.ndarray,
        inverse: np.ndarray,
        shaded: _Shaded | None,
    ):
        self.system, self.shaded = system, shaded
        self.start, self.tangents = directions, across(directions)
        count = system.count
        several = np.any(np.bincount(system.lamp, minlength=1) > 1)
        parallax = system.lamps == "distant" and bool(several or shaded is not None)
        self.free = np.concatenate(
            [
                np.ones(2 * count),
                np.full(count, float(system.lamps == "near")),
                [float(parallax)],
                np.ones(3 * system.spheres),
                np.full(5, float(shaded is not None)),
            ]
        ).astype(bool)
        if shaded is not None:
            information = shaded.shading.information
            values, vectors = np.linalg.eigh(information)
            limit = 1e-9 * np.maximum(values.max(axis=-1, keepdims=True), 1e-300)
            kept = values > limit
            root = np.sqrt(np.where(kept, values, 0))
            self.root = root[..., None] * vectors.swapaxes(-1, -2)
            back = np.where(kept, 1 / np.where(kept, root, 1), 0)
            self.aim = back * np.einsum("lij,li->lj", vectors, shaded.shading.pull)
            self.known = kept
            self.hold = np.linalg.inv(np.linalg.cholesky(shaded.matte.covariance))

    def place_moves(self) -> np.ndarray:
        """Where shading was looked at, as moves of what was known before."""
        assert self.shaded is not None
        now, first = self.shaded.shading.place, self.shaded.matte.place
        return np.concatenate(
            [
                now.outline - first.outline,
                [np.log(now.radius / first.radius), now.falloff - first.falloff],
            ]
        )

    def unpack(self, flat: np.ndarray) -> tuple[np.ndarray, ...]:
        turns, each, common, moves, place = np.split(flat, self.system.parts[:-1])
        turned = np.einsum("li,lij->lj", turns.reshape(-1, 2), self.tangents)
        return unit(self.start + turned), each + common, moves.reshape(-1, 3), place

    def residuals(self, flat: np.ndarray) -> np.ndarray:
        """Of highlights, of outlines, and of shading and the matte sphere's place."""
        system = self.system
        directions, inverse, moves, place = self.unpack(flat)
        outlines = (system.chrome.outlines + moves)[system.sphere]
        ray = mirrored(system.pixels, outlines, system.view, system.chrome.radius)
        # A lamp at any distance, infinity too, in homogeneous coordinates.
        near = inverse[system.lamp, None]
        towards = near * (system.reference - ray.position) + directions[system.lamp]
        apart = np.einsum(
            "kij,kj->ki", system.rays.tangent, ray.direction - unit(towards)
        )
        by_pixel = np.einsum("kij,kj->ki", system.to_pixels, apart) / system.errors
        held = np.einsum("sij,sj->si", system.whiten, moves)
        found = [by_pixel.ravel(), held.ravel()]
        if self.shaded is not None:
            shading = self.shaded.shading
            step = np.concatenate(
                [
                    np.einsum("lij,lj->li", self.tangents, directions),
                    (inverse - shading.inverse_distances)[:, None],
                    np.broadcast_to(place - self.place_moves(), (system.count, 5)),
                ],
                axis=1,
            )
            found.append((np.einsum("lij,lj->li", self.root, step) - self.aim).ravel())
            found.append(self.hold @ place)
        return np.concatenate(found)

    def _groups(self) -> tuple[slice, slice]:
        """Which residuals are those of highlights, and of shading."""
        first = 2 * len(self.system.lamp)
        second = first + 3 * self.system.spheres
        shaded = 0 if self.shaded is None else 8 * self.system.count
        return slice(0, first), slice(second, second + shaded)

    def scale_of(self, scales: np.ndarray) -> np.ndarray:
        size = 2 * len(self.system.lamp) + 3 * self.system.spheres
        size += 0 if self.shaded is None else 8 * self.system.count + 5
        scale = np.ones(size)
        for group, one in zip(self._groups(), scales, strict=True):
            scale[group] = one
        return scale

    def new_scales(
        self, scales: np.ndarray, rest: np.ndarray, hat: np.ndarray
    ) -> np.ndarray:
        highlights, shading = self._groups()
        # With few to tell it, nearer to what centroids' errors say themselves.
        spare = max(2 * len(self.system.lamp) - hat[highlights].sum(), 0.0)
        squared = np.sum(rest[highlights] ** 2) * scales[0] ** 2
        first = np.sqrt((squared + 4) / (spare + 4))
        if self.shaded is None:
            return np.array([first, 1.0])
        spare = max(float(self.known.sum()) - hat[shading].sum(), 0.0)
        squared = np.sum(rest[shading] ** 2) * scales[1] ** 2
        return np.array([first, max(np.sqrt((squared + 4) / (spare + 4)), 1.0)])

    def estimate(
        self, flat: np.ndarray, joint: np.ndarray, scales: np.ndarray
    ) -> LampEstimate:
        system = self.system
        directions, inverse, moves, place = self.unpack(flat)
        count = system.count
        each = np.full(count, system.parts[1])
        if system.lamps == "near":
            each = 2 * count + np.arange(count)
        turns = np.arange(2 * count).reshape(-1, 2)
        where = np.concatenate([turns, each[:, None]], axis=1)
        chosen = np.concatenate([where.ravel(), system.parts[3] + np.arange(5)])
        turn = np.eye(len(chosen))
        turn[:-5, :-5] = _turns(self.tangents, across(directions))
        covariance = turn @ joint[np.ix_(chosen, chosen)] @ turn.T
        apart = self.residuals(flat)[: 2 * len(system.lamp)].reshape(-1, 2)
        distance = np.full((count, system.spheres), np.nan)
        distance[system.lamp, system.sphere] = np.hypot(*apart.T) / scales[0]
        shaded = self.shaded
        return LampEstimate(
            directions,
            inverse,
            covariance,
            distance,
            float(scales[0]),
            system.chrome.outlines + moves,
            None if shaded is None else shaded.matte.place.moved(place),
        )


def _steps(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """A Jacobian by central differences."""
    step = 1e-5
    moves = step * np.eye(len(at))
    return np.stack(
        [(function(at + move) - function(at - move)) / (2 * step) for move in moves], 1
    )


def _turns(old: np.ndarray, new: np.ndarray) -> Float[np.ndarray, "n n"]:
    """From coordinates by the start's tangents to those by the answer's."""
    count = len(old)
    turn = np.zeros((count, 3, count, 3))
    each = np.arange(count)
    turn[each, :2, each, :2] = np.einsum("lij,lkj->lik", new, old)
    turn[each, 2, each, 2] = 1
    return turn.reshape(3 * count, 3 * count)
