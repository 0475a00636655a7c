r"""Correction of fits for the compression of JPEG files, by simulation.

Errors of compression are not independent noise. A coefficient that rounds to 0 loses
its signal, at all edges and highlights alike; colour on a coarser grid bleeds over
silhouettes; all pixels of a block share the rounding of its coefficients, and all
blocks of one colour that of their mean. So the fitted image, with noise, is compressed
by the file's own steps some dozen times. The mean error is subtracted from the
photograph, which is fitted again, and the scatter of the simulations determines the
errors.

Each simulated image is scaled and shifted by a few levels, so that the position of a
large coefficient between two steps is random, while a small one still rounds to 0. All
images of one draw have the same scale and shift: they show one material, whose colours
round alike in all of them.

??? cite "Source"
    Widrow and Kollár, *Quantization noise*, 2008, chapters 4 and 19; Gouriéroux,
    Monfort and Renault, *Indirect inference*, J. Appl. Econometrics 8(S1), 1993.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.problem.problem import Problem, evaluate
from phongfit.fitting.problem.samples import Source
from phongfit.fitting.solve.search import SearchResult
from phongfit.fitting.solve.solution import solve
from phongfit.fitting.solve.sums import Jacobian, Linearization, linearize
from phongfit.programs import program
from phongfit.rendering.film import Film, decode, encode
from phongfit.rendering.jpeg import JpegCompression, compressed

# Number of draws for the correction, and for the errors at the end: a standard error
# from 32 draws is accurate to 12 %.
FEW, MANY = 8, 32
# Largest relative change of brightness in a draw.
BRIGHTER = 0.15
# Radius in pixels over which the surroundings of the surface are smoothed.
AROUND = 4
# Fraction of the samples in blocks that show only the surface, above which the noise is
# estimated from these blocks.
ENOUGH = 0.1
# Most times that the search for the noise quadruples a variance that is too small.
GROWN = 6

Drawn = Float[np.ndarray, "draws 3 rows columns"]
"""Sums over tiles of simulated residuals; the sum of their squares is a variance."""


def restore(
    found: SearchResult,
    sources: list[Source],
    films: tuple[Film, ...],
    noise_given: bool,
    max_steps: int,
    side: int,
) -> tuple[SearchResult, list[Source], list[Drawn]]:
    """Fit photographs again, corrected for JPEG compression.

    **Arguments:**

    - `found`: a fit of the images as they are.
    - `sources`, `films`: all images, also those that are not JPEG.
    - `side`: pixels along the side of a tile.

    **Returns:** the solution, the corrected photographs with rounding steps that match
    the errors, and sums over tiles of the right model's residuals: see
    [`find_misfit`][].
    """
    first, problem, y, steps = found.problem, found.problem, found.y, found.steps
    plates = _plates(first, sources, films)
    for _ in range(2):
        stage = _Stage(first, problem, y, plates)
        problem = stage.corrected(float(first.sigma) if noise_given else stage.noise())
        solution = solve(problem, y, max_steps)
        y, steps = solution.y, steps + solution.steps
    draws, step = _Stage(first, problem, y, plates).draw(side), problem.samples.step
    problem = _restored(first, draws.lost, step, problem.sigma)
    solution = solve(problem, y, max_steps)
    restored = [
        dataclasses.replace(
            source,
            image=source.image - jnp.asarray(plate.picture(draws.lost)),
            step=plate.picture(np.asarray(step)),
        )
        for source, plate in zip(sources, plates, strict=True)
    ]
    problem = dataclasses.replace(problem, scatter=draws.scatter)
    steps = steps + solution.steps
    found = SearchResult(problem, solution.y, solution.converged, steps)
    return found, restored, draws.tiles


def foresee(
    problem: Problem,
    y: Float[Array, " n"],
    sources: list[Source],
    films: tuple[Film, ...],
) -> Problem:
    """The problem of photographs not yet taken, with the rounding of their JPEG files.

    **Arguments:** `y`: the truth.
    """
    plates = _plates(problem, sources, films)
    there = _Stage(problem, problem, y, plates).corrected(1.0)
    draws = _Stage(problem, there, y, plates).draw(8)
    return dataclasses.replace(there, scatter=draws.scatter)


def _restored(
    first: Problem,
    lost: Float[np.ndarray, "3 samples"],
    step: Any,
    sigma: Any,
) -> Problem:
    """The problem with corrected targets, and other rounding steps and noise."""
    kind = first.samples.target.dtype
    samples = eqx.tree_at(
        lambda s: (s.target, s.step),
        first.samples,
        (first.samples.target - jnp.asarray(lost, kind), jnp.asarray(step, kind)),
    )
    return dataclasses.replace(first, samples=samples, sigma=jnp.asarray(sigma, kind))


class _Plate(NamedTuple):
    """An image, prepared for simulations of its film.

    - `around`: light outside of the surface, (pixels, 3).
    - `place`, `columns`: flat indices of the fit's pixels, and their indices among the
        samples.
    - `used`: true for used samples, (height, width, 3).
    - `box`: rows and columns of the blocks of these pixels and of the adjacent blocks;
        other blocks do not affect them.
    """

    film: Film
    around: Float[np.ndarray, "pixels 3"]
    place: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    used: Bool[np.ndarray, "height width 3"]
    box: tuple[slice, slice]

    def picture(
        self, samples: Float[np.ndarray, "3 samples"]
    ) -> Float[np.ndarray, "height width 3"]:
        """Values of the samples as an image; 0 elsewhere."""
        picture = np.zeros(self.around.shape, samples.dtype)
        picture[self.place] = samples[:, self.columns].T
        return np.where(self.used, picture.reshape(self.used.shape), 0)

    def all_over(
        self, blocks: Shaped[np.ndarray, "rows columns channels"], jpeg: JpegCompression
    ) -> Shaped[np.ndarray, "height width channels"]:
        """Repeat the value of each block of the file at all of its pixels."""
        (down, across), (height, width, _) = jpeg.block, self.used.shape
        return blocks.repeat(down, axis=0).repeat(across, axis=1)[:height, :width]

    def levels(
        self, light: Float[np.ndarray, "3 n"]
    ) -> Float[np.ndarray, "rows columns 3"]:
        """Encoded levels 0 … 255 of the box with this light on the surface."""
        canvas = self.around.copy()
        canvas[self.place] = light.T
        shown = np.clip(canvas.reshape(self.used.shape)[self.box], 0, 1)
        return encode(shown, self.film.encoding) * 255

    def read(
        self, levels: Float[np.ndarray, "rows columns 3"]
    ) -> Float[np.ndarray, "3 n"]:
        """Light of the surface, from encoded levels of the box."""
        image = np.zeros(self.used.shape, levels.dtype)
        image[self.box] = decode(np.clip(levels / 255, 0, 1), self.film.encoding)
        return image.reshape(-1, 3)[self.place].T


def _plates(
    problem: Problem, sources: list[Source], films: tuple[Film, ...]
) -> list[_Plate]:
    plates, weight = [], np.asarray(problem.samples.weight)
    views, size = problem.samples.views, problem.samples.image.size // len(sources)
    for k, (view, source, film) in enumerate(zip(views, sources, films, strict=True)):
        own = np.arange(size * k, size * (k + 1))
        columns = own[(weight[:, own] > 0).any(axis=0)]
        place = np.asarray(view.index)[columns - size * k]
        image = np.asarray(source.image, np.float32)
        used = np.greater(np.broadcast_to(source.weight, image.shape), 0)
        around = _surroundings(image, used.max(axis=-1, keepdims=True))
        around, box = around.reshape(-1, 3), _box(used, film)
        plates.append(_Plate(film, around, place, columns, used, box))
    return plates


def _box(used: Bool[np.ndarray, "height width 3"], film: Film) -> tuple[slice, slice]:
    """Rows and columns of the blocks with used pixels, and one block around."""
    if film.jpeg is None or not used.any():
        return slice(None), slice(None)
    edges = []
    for axis, block in enumerate(film.jpeg.block):
        there = np.flatnonzero(used.any(axis=(1 - axis, 2))) // block
        edges.append(slice(max(there[0] - 1, 0) * block, (there[-1] + 2) * block))
    return edges[0], edges[1]


def _surroundings(
    image: Float[np.ndarray, "height width 3"],
    used: Bool[np.ndarray, "height width 1"],
) -> Float[np.ndarray, "height width 3"]:
    """The image with its surroundings of the used pixels smoothed.

    Ripples near an edge are a result of compression: the file lacks the edge's high
    frequencies. They must not be part of an image that is compressed again.
    """
    outside = ~used
    share = _blurred(outside.astype(image.dtype))
    mean = _blurred(np.where(outside, image, 0)) / np.maximum(share, 1e-6)
    near = outside & (_blurred(used.astype(image.dtype)) > 1e-6)
    return np.where(near, mean, image)


def _blurred(image: np.ndarray) -> np.ndarray:
    """Means over a triangular window."""
    # Imported here, since SciPy takes long to import and few fits need it.
    from scipy.ndimage import uniform_filter1d

    for axis in (0, 0, 1, 1):
        image = uniform_filter1d(image, AROUND + 1, axis, mode="constant")
    return image


def _in_blocks(
    picture: np.ndarray, down: int, across: int
) -> Float[np.ndarray, "rows columns channels"]:
    """Sums over the blocks of an image; the last ones may be incomplete."""
    height, width, channels = picture.shape
    padded = np.pad(picture, [(0, -height % down), (0, -width % across), (0, 0)])
    blocks = padded.reshape(-(-height // down), down, -1, across, channels)
    return blocks.sum(axis=(1, 3), dtype=float)


class _Draws(NamedTuple):
    """Mean error of simulated images, and its scatter.

    - `lost`: mean error, in linear light.
    - `scatter`: covariance of the scores: see [`Problem`][].
    - `tiles`: sums over tiles, for each image: see [`find_misfit`][].
    """

    lost: Float[np.ndarray, "3 samples"]
    scatter: Float[Array, "n n"]
    tiles: list[Drawn]


class _Stage:
    """The fitted images, prepared for simulations of their films."""

    def __init__(
        self,
        first: Problem,
        problem: Problem,
        y: Float[Array, " n"],
        plates: list[_Plate],
    ):
        light, found, gram = _look(problem, y)
        self.first, self.problem, self.y, self.plates = first, problem, y, plates
        self.light, self.jacobian, at = np.asarray(light), found.jacobian, found.at
        self.given_back = np.asarray(first.samples.target - problem.samples.target)
        self.step = np.asarray(first.samples.step)
        weight = np.asarray(problem.samples.weight)
        self.used, self.weight = weight > 0, np.where(weight > 0, weight, 1)
        self.deviation, self.floor = np.asarray(at.deviation), float(at.floor)
        self.residual = np.asarray(at.residual)
        # Derivative of a robust loss's score: near 0 for outliers.
        self.bend = np.asarray(problem.loss.score(at.residual)[1])
        self.gram = np.asarray(gram, float)
        priors = np.asarray(self.jacobian.priors, float)
        self.inverse = np.linalg.pinv(self.gram + priors.T @ priors, hermitian=True)

    def noise(self) -> float:
        """Noise level for which simulated residuals are as large as the measured ones.

        The effect of JPEG on it is simulated, since most of the noise may be rounded
        away.
        """
        inner = self._inner()
        wanted = self._size(self.residual, inner)
        # Fewer draws for many pixels. Not the draws of the correction, whose noise
        # would seem too small.
        count = max(1, min(FEW, 2**17 // self.light.shape[1]))
        seeds = range(FEW + MANY, FEW + MANY + count)

        def excess(variance: float) -> float:
            drawn = self.errors(np.sqrt(variance), seeds)
            left = (one - self.given_back for one in drawn)
            sizes = [self._size(one / self.deviation, inner) for one in left]
            return float(np.mean(sizes)) - wanted

        scale = float(np.mean(self.step[self.used] ** 2)) / 12
        scale = max(float(self.problem.sigma) ** 2, scale)
        return max(float(np.sqrt(_root(excess, scale))), self.floor)

    def _inner(self) -> Bool[np.ndarray, "3 samples"]:
        """Samples whose blocks show only the surface; all if these are too few."""
        inner = np.zeros_like(self.used)
        for plate in self.plates:
            seen, jpeg = plate.used.max(axis=-1, keepdims=True), plate.film.jpeg
            if jpeg is not None:
                seen = plate.all_over(_in_blocks(~seen, *jpeg.block) == 0, jpeg)
            inner[:, plate.columns] = seen.ravel()[plate.place]
        inner &= self.used
        few = np.count_nonzero(inner) <= ENOUGH * np.count_nonzero(self.used)
        return self.used if few else inner

    def _size(self, residual: np.ndarray, which: np.ndarray) -> float:
        """Mean square of a fit's residuals to such errors, in standard deviations."""
        left = self._left(residual)
        if self.problem.loss.robust:
            return float(median_deviation(jnp.asarray(left), jnp.asarray(which))) ** 2
        return float(np.mean(left[which].astype(float) ** 2))

    def _left(self, residual: np.ndarray) -> Float[np.ndarray, "3 samples"]:
        """Residuals of a fit to such errors."""
        taken = jnp.asarray(self.inverse @ self._pull(residual), self.y.dtype)
        return residual - np.asarray(_change(self.jacobian, taken))

    def _pull(self, residual: np.ndarray) -> Float[np.ndarray, " n"]:
        pull = _pull(self.jacobian, jnp.asarray(residual, self.y.dtype))
        return np.asarray(pull, float)

    def errors(
        self, sigma: float, seeds: range
    ) -> Iterator[Float[np.ndarray, "3 samples"]]:
        """Simulated errors of predictions by noise and film; 0 for unused samples.

        Each draw has its own scale and shift of levels.
        """
        kind = self.light.dtype
        there = dataclasses.replace(self.problem, sigma=jnp.asarray(sigma, kind))
        predicted = evaluate(there, self.y).difference + there.samples.target
        predicted, noise = np.asarray(predicted), sigma / np.sqrt(self.weight)
        for seed in seeds:
            rng, errors = np.random.default_rng(seed), np.zeros_like(self.light)
            drawn = rng.standard_normal(self.light.shape, np.float32)
            light = self.light + (noise * drawn).astype(kind)
            levels = [p.levels(light[:, p.columns]) for p in self.plates]
            films = [p.film for p in self.plates]
            another = _another(films, max(float(one.max()) for one in levels), rng)
            for plate, one in zip(self.plates, levels, strict=True):
                shown = _developed(plate, light[:, plate.columns], one, *another)
                errors[:, plate.columns] = shown - predicted[:, plate.columns]
            yield np.where(self.used, errors, 0)

    def corrected(self, sigma: float) -> Problem:
        """The problem, corrected by a few draws with this noise."""
        errors = np.array(list(self.errors(sigma, range(FEW))))
        step = self._wider_steps(errors, sigma)
        return _restored(self.first, errors.mean(axis=0), step, sigma)

    def _wider_steps(
        self, errors: Float[np.ndarray, "draws 3 samples"], sigma: float
    ) -> Float[np.ndarray, "3 samples"]:
        """Rounding steps that match such errors, block by block: largest at edges."""
        beyond = 12 * ((errors**2).mean(axis=0) - sigma**2 / self.weight)
        wider = self.step.copy()
        for plate in self.plates:
            jpeg, step = plate.film.jpeg, plate.picture(self.step)
            if jpeg is None:
                continue
            shares = plate.picture(beyond) / np.where(step > 0, step, 1) ** 2
            mean = _in_blocks(shares, *jpeg.block)
            mean = mean / np.maximum(_in_blocks(plate.used, *jpeg.block), 1)
            factor = plate.all_over(np.sqrt(np.maximum(mean, 1)), jpeg)
            wider[:, plate.columns] *= factor.reshape(-1, 3)[plate.place].T
        return wider

    def draw(self, side: int) -> _Draws:
        """Simulate `MANY` draws at the problem's noise level."""
        total, scores, tiles = np.zeros_like(self.light), [], []
        # Not the draws of the correction, from which the solution was computed.
        for errors in self.errors(float(self.problem.sigma), range(FEW, FEW + MANY)):
            total += errors
            scaled = errors / self.deviation
            scores.append(self._pull(self.bend * scaled))
            left = self._left(scaled)
            tiles.append([_in_blocks(p.picture(left), side, side) for p in self.plates])
        root = np.sqrt(np.diag(self.gram))
        every = np.concatenate([_apart(scores), self._doubts(total / MANY)])
        rows = every / np.where(root > 0, root, 1)
        each = [np.moveaxis(_rows(one), -1, 1) for one in zip(*tiles, strict=True)]
        scatter = jnp.asarray(rows.T @ rows, self.y.dtype)
        return _Draws(total / MANY, scatter, each)

    def _doubts(self, lost: Float[np.ndarray, "3 samples"]) -> Float[np.ndarray, "3 n"]:
        """Scores of the correction itself, which counts as an uncertainty.

        An encoder may round in another way, and the surroundings are estimated. Each
        channel takes the correction of each channel in turn, since it may be small in
        one by chance.

        Half of it is not enough for one photograph of quality 75 whose colour is on a
        coarser grid: intervals of the blue reflectance contain the truth in 72 % of
        draws (`python -m experiments.honesty --only "its film known" --draws 40`).
        The whole makes errors of six photographs 1.6 times too large.
        """
        turns = [np.roll(lost / self.deviation, k, axis=0) for k in range(3)]
        pulls = [self._pull(self.bend * one) for one in turns]
        return np.array(pulls) / np.sqrt(3)


