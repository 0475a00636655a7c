"""Folders of maps: `maps.npz` for programs, floating-point TIFF for other tools."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from phongfit.files.arguments import describe
from phongfit.files.arrays import read_array, write_array
from phongfit.files.encodings import EncodingField, describe_encoding
from phongfit.files.fits import DataRecord, Edges, LossName, made_with
from phongfit.files.formats import WRITERS
from phongfit.files.images import write_image
from phongfit.files.inputs import inside, naming
from phongfit.files.outputs import replacing, write_json
from phongfit.files.records import AbstractRecord, Colour, Many, read_record
from phongfit.files.schema import MaterialRecord, SpecularRecord
from phongfit.maps.pixel.settings import MAP_PARAMETERS, MOST_MATERIALS
from phongfit.maps.result import BasisMaterials, Maps, StrengthsName, load_maps
from phongfit.reflectance import AbstractSpecular
from phongfit.rendering.film import Encoding

MAPS_FORMAT = "phongfit maps"
RECORD_FILE = "maps.json"
ARRAYS_FILE = "maps.npz"
NORMALS_FILE = "normals.npy"
NORMALS_PICTURE = "normals.png"


class MapOptions(AbstractRecord):
    """Options of the fit of maps: see [`fit_maps`][]."""

    unknowns: Many[str] = list(MAP_PARAMETERS)
    per_channel: Many[str] = ["ambient", "diffuse", "specular"]
    known: MaterialRecord | None = None
    bounds: dict[str, Edges] = {}
    noise: Annotated[float, Field(gt=0)] | None = None
    loss: LossName = "linear"
    normals: Literal["given", "fit"] = "given"
    materials: (
        Annotated[int, Field(ge=1, le=MOST_MATERIALS)] | Literal["auto"] | None
    ) = None
    passes: Annotated[int, Field(ge=1)] = 1
    strengths: StrengthsName = "given"


class SharedRecord(AbstractRecord):
    """A material that pixels share; the error of an unidentified number is `null`."""

    share: float
    specular: Colour
    shininess: float
    stderr_specular: Many[float | None]
    stderr_shininess: float | None


class MapsRecord(AbstractRecord):
    """`maps.json`: description of the arrays beside it, and of the fit.

    `encoding` is that of the photographs; version 1 does not have it. `materials` are
    shared by pixels, and `criterion` is BIC of 1, 2, … materials.
    """

    format: Literal["phongfit maps"]
    version: Literal[1, 2]
    data: DataRecord
    settings: MapOptions
    model: SpecularRecord
    encoding: EncodingField | None = None
    materials: Many[SharedRecord] | None = None
    criterion: Many[float] | None = None
    made_with: dict[str, str]


def save_folder(
    folder: Path,
    maps: Maps,
    *,
    data: DataRecord,
    settings: MapOptions,
    model: AbstractSpecular,
    encoding: Encoding,
) -> None:
    """Write maps into an existing folder.

    Each map has a TIFF, and another for its errors, which are infinite for unidentified
    pixels. Normals are written as numbers, and as a picture of (n + 1) / 2.

    **Arguments:** `encoding`: of the photographs.

    **Raises:** `OSError` that names the file.
    """
    maps.save(folder / ARRAYS_FILE)
    write_array(folder / NORMALS_FILE, maps.normals)
    # Encoded as in other programs; black outside, which no normal is encoded as.
    coloured = np.where(maps.normals.any(axis=-1, keepdims=True), maps.normals, -1)
    write_image(folder / NORMALS_PICTURE, (coloured + 1) / 2, "linear", 16)
    for name in maps.unknowns:
        _write_tiff(folder / f"{name}.tif", getattr(maps, name))
        _write_tiff(folder / f"stderr_{name}.tif", getattr(maps.stderr, name))
    content = {
        "format": MAPS_FORMAT,
        "version": 2,
        "data": data.model_dump(),
        "settings": settings.model_dump(),
        "model": describe(model),
        "encoding": describe_encoding(encoding),
        **_shared(maps.materials),
        "made_with": made_with(),
    }
    write_json(folder / RECORD_FILE, content)


def _shared(materials: BasisMaterials | None) -> dict[str, Any]:
    """Shared materials in the form of the record."""
    if materials is None:
        return {}
    shared = [
        {
            "share": float(share),
            "specular": materials.specular[k].tolist(),
            "shininess": float(materials.shininess[k]),
            "stderr_specular": [_finite(e) for e in materials.stderr_specular[k]],
            "stderr_shininess": _finite(materials.stderr_shininess[k]),
        }
        for k, share in enumerate(materials.shares)
    ]
    return {"materials": shared, "criterion": materials.criterion.tolist()}


def _finite(error: float) -> float | None:
    return float(error) if np.isfinite(error) else None


def _write_tiff(path: Path, array: np.ndarray) -> None:
    # Not with `write_image`, which does not allow infinite numbers.
    numbers = np.broadcast_to(array, (*array.shape[:2], 3)).astype(np.float32)
    with replacing(path) as temporary:
        WRITERS[".tif"][32](temporary, np.ascontiguousarray(numbers))


def load_folder(folder: Path) -> tuple[Maps, MapsRecord, np.ndarray]:
    """Read the maps of a folder, their record, and the normals.

    **Raises:** `ValueError` that names the file and its fault.
    """
    with naming(str(folder)):
        record, arrays, normals = (
            inside(folder, name) for name in (RECORD_FILE, ARRAYS_FILE, NORMALS_FILE)
        )
    maps, read = load_maps(arrays), read_record(record, MapsRecord)
    seen = _normals(normals, maps)
    if maps.specular_model is None:
        # Older versions wrote normals and model beside `maps.npz` only.
        given = np.where(seen.any(axis=-1), 0, np.inf)
        maps = dataclasses.replace(
            maps,
            normals=seen,
            normals_stderr=given,
            specular_model=read.model.build(),
        )
    return maps, read, seen


def _normals(path: Path, maps: Maps) -> np.ndarray:
    normals = read_array(path, "normals")
    wanted = (*maps.flags.shape, 3)
    if normals.shape != wanted or not np.isfinite(normals).all():
        raise ValueError(
            f"{path}: expected finite numbers of shape {wanted}, got {normals.dtype} "
            f"of shape {normals.shape}"
        )
    return normals
