r"""Normal equations of texels, which are sparse: a sample sees four neighbours.

In a channel, light is $I_i = \sum_p b_{pi} \sum_k w_{ik} t_{p k} + \dots$, with basis
images $b_p$ and the weights $w$ of a bilinear texture. $J^T J$ then couples a texel
only with the eight around it. It is symmetric, so five images hold it (one for the
diagonal, four for offsets), whatever the number of photographs.
"""

import abc
import dataclasses
import functools
import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse

from phongfit.geometry.meshes import Mesh
from phongfit.geometry.surfaces import GBuffer
from phongfit.textures import AbstractTexture, Filter, Texture, Wrap, texels

SPACING = 8
"""Distance of texels that are probed together; so far apart they hardly covary."""

# (Down, right) from a texel to itself and to the right, lower and diagonal neighbours.
OFFSETS = ((0, 0), (0, 1), (1, 0), (1, 1), (1, -1))
# Pairs of the four texels that a point lies between, by the offset of the second; the
# four are upper left, upper right, lower left, lower right.
PAIRS = (
    ((0, 0), (1, 1), (2, 2), (3, 3)),
    ((0, 1), (2, 3)),
    ((0, 2), (1, 3)),
    ((0, 3),),
    ((1, 2),),
)

CORNERS = ((0, 1), (0, 2), (1, 2))
"""A triangle's edges, as pairs of its corners."""


class Links(NamedTuple):
    """Pairs of neighbouring texels, each pair once.

    - `first`, `second`: indices of the two texels.
    - `slot`: row of a block of sums that holds the pair, in column `first`.
    """

    first: Int[np.ndarray, " links"]
    second: Int[np.ndarray, " links"]
    slot: Int[np.ndarray, " links"]


class Pattern(NamedTuple):
    """Sparsity pattern of a matrix, and each entry's index in a block of sums."""

    ends: np.ndarray
    columns: np.ndarray
    source: np.ndarray
    diagonal: np.ndarray