def _apart(draws: Sequence[np.ndarray]) -> Float[np.ndarray, "draws ..."]:
    """Vectors whose outer products add up to the covariance of a draw.

    The uncertainty of their mean, which is estimated from the draws, is included.
    """
    each = np.array(draws, float)
    count = len(each)
    return (each - each.mean(axis=0)) * np.sqrt((1 + 1 / count) / (count - 1))


def _rows(draws: Sequence[np.ndarray]) -> Float[np.ndarray, "draws ..."]:
    """The vectors of [`_apart`][], and the mean as an uncertainty of itself."""
    return np.concatenate([_apart(draws), np.mean(draws, axis=0, keepdims=True)])


@program()
def _look(
    problem: Problem, y: Float[Array, " n"]
) -> tuple[Array, Linearization, Array]:
    r"""Light, its linearization, and $J^\top J$."""
    found = linearize(problem, y)
    return problem.light(y), found, found.jacobian.gram()


# Outside of a program, sums of several images would be compiled again at each draw.
_pull, _change = program()(Jacobian.pull), program()(Jacobian.change)


def _developed(
    plate: _Plate,
    light: Float[np.ndarray, "3 n"],
    levels: Float[np.ndarray, "rows columns 3"],
    share: np.float32,
    shift: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3 n"]:
    """Light on the surface after storage in a file with the plate's film.

    **Arguments:** `levels`: those of the image; `share`, `shift`: see [`_another`][].
    """
    film = plate.film
    if film.jpeg is not None:
        levels = compressed(share * levels + shift, film.jpeg)
        return plate.read((levels - shift) / share)
    shown = np.clip(light, 0, 1) if film.clamp else light
    if film.bits is None:
        return shown
    top = 2**film.bits - 1
    levels = np.round(encode(shown, film.encoding) * top + shift[:, None])
    return decode(np.clip((levels - shift[:, None]) / top, 0, 1), film.encoding)


def _another(
    films: Sequence[Film], brightest: float, rng: np.random.Generator
) -> tuple[np.float32, Float[np.ndarray, "3"]]:
    """A random scale of all levels and shift of red, green and blue.

    No further sample exceeds white.
    """
    known = [film.jpeg for film in films if film.jpeg is not None]
    widest = max([1.0, *(jpeg.widest for jpeg in known)])
    shift = rng.uniform(-widest, widest, 3).astype(np.float32)
    if all(len(jpeg.tables) == 1 for jpeg in known):
        shift[:] = shift[0]
    most = min(1 + BRIGHTER, (255 - widest) / max(brightest, 1.0))
    return np.float32(most - 2 * BRIGHTER * rng.uniform()), shift


def _root(function: Callable[[float], float], scale: float) -> float:
    """Root of an increasing function of a variance; 0 if it is not negative at 0."""
    # Imported here, since SciPy takes long to import and few fits need it.
    from scipy.optimize import root_scalar

    if function(0.0) >= 0:
        return 0.0
    high = scale
    while function(high) <= 0:
        high *= 4
        if high >= scale * 4**GROWN:
            return high
    how = {"xtol": 0.002 * high, "rtol": 0.01}
    return float(root_scalar(function, bracket=(0.0, high), **how).root)
