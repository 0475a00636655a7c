"""Question: how accurate are normals that are fitted with the material?

The data are photographs under known lamps of an object with known normals, in
DiLiGenT's layout or an RTI folder with an `.lp` and a `normals.png`. phongfit's
normals, and those of least squares for a matte surface, are compared with the truth at
the same pixels.

??? cite "Source"
    Woodham, *Photometric method for determining surface orientation from multiple
    images*, Optical Engineering 19(1), 1980; Shi et al., *A benchmark dataset and
    evaluation for non-Lambertian and uncalibrated photometric stereo*, TPAMI 41(2),
    2019: least squares as it is published.
"""

import dataclasses
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

import phongfit as pf
from experiments.output import (
    JsonFile,
    PictureFile,
    check_outputs,
    save_numbers,
    save_picture,
)
from experiments.style import page, styled
from phongfit.cli import run
from phongfit.commands.options import EncodingName
from phongfit.files.capture_data import open_captured
from phongfit.files.dataset import Photographs
from phongfit.files.diligent import is_diligent, open_diligent
from phongfit.files.encodings import parse_encoding
from phongfit.rendering.film import Encoding, encode

# Luma of BT.601, as the published recipe has it.
LUMA = np.array([0.299, 0.587, 0.114])
# Wider than the default for ρ_d and ρ_s: polished metal and paint exceed 1.
BOUNDS = {"diffuse": (0.0, 2.0), "specular": (0.0, 8.0), "shininess": (1.0, 1000.0)}
# File of the true normals in an RTI folder.
TRUTH = "normals.png"


@dataclasses.dataclass(frozen=True)
class Photos:
    """Photographs of an object, and its true normals.

    - `photographs`: files, and scenes with their lamps;
    - `truth`: true unit normals in the camera's axes (x right, y up, z to the camera);
    - `mask`: pixels where the truth is known;
    - `stored`: whether least squares is also tried on values as stored, not decoded.
    """

    photographs: Photographs
    truth: Float[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]
    stored: bool


def read(folder: Path, encoding: Encoding | None) -> Photos:
    """Read a folder in DiLiGenT's layout, or an RTI folder.

    **Arguments:** `encoding`: of an RTI folder's photographs; `None` if their format
    fixes it.

    **Raises:** `ValueError` that names the folder, if it has no true normals, or the
    file that cannot be read.
    """
    if is_diligent(folder):
        data = open_diligent(folder)
        gbuffer = pf.geometry.trace(data.scenes[0].surface, data.scenes[0].camera)
        normals, mask = np.asarray(gbuffer.normal, float), np.asarray(gbuffer.mask)
        return Photos(data, normals, mask, False)
    source = folder / "Dome" if (folder / "Dome").is_dir() else folder
    truth = next((p / TRUTH for p in (source, folder) if (p / TRUTH).exists()), None)
    if truth is None:
        raise ValueError(
            f"{folder}: expected true normals: Normal_gt.mat in DiLiGenT's layout, or "
            f"{TRUTH} beside the photographs"
        )
    data = open_captured(source, encoding, normals="fit")
    # Stored as (normal + 1) / 2; outside the object the colour is no unit vector.
    normals = 2 * np.asarray(pf.read_image(truth, "linear"), float) - 1
    length = np.linalg.norm(normals, axis=-1)
    mask = abs(length - 1) < 0.1
    normals = normals / np.where(mask, length, 1)[..., None]
    return Photos(data, normals, mask, True)


def every_nth(photos: Photos, every: int) -> Photos:
    """Keep one of every `every` photographs, beginning with the first."""
    data, pick = photos.photographs, slice(None, None, every)
    chosen = range(len(data.names))[pick]

    def read_one(number: int):
        """Read one of the kept photographs, counted from 0."""
        return data.read(chosen[number])

    part = dataclasses.replace(
        data, scenes=data.scenes[pick], names=data.names[pick], read=read_one
    )
    if data.film_of is not None:
        film_of = data.film_of
        part = dataclasses.replace(part, film_of=lambda n: film_of(chosen[n]))
    return dataclasses.replace(photos, photographs=part)


def least_squares(
    images: Float[np.ndarray, "images height width 3"],
    directions: Float[np.ndarray, "images 3"],
) -> Float[np.ndarray, "height width 3"]:
    """Normals of a matte surface by least squares, from luma clipped at 1.

    **Arguments:** `directions`: to the lamps, of the length of their intensity.

    **Returns:** unit normals, or 0 where a pixel is black.
    """
    grey = np.minimum(images @ LUMA, 1)
    normals = np.einsum("dk,khw->hwd", np.linalg.pinv(directions), grey)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