class AbstractTexels(abc.ABC):
    """Places on a mesh that each have unknowns, and which of them are neighbours."""

    word: ClassVar[str]
    one: ClassVar[str]
    regular: ClassVar[bool]
    """Whether neighbours have the same offsets everywhere, so that sums are images."""

    layers: int

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Number of layers (one, or one for each material), and a layer's shape."""

    @property
    def texels(self) -> int:
        """Number of places in all layers."""
        return math.prod(self.shape)

    @abc.abstractmethod
    def check(self, surface: Any) -> None:
        """**Raises:** `ValueError` if a scene's surface does not have these places."""

    @abc.abstractmethod
    def touched(
        self, gbuffer: GBuffer, layer: Int[np.ndarray, " n"] | None
    ) -> "Touched":
        """Texels that samples see, with their weights.

        **Arguments:** `gbuffer`: n pixels. `layer`: each pixel's layer, if there are
        several.
        """

    @abc.abstractmethod
    def coarser(self, by: int) -> "AbstractTexels":
        """A grid with `by` times fewer texels along a side; vertices do not change."""

    @property
    @abc.abstractmethod
    def slots(self) -> int:
        """Number of rows of a block of sums; the first is for the texels themselves."""

    @abc.abstractmethod
    def pairs(self) -> "Links":
        """All pairs of texels that samples couple."""

    @abc.abstractmethod
    def links(self) -> "Links":
        """Pairs of neighbours whose difference the smoothness prior limits."""

    def differences(
        self, scale: Float[np.ndarray, " texels"]
    ) -> Float[np.ndarray, "slots texels"]:
        r"""$\sum (s_i t_i - s_j t_j)^2$ over neighbours, as a block of sums."""
        first, second, slot = self.links()
        block = np.zeros((self.slots, self.texels))
        block[slot, first] = -scale[first] * scale[second]
        block[0] = np.bincount(first, minlength=self.texels) * scale**2
        block[0] += np.bincount(second, minlength=self.texels) * scale**2
        return block

    def from_neighbours(
        self, texels: Float[np.ndarray, " texels"]
    ) -> Float[np.ndarray, " texels"]:
        r"""The gradient of half of $\sum (t_i - t_j)^2$ over neighbours."""
        first, second, _ = self.links()
        apart = texels[first] - texels[second]
        total = np.bincount(first, apart, self.texels)
        total = total - np.bincount(second, apart, self.texels)
        # If there are no neighbours, NumPy returns whole numbers.
        return total.astype(float, copy=False)

    @functools.cached_property
    def pattern(self) -> Pattern:
        """Pattern of the matrix over all texels."""
        owner, other, slot = self.pairs()
        own = np.arange(self.texels)
        source = np.concatenate([own, *[slot * self.texels + owner] * 2])
        rows = np.concatenate([own, owner, other])
        columns = np.concatenate([own, other, owner])
        order = np.lexsort([columns, rows])
        ends = np.searchsorted(rows[order], np.arange(self.texels + 1))
        # At a texture's end a texel may be its own neighbour.
        diagonal = np.flatnonzero(source[order] < self.texels)
        kind = np.int32
        return Pattern(
            ends.astype(kind), columns[order].astype(kind), source[order], diagonal
        )

    def matrix(
        self,
        blocks: dict[tuple[int, int], np.ndarray],
        fields: int,
        prior: float | Float[np.ndarray, " n"] = 0.0,
    ) -> sparse.csr_array:
        """The symmetric matrix over all texels of all fields, field by field.

        **Arguments:**

        - `blocks`: sums of [`Touched.add_products`][] for fields p ≤ q; entries for
            other pairs are 0.
        - `prior`: added to the diagonal, field by field.
        """
        count = self.texels
        prior = np.broadcast_to(prior, fields * count).reshape(fields, count)

        def of(p: int, q: int) -> sparse.csr_array | None:
            block = blocks.get((min(p, q), max(p, q)))
            if block is None:
                return None
            more = prior[p] if p == q else 0.0
            if len(block) == 1:
                return sparse.csr_array(sparse.diags_array(block[0] + more))
            ends, columns, source, diagonal = self.pattern
            values = block.ravel()[source].astype(float)
            values[diagonal] += more
            return sparse.csr_array((values, columns, ends), (count, count))

        rows = [[of(p, q) for q in range(fields)] for p in range(fields)]
        return sparse.csr_array(sparse.block_array(rows, format="csr"))

    @abc.abstractmethod
    def colours(self) -> Int[np.ndarray, " texels"]:
        """Colours from 0, such that texels with the same colour hardly covary."""

    @abc.abstractmethod
    def texture(self, values: Float[np.ndarray, "*places channels"]) -> AbstractTexture:
        """One layer's values as a texture of a mesh."""

    @abc.abstractmethod
    def nearest(self, known: Bool[np.ndarray, "*places"]) -> tuple[np.ndarray, ...]:
        """For each place of a layer the indices of the nearest known place."""

    def filled(
        self,
        values: Float[np.ndarray, "*places channels"],
        known: Bool[np.ndarray, "*places channels"],
    ) -> Float[np.ndarray, "*places channels"]:
        """One layer's values, with unknown ones replaced by the nearest known value."""
        values = values.copy()
        for c in range(values.shape[-1]):
            own, channel = known[..., c], values[..., c]
            if own.any() and not own.all():
                channel[~own] = channel[self.nearest(own)][~own]
        return values


