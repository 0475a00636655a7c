"""Edges that unknowns move: light jumps there, and the pixels at them are left out.

An outline, a crease of the surface, the rim of a spot's cone, the border of a cast
shadow: as one of these moves over a pixel, its light jumps, and between jumps it says
nothing of where the edge is.
Derivatives know no jumps, so a pixel on the wrong side of an edge would pull on all
that is unknown for the wrong reason.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from phongfit.codes import coded
from phongfit.fitting.problem.samples import Source, gather
from phongfit.fitting.problem.unknowns import Unknowns, in_units
from phongfit.fitting.solve.search import SearchResult, search_on
from phongfit.geometry.shading import FlatShading
from phongfit.geometry.surfaces import GBuffer, NormalMap
from phongfit.programs import program
from phongfit.scene import Scene

# Pixels to either side of an edge that are left out, and of these the nearest, which
# must be: an edge may come to rest within the strip, not beside it.
REACH, NEAREST = 2, 1
MOST_ROUNDS = 8
# Degrees by which the normals of neighbouring pixels differ at a crease, and between
# their tangent planes and the step from one to the other at a jump in depth. On a
# smooth sphere, normals differ that much only within two pixels of its outline.
CREASE = 30.0
_BUT_LAST, _BUT_FIRST = slice(None, -1), slice(1, None)


def keep_off_edges(
    found: SearchResult,
    sources: list[Source],
    seen: list[np.ndarray],
    noise_given: bool,
    max_steps: int,
) -> tuple[SearchResult, list[Source], tuple[str, ...]]:
    """A fit again and again, until no pixel that counts lies at an edge that it moves.

    **Arguments:** `seen`: of each image the pixels that the fit gathered.

    **Returns:** the last fit, the images without what was left out of them, and what
    there is to warn of.
    """
    unknowns = found.problem.unknowns
    scenes = tuple(source.scene for source in sources)
    if not moves_edges(unknowns, scenes):
        return found, sources, ()
    kept, crossed = sources, 0
    for _ in range(MOST_ROUNDS):
        here = unknowns.scenes(in_units(unknowns, found.y)[0], scenes)
        edges = [edges_of(unknowns, scene) for scene in here]
        crossed = _count(kept, [near(one, NEAREST) for one in edges])
        if crossed == 0:
            return found, kept, ()
        fewer = _off(edges, sources)
        if sum(source.count() for source in fewer) <= found.y.size:
            break
        kept = fewer
        found = search_on(found, gather(kept, seen), noise_given, max_steps)
    return found, kept, (_words(crossed),)


def off_edges(unknowns: Unknowns, sources: list[Source]) -> list[Source]:
    """Images without what a fit that ends where their scenes are leaves out of them."""
    scenes = tuple(source.scene for source in sources)
    if not moves_edges(unknowns, scenes):
        return sources
    return _off([edges_of(unknowns, scene) for scene in scenes], sources)


def _off(edges: Sequence["Edges"], sources: Sequence[Source]) -> list[Source]:
    return [
        dataclasses.replace(
            source, weight=jnp.where(near(one, REACH)[..., None], 0, source.weight)
        )
        for one, source in zip(edges, sources, strict=True)
    ]


def _words(crossed: int) -> str:
    return coded(
        "moving-edge",
        f"{crossed} pixels in use lie at an edge (an outline, a crease, the rim of a "
        "spot, a shadow) that moves with an unknown: light jumps there, which no "
        "derivative describes. Values may be off by more than their errors",
    )


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


class Edges(NamedTuple):
    """What an image shows of the edges that move.

    - `seen`: pixels that see the surface; `outlined`: whether the outline is an edge.
    - `sides`: on which side of each other edge they lie.
    - `broken`: pixels beside a crease, a jump in depth or another material, where
      these move.
    """

    seen: Bool[np.ndarray, "height width"]
    outlined: bool
    sides: Bool[np.ndarray, "height width edges"]
    broken: Bool[np.ndarray, "height width"]


def edges_of(unknowns: Unknowns, scene: Scene) -> Edges:
    """The edges of one image that move with what is unknown."""
    buffer, sides = _sides(scene, _moving_cones(unknowns, scene))
    seen, moves = np.asarray(buffer.mask), unknowns.moves_geometry
    # The normals of a picture stay in their pixels, whatever moves.
    breaks = moves and not isinstance(scene.surface, NormalMap)
    flat = isinstance(scene.shading, FlatShading)
    broken = _broken(buffer, flat) if breaks else np.zeros_like(seen)
    return Edges(seen, moves, np.asarray(sides), broken)


def near(edges: Edges, reach: int) -> Bool[np.ndarray, "height width"]:
    """Pixels within `reach` of an edge that moves.

    Where that is the outline, pixels that see no surface are among them.
    """
    seen = edges.seen
    found = _spread(~seen, reach) if edges.outlined else np.zeros_like(seen)
    for side in np.moveaxis(edges.sides, -1, 0):
        found |= _spread(side & seen, reach) & _spread(~side & seen, reach)
    return found | _spread(edges.broken, reach - 1)


def _broken(buffer: GBuffer, flat: bool) -> Bool[np.ndarray, "height width"]:
    """Pixels whose neighbour in a row or column sees a surface that does not go on.

    On a smooth surface the step from one point to the next is at a right angle to the
    mean of both normals, up to third order in its length.

    **Arguments:** `flat`: whether every edge between faces is a crease.
    """
    seen, normal = np.asarray(buffer.mask), np.asarray(buffer.normal)
    position = np.asarray(buffer.position)
    labels = [buffer.material_index, buffer.face if flat else None]
    labels = [np.asarray(label) for label in labels if label is not None]
    found = np.zeros_like(seen)
    for axis in (0, 1):
        here, there = ((slice(None),) * axis + (s,) for s in (_BUT_LAST, _BUT_FIRST))
        turn = np.sum(normal[here] * normal[there], axis=-1)
        step = position[there] - position[here]
        rise = abs(np.sum(step * (normal[here] + normal[there]) / 2, axis=-1))
        jumps = turn < np.cos(np.deg2rad(CREASE))
        jumps |= rise > np.sin(np.deg2rad(CREASE)) * np.linalg.norm(step, axis=-1)
        for label in labels:
            jumps |= label[here] != label[there]
        jumps &= seen[here] & seen[there]
        found[here] |= jumps
        found[there] |= jumps
    return found


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


@program("cones")
def _sides(
    scene: Scene, cones: tuple[int, ...]
) -> tuple[GBuffer, Bool[Array, "height width edges"]]:
    """The surface at each pixel, and its side of each edge."""
    buffer = scene.trace()
    sides = [jax.vmap(jax.vmap(scene.lights[k].covers))(buffer.position) for k in cones]
    if buffer.visibility is not None and buffer.visibility.ndim == 3:
        sides += list(jnp.moveaxis(buffer.visibility > 0, -1, 0))
    none = jnp.zeros((*buffer.mask.shape, 0), bool)
    return buffer, jnp.stack(sides, axis=-1) if sides else none


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
