"""Materials by name: from a preset, an `.mtl` library or a JSON file of phongfit."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from phongfit.files.arguments import describe
from phongfit.files.fits import FIT_FORMAT, FitRecord, check_fit
from phongfit.files.inputs import naming, naming_field
from phongfit.files.mtl import read_mtl
from phongfit.files.outputs import write_json
from phongfit.files.records import AbstractRecord, read_one_of
from phongfit.files.schema import (
    TRUTH_FORMAT,
    MaterialRecord,
    SpecularRecord,
    TruthRecord,
    describe_material,
)
from phongfit.material import Material, preset
from phongfit.reflectance import AbstractSpecular, BlinnPhong

MATERIAL_FORMAT = "phongfit material"


class MaterialFile(AbstractRecord):
    """The JSON file of one material and its specular model."""

    format: Literal["phongfit material"]
    version: Literal[1]
    name: str = "material"
    model: SpecularRecord | None = None
    material: MaterialRecord


class NamedMaterial(NamedTuple):
    """A material with its name, and its specular model if the source states one."""

    name: str
    material: Material
    model: AbstractSpecular | None


FORMATS: Mapping[str, type[AbstractRecord]] = {
    FIT_FORMAT: FitRecord,
    TRUTH_FORMAT: TruthRecord,
    MATERIAL_FORMAT: MaterialFile,
}


def read_material(source: str) -> NamedMaterial:
    """A material by its name, or from its file.

    **Arguments:** `source`: `preset:NAME`, an `.mtl` file of one material,
    `FILE.mtl:NAME` for one of several, or a `.json`: a fit, a truth, a material.

    **Raises:** `ValueError` that describes the error.
    """
    kind, _, name = source.partition(":")
    if kind == "preset":
        # OpenGL's materials are defined for Blinn-Phong highlights.
        return NamedMaterial(name, preset(name), BlinnPhong())
    file, colon, name = source.rpartition(":")
    if colon and file.lower().endswith(".mtl"):
        return _from_library(Path(file), name)
    match Path(source).suffix.lower():
        case ".mtl":
            return _from_library(Path(source), None)
        case ".json":
            return _from_record(Path(source))
    raise ValueError(
        f"material: expected preset:NAME, an .mtl or a .json file, got {source!r}"
    )


def _from_library(path: Path, name: str | None) -> NamedMaterial:
    materials = read_mtl(path)
    if name is None and len(materials) == 1:
        (name,) = materials
    if name not in materials:
        came = "none" if name is None else repr(name)
        known = ", ".join(f"{path}:{known}" for known in materials) or "it has none"
        raise ValueError(f"{path}: expected one of its materials ({known}), got {came}")
    return NamedMaterial(name, materials[name], BlinnPhong())


def _from_record(path: Path) -> NamedMaterial:
    record: Any = read_one_of(path, FORMATS)
    with naming(str(path)):
        if isinstance(record, FitRecord):
            check_fit(record)
            return NamedMaterial(record.data.name, record.build(), record.specular())
        with naming_field("material"):
            material = record.material.build()
        if isinstance(record, TruthRecord):
            return NamedMaterial(path.stem, material, None)
        model = record.model.build() if record.model else BlinnPhong()
        return NamedMaterial(record.name, material, model)


def write_material(
    path: str | os.PathLike[str],
    name: str,
    material: Material,
    model: AbstractSpecular,
) -> None:
    """Write one material to a JSON file that [`read_material`][] reads.

    **Raises:** `ValueError` for parameters that are not () or (3,), `OSError` that
    names the file.
    """
    content = {
        "format": MATERIAL_FORMAT,
        "version": 1,
        "name": name,
        "model": describe(model),
        "material": describe_material(material),
    }
    write_json(path, content)
