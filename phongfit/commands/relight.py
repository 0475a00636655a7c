"""`phongfit relight`: maps and a list of lights in, a picture for each light out."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from phongfit.commands.data import DataOptions, stack_data
from phongfit.commands.options import (
    EncodingName,
    OutFolder,
    optional,
    read_lights,
    refuse,
)
from phongfit.commands.progress import stage
from phongfit.files.encodings import parse_encoding
from phongfit.files.fits import DataRecord
from phongfit.files.formats import WRITERS
from phongfit.files.images import write_image
from phongfit.files.inputs import naming
from phongfit.files.matching import base_name
from phongfit.files.outputs import replacing_folder
from phongfit.files.zarrs import is_store
from phongfit.maps.folder import load_folder
from phongfit.maps.relighting import relit
from phongfit.rendering.film import Film
from phongfit.scene import Scene

OTHER = ".png"
"""Suffix of a picture whose name has no suffix that can be written."""


@dataclass(frozen=True)
class Options:
    """Options of `phongfit relight`.

    Args:
        maps: The folder that `phongfit maps` made.
        lights: An .lp, or the lights.json that `phongfit calibrate` writes.
        out: Folder to make: a picture for each light, named as in the list.
        photographs: The folder that the maps were fitted to. Its residual images,
            interpolated between the lamps, are added: interreflections and real
            shadows, in place of shadows by height.
        shadows: Cast shadows, by the height that is integrated from the normals.
        ambient: Ambient light. Default: that of the photographs.
        distance: Distance of the surface from a pinhole camera, if the maps' geometry
            did not have it.
        encoding: Encoding of the pictures. Default: that of the photographs.
        overwrite: Replace older pictures in OUT.
    """

    maps: Annotated[Positional[Path], arg(metavar="MAPS")]
    lights: Annotated[Path, arg(metavar="FILE")]
    out: OutFolder
    photographs: Annotated[Path | None, optional("FOLDER")] = None
    shadows: bool = True
    ambient: Annotated[float | None, optional("X")] = None
    distance: Annotated[float | None, optional("LENGTH")] = None
    encoding: EncodingName = None
    overwrite: bool = False


def main(options: Options) -> int:
    """Show an object under other lights: diffuse light, highlights, shadows.

    For example:
      phongfit relight out/maps --lights dome.lp -o out/relit
      phongfit relight out/maps --lights out/lights/lights.json -o out/measured
      phongfit relight out/coin --lights dome.lp --photographs coin -o out/as-seen
    """
    maps, record, _ = load_folder(options.maps)
    encoding = parse_encoding(options.encoding) or record.encoding
    if encoding is None:
        raise ValueError(
            "encoding: expected --encoding linear or srgb, since "
            f"{options.maps}, of an older version, does not say it"
        )
    if maps.camera is None and options.lights.suffix.lower() == ".lp":
        raise ValueError("camera: maps of an older version do not have it")
    listed, lights = read_lights(options.lights, maps.camera)
    names = picture_names(listed)
    ambient = options.ambient
    if ambient is not None and not ambient >= 0:
        raise ValueError(f"ambient: expected a number ≥ 0, got {ambient:g}")

    if options.photographs is not None:
        refuse(options, "shadows", "photographs have theirs, expected one of both")

    def may_replace(name: str) -> bool:
        return options.overwrite and name in names

    with replacing_folder(options.out, may_replace) as folder:
        photographs = None
        if options.photographs is not None:
            with stage("reading the photographs"):
                scenes, stack = _photographs(options.photographs, record.data)
            if maps.strengths is not None:
                scenes = maps.strengths.lit(scenes)
            photographs = scenes, stack
        with stage("integrating the normals"):
            surface = maps.height(distance=options.distance)
        pictures = relit(
            maps,
            lights,
            surface,
            ambient=maps.ambient_light if ambient is None else ambient,
            shadows=options.shadows,
            film=Film(clamp=False),
            photographs=photographs,
        )
        with stage("relighting"):
            for name, picture in zip(names, pictures, strict=True):
                write_image(folder / name, picture, encoding)
    print(surface)
    others = sum(a != b for a, b in zip(names, map(base_name, listed), strict=True))
    print(
        f"{options.out}: {len(names)} pictures, {encoding}"
        + (f"; {others} of them as {OTHER}" if others else "")
    )
    return 0


def _photographs(folder: Path, data: DataRecord) -> tuple[Sequence[Scene], Any]:
    """Scenes and images to which maps were fitted, read with the recorded settings.

    **Raises:** `ValueError` that names a file, such as one that the maps do not record.
    """
    if is_store(folder):
        raise ValueError(f"photographs: expected a folder, got a zarr array: {folder}")
    with naming("photographs"):
        stack, read = stack_data(DataOptions(folder).like(data.reading))
    others = [
        f for f, digest in read.inputs.items() if digest not in data.inputs.values()
    ]
    if others:
        raise ValueError(
            f"photographs: expected those of the maps, {data.name}; in {folder} "
            f"{others[0]} is another file"
        )
    return stack.photographs.scenes, stack


def picture_names(listed: Sequence[str]) -> list[str]:
    """File names of the pictures, with a new suffix where 8 bits cannot be written.

    **Raises:** `ValueError` if two names would be equal.
    """
    names = []
    for name in map(base_name, listed):
        own = Path(name)
        depths = WRITERS.get(own.suffix.lower(), {32: None})
        name = name if min(depths) == 8 else f"{name}{OTHER}"
        if name in names:
            raise ValueError(f"lights: expected different names, got {name} twice")
        names.append(name)
    return names
