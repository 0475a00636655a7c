"""Files that come through the page: read as those on disk are, within limits."""

import math
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.images import read_film, read_image, read_mask
from phongfit.files.inputs import naming
from phongfit.files.meshes import load_mesh
from phongfit.geometry.meshes import Mesh
from phongfit.lab.scene import fitted_into_view
from phongfit.rendering.film import Encoding

MAX_BYTES = 2**26
"""Larger files are refused."""

MAX_PIXELS = 2**24
"""Larger photographs are refused: a page should not fill the memory."""

MAX_FACES = 500_000
"""Meshes of more faces are refused."""

MAX_SIDE = 768
"""Larger photographs are shrunk: a slider has to be answered at once."""

T = TypeVar("T")


def read_mesh(name: str, content: bytes) -> Mesh:
    """A mesh of one material, in the sphere of radius 1: see [`load_mesh`][].

    **Arguments:** `name` of the file, whose suffix tells the format; its `content`.

    **Raises:** `ValueError` that names the file.
    """

    def read(path: Path) -> Mesh:
        with warnings.catch_warnings():
            # Materials that are missing: the sliders' one is used for all faces.
            warnings.simplefilter("ignore")
            mesh = load_mesh(path).mesh
        with naming(str(path)):
            if len(mesh.faces) > MAX_FACES:
                raise ValueError(
                    f"expected at most {MAX_FACES}, got {len(mesh.faces)} faces"
                )
            return fitted_into_view(mesh)

    return _read(name, content, read)


def read_photograph(
    name: str, content: bytes, encoding: Encoding
) -> tuple[Float[np.ndarray, "height width 3"], int, bool]:
    """An image as linear light: see [`read_image`][].

    **Returns:** the image, its longer side at most `MAX_SIDE`; how many times it was
    shrunk for that; and whether its file clamps light at black and white.

    **Raises:** `ValueError` that names the file.
    """

    def read(path: Path) -> tuple[np.ndarray, bool]:
        image = read_image(path, encoding, max_pixels=MAX_PIXELS)
        return image, read_film(path, encoding).clamp

    image, clamps = _read(name, content, read)
    return *shrunk(image), clamps


def read_photograph_mask(
    name: str, content: bytes, times: int, shape: tuple[int, int]
) -> Bool[np.ndarray, "height width"]:
    """A mask for a photograph that was shrunk `times` to `shape`: see [`read_mask`][].

    **Raises:** `ValueError` that names the file, and if it is not of the photograph's
    size.
    """
    mask = _read(name, content, lambda path: read_mask(path, max_pixels=MAX_PIXELS))
    whole = _shrink(mask[..., None].astype(float), times)[..., 0] >= 1
    if whole.shape != shape:
        came, wanted = mask.shape, tuple(times * side for side in shape)
        raise ValueError(f"{_plain(name)}: expected {wanted} pixels, got {came}")
    return whole


def shrunk(
    image: Float[np.ndarray, "height width channels"],
) -> tuple[Float[np.ndarray, "h w channels"], int]:
    """An image with its longer side at most `MAX_SIDE`, and how many times that is."""
    times = math.ceil(max(image.shape) / MAX_SIDE)
    return _shrink(image, times), times


def _shrink(image: np.ndarray, times: int) -> np.ndarray:
    """Means of blocks: light is what adds up."""
    height, width = (side // times for side in image.shape[:2])
    cut = image[: height * times, : width * times]
    return cut.reshape(height, times, width, times, -1).mean(axis=(1, 3))


def _read(name: str, content: bytes, read: Callable[[Path], T]) -> T:
    """What `read` makes of a file with this content, alone in a folder of its own."""
    shown = _plain(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "upload" + Path(shown).suffix[:16])
        path.write_bytes(content)
        try:
            return read(path)
        except ValueError as error:
            words = str(error).replace(str(path), shown).replace(path.name, shown)
            raise ValueError(" ".join(words.split())) from error


def _plain(name: str) -> str:
    """A file's name, fit for a message."""
    return "".join(c for c in Path(name).name if c.isprintable())[-80:] or "file"
