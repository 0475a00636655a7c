"""Files uploaded through the page, read like files on disk, within limits."""

import math
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.images import read_mask, read_opaque
from phongfit.files.inputs import naming
from phongfit.files.meshes import load_mesh
from phongfit.geometry.meshes import Mesh
from phongfit.lab.scene import fitted_into_view
from phongfit.rendering.film import Encoding
from phongfit.rendering.render import block_means

MAX_BYTES = 2**26
"""Maximum size of a file, bytes."""

MAX_PIXELS = 2**24
"""Maximum number of pixels of a photograph, to protect the memory."""

MAX_FACES = 500_000
"""Maximum number of faces of a mesh."""

MAX_SIDE = 768
"""Largest side of a photograph, pixels; larger ones are shrunk, for fast sliders."""

T = TypeVar("T")


def read_mesh(name: str, content: bytes) -> Mesh:
    """A mesh of one material, in the sphere of radius 1: see [`load_mesh`][].

    **Arguments:** `name` of the file, whose suffix determines the format; its
    `content`.

    **Raises:** `ValueError` that names the file.
    """

    def read(path: Path) -> Mesh:
        with warnings.catch_warnings():
            # No warnings of missing materials, since the sliders' material is used.
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

    **Returns:** the image, its longer side at most `MAX_SIDE`; the factor by which it
    was shrunk; and true if its file clamps light at black and white.

    **Raises:** `ValueError` that names the file.
    """

    def read(path: Path) -> tuple[np.ndarray, bool]:
        light = read_opaque(path, encoding, max_pixels=MAX_PIXELS)
        return light.image, light.clamped

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
    whole = block_means(mask[..., None].astype(float), times)[..., 0] >= 1
    if whole.shape != shape:
        came, wanted = mask.shape, tuple(times * side for side in shape)
        raise ValueError(f"{_plain(name)}: expected {wanted} pixels, got {came}")
    return whole


def shrunk(
    image: Float[np.ndarray, "height width channels"],
) -> tuple[Float[np.ndarray, "h w channels"], int]:
    """An image shrunk to a longer side of at most `MAX_SIDE`, and the factor."""
    times = math.ceil(max(image.shape) / MAX_SIDE)
    return block_means(image, times), times


def _read(name: str, content: bytes, read: Callable[[Path], T]) -> T:
    """Apply `read` to a temporary file with this content, in a separate folder."""
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
    """A file's name, shortened and printable, for messages."""
    return "".join(c for c in Path(name).name if c.isprintable())[-80:] or "file"
