"""Estimates of an object's materials from a sample of its pixels."""

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from phongfit.maps.materials.bases import Bases, size_of
from phongfit.maps.materials.grouping import Table, group
from phongfit.maps.materials.looks import Alone, fit_alone, fit_row, look_at
from phongfit.maps.materials.mixture import Mixture, Told, maximize
from phongfit.maps.pixel.samples import Outside, Tile
from phongfit.maps.pixel.scale import most_by_chance
from phongfit.maps.pixel.settings import MOST_MATERIALS, MapSettings, Point
from phongfit.maps.result import BasisMaterials

# Number of pixels of a sample times number of images, and limits of the former.
LIGHT = 2**17
FEWEST, MOST = 1024, 4096
# Number of exponents in the table of costs, and the lowest, unless it is out of bounds.
EXPONENTS, BROADEST = 14, 1.5
PATIENCE = 2
"""Number of materials beyond the best number that are tried before the search ends."""


class Materials(NamedTuple):
    """The materials of an object.

    - `bases`: empty if matte light alone explains the sample best.
    - `criterion`: BIC of 1, 2, … materials.
    - `sample`: number of pixels in the sample.
    """

    bases: Bases
    criterion: Float[np.ndarray, " tried"]
    sample: int

    def basis(
        self, settings: MapSettings, weights: Float[np.ndarray, "height width k"]
    ) -> BasisMaterials:
        """The materials of maps, with the probability of each in each pixel."""
        values = np.asarray(self.bases.values, float)
        variances = np.diagonal(np.asarray(self.bases.covariance, float), 0, 1, 2)
        errors, shape = np.sqrt(variances), (len(values), 3)
        shininess = np.exp(values[:, 0])
        gap = np.abs(values[:, :1] - np.array(settings.log_bounds)).min(axis=1)
        return BasisMaterials(
            specular=np.broadcast_to(values[:, 1:], shape).copy(),
            shininess=shininess,
            stderr_specular=np.broadcast_to(errors[:, 1:], shape).copy(),
            stderr_shininess=shininess * errors[:, 0],
            at_bound=gap < 1e-5,
            weights=weights,
            criterion=self.criterion,
            sample=self.sample,
        )


