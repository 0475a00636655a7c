"""Unknowns at the vertices of a mesh, with the same interface as a grid of texels."""

import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from phongfit.fitting.texels.sums import CORNERS, AbstractTexels, Links, Touched
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.surfaces import GBuffer
from phongfit.textures import VertexColours

RINGS = 5
"""Vertices at most this many edges apart are not probed together, as they covary."""


def as_mesh(surface: Any) -> Mesh:
    """The scene's surface if it is a mesh; otherwise raise `ValueError`."""
    if not isinstance(surface, Mesh):
        kind = type(surface).__name__
        raise ValueError(f"scene: expected a Mesh, which has vertices, got {kind}")
    return surface


class Edges(NamedTuple):
    """All edges of a mesh, each owned by one of its ends, so that none owns many.

    - `owner`, `other`: the ends of each edge.
    - `slot`: number of the edge among its owner's edges, from 1; 0 is the vertex
        itself.
    - `of_faces`: indices of each face's edges, in the order of `CORNERS`.
    """

    owner: Int[np.ndarray, " edges"]
    other: Int[np.ndarray, " edges"]
    slot: Int[np.ndarray, " edges"]
    of_faces: Int[np.ndarray, "faces 3"]


def find_edges(faces: Int[np.ndarray, "faces 3"], vertices: int) -> Edges:
    """The edges of a mesh, without edges between a vertex and itself."""
    ends = np.sort(faces[:, CORNERS].reshape(-1, 2), axis=1).astype(np.int64)
    keys, number = np.unique(ends[:, 0] * vertices + ends[:, 1], return_inverse=True)
    low, high = keys // vertices, keys % vertices
    long = low != high
    # Faces with such edges are never seen, so any index serves them.
    number = np.where(long, np.cumsum(long) - 1, 0)[number]
    low, high = low[long], high[long]
    degree = np.bincount(np.concatenate([low, high]), minlength=vertices)
    # The end with fewer edges owns an edge, so that the centre of a fan owns none.
    swapped = degree[low] > degree[high]
    owner, other = np.where(swapped, high, low), np.where(swapped, low, high)
    order = np.argsort(owner, kind="stable")
    slot = np.empty(len(owner), np.int64)
    kept = owner[order]
    slot[order] = np.arange(len(kept)) - np.searchsorted(kept, kept) + 1
    return Edges(owner, other, slot, number.reshape(-1, 3))


@dataclasses.dataclass(frozen=True, eq=False)
class Vertices(AbstractTexels):
    """Unknowns at vertices, in `layers` layers: one, or one for each material.

    **Arguments:** `points`, `faces`: the mesh.
    """

    word: ClassVar[str] = "vertices"
    one: ClassVar[str] = "vertex"
    regular: ClassVar[bool] = False

    layers: int
    points: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.layers, len(self.points)

    @functools.cached_property
    def edges(self) -> Edges:
        """Edges of the mesh."""
        return find_edges(self.faces, len(self.points))

    @property
    def slots(self) -> int:
        # The vertex itself, and the edges that it owns.
        return 1 + int(self.edges.slot.max(initial=0))

    def check(self, surface: Any) -> None:
        mesh = as_mesh(surface)
        same = len(mesh.vertices) == len(self.points)
        if not same or not np.array_equal(mesh.faces, self.faces):
            raise ValueError("scene: expected the same Mesh in all scenes")

    def touched(self, gbuffer: GBuffer, layer: Int[np.ndarray, " n"] | None) -> Touched:
        face = np.asarray(gbuffer.face)
        number = self.faces[face].astype(np.int32)
        edge = self.edges.of_faces[face]
        beside = self.edges.slot[edge] * self.texels + self.edges.owner[edge]
        if layer is not None:
            number = number + (layer * np.int32(len(self.points)))[:, None]
            beside = beside + (layer.astype(np.int64) * len(self.points))[:, None]
        return Touched(number, np.asarray(gbuffer.barycentrics), beside, self.slots)

    def coarser(self, by: int) -> "Vertices":
        del by
        return self

    def pairs(self) -> Links:
        start = (np.arange(self.layers) * len(self.points))[:, None]
        return Links(
            (start + self.edges.owner).ravel(),
            (start + self.edges.other).ravel(),
            np.tile(self.edges.slot, self.layers),
        )

    def links(self) -> Links:
        return self.pairs()

    def colours(self) -> Int[np.ndarray, " texels"]:
        count = len(self.points)
        ends = np.concatenate([self.edges.owner, self.edges.other])
        others = np.concatenate([self.edges.other, self.edges.owner])
        one = sparse.csr_array((np.ones(len(ends), bool), (ends, others)), (count,) * 2)
        one = sparse.csr_array(one + sparse.eye_array(count, dtype=bool))
        near = one
        for _ in range(RINGS - 1):
            near = sparse.csr_array(near @ one)
        colour = np.full(count, -1)
        for k in range(count):
            taken = colour[near.indices[near.indptr[k] : near.indptr[k + 1]]]
            free = np.ones(len(taken) + 1, bool)
            free[taken[(taken >= 0) & (taken < len(free))]] = False
            colour[k] = free.argmax()
        # Vertices of different materials are not seen together.
        return np.tile(colour, self.layers)

    def texture(self, values: Float[np.ndarray, "vertices channels"]) -> VertexColours:
        return VertexColours(values)

    def nearest(self, known: Bool[np.ndarray, " vertices"]) -> tuple[np.ndarray, ...]:
        _, nearest = KDTree(self.points[known]).query(self.points)
        return (np.flatnonzero(known)[nearest],)
