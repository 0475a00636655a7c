r"""JPEG compression, as a function from the levels written to the levels read back.

Levels are converted to luma and two colour differences, the latter perhaps on a coarser
grid. Blocks of 8 × 8 are cosine-transformed, and each coefficient is rounded to a
multiple of its step. The coding after that is lossless, and is left out.

??? cite "Source"
    ITU-T T.81, *Digital compression and coding of continuous-tone still images*, 1992;
    T.871 (JFIF), 2011, for the colours. Upsampling is that of the Independent JPEG
    Group's library, which nearly all programs read files with.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from phongfit.checks import as_array, as_integers
from phongfit.edge import check_fields, checked

Table = tuple[tuple[int, ...], ...]
SAMPLINGS = {
    "4:4:4": ((1, 1), (1, 1), (1, 1)),
    "4:2:2": ((2, 1), (1, 1), (1, 1)),
    "4:2:0": ((2, 2), (1, 1), (1, 1)),
}
"""How many samples across and down the components have, relative to one another."""
COARSE = 35
"""Quality at and below which errors of fits were found too small."""


@dataclasses.dataclass(frozen=True)
class JpegCompression:
    """The rounding of a JPEG file, as stated in its header: see [`read_film`][].

    **Arguments:**

    - `tables`: for each component the steps of its 8 × 8 coefficients, in levels of 8
        bits; rows are frequencies down the image. One component is grey, three are
        colour.
    - `sampling`: for each component samples across and down, relative to the others:
        ((2, 2), (1, 1), (1, 1)) has half the resolution in colour. Default: all equal.
    - `ycbcr`: whether three components are luma and colour differences; else they are
        red, green and blue.

    **Raises:** `ValueError` that names the argument.
    """

    tables: Any
    sampling: Sequence[tuple[int, int]] = ()
    ycbcr: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        tables = _as_tables(self.tables)
        sampling = _as_pairs(self.sampling) or ((1, 1),) * len(tables)
        if len(sampling) != len(tables):
            raise ValueError(
                f"sampling: expected {len(tables)} pairs, one a table, got "
                f"{len(sampling)}"
            )
        largest = np.max(sampling, axis=0)
        if np.any(largest % np.array(sampling)):
            raise ValueError(
                "sampling: expected whole numbers that divide the largest, got "
                f"{sampling}"
            )
        object.__setattr__(self, "tables", tables)
        object.__setattr__(self, "sampling", sampling)

    @property
    def widest(self) -> float:
        """Coarsest rounding step of a block's mean, at least 1, in levels."""
        return max(1.0, *(table[0][0] / 8 for table in self.tables))

    @property
    def is_coarse(self) -> bool:
        """Whether the luma steps are, on average, at least those of quality 35."""
        limit = JpegCompression.at_quality(COARSE).tables[0]
        return bool(np.mean(self.tables[0]) >= np.mean(limit))

    @classmethod
    @checked
    def at_quality(cls, quality: int, subsampling: str = "4:2:0") -> "JpegCompression":
        """The compression that most programs use for a quality of 1 … 100.

        **Arguments:** `subsampling`: `"4:4:4"`, `"4:2:2"` or `"4:2:0"`.

        **Raises:** `ValueError` that names the argument.

        ??? cite "Source"
            T.81, tables K.1 and K.2; their scaling is the Independent JPEG Group's.
        """
        if not 1 <= quality <= 100:
            raise ValueError(f"quality: expected 1 … 100, got {quality!r}")
        if subsampling not in SAMPLINGS:
            wanted = ", ".join(SAMPLINGS)
            raise ValueError(f"subsampling: expected {wanted}, got {subsampling!r}")
        scale = 5000 // quality if quality < 50 else 200 - 2 * quality
        luma, chroma = (
            np.clip((np.array(table) * scale + 50) // 100, 1, 255)
            for table in (_LUMA, _CHROMA)
        )
        return cls((luma, chroma, chroma), SAMPLINGS[subsampling])

    @property
    def transposed(self) -> "JpegCompression":
        """The compression of the transposed image."""
        tables = tuple(np.transpose(table) for table in self.tables)
        sampling = tuple((down, across) for across, down in self.sampling)
        return JpegCompression(tables, sampling, self.ycbcr)

    @property
    def subsampling(self) -> str:
        """Name of the subsampling, such as `"4:2:0"`; `"grey"` for one component."""
        if len(self.tables) == 1:
            return "grey"
        named = [name for name, known in SAMPLINGS.items() if known == self.sampling]
        sizes = "/".join(f"{across}x{down}" for across, down in self.sampling)
        return named[0] if named else sizes

    @property
    def ratios(self) -> tuple[tuple[int, int], ...]:
        """Pixels (down, across) for one sample, component by component."""
        across, down = np.max(self.sampling, axis=0).tolist()
        return tuple((down // v, across // h) for h, v in self.sampling)

    @property
    def block(self) -> tuple[int, int]:
        """Pixels (down, across) of the smallest unit that is coded independently."""
        across, down = np.max(self.sampling, axis=0).tolist()
        return 8 * down, 8 * across

    @property
    def from_components(self) -> Float[np.ndarray, "3 components"]:
        """Matrix from the components' levels to those of red, green and blue."""
        if len(self.tables) == 1:
            return np.ones((3, 1))
        return _FROM_YCBCR if self.ycbcr else np.eye(3)

    @property
    def to_components(self) -> Float[np.ndarray, "components 3"]:
        """Matrix from red, green and blue to the components; grey takes the red."""
        if len(self.tables) == 1:
            return np.array([[1.0, 0.0, 0.0]])
        return np.linalg.inv(self.from_components)


_FROM_YCBCR = np.array([[1, 0, 1.402], [1, -0.344136, -0.714136], [1, 1.772, 0]])


def _as_tables(given: Any) -> tuple[Table, ...]:
    steps = as_integers("tables", _whole("tables", given), 1, 2**16)
    if steps.ndim != 3 or len(steps) not in (1, 3) or steps.shape[1:] != (8, 8):
        raise ValueError(
            f"tables: expected shape (1, 8, 8) or (3, 8, 8), got {steps.shape}"
        )
    return tuple(tuple(map(tuple, table)) for table in steps.tolist())


def _whole(name: str, given: Any) -> np.ndarray:
    """Convert arrays of whole floating-point numbers to integers; leave others."""
    array = as_array(name, given)
    if array.dtype.kind == "f" and (array == np.round(array)).all():
        return array.astype(np.int64)
    return array


def _as_pairs(given: Any) -> tuple[tuple[int, int], ...]:
    """Sampling factors (across, down) of each component; () if all are (1, 1)."""
    if as_array("sampling", given).size == 0:
        return ()
    pairs = as_integers("sampling", _whole("sampling", given), 1, 5)
    if pairs.shape[1:] != (2,):
        raise ValueError(f"sampling: expected pairs, got shape {pairs.shape}")
    return tuple(map(tuple, pairs.tolist()))


def compressed(
    levels: Float[Any, "height width 3"], jpeg: JpegCompression
) -> Float[Any, "height width 3"]:
    """Levels 0 … 255 after compression and decompression; arrays of JAX or NumPy."""
    xp, kind = namespace(levels), levels.dtype
    height, width, _ = levels.shape
    whole = xp.clip(xp.round(xp.moveaxis(levels, -1, 0)), 0, 255)
    to, back = (
        xp.asarray(matrix, kind)
        for matrix in (jpeg.to_components, jpeg.from_components)
    )
    offsets = _offsets(jpeg, kind)
    planes = xp.round(_multiply_channels(to, _pad_to_blocks(whole, jpeg))) - offsets
    decoded = []
    for k, (table, ratio) in enumerate(zip(jpeg.tables, jpeg.ratios, strict=True)):
        plane = planes[k]
        if ratio != (1, 1):
            plane = xp.round(_downsample(plane, ratio))
        step = xp.asarray(table, kind)[None, None]
        rounded = xp.round(cosines(plane) / step) * step
        plane = xp.clip(xp.round(_pixels(rounded)), -128, 127)
        if ratio != (1, 1):
            plane = xp.round(_upsample(plane, ratio))
        decoded.append(plane)
    shown = xp.clip(
        xp.round(_multiply_channels(back, xp.stack(decoded) + offsets)), 0, 255
    )
    return xp.moveaxis(shown[:, :height, :width], 0, -1)


def cosines(plane: Float[Any, "height width"]) -> Float[Any, "down across 8 8"]:
    """Cosine transform of each block of 8 × 8; it is orthonormal."""
    xp = namespace(plane)
    down, across = (side // 8 for side in plane.shape)
    blocks = xp.moveaxis(plane.reshape(down, 8, across, 8), 2, 1)
    basis = xp.asarray(_COSINES, plane.dtype)
    return basis @ blocks @ basis.T


def _pixels(blocks: Float[Any, "down across 8 8"]) -> Float[Any, "height width"]:
    """The inverse of [`cosines`][]."""
    xp = namespace(blocks)
    basis = xp.asarray(_COSINES, blocks.dtype)
    down, across = blocks.shape[:2]
    plane = xp.moveaxis(basis.T @ blocks @ basis, 1, 2)
    return plane.reshape(8 * down, 8 * across)


def namespace(values: Any) -> Any:
    """The array module of `values`: NumPy for NumPy's arrays, else `jax.numpy`."""
    return np if isinstance(values, np.ndarray | np.generic) else jnp


def _multiply_channels(matrix: Any, planes: Any) -> Any:
    """Multiply the channels of each pixel by a matrix; (rows, height, width)."""
    _, height, width = planes.shape
    return (matrix @ planes.reshape(len(planes), -1)).reshape(-1, height, width)


def _offsets(jpeg: JpegCompression, kind: Any) -> Any:
    """Level of each component that is 0 in a file: 128, or 0 for colour differences."""
    count = len(jpeg.tables)
    offsets = [128, 0, 0] if count == 3 and jpeg.ycbcr else [128] * count
    return np.array(offsets, kind)[:, None, None]


def _pad_to_blocks(planes: Any, jpeg: JpegCompression) -> Any:
    """Pad planes to whole blocks: the last row and column are repeated."""
    xp = namespace(planes)
    down, across = jpeg.block
    _, height, width = planes.shape
    return xp.pad(planes, [(0, 0), (0, -height % down), (0, -width % across)], "edge")


def _downsample(plane: Any, ratio: tuple[int, int]) -> Any:
    """Downsample a plane: each sample is the mean of its pixels."""
    down, across = ratio
    height, width = plane.shape
    cells = plane.reshape(height // down, down, width // across, across)
    return cells.mean(axis=(1, 3))


def _upsample(plane: Any, ratio: tuple[int, int]) -> Any:
    """Upsample a plane to pixels: interpolated for ratios up to 2, else repeated."""
    xp = namespace(plane)
    for axis, times in enumerate(ratio):
        if max(ratio) > 2:
            plane = xp.repeat(plane, times, axis=axis)
        elif times == 2:
            plane = _double(plane, axis)
    return plane


def _double(plane: Any, axis: int) -> Any:
    """Twice as many samples along an axis: 3/4 the nearest and 1/4 the next one."""
    xp = namespace(plane)
    wide = xp.moveaxis(plane, axis, -1)
    ends = xp.pad(wide, [(0, 0), (1, 1)], "edge")
    pair = xp.stack([3 * wide + ends[:, :-2], 3 * wide + ends[:, 2:]], axis=-1) / 4
    return xp.moveaxis(pair.reshape(len(wide), -1), -1, axis)


def _cosine_basis() -> Float[np.ndarray, "8 8"]:
    frequency, place = np.mgrid[:8, :8]
    basis = np.cos(np.pi * (2 * place + 1) * frequency / 16) / 2
    basis[0] /= np.sqrt(2)
    return basis


_COSINES = _cosine_basis()

# T.81, tables K.1 and K.2.
_LUMA = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
_CHROMA = (
    (17, 18, 24, 47, 99, 99, 99, 99),
    (18, 21, 26, 66, 99, 99, 99, 99),
    (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99),
    *((99,) * 8,) * 4,
)