def choose_sample(pixels: Int[np.ndarray, " n"], images: int) -> np.ndarray:
    """Random pixels from all over the object, reproducible for equal arguments."""
    wanted = int(np.clip(LIGHT // images, FEWEST, MOST))
    if len(pixels) <= wanted:
        return pixels
    chosen = np.random.default_rng(0).choice(len(pixels), wanted, replace=False)
    return pixels[np.sort(chosen)]


def find_materials(
    blocks: Sequence[Tile],
    pixels: int,
    outside: Outside,
    settings: MapSettings,
    workers: Executor,
) -> Materials:
    """Estimate the materials of a sample: their number, exponents and ρ_s.

    **Arguments:**

    - `blocks`: the sample; `pixels`: their number without padding.
    - `workers`: threads that work on blocks in parallel.

    **Raises:** `ValueError` if no pixel of the sample can be used.
    """
    # Each pixel of the sample has a separate highlight at first.
    apart = dataclasses.replace(settings, materials=None)
    sample = _Sample(blocks, pixels, outside, apart, workers)
    table = sample.table()
    wanted = settings.materials
    most = MOST_MATERIALS if wanted == "auto" else int(wanted or 1)
    highest = settings.bound("specular")[1]
    found: list[Mixture] = []
    for count in range(1, most + 1):
        groups = group(table, count, highest)
        values = np.full((count, size_of(settings)), 0.0)
        values[:, 0] = table.log_exponents[groups.exponent]
        values[:, 1:] = groups.strength[:, None]
        found.append(sample.maximize(values, groups.exponent))
        best = int(np.argmin([one.criterion for one in found]))
        if wanted == "auto" and count > best + PATIENCE:
            break
    criterion = np.array([one.criterion for one in found])
    best = found[int(criterion.argmin()) if wanted == "auto" else most - 1]
    order = np.argsort(-best.shares, kind="stable")
    if wanted == "auto" and sample.matte() <= criterion.min():
        order = order[:0]
    dtype = outside.noise.dtype
    bases = (best.values[order], best.covariance[order], best.shares[order])
    return Materials(
        Bases(*(jnp.asarray(part, dtype) for part in (*bases, sample.noise))),
        criterion,
        sample.pixels,
    )


class _Sample:
    """Blocks of sampled pixels, and their fitted points under each exponent."""

    def __init__(
        self,
        blocks: Sequence[Tile],
        pixels: int,
        outside: Outside,
        settings: MapSettings,
        workers: Executor,
    ):
        self._settings, self._known = settings, outside.known
        self._workers = workers

        def fit(part: Tile) -> Alone:
            return fit_alone(part, outside, settings)

        self._blocks = list(workers.map(fit, blocks))
        sound = np.concatenate([np.asarray(block.sound) for block in self._blocks])
        sound &= np.arange(len(sound)) < pixels
        if not sound.any():
            raise ValueError(
                "materials: expected pixels with more samples than unknowns, got none"
            )
        self._sound = sound
        self.pixels = int(sound.sum())
        level = np.concatenate([np.asarray(block.level) for block in self._blocks])
        count = np.concatenate([np.asarray(block.used) for block in self._blocks])
        given = settings.noise_given
        self.noise = float(outside.noise if given else np.median(level[sound]))
        # Exact data have no residuals, but the noise must be positive.
        bright = np.median(
            [float(jnp.max(abs(b.samples.target))) for b in self._blocks]
        )
        self.noise = max(self.noise, 1e-6 * bright)
        freedom = np.maximum(count - settings.unknowns(), 1)
        worse = (level / self.noise) ** 2
        # Pixels with lack of fit even under a separate material get less weight.
        wrong = worse > np.asarray(most_by_chance(jnp.asarray(freedom)))
        scale = self.noise * np.where(wrong, np.sqrt(worse), 1)
        self._scales = np.split(scale.astype(level.dtype), len(self._blocks))
        self._rows: list[list[Point]] = []

    def _fit(
        self, program: Callable[..., Any], starts: list[Point], *args: Any
    ) -> tuple[list[Point], Any]:
        """Fit all blocks in parallel.

        **Returns:** the points of each block, and the result with its other arrays
        joined, pixels first, without unusable pixels.
        """

        def one(number: int) -> Any:
            block, scale = self._blocks[number], self._scales[number]
            start, settings = starts[number], self._settings
            return program(block.samples, start, scale, *args, settings=settings)

        def joined(*parts: Any) -> np.ndarray:
            whole = np.concatenate([np.asarray(p, float) for p in parts], axis=-1)
            return np.moveaxis(whole[..., self._sound], -1, 0)

        found = list(self._workers.map(one, range(len(self._blocks))))
        points = [block.point for block in found]
        rest = [block._replace(point=None) for block in found]
        return points, jax.tree.map(joined, *rest)

    def table(self) -> Table:
        """Costs of all pixels at a series of exponents."""
        low, high = self._settings.log_bounds
        first = max(low, min(np.log(BROADEST), high))
        exponents = np.linspace(first, high, EXPONENTS if high > first else 1)
        alone = [block.point for block in self._blocks]
        dtype = self._blocks[0].level.dtype
        fits = [self._fit(fit_row, alone, jnp.asarray(t, dtype)) for t in exponents]
        self._rows = [points for points, _ in fits]
        names = ("cost", "strength", "curvature")
        arrays = (np.stack([getattr(row, name) for _, row in fits]) for name in names)
        return Table(exponents, *arrays)

    def maximize(self, values: np.ndarray, rows: np.ndarray) -> Mixture:
        """The best materials from start values, which are near rows of the table."""
        look = self._look([list(self._rows[row]) for row in rows])
        settings = self._settings
        low, high = settings.bound("specular")
        bottom, top = settings.log_bounds
        strengths = size_of(settings) - 1
        edges = (
            np.array([bottom] + [low] * strengths),
            np.array([top] + [high] * strengths),
        )
        return maximize(values.clip(*edges), look, edges)

    def _look(self, starts: list[list[Point]]) -> Callable[[int, np.ndarray], Told]:
        """A function that fits the pixels under a material, starting from the last fit.

        **Arguments:** `starts`: start points for each material and block.
        """

        dtype = self._blocks[0].level.dtype

        def look(material: int, values: np.ndarray) -> Told:
            given = jnp.asarray(values, dtype), self._known
            starts[material], seen = self._fit(look_at, starts[material], *given)
            steepness = max(float(seen.steepness.sum() / seen.kept.sum()), 0.1)
            return Told(seen.cost, seen.log_det, seen.pull, seen.curvature, steepness)

        return look

    def matte(self) -> float:
        """BIC of a fit without highlights."""
        values = np.zeros((1, size_of(self._settings)))
        nothing = np.zeros(values.shape[1])
        look = self._look([list(self._rows[0])])
        return maximize(values, look, (nothing, nothing), free=0).criterion
