"""Photographs in the layout of DiLiGenT.

??? cite "Source"
    Shi, Mo, Wu, Duan, Yeung and Tan, *A benchmark dataset and evaluation for
    non-Lambertian and uncalibrated photometric stereo*, TPAMI 41(2), 2019.
"""

import math
import os
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.budget import afford
from phongfit.files.coded import Coded
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.images import read_light, read_mask
from phongfit.files.inputs import (
    inside,
    naming,
    read_bytes,
    read_table,
    read_text,
    reason,
)
from phongfit.files.matlab import read_matrix
from phongfit.geometry.cameras import OrthographicCamera
from phongfit.geometry.planes import plane_before
from phongfit.geometry.surfaces import NormalMap
from phongfit.lights import DirectionalLight
from phongfit.rendering.film import Film
from phongfit.scene import Scene

NORMALS = "Normal_gt"


def is_diligent(folder: Path) -> bool:
    """True if a folder has the layout of DiLiGenT."""
    return (folder / "filenames.txt").exists()


def open_diligent(
    folder: str | os.PathLike[str],
    *,
    min_cosine: float = -1.0,
    min_facing: float = -1.0,
    normals: Literal["given", "fit"] = "given",
) -> Photographs:
    """One object of DiLiGenT: linear photographs, each under one distant light.

    Photographs are divided by the intensities of their lights, so that each light's
    intensity is 1, and saturated samples are masked, channel by channel.

    **Arguments:**

    - `folder`: holds `filenames.txt`, the photographs in it, `light_directions.txt`,
        `light_intensities.txt`, `mask.png` and `Normal_gt.mat`.
    - `min_cosine`: samples with n·l up to this are masked too: there light from other
        surfaces, and the shadow's edge, outweigh the light itself.
    - `min_facing`: pixels with n_z up to this are masked too: on the rim a pixel
        averages over many normals.
    - `normals`: `"fit"` if normals are fitted too: `Normal_gt.mat` is then not read,
        and the surface is a plane perpendicular to the camera's axis.

    **Raises:** `ValueError` that names the file that is missing or wrong.
    """
    folder = Path(folder)
    names = tuple(read_text(inside(folder, "filenames.txt")).split())
    directions = _read_rows(folder, "light_directions.txt", len(names))
    intensities = _read_rows(folder, "light_intensities.txt", len(names))
    _check_lights(folder, directions, intensities)
    inside_mask = read_mask(inside(folder, "mask.png"))
    height, width = inside_mask.shape
    camera = OrthographicCamera(width, height)
    if normals == "fit":
        surface = NormalMap(plane_before(camera).normals, inside_mask)
    else:
        surface = _read_surface(folder, inside_mask)
    vectors = np.asarray(surface.normals, np.float64)
    used = inside_mask & (vectors[..., 2] > min_facing)

    def read(number: int) -> Photograph:
        with naming(f"{folder / 'filenames.txt'}"):
            path = inside(folder, names[number])
        photo = read_light(path, "linear")
        if photo.usable.shape != inside_mask.shape:
            raise ValueError(
                f"{path}: expected {inside_mask.shape} pixels, as mask.png has, got "
                f"{photo.usable.shape}"
            )
        image, known = photo.image, photo.usable
        direction = directions[number]
        cosine = vectors @ (direction / np.linalg.norm(direction))
        # Mask before the division, which makes white differ between channels.
        mask = (used & known & (cosine > min_cosine))[..., None] & (image < 1)
        light = image / intensities[number].astype(image.dtype)
        return Photograph(Coded(light), mask)

    return Photographs(
        folder.resolve().name,
        tuple(
            Scene(surface, camera, DirectionalLight(direction))
            for direction in directions
        ),
        names,
        # Masks exclude clipped samples.
        Film(clamp=False),
        read,
    )


def _read_rows(folder: Path, name: str, count: int) -> Float[np.ndarray, "count 3"]:
    path = inside(folder, name)
    table = read_table(path, 3)
    if len(table) != count or count == 0:
        raise ValueError(
            f"{path}: expected {count} lines, one for each photograph in "
            f"filenames.txt, got {len(table)}"
        )
    return table


def _check_lights(
    folder: Path, directions: np.ndarray, intensities: np.ndarray
) -> None:
    # Quotients and squares of intensities must fit in single precision.
    sound = (intensities > 1e-12) & (intensities < 1e12)
    for name, fine, wanted in (
        ("light_directions.txt", np.any(directions != 0, axis=1), "a vector but zero"),
        ("light_intensities.txt", sound.all(axis=1), "numbers > 0"),
    ):
        if not fine.all():
            line = int(np.argmin(fine))
            raise ValueError(f"{folder / name}: light {line + 1}: expected {wanted}")


def _read_surface(folder: Path, mask: Bool[np.ndarray, "height width"]) -> NormalMap:
    path = inside(folder, "Normal_gt.mat")
    if not path.exists():
        raise ValueError(
            f"{path}: expected the true normals, got no such file: without them, fit "
            "the normals too (phongfit maps --normals fit)"
        )
    data, wanted = read_bytes(path), (*mask.shape, 3)
    afford(len(data) + 2 * 8 * math.prod(wanted), "normals")
    try:
        return NormalMap(read_matrix(data, NORMALS, wanted), mask)
    except Exception as error:
        # A broken file makes this reader raise nearly anything.
        raise ValueError(f"{path}: {reason(error)}") from error
