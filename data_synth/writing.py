"""Writing a data set into a folder: PNG or TIFF images, JSON, and a contact sheet."""

import dataclasses
import os
import re
from collections.abc import Sequence
from pathlib import Path

from data_synth.sheet import contact_sheet
from phongfit import AbstractLight, Scene
from phongfit.files.dataset import Dataset
from phongfit.files.images import Bits, write_image
from phongfit.files.outputs import replacing_folder
from phongfit.files.scenes import SCENE_FILE, TRUTH_FILE, save_scene, save_truth
from phongfit.files.schema import ImageRecord

SHEET_FILE = "contact_sheet.png"

OURS = re.compile(
    rf"\d{{3,}}(_mask)?\.(png|tif)|scene_\w+\.(npy|png)"
    rf"|{re.escape(SCENE_FILE)}|{re.escape(TRUTH_FILE)}|{re.escape(SHEET_FILE)}"
)
"""Names that [`write_dataset`][] gives to files: those that it may replace."""


def write_dataset(
    dataset: Dataset,
    out_dir: str | os.PathLike[str],
    *,
    noise: float | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> None:
    """Write images, `scene.json`, `truth.json` and a contact sheet: all or nothing.

    **Arguments:**

    - `dataset`: of one surface, camera, ambient light and film: those of its first
        image are written.
    - `out_dir`: the folder to make, with its parents. If it exists it must be empty.
    - `noise`, `seed`: what the images were made with, for `truth.json` and the sheet;
        `None` if not known.
    - `overwrite`: replace an older data set in `out_dir`. A folder with any other file
        is refused nevertheless.

    **Raises:** `OSError` if the folder cannot be written, `ValueError` for a data set
    that the files cannot hold.
    """
    with replacing_folder(out_dir, _is_ours if overwrite else None) as folder:
        entries = _write_images(folder, dataset)
        scene = _whole_scene(dataset.scenes)
        save_scene(folder / SCENE_FILE, scene, film=dataset.films[0], images=entries)
        if dataset.truth is not None:
            save_truth(folder / TRUTH_FILE, dataset.truth, noise=noise, seed=seed)
        sheet = contact_sheet(dataset, noise=noise, seed=seed)
        sheet.savefig(folder / SHEET_FILE, dpi=120)


def _is_ours(name: str) -> bool:
    """Whether a file in the folder has a name that [`write_dataset`][] gives."""
    return OURS.fullmatch(name) is not None


def _write_images(folder: Path, dataset: Dataset) -> list[ImageRecord]:
    """Write images and masks; returns each image's file, lights and mask.

    A mask that is true everywhere is not written.
    """
    lights = _all_lights(dataset.scenes)
    film, entries = dataset.films[0], []
    for scene, image, mask, name in zip(
        dataset.scenes, dataset.images, dataset.masks, dataset.names, strict=True
    ):
        write_image(folder / name, image, film.encoding, _file_bits(film.bits))
        mask_name = None
        if not mask.all():
            mask_name = f"{Path(name).stem}_mask.png"
            write_image(folder / mask_name, mask.astype(float), "linear")
        on = [_index(lights, light) for light in scene.lights]
        entries.append(ImageRecord(file=name, lights=on, mask=mask_name))
    return entries


def _file_bits(bits: int | None) -> Bits:
    """Bits of a file's samples: 8 or 16, or 32 (floats) for images not rounded."""
    match bits:
        case None:
            return 32
        case 8 | 16:
            return bits
    raise ValueError(f"bits: expected 8, 16 or None, got {bits}")


def _all_lights(scenes: Sequence[Scene]) -> list[AbstractLight]:
    """Each light of the scenes once, in order of first use.

    Lights are compared by identity: two with equal values are two lights.
    """
    lights: list[AbstractLight] = []
    for scene in scenes:
        for light in scene.lights:
            if not any(light is known for known in lights):
                lights.append(light)
    return lights


def _index(lights: Sequence[AbstractLight], light: AbstractLight) -> int:
    """Position of this very light in the list."""
    return next(index for index, known in enumerate(lights) if known is light)


def _whole_scene(scenes: Sequence[Scene]) -> Scene:
    """The first of `scenes`, with the lights of all of them."""
    return dataclasses.replace(scenes[0], lights=_all_lights(scenes))