def angles(
    normals: Float[np.ndarray, "height width 3"], photos: Photos
) -> Float[np.ndarray, " pixels"]:
    """Angles of normals from the truth, degrees, at all pixels where it is known."""
    cosine = np.sum(normals * photos.truth, axis=-1)[photos.mask]
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def compare(
    photos: Photos, materials: int | Literal["auto"] | None = None
) -> tuple[dict[str, Any], pf.Maps]:
    """Angular errors of both methods, in degrees, and phongfit's maps.

    **Arguments:** `materials`: number of materials that the pixels share; `"auto"`
    finds it; `None`: each pixel has its own.

    **Returns:** numbers by name; `identified` and `lamps_in_a_plane` are fractions of
    the pixels with a known truth.
    """
    data = photos.photographs
    directions = np.array([_direction(scene) for scene in data.scenes])
    loaded = data.load()
    images = np.stack(loaded.images)

    def matte(values: np.ndarray) -> float:
        """Mean angular error of least squares on these values, degrees."""
        return float(angles(least_squares(values, directions), photos).mean())

    numbers: dict[str, Any] = {
        "photographs": len(images),
        "pixels": int(photos.mask.sum()),
        "least_squares": matte(images),
    }
    if photos.stored:
        stored = np.asarray(encode(images, "srgb"))
        numbers["least_squares_of_stored_values"] = matte(stored)
    inside, shape = photos.mask[..., None], images[0].shape
    masks = [
        np.broadcast_to((mask if mask.ndim == 3 else mask[..., None]) & inside, shape)
        for mask in loaded.masks
    ]
    maps = pf.fit_maps(
        data.scenes,
        images,
        mask=masks,
        film=loaded.films,
        normals="fit",
        # One pass, as the published methods that the table compares have.
        passes=1,
        unknowns=("diffuse", "specular", "shininess"),
        # A highlight has the lamp's colour, and few lamps identify a ρ_s for each
        # channel.
        per_channel=("diffuse",),
        bounds=BOUNDS,
        materials=materials,
    )
    degrees_off = angles(maps.normals, photos)
    errors = maps.normals_stderr[photos.mask]
    identified = np.isfinite(errors)
    numbers |= {
        "mean_angular_error": float(degrees_off.mean()),
        "median_angular_error": float(np.median(degrees_off)),
        "identified": float(identified.mean()),
        "mean_angular_error_where_identified": float(degrees_off[identified].mean())
        if identified.any()
        else None,
        "least_standard_error": float(errors.min()),
        "lamps_in_a_plane": float(maps.flagged(pf.Flag.IN_A_PLANE)[photos.mask].mean()),
    }
    return numbers, maps


def _direction(scene: pf.Scene) -> np.ndarray:
    """Direction to the scene's only lamp, of the length of its mean intensity."""
    (light,) = scene.lights
    assert isinstance(light, pf.DirectionalLight)
    direction = np.asarray(light.direction, float)
    strength = np.asarray(light.intensity, float).mean()
    return strength * direction / np.linalg.norm(direction)


@styled
def draw(photos: Photos, maps: pf.Maps) -> Figure:
    """Draw true and fitted normals, the angles between them, and the stated errors."""
    drawing = page(2.6)
    panels = drawing.subplots(1, 4)
    for axes, normals, title in (
        (panels[0], photos.truth, "true normals"),
        (panels[1], maps.normals, "found"),
    ):
        axes.imshow(np.where(photos.mask[..., None], (normals + 1) / 2, 1))
        axes.set_title(title)
    cosine = np.clip(np.sum(maps.normals * photos.truth, axis=-1), -1, 1)
    for axes, degrees, title in (
        (panels[2], np.rad2deg(np.arccos(cosine)), "degrees off"),
        (panels[3], maps.normals_stderr, "standard error, degrees"),
    ):
        shown = np.where(photos.mask & np.isfinite(degrees), degrees, np.nan)
        drawn = axes.imshow(shown, vmin=0, vmax=6, cmap="viridis")
        drawing.colorbar(drawn, ax=axes, fraction=0.046)
        axes.set_title(title)
    for axes in panels:
        axes.set(xticks=[], yticks=[])
        axes.grid(False)
    return drawing


def main(
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    every: int = 1,
    materials: Literal["own", "auto", 1, 2, 3, 4, 5, 6] = "own",
    encoding: EncodingName = None,
    picture: PictureFile = Path("out/photometric_stereo.png"),
    json: JsonFile = None,
) -> int:
    """How accurate are normals that are fitted with the material?

    Prints the mean angular error of phongfit's normals, and of least squares on the
    same pixels; draws the normals and their errors.

    Args:
        folder: DiLiGenT's layout, or photographs with an .lp and a normals.png.
        every: Use only every N-th photograph, from the first on.
        materials: Number of materials that the pixels share; auto finds it; own: each
            pixel has its own.
        encoding: Encoding of the photographs' numbers, if their format does not fix it.
        picture: File for the picture.
        json: File for the numbers: mean_angular_error, least_squares, and more.
    """
    if not folder.is_dir():
        print(f"skipped: there is no folder {folder}")
        return 0
    check_outputs(picture, json)
    photos = every_nth(read(folder, parse_encoding(encoding)), every)
    numbers, maps = compare(photos, None if materials == "own" else materials)
    for name, number in numbers.items():
        words = re.sub("_", " ", name)
        shown = f"{number:.4g}" if isinstance(number, float) else number
        print(f"{words:<40} {shown}")
    print(maps)
    save_picture(picture, draw(photos, maps))
    save_numbers(json, numbers)
    return 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.photometric_stereo"))
