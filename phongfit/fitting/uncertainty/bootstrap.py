"""Parametric bootstrap: the spread of fits of photographs that a fit predicts."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.edge import shown
from phongfit.fitting.problem.noise import rounding_steps
from phongfit.fitting.problem.posing import FitData, set_up
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.minimum import find_minimum
from phongfit.fitting.solve.search import SearchResult
from phongfit.material import Material
from phongfit.programs import program
from phongfit.rendering.film import Film, decode
from phongfit.rendering.pixels import PixelTerms, resolve_terms
from phongfit.scene import Scene


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Bootstrap:
    """Estimates from simulated photographs, in the order of `labels`.

    **Arguments:**

    - `labels`: the unknowns.
    - `values`: (draws, unknowns), the estimates of the fits that converged.
    - `failed`: number of fits that did not converge, which `values` does not have.
    """

    labels: tuple[str, ...]
    values: np.ndarray
    failed: int

    @property
    def errors(self) -> np.ndarray:
        """Standard deviations of the estimates; NaN for fewer than two of them."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the estimates; NaN for fewer than two of them."""
        count = len(self.labels)
        if len(self.values) < 2:
            return np.full((count, count), np.nan)
        return np.cov(self.values, rowvar=False).reshape(count, count)

    def __str__(self) -> str:
        width = max(map(len, self.labels))
        none = np.full(len(self.labels), np.nan)
        means = self.values.mean(axis=0) if len(self.values) else none
        rows = zip(self.labels, means, self.errors, strict=True)
        return "\n".join(
            [
                f"phongfit: {len(self.values)} simulated fits, {self.failed} failed",
                "",
                *(
                    f"  {one:<{width}}  {mean:10.4g} ± {sd:.2g}"
                    for one, mean, sd in rows
                ),
            ]
        )

    def __repr__(self) -> str:
        return str(self)


def bootstrap(
    solution: SearchResult,
    specification: Specification,
    scenes: Sequence[Scene],
    noise_given: bool,
    n: int,
    key: Any,
) -> Bootstrap:
    """Simulate photographs from a solution, and fit each set.

    **Arguments:**

    - `specification`: with the films of the photographs.
    - `scenes`: with the fitted values.
    - `n`, `key`: see [`Fit`][]`.bootstrap`.
    """
    if n < 2:
        raise ValueError(f"n: expected 2 or more, got {n}")
    try:
        keys = jax.random.split(key, n)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"key: expected a key, such as jax.random.key(0), got {shown(key)}"
        ) from error
    problem, y = solution.problem, solution.y
    data = _data(problem, specification, noise_given)
    entries = problem.unknowns.entries(y)
    material, exposures = problem.material(y), problem.unknowns.exposures(entries)
    lights = []
    for one, exposure in zip(scenes, exposures, strict=True):
        mask, pixels = resolve_terms(one)
        lights.append(_light(pixels, material, exposure, mask, one.background))
    estimates, failed = [], 0
    for one in keys:
        drawn = _draw(data, lights, entries, float(problem.sigma), one)
        found = find_minimum(drawn).found
        if bool(found.converged):
            values = found.problem.unknowns.entries(found.y)
            estimates.append(np.asarray(values, float)[drawn.unknowns.reported])
        else:
            failed += 1
    labels = data.unknowns.labels
    return Bootstrap(labels, np.reshape(estimates, (-1, len(labels))), failed)


def _data(problem: Problem, specification: Specification, noise_given: bool) -> FitData:
    """The data of a fit with its first scenes and weights, and grey photographs.

    Entries count from the first scenes, as the angles of a rotation do.
    """
    scenes = tuple(view.scene for view in problem.samples.views)
    kind = problem.samples.target.dtype
    grey = [np.full((s.camera.height, s.camera.width, 3), 0.5, kind) for s in scenes]
    # The weights of a fit with a given noise level are inverse variances.
    noise = 1.0 if noise_given else None
    data = set_up(specification, scenes, grey, noise=noise)
    sources = [
        dataclasses.replace(source, weight=jnp.asarray(weight))
        for source, weight in zip(data.sources, _weights(problem), strict=True)
    ]
    return dataclasses.replace(data, sources=sources)


def _weights(problem: Problem) -> list[np.ndarray]:
    """The weights of a problem's samples, as (height, width, 3) for each image."""
    views = problem.samples.views
    images = []
    parts = np.split(np.asarray(problem.samples.weight), len(views), axis=1)
    for view, part in zip(views, parts, strict=True):
        camera = view.scene.camera
        weight = np.zeros((camera.height * camera.width, 3), part.dtype)
        # In reverse, since padding repeats the first pixel with weight 0.
        weight[np.asarray(view.index)[::-1]] = part.T[::-1]
        images.append(weight.reshape(camera.height, camera.width, 3))
    return images


@program()
def _light(
    pixels: PixelTerms,
    material: Material,
    exposure: Float[Array, ""],
    mask: Bool[Array, "height width"],
    background: Float[Array, "3"],
) -> Float[Array, "height width 3"]:
    """Linear light of an image without noise, before the film."""
    light = pixels.radiance(material) * exposure
    return jnp.where(mask[..., None], light, background)


def _draw(
    data: FitData,
    lights: Sequence[Array],
    entries: Float[Array, " entries"],
    sigma: float,
    key: Array,
) -> FitData:
    """The data of a fit with simulated photographs and means of the priors."""
    first, *others = jax.random.split(key, 1 + len(lights))
    rounded = data.sources[0].step is not None
    sources = []
    for source, light, film, one in zip(
        data.sources, lights, data.films, others, strict=True
    ):
        image = _photograph(light, source.weight, sigma, film, one)
        step = rounding_steps(np.asarray(image), film) if rounded else None
        sources.append(dataclasses.replace(source, image=image, step=step))
    unknowns = _with_drawn_priors(data.unknowns, entries, first)
    return dataclasses.replace(data, sources=sources, unknowns=unknowns)


@program()
def _photograph(
    light: Float[Array, "height width 3"],
    weight: Float[Array, "height width channels"],
    sigma: Any,
    film: Film,
    key: Array,
) -> Float[Array, "height width 3"]:
    """An image with noise, as read from its file; unused samples have typical noise."""
    weight = jnp.broadcast_to(weight, light.shape)
    typical = jnp.nanmedian(jnp.where(weight > 0, weight, jnp.nan))
    # An image without any used sample has none.
    typical = jnp.where(jnp.isnan(typical), 1, typical)
    deviation = sigma / jnp.sqrt(jnp.where(weight > 0, weight, typical))
    noisy = light + deviation * jax.random.normal(key, light.shape, light.dtype)
    return decode(film.expose(noisy), film.encoding)


def _with_drawn_priors(
    unknowns: Unknowns, entries: Float[Array, " entries"], key: Array
) -> Unknowns:
    """Unknowns whose priors are drawn around the entries: each is a measurement."""
    wanted = np.flatnonzero(unknowns.has_prior)
    if not len(wanted):
        return unknowns
    spread = jnp.linalg.pinv(unknowns.prior_root)
    off = spread @ jax.random.normal(key, (len(spread.T),), entries.dtype)
    mean = unknowns.prior_mean.at[wanted].set(entries[wanted] + off)
    return eqx.tree_at(lambda u: u.prior_mean, unknowns, mean)
