r"""What a JPEG file took from its image, as far as the fitted image tells.

Its errors are no noise. A coefficient that rounds to 0 takes its signal with it, at
each edge and each highlight alike; colour on a coarser grid bleeds over silhouettes;
and all pixels of a block share the rounding of its coefficients, all blocks of one
colour that of their mean. So the fitted image, with noise, is drawn through the file's
own steps some dozen times. The mean of what it loses is given back to the photograph,
which is fitted again; how the draws scatter says what the errors are.

Each draw is a little darker than the fitted image, and shifted by a few levels: where a
large number lies between two steps is chance, but a small one rounds to 0 all the same.

??? cite "Source"
    Widrow and Kollár, *Quantization noise*, 2008, chapters 4 and 19; Gouriéroux,
    Monfort and Renault, *Indirect inference*, J. Appl. Econometrics 8(S1), 1993.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.diagnostics import (
    Expected,
    all_neighbours,
    compare_neighbours,
    correlation_of,
)
from phongfit.fitting.noise import median_deviation
from phongfit.fitting.problem import Problem, evaluate
from phongfit.fitting.samples import Source
from phongfit.fitting.search import Found
from phongfit.fitting.solution import solve
from phongfit.fitting.sums import linearize
from phongfit.rendering.film import Film, decode, encode
from phongfit.rendering.jpeg import JpegCompression, compressed

# Draws while the fit still moves, and at its end: a standard error of 32 draws is
# known to 12 %.
FEW, MANY = 8, 32
# An encoder may round otherwise than is assumed, and what surrounds the surface is
# estimated: so much of what is given back counts as an error.
DOUBT = 0.25
# Draws are up to so much darker than the fitted image.
DARKER = 0.1
# Pixels around the surface that are averaged for what lies there.
AROUND = 4
# Share of the samples that lie in such blocks, from which on these tell the noise.
ENOUGH = 0.1
# How often the search for the noise quadruples a variance that is too small.
GROWN = 6


class Restored(NamedTuple):
    """A fit of photographs that have been given back what JPEG took.

    - `found`: the solution, and its problem.
    - `lost`: of each image what was given back, (H, W, 3), linear light.
    - `expected`: how neighbours' residuals correlate where the model is right.
    """

    found: Found
    lost: list[Float[np.ndarray, "height width 3"]]
    expected: Expected


def restore(
    found: Found,
    sources: list[Source],
    films: tuple[Film, ...],
    noise_given: bool,
    max_steps: int,
) -> Restored:
    """Fit again, what the files took from their images given back.

    **Arguments:**

    - `found`: a fit of the images as they are.
    - `sources`, `films`: the images; those that are no JPEG take part too.
    """
    problem, y, steps = found.problem, found.y, found.steps
    measured, step = problem.samples.target, problem.samples.step
    plates = _plates(problem, sources, films)
    converged, stage, draws = found.converged, None, None
    coarser = np.ones(measured.shape, np.asarray(measured).dtype)
    for count in (FEW, FEW, MANY):
        given_back = measured - problem.samples.target
        stage = _Stage(problem, y, plates, given_back, coarser)
        sigma = problem.sigma if noise_given else stage.noise()
        draws = stage.draw(sigma, count)
        kind = measured.dtype
        problem = eqx.tree_at(
            lambda p: (p.samples.target, p.samples.step, p.sigma),
            problem,
            (
                measured - jnp.asarray(draws.mean, kind),
                step * jnp.asarray(draws.coarser, kind),
                jnp.asarray(sigma, kind),
            ),
        )
        coarser = draws.coarser
        solution = solve(problem, y, max_steps)
        y, steps, converged = solution.y, steps + solution.steps, solution.converged
    scatter = stage.scatter(draws)
    problem = dataclasses.replace(problem, scatter=jnp.asarray(scatter, y.dtype))
    lost = [plate.picture(draws.mean) for plate in plates]
    return Restored(Found(problem, y, converged, steps), lost, draws.expected)


class _Plate(NamedTuple):
    """An image as its film makes it.

    - `around`: its light, (pixels, 3), where `place` is not: what lies about the
        surface.
    - `place`, `columns`: the pixels that the fit uses, counted row by row, and where
        they stand among the samples.
    - `used`: true for the samples that count, (height, width, 3).
    """

    film: Film
    around: Float[np.ndarray, "pixels 3"]
    place: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    used: Bool[np.ndarray, "height width 3"]

    def picture(self, samples: np.ndarray) -> Float[np.ndarray, "height width 3"]:
        """Numbers of the samples, where they lie in the image; 0 elsewhere."""
        picture = np.zeros(self.around.shape, samples.dtype)
        picture[self.place] = samples[:, self.columns].T
        return np.where(self.used, picture.reshape(self.used.shape), 0)

    def lit(self, light: np.ndarray) -> Float[np.ndarray, "height width 3"]:
        """Encoded levels 0 … 255 of the image with this light on the surface."""
        canvas = self.around.copy()
        canvas[self.place] = light.T
        shown = np.clip(canvas, 0, 1).reshape(self.used.shape)
        return encode(shown, self.film.encoding) * 255


def _plates(
    problem: Problem, sources: list[Source], films: tuple[Film, ...]
) -> list[_Plate]:
    plates, weight = [], np.asarray(problem.samples.weight)
    views, size = problem.samples.views, problem.samples.image.size // len(sources)
    for k, (view, source, film) in enumerate(zip(views, sources, films, strict=True)):
        columns = size * k + np.flatnonzero(
            (weight[:, size * k : size * (k + 1)] > 0).any(axis=0)
        )
        place = np.asarray(view.index)[columns - size * k]
        image = np.asarray(source.image, np.float32)
        used = np.broadcast_to(np.asarray(source.weight) > 0, image.shape)
        around = _surroundings(image, used.any(axis=-1))
        plates.append(_Plate(film, around.reshape(-1, 3), place, columns, used))
    return plates


def _surroundings(
    image: Float[np.ndarray, "height width 3"], used: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """What lies around the pixels that are used, the codec's ripples smoothed away.

    Ripples are what is left of an edge whose high frequencies the file lacks; to keep
    them would be to believe that it never had any.
    """
    outside = ~used[..., None]
    share = _blurred(outside.astype(image.dtype))
    mean = _blurred(np.where(outside, image, 0)) / np.maximum(share, 1e-6)
    near = outside & (_blurred(used[..., None].astype(image.dtype)) > 1e-6)
    return np.where(near, mean, image)


def _blurred(image: np.ndarray) -> np.ndarray:
    """Means over a window, which falls off linearly from its middle."""
    ramp = np.arange(1, AROUND + 1, dtype=image.dtype)
    window = np.concatenate([ramp, [AROUND + 1], ramp[::-1]]) / (AROUND + 1) ** 2
    for axis in (0, 1):
        wide = np.moveaxis(image, axis, 0)
        ends = np.pad(wide, [(AROUND, AROUND), (0, 0), (0, 0)])
        rows = (w * ends[k : k + len(wide)] for k, w in enumerate(window))
        image = np.moveaxis(sum(rows), 0, axis)
    return image


def _inner(
    used: Bool[np.ndarray, "3 samples"], plates: list[_Plate]
) -> Bool[np.ndarray, "3 samples"]:
    """Samples whose blocks show the surface alone; all, where these are few."""
    inner = np.zeros_like(used)
    for plate in plates:
        seen = plate.used.any(axis=-1)
        if plate.film.jpeg is not None:
            seen = _whole_blocks(seen, *plate.film.jpeg.block)
        inner[:, plate.columns] = seen.ravel()[plate.place]
    inner &= used
    return inner if np.count_nonzero(inner) > ENOUGH * np.count_nonzero(used) else used


def _whole_blocks(
    seen: Bool[np.ndarray, "height width"], down: int, across: int
) -> Bool[np.ndarray, "height width"]:
    height, width = seen.shape
    padding = (0, -height % down), (0, -width % across)
    blocks = np.pad(seen, padding).reshape(-(-height // down), down, -1, across)
    whole = blocks.all(axis=(1, 3))
    return whole.repeat(down, axis=0).repeat(across, axis=1)[:height, :width]


def _block_means(
    picture: Float[np.ndarray, "height width 3"],
    used: Bool[np.ndarray, "height width 3"],
    jpeg: JpegCompression,
) -> Float[np.ndarray, "height width 3"]:
    """At each pixel the mean over what is used of its block."""
    (height, width, _), (down, across) = picture.shape, jpeg.block
    padding = (0, -height % down), (0, -width % across), (0, 0)

    def sums(values: np.ndarray) -> np.ndarray:
        blocks = np.pad(values, padding)
        blocks = blocks.reshape(-(-height // down), down, -1, across, 3)
        return blocks.sum(axis=(1, 3), dtype=float)

    mean = sums(np.where(used, picture, 0)) / np.maximum(sums(used), 1)
    return mean.repeat(down, axis=0).repeat(across, axis=1)[:height, :width]


class _Draws(NamedTuple):
    """Errors in linear light of images drawn through their films.

    - `mean`: of each sample.
    - `scores`: of each draw the sum of the errors' scores, (draws, n).
    - `coarser`: how many times as wide as the levels a rounding with such errors is.
    """

    mean: Float[np.ndarray, "3 samples"]
    scores: Float[np.ndarray, "draws n"]
    coarser: Float[np.ndarray, "3 samples"]
    expected: Expected


class _Stage:
    """The fitted images, ready to be drawn through their films."""

    def __init__(
        self,
        problem: Problem,
        y: Float[Array, " n"],
        plates: list[_Plate],
        given_back: Float[Array, "3 samples"],
        coarser: Float[np.ndarray, "3 samples"],
    ):
        light, (self.jacobian, at) = _look(problem, y)
        self.problem, self.y, self.plates = problem, y, plates
        self.light, self.given_back = np.asarray(light), np.asarray(given_back)
        self.used = np.asarray(problem.samples.weight) > 0
        self.inner = _inner(self.used, plates)
        self.coarser = coarser
        self.deviation = np.asarray(at.deviation)
        self.floor = float(at.floor)
        self.left = np.asarray(at.residual)
        # How much an outlier's error still moves the solution.
        self.bend = np.asarray(problem.loss.score(at.residual)[1])
        self.gram = np.asarray(self.jacobian.gram(), float)

    def noise(self) -> float:
        """The sensor's noise, with which as much is left over as was.

        What JPEG makes of it is found by drawing: most of it may be rounded away.
        """
        wanted = self._left(self.left)
        # About as many samples for few pixels as for many.
        seeds = range(max(1, min(FEW, 2**17 // self.light.shape[1])))

        def excess(variance: float) -> float:
            sigma = np.sqrt(variance)
            mean = self._mean(sigma)
            errors = (self._errors(sigma, mean, seed) for seed in seeds)
            left = [
                self._left((error - self.given_back) / self.deviation)
                for error in errors
            ]
            return float(np.mean(left)) - wanted

        step = np.asarray(self.problem.samples.step)[self.used]
        scale = max(float(self.problem.sigma) ** 2, float(np.mean(step**2)) / 12)
        return max(float(np.sqrt(_root(excess, scale))), self.floor)

    def _left(self, residual: Float[np.ndarray, "3 samples"]) -> float:
        """Mean square of what a fit leaves of such errors, in standard deviations."""
        taken = np.linalg.pinv(self.gram, hermitian=True) @ self._pull(residual)
        kind = residual.dtype
        left = residual - np.asarray(self.jacobian.push(jnp.asarray(taken, kind)))
        if self.problem.loss.robust:
            return float(median_deviation(jnp.asarray(left), self.inner)) ** 2
        return float(np.mean(left[self.inner].astype(float) ** 2))

    def _pull(self, residual: Float[np.ndarray, "3 samples"]) -> np.ndarray:
        kind = self.y.dtype
        return np.asarray(self.jacobian.pull(jnp.asarray(residual, kind)), float)

    def _mean(self, sigma: float) -> Float[np.ndarray, "3 samples"]:
        """What the fit predicts for a noise."""
        kind = self.y.dtype
        there = dataclasses.replace(self.problem, sigma=jnp.asarray(sigma, kind))
        return np.asarray(evaluate(there, self.y).difference + there.samples.target)

    def _errors(
        self, sigma: float, mean: np.ndarray, seed: int
    ) -> Float[np.ndarray, "3 samples"]:
        """What noise and films add to the mean in one draw; 0 where nothing is used."""
        rng = np.random.default_rng(seed)
        weight = np.asarray(self.problem.samples.weight)
        noise = sigma / np.sqrt(np.where(weight > 0, weight, 1))
        errors = np.zeros_like(self.light)
        for plate in self.plates:
            light = self.light[:, plate.columns]
            drawn = rng.standard_normal(light.shape, np.float32)
            light = light + noise[:, plate.columns].astype(light.dtype) * drawn
            shown = _developed(plate, light, rng)
            errors[:, plate.columns] = shown - mean[:, plate.columns]
        return np.where(self.used, errors, 0)

    def draw(self, sigma: float, count: int) -> _Draws:
        """So many draws, no two of the same roundings."""
        mean, total, squares = self._mean(sigma), 0, 0
        scores, correlations = [], []
        for seed in range(1000, 1000 + count):
            errors = self._errors(sigma, mean, seed)
            total, squares = total + errors, squares + errors**2
            scores.append(self._pull(self.bend * errors / self.deviation))
            left = errors - self.given_back
            pairs = [compare_neighbours(p.picture(left), p.used) for p in self.plates]
            correlations.append(correlation_of(all_neighbours(pairs)))
        return _Draws(
            total / count,
            np.array(scores),
            self._coarser(squares / count, sigma),
            Expected(float(np.mean(correlations)), float(np.std(correlations))),
        )

    def _coarser(
        self, squares: Float[np.ndarray, "3 samples"], sigma: float
    ) -> Float[np.ndarray, "3 samples"]:
        """How many times as wide as a level, block by block: edges are worst."""
        weight = np.where(self.used, np.asarray(self.problem.samples.weight), 1)
        step = np.asarray(self.problem.samples.step) / self.coarser
        step = np.where(step > 0, step, 1)
        beyond = (squares - sigma**2 / weight) * 12 / step**2
        factor = np.ones_like(self.light)
        for plate in self.plates:
            if plate.film.jpeg is not None:
                mean = _block_means(plate.picture(beyond), plate.used, plate.film.jpeg)
                mean = mean.reshape(-1, 3)[plate.place].T
                factor[:, plate.columns] = np.sqrt(np.maximum(mean, 1))
        return factor

    def scatter(self, draws: _Draws) -> Float[np.ndarray, "n n"]:
        """Covariance of the scores, over the roots of the diagonal of JᵀJ."""
        lost = draws.scores.mean(axis=0)
        apart = draws.scores - lost
        count = len(apart)
        # The mean is known no better than from so many draws.
        covariance = apart.T @ apart / (count - 1) * (1 + 1 / count)
        covariance += DOUBT**2 * np.outer(lost, lost)
        root = np.sqrt(np.diag(self.gram))
        root = np.where(root > 0, root, 1)
        return covariance / np.outer(root, root)


@eqx.filter_jit
def _look(problem: Problem, y: Float[Array, " n"]) -> tuple[Array, tuple[Any, Any]]:
    found = linearize(problem, y)
    return problem.light(y), (found.jacobian, found.at)


def _developed(
    plate: _Plate,
    light: Float[np.ndarray, "3 n"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "3 n"]:
    """Light on the surface as it is read from the file; its roundings are drawn."""
    film = plate.film
    if film.jpeg is None:
        shown = np.clip(light, 0, 1) if film.clamp else light
        if film.bits is None:
            return shown
        top = 2**film.bits - 1
        offset = rng.uniform(-0.5, 0.5, (3, 1)).astype(light.dtype)
        levels = np.round(encode(shown, film.encoding) * top + offset) - offset
        return decode(np.clip(levels / top, 0, 1), film.encoding)
    share, shift = _another(film.jpeg, rng)
    levels = compressed(share * plate.lit(light) + shift, film.jpeg)
    read = decode(np.clip((levels - shift) / share / 255, 0, 1), film.encoding)
    return read.reshape(-1, 3)[plate.place].T


def _another(
    jpeg: JpegCompression, rng: np.random.Generator
) -> tuple[np.float32, Float[np.ndarray, " 3"]]:
    """What levels are multiplied by, and what is added to red, green and blue.

    They stay between 0 and 255, so that no more is cut off than was.
    """
    # Twice as wide as the coarsest rounding of a block's mean.
    widest = 2 * max(1.0, *(table[0][0] / 8 for table in jpeg.tables))
    shift = rng.uniform(0, widest, 3).astype(np.float32)
    if len(jpeg.tables) == 1:
        shift[:] = shift[0]
    return np.float32(1 - widest / 255 - DARKER * rng.uniform()), shift


def _root(function: Any, scale: float) -> float:
    """Where a rising function of a variance is 0; 0 if it is never below."""
    low, high = 0.0, scale
    below, above = function(low), function(high)
    if below >= 0:
        return 0.0
    for _ in range(GROWN):
        if above > 0:
            break
        low, below, high = high, above, 4 * high
        above = function(high)
    if above <= 0:
        return high
    for _ in range(3):
        # Nearly a line, so that its crossing is soon found.
        middle = low - below * (high - low) / (above - below)
        there = function(middle)
        if there < 0:
            low, below = middle, there
        else:
            high, above = middle, there
    return low - below * (high - low) / (above - below)