@dataclasses.dataclass(frozen=True)
class Grid(AbstractTexels):
    """Texels of textures of one size: one texture, or one for each material."""

    word: ClassVar[str] = "texels"
    one: ClassVar[str] = "texel"
    regular: ClassVar[bool] = True

    layers: int
    rows: int
    columns: int
    wrap: Wrap
    filter: Filter = "bilinear"

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.layers, self.rows, self.columns

    def check(self, surface: Any) -> None:
        if not isinstance(surface, Mesh) or surface.uv is None:
            raise ValueError(
                "scene: expected a Mesh with uv, which say where its texels lie, got "
                f"{type(surface).__name__}"
            )

    def touched(
        self, gbuffer: GBuffer, layer: Int[np.ndarray, " n"] | None
    ) -> "Touched":
        assert gbuffer.uv is not None
        size = self.rows, self.columns
        index, share = texels(gbuffer.uv, size, self.filter, self.wrap)
        number = np.asarray(index, np.int32)
        if layer is not None:
            number = number + (layer * np.int32(self.rows * self.columns))[:, None]
        return merged(Touched(number, np.asarray(share)))

    def coarser(self, by: int) -> "Grid":
        rows, columns = max(self.rows // by, 1), max(self.columns // by, 1)
        return dataclasses.replace(self, rows=rows, columns=columns)

    def pairs(self) -> Links:
        number = np.arange(self.texels, dtype=np.int32)
        others = [self.neighbour(offset) for offset in OFFSETS[1:]]
        slots = np.arange(1, len(OFFSETS))
        return Links(
            np.tile(number, len(others)),
            np.concatenate(others),
            np.repeat(slots, len(number)),
        )

    def colours(self) -> Int[np.ndarray, " texels"]:
        row, column = np.divmod(np.arange(self.texels), self.columns)
        # Layers are stacked one below the other.
        return row % self.rows % SPACING * SPACING + column % SPACING

    def texture(self, values: Float[np.ndarray, "rows columns channels"]) -> Texture:
        return Texture(values, self.filter, self.wrap)

    def nearest(
        self, known: Bool[np.ndarray, "rows columns"]
    ) -> tuple[np.ndarray, ...]:
        at = ndimage.distance_transform_edt(
            ~known, return_distances=False, return_indices=True
        )
        return tuple(np.array(at))

    def neighbour(self, offset: tuple[int, int]) -> Int[np.ndarray, " texels"]:
        """Index of each texel's neighbour at an offset (down, right)."""
        number = np.arange(self.texels, dtype=np.int32).reshape(self.shape)
        down, right = offset
        return np.roll(number, (-down, -right), axis=(1, 2)).ravel()

    @property
    def slots(self) -> int:
        return len(OFFSETS)

    def links(self) -> Links:
        number = np.arange(self.texels, dtype=np.int32).reshape(self.shape)
        pairs = []
        # Horizontal pairs, then vertical pairs.
        for axis, count, offset in ((2, self.columns, (0, 1)), (1, self.rows, (1, 0))):
            ends = count if self.wrap == "repeat" and count > 2 else count - 1
            keep = np.arange(ends)
            first = number.take(keep, axis).ravel()
            second = self.neighbour(offset).reshape(self.shape).take(keep, axis)
            slot = np.full(len(first), OFFSETS.index(offset), np.int8)
            pairs.append((first, second.ravel(), slot))
        return Links(*(np.concatenate(part) for part in zip(*pairs, strict=True)))


class Touched(NamedTuple):
    """Texels that each sample sees, and their weights.

    A sample sees four texels, three vertices, or one nearest texel.

    - `number`: indices of the texels. `weight`: their weights.
    - `beside`: for vertices, the flat index in a block of sums of each pair of corners.
    - `slots`: number of rows of such a block; the first row is for single vertices.
    """

    number: Int[np.ndarray, "samples corners"]
    weight: Float[np.ndarray, "samples corners"]
    beside: Int[np.ndarray, "samples pairs"] | None = None
    slots: int = len(OFFSETS)

    def mean(self, texels: Float[np.ndarray, " texels"]) -> Float[np.ndarray, " n"]:
        """A texture's value at each sample."""
        total = self.weight[:, 0] * texels[self.number[:, 0]]
        for k in range(1, self.number.shape[1]):
            total += self.weight[:, k] * texels[self.number[:, k]]
        return total

    def scattered(self, values: np.ndarray, texels: int) -> np.ndarray:
        """The transpose of [`Touched.mean`][]."""
        # Count all corners together, as each `bincount` allocates an image.
        both = self.weight * values[:, None]
        return np.bincount(self.number.ravel(), both.ravel(), texels)

    def add_products(self, values: np.ndarray, total: np.ndarray) -> None:
        r"""Add $\sum_i v_i w_{ik} w_{il}$ to `total` for pairs of neighbours k, l."""
        if self.beside is not None:
            flat = total.reshape(-1)
            total[0] += self._replace(weight=self.weight**2).scattered(
                values, len(total[0])
            )
            for pair, (k, m) in enumerate(CORNERS):
                both = values * self.weight[:, k] * self.weight[:, m]
                flat += np.bincount(self.beside[:, pair], both, len(flat))
            return
        for image, pairs in zip(total, PAIRS[: self.offsets], strict=True):
            first, second = np.transpose(pairs[: self.number.shape[1]])
            both = self.weight[:, first] * self.weight[:, second]
            pair = Touched(self.number[:, first], both)
            image += pair.scattered(values, len(image))

    @property
    def offsets(self) -> int:
        """Number of rows of a block of sums."""
        return self.slots if self.number.shape[1] > 1 else 1


def merged(touched: Touched) -> Touched:
    """Merge weights at a texture's end, where two of a sample's texels are the same."""
    number, weight = touched.number, touched.weight
    if number.shape[1] == 1:
        return touched
    weight = weight.copy()
    for one, other in ((0, 1), (2, 3), (0, 2), (1, 3)):
        same = number[:, one] == number[:, other]
        weight[:, one] += np.where(same, weight[:, other], 0)
        weight[same, other] = 0
    return Touched(number, weight)
