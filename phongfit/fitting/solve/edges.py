"""Edges that unknowns move, where light is discontinuous: their pixels are left out.

These are outlines, creases of the surface, rims of spots' cones, and borders of cast
shadows. When an edge moves over a pixel, its light jumps; otherwise the light does not
depend on the edge.
Derivatives do not include jumps, so a pixel on the wrong side of an edge would bias all
unknowns.
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

# Width in pixels of the strip on either side of an edge that is left out, and the
# smaller distance within which no used pixel may lie: a fitted edge may move within the
# strip.
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
    """Fit repeatedly, until no used pixel lies at an edge that unknowns move.

    **Arguments:** `seen`: for each image the pixels of the fit. **Returns:** the last
    fit, the images with weight 0 at edges, and warnings.
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
    """Images with weight 0 at the edges of their scenes that unknowns move."""
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
    """Number of these pixels with a weight above 0."""
    return sum(
        int(np.count_nonzero((np.asarray(source.weight) > 0).any(axis=-1) & one))
        for source, one in zip(sources, pixels, strict=True)
    )


def moves_edges(unknowns: Unknowns, scenes: Sequence[Scene]) -> bool:
    """Whether unknowns move an edge."""
    if unknowns.moves_geometry:
        return True
    if unknowns.moves_lights and any(scene.shadows for scene in scenes):
        return True
    return any(_moving_cones(unknowns, scene) for scene in scenes)


class Edges(NamedTuple):
    """The moving edges of an image.

    - `seen`: pixels that see the surface; `outlined`: whether the outline is an edge.
    - `sides`: side of each other edge on which a pixel lies.
    - `broken`: pixels beside a crease, a jump in depth or another material, where
      these move.
    """

    seen: Bool[np.ndarray, "height width"]
    outlined: bool
    sides: Bool[np.ndarray, "height width edges"]
    broken: Bool[np.ndarray, "height width"]


def edges_of(unknowns: Unknowns, scene: Scene) -> Edges:
    """The edges of one image that unknowns move."""
    buffer, sides = _sides(scene, _moving_cones(unknowns, scene))
    seen, moves = np.asarray(buffer.mask), unknowns.moves_geometry
    # The normals of a normal map are fixed to pixels.
    breaks = moves and not isinstance(scene.surface, NormalMap)
    flat = isinstance(scene.shading, FlatShading)
    broken = _broken(buffer, flat) if breaks else np.zeros_like(seen)
    return Edges(seen, moves, np.asarray(sides), broken)


def near(edges: Edges, reach: int) -> Bool[np.ndarray, "height width"]:
    """Pixels within `reach` of a moving edge.

    Near an outline this includes pixels that see no surface.
    """
    seen = edges.seen
    found = _spread(~seen, reach) if edges.outlined else np.zeros_like(seen)
    for side in np.moveaxis(edges.sides, -1, 0):
        found |= _spread(side & seen, reach) & _spread(~side & seen, reach)
    return found | _spread(edges.broken, reach - 1)


def _broken(buffer: GBuffer, flat: bool) -> Bool[np.ndarray, "height width"]:
    """Pixels beside a crease or a jump in depth, in their row or column.

    On a smooth surface the step from one point to the next is perpendicular to the mean
    of both normals, up to third order in its length.

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
    """Indices of lights with a sharp edge that unknowns move."""
    places = ("position", "axis", "direction")
    return tuple(
        k
        for k, light in enumerate(scene.lights)
        if light.jumps
        and (
            unknowns.moves_geometry
            or any(f"scene.lights[{k}].{place}" in unknowns.sought for place in places)
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
    # Imported here, since SciPy takes long to import and few fits need it.
    from scipy.ndimage import maximum_filter

    return maximum_filter(pixels, 2 * reach + 1, mode="constant")
