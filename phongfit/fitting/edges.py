"""Edges that unknowns move: light jumps there, and the pixels at them are left out.

An outline, the rim of a spot's cone, the border of a cast shadow: as one of these moves
over a pixel, its light jumps, and between jumps it says nothing of where the edge is.
Derivatives know no jumps, so a pixel on the wrong side of an edge would pull on all
that is unknown for the wrong reason.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from phongfit.fitting.samples import Samples, Source
from phongfit.fitting.search import Found, search_on
from phongfit.fitting.unknowns import Unknowns, in_units
from phongfit.scene import Scene

# Pixels to either side of an edge that are left out, and of these the nearest, which
# must be: an edge may come to rest within the strip, not beside it.
REACH, NEAREST = 2, 1
MOST_ROUNDS = 8


def keep_off_edges(
    found: Found, sources: list[Source], noise_given: bool, max_steps: int
) -> tuple[Found, list[Source], tuple[str, ...]]:
    """A fit again and again, until no pixel that counts lies at an edge that it moves.

    **Returns:** the last fit, the images without what was left out of them, and what
    there is to warn of.
    """
    unknowns = found.problem.unknowns
    scenes = tuple(source.scene for source in sources)
    if not moves_edges(unknowns, scenes):
        return found, sources, ()
    samples, kept, crossed = found.problem.samples, sources, 0
    for _ in range(MOST_ROUNDS):
        here = unknowns.scenes(in_units(unknowns, found.y)[0], scenes)
        crossed = _count(kept, near_edges(unknowns, here, NEAREST))
        if crossed == 0:
            return found, kept, ()
        pixels = near_edges(unknowns, here)
        fewer = list(map(_without, sources, pixels))
        if sum(source.count() for source in fewer) <= found.y.size:
            break
        kept = fewer
        found = search_on(found, left_out(samples, pixels), noise_given, max_steps)
    return found, kept, (_words(crossed),)


def _words(crossed: int) -> str:
    return (
        f"{crossed} pixels that count lie at an edge (an outline, the rim of a spot, a "
        "shadow) that moves with what is unknown: light jumps there, and no derivative "
        "says how. Values may be off by more than their errors; mask out what lies "
        "near the edge, or start nearer to the truth"
    )


def _without(source: Source, pixels: Bool[np.ndarray, "height width"]) -> Source:
    weight = jnp.where(pixels[..., None], 0, source.weight)
    return dataclasses.replace(source, weight=weight)


def _count(sources: Sequence[Source], pixels: Sequence[np.ndarray]) -> int:
    """How many of these pixels count."""
    return sum(
        int(np.count_nonzero((np.asarray(source.weight) > 0).any(axis=-1) & one))
        for source, one in zip(sources, pixels, strict=True)
    )


def moves_edges(unknowns: Unknowns, scenes: Sequence[Scene]) -> bool:
    """Whether an edge moves with what is unknown."""
    if unknowns.moves_geometry:
        return True
    if unknowns.moves_lights and any(scene.shadows for scene in scenes):
        return True
    return any(_moving_cones(unknowns, scene) for scene in scenes)


def near_edges(
    unknowns: Unknowns, scenes: Sequence[Scene], reach: int = REACH
) -> list[Bool[np.ndarray, "height width"]]:
    """Of each scene the pixels within `reach` of an edge that moves.

    Where the outline moves, pixels that see no surface are among them.
    """
    return [_near_edges(unknowns, scene, reach) for scene in scenes]


def left_out(
    samples: Samples, pixels: Sequence[Bool[np.ndarray, "height width"]]
) -> Samples:
    """The same samples, without the weight of some pixels of each image."""
    out = [
        one.ravel()[np.asarray(view.index)]
        for one, view in zip(pixels, samples.views, strict=True)
    ]
    weight = jnp.where(np.concatenate(out)[None], 0, samples.weight)
    return eqx.tree_at(lambda s: s.weight, samples, weight)


def _near_edges(unknowns: Unknowns, scene: Scene, reach: int) -> np.ndarray:
    seen, sides = _sides(scene, _moving_cones(unknowns, scene))
    seen, sides = np.asarray(seen), np.asarray(sides)
    near = np.zeros_like(seen)
    if unknowns.moves_geometry:
        near = _spread(~seen, reach)
    for side in np.moveaxis(sides, -1, 0):
        near |= _spread(side & seen, reach) & _spread(~side & seen, reach)
    return near


def _moving_cones(unknowns: Unknowns, scene: Scene) -> tuple[int, ...]:
    """Lights that end somewhere, and of which something unknown moves that edge."""
    places = ("position", "axis", "direction")
    return tuple(
        k
        for k, light in enumerate(scene.lights)
        if light.jumps
        and (
            unknowns.moves_geometry
            or any(f"scene.lights[{k}].{place}" in unknowns.names for place in places)
        )
    )


@eqx.filter_jit
def _sides(
    scene: Scene, cones: tuple[int, ...]
) -> tuple[Bool[Array, "height width"], Bool[Array, "height width edges"]]:
    """Which pixels see the surface, and on which side of each edge they lie."""
    buffer = scene.trace()
    sides = [jax.vmap(jax.vmap(scene.lights[k].covers))(buffer.position) for k in cones]
    if buffer.visibility is not None and buffer.visibility.ndim == 3:
        sides += list(jnp.moveaxis(buffer.visibility > 0, -1, 0))
    none = jnp.zeros((*buffer.mask.shape, 0), bool)
    return buffer.mask, jnp.stack(sides, axis=-1) if sides else none


def _spread(pixels: np.ndarray, reach: int) -> np.ndarray:
    """Pixels with one of these no further than `reach` rows and columns away."""
    for axis in (0, 1):
        rows = np.moveaxis(pixels, axis, 0)
        wide = rows.copy()
        for step in range(1, reach + 1):
            wide[step:] |= rows[:-step]
            wide[:-step] |= rows[step:]
        pixels = np.moveaxis(wide, 0, axis)
    return pixels
