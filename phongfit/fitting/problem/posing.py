"""Make a problem from a specification and data."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, Unpack

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from phongfit.checks import untraced
from phongfit.edge import checked
from phongfit.fitting.problem.inputs import (
    Observation,
    as_photographs,
    as_scenes,
    is_number,
)
from phongfit.fitting.problem.layout import make_unknowns
from phongfit.fitting.problem.noise import find_film, rounding_steps
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.samples import Source, gather, seen_pixels
from phongfit.fitting.problem.shapes import check_shape
from phongfit.fitting.problem.specification import (
    Specification,
    SpecificationOptions,
    specified,
)
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.geometry.surfaces import GBuffer
from phongfit.rendering.film import Film, as_films
from phongfit.rendering.pixels import PixelTerms, resolve, resolve_terms
from phongfit.scene import Scene

# Largest side of a tile in pixels, and most tiles with smaller sides.
LARGEST, MOST_TILES = 8, 1024


@checked
def make_problem(
    scene: Scene | Sequence[Scene],
    image: Any,
    noise: Any,
    specification: Specification | None = None,
    *,
    mask: Any = None,
    weights: Any = None,
    **options: Unpack[SpecificationOptions],
) -> Problem:
    """The problem that [`fit`][] solves, for your own samplers and solvers.

    A [`Problem`][] is a function of a vector of unknowns: `residual(y)`,
    `log_likelihood(y)`, `log_prior(y)` and `material(y)` are pure, and go through
    `jax.jit`, `jax.vmap` and `jax.grad`. `unknowns` describes the vector: `y_labels`,
    `start`, `lower` and `upper`. An exponent is represented by its logarithm: the
    number called `log_shininess` is $\\log f$. Arrays that are `uncertain` are unknowns
    too, each with its prior.

    **Arguments:**

    - `scene`, `image`, `mask`, `weights`: as for [`fit`][].
    - `noise`: standard deviation in linear light, a number or as `weights`.
    - `specification`, and options beside it: as for [`fit`][].

    **Raises:** `ValueError` that names the argument; `TypeError` for an unknown option.
    """
    if noise is None:
        raise ValueError("noise: expected a standard deviation, got None")
    instead = "make the problem outside of what JAX traces; its functions can be traced"
    data = {"mask": mask, "weights": weights, "noise": noise}
    untraced(instead, scene=scene, image=image, **data)
    specification = specified(specification, options, instead)
    return set_up(specification, scene, image, **data).problem()


@dataclasses.dataclass(frozen=True)
class FitData:
    """The question of a fit, checked: options, unknowns, images with their geometry.

    - `photographs`: copies of the images as they were given.
    - `single`: whether one image was given, not a sequence.
    - `noise_given`: whether the noise level was given.
    - `arrays`: names of the arguments that were given as arrays.
    """

    specification: Specification
    unknowns: Unknowns
    sources: list[Source]
    films: tuple[Film, ...]
    photographs: tuple[np.ndarray, ...]
    single: bool
    noise_given: bool
    arrays: tuple[str, ...]

    def problem(self) -> Problem:
        """The problem of all used pixels, at a noise level of 1."""
        samples = gather(self.sources, seen_pixels(self.sources))
        return Problem(
            samples,
            self.unknowns,
            jnp.ones((), samples.target.dtype),
            self.specification.loss,
            self.films[0].clamp,
            tolerance=self.specification.tolerance,
        )

    @property
    def side(self) -> int:
        """Pixels along the side of a tile: see [`tile_side`][]."""
        return max(tile_side(*source.mask.shape) for source in self.sources)


def tile_side(height: int, width: int) -> int:
    """Pixels along the side of a tile: a power of two, smaller for small images."""
    side = 1
    while side < LARGEST and -(-height // side) * -(-width // side) > MOST_TILES:
        side *= 2
    return side


def set_up(
    specification: Specification,
    scene: Scene | Sequence[Scene],
    image: Any,
    *,
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
) -> FitData:
    """Check the options and the data of a fit.

    **Raises:** `ValueError` that names the argument.
    """
    scenes = as_scenes(scene)
    check_shape(specification.unknowns, scenes[0].specular_model)
    dtype, materials = jnp.result_type(float), scenes[0].surface.materials
    if len(scenes) == 1 and specification.asks_as_usual:
        layout = _default_unknowns(dtype, materials)
    else:
        layout = make_unknowns(specification, materials, scenes)
    # Shadows move with the lights.
    shadows = any(scene.shadows for scene in scenes)
    moving = layout.moves_geometry or (shadows and layout.moves_lights)
    # Dispatched here: JAX computes it while the images are checked.
    seen = [_geometry(one, layout.relights and not moving) for one in scenes]
    single = isinstance(scene, Scene)
    scene = scene if single else scenes
    photographs = as_photographs(scene, image, mask, weights, noise)
    films = find_films(specification.film, photographs)
    if specification.film is not None:
        for pair in zip(films, photographs, strict=True):
            _check_range(*pair)
    rounded = any(film.bits is not None for film in films)
    sources = [
        as_source(*one, rounded) for one in zip(photographs, seen, films, strict=True)
    ]
    _check_samples(sources, layout)
    _check_constants(layout, sources)
    given = {"mask": mask, "weights": weights, "noise": noise}
    return FitData(
        specification=specification,
        unknowns=layout,
        sources=sources,
        films=films,
        photographs=tuple(
            np.array(one, jnp.result_type(float))
            for one in ([image] if single else image)
        ),
        single=single,
        noise_given=noise is not None,
        arrays=tuple(name for name, value in given.items() if not is_number(value)),
    )


@functools.cache
def _default_unknowns(dtype: Any, materials: int) -> Unknowns:
    """Cached unknowns of one image with default options; they are slow to make."""
    del dtype  # that of their numbers
    return make_unknowns(Specification(), materials)


class _Geometry(NamedTuple):
    mask: Array
    pixels: PixelTerms
    gbuffer: GBuffer | None


def _geometry(scene: Scene, keep: bool) -> _Geometry:
    """Geometry of the pixels; with `keep` also the buffer, for changed lights."""
    if not keep:
        return _Geometry(*resolve_terms(scene), None)
    gbuffer, pixels = resolve(scene)
    return _Geometry(gbuffer.mask, pixels, gbuffer)


def as_source(
    photograph: Observation, seen: _Geometry, film: Film, rounded: bool
) -> Source:
    """A photograph with its geometry; pixels that see no surface have weight 0.

    **Arguments:** `rounded`: whether any of the photographs was rounded.
    """
    mask, weight = np.asarray(seen.mask)[..., None], photograph.weight
    weight = np.where(mask, weight, np.zeros_like(weight))
    return Source(
        photograph.scene,
        *seen,
        # A copy, since the caller may change the array.
        jnp.array(_as_shown(photograph.image, film)),
        jnp.asarray(weight),
        rounding_steps(photograph.image, film) if rounded else None,
    )


def _as_shown(image: np.ndarray, film: Film) -> np.ndarray:
    """An image clipped at black too, if its film clamps."""
    return np.maximum(image, 0) if film.clamp and image.min() < 0 else image


def find_films(
    film: Film | Sequence[Film] | None, photographs: Sequence[Observation]
) -> tuple[Film, ...]:
    """A film for each photograph: the given ones, or one that is detected for all.

    **Raises:** `ValueError` that names the argument.
    """
    if film is None:
        return (find_film([p.used() for p in photographs]),) * len(photographs)
    films = as_films(film, len(photographs))
    if len({one.clamp for one in films}) > 1:
        raise ValueError("film: expected one clamp for all images, got both")
    return films


def _check_range(film: Film, photograph: Observation) -> None:
    """Check that a photograph has values that its given film can have."""
    values = photograph.used()
    if film.clamp and values.size and not 0 <= values.min() <= values.max() <= 1:
        raise ValueError(
            f"{photograph.name}: expected values in [0, 1], as a clamped film holds, "
            f"got {values.min():.4g} … {values.max():.4g}; say film=Film(clamp=False)"
        )


def _check_samples(sources: list[Source], unknowns: Unknowns) -> None:
    count = sum(source.count() for source in sources)
    if count == 0:
        raise ValueError("mask: it leaves no pixel that sees the surface")
    free = np.count_nonzero(~unknowns.y_nuisance)
    if count + unknowns.n_priors <= free:
        raise ValueError(
            f"mask: expected more samples than unknowns, got {count} samples for "
            f"{free} unknowns"
        )


def _check_constants(unknowns: Unknowns, sources: list[Source]) -> None:
    """Check that ambient and emission are not both unknown if they are degenerate."""
    if not {"ambient", "emission"} <= set(unknowns.names):
        return
    light = np.concatenate(
        [np.asarray(source.pixels.terms.ambient).reshape(-1, 3) for source in sources]
    )
    free = set(np.array(unknowns.table.parameter)[unknowns.y_entry])
    known = {"ambient", "emission"} - free or unknowns.n_priors
    if not known and np.all(np.ptp(light, axis=0) <= 1e-6 * np.abs(light).max()):
        raise ValueError(
            "unknowns: expected ambient or emission, got both: under constant ambient "
            "light they are degenerate; leave one out"
        )
