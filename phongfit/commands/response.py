"""`phongfit response`: photographs in; what their numbers are out."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from phongfit.calibration.response import Response, fit_response
from phongfit.commands.options import OutFile, WhiteLevel, optional, refuse
from phongfit.commands.progress import stage
from phongfit.files.capture_data import DIRECTION, open_captured
from phongfit.files.encodings import RESPONSE_FORMAT
from phongfit.files.images import read_image, read_mask
from phongfit.files.inputs import sparing
from phongfit.files.outputs import check_file, write_json
from phongfit.files.photographs import (
    AbstractImages,
    list_photographs,
    open_photographs,
)
from phongfit.rendering.response import AS_STORED


@dataclass(frozen=True)
class Options:
    """Options of `phongfit response`.

    Args:
        photographs: A folder of photographs of a standing camera: of a matte sphere
            under known lamps, with --matte; or of one view, exposed differently.
        out: The .json file to write, which every --encoding accepts.
        matte: The matte sphere: x and y of its centre and its radius in pixels, from
            the upper left corner.
        lights: With --matte: its lamps, as `phongfit calibrate` writes them from
            chrome spheres, or an .lp. Default: those in the folder.
        exposures: Without --matte: relative exposure of each photograph, in the order
            of their names. Default: by their EXIF data.
        mask: White where pixels may be used.
        white: The number in the photographs that is white, such as 4095 for 12 bits in
            PNGs of 16. Default: the largest of the format.
    """

    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    out: OutFile
    matte: Annotated[tuple[float, float, float] | None, optional("X Y R")] = None
    lights: Annotated[Path | None, optional("FILE")] = None
    exposures: Annotated[tuple[float, ...], optional("E ...")] = ()
    mask: Annotated[Path | None, optional("FILE")] = None
    white: WhiteLevel = None


def main(options: Options) -> int:
    """Check a camera's response, and fit it where it is neither linear nor sRGB.

    States whether linear or sRGB describes the photographs, and by how many standard
    deviations it does not. The fitted curve is smooth and rising, and the same for all
    channels.

    For example:
      phongfit response brackets -o response.json --exposures 1 2 4 8
      phongfit response photos -o response.json --matte 179 155 81 --lights out/lights
      phongfit calibrate photos -o out/linear --encoding response.json
    """
    check_file(options.out)
    if options.out.suffix.lower() != ".json":
        raise ValueError(f"out: expected a .json file, got {options.out}")
    with sparing(options.out):
        paths, given = _of_matte(options) if options.matte else _of_brackets(options)
        mask = None if options.mask is None else read_mask(options.mask)
        photographs, names = _Stored(paths, options.white), [p.name for p in paths]
        with stage("fitting the response"):
            found = fit_response(photographs, mask=mask, names=names, **given)
    write_json(options.out, _record(found))
    print(found)
    use = found.encoding if isinstance(found.encoding, str) else options.out
    print(f"\n{options.out}: the curve; use --encoding {use}")
    return 0


class _Stored(AbstractImages):
    """Encoded numbers of photographs, relative to white, one in memory at a time."""

    def __init__(self, paths: Sequence[Path], white: int | None):
        self.paths, self.white = paths, white

    def __len__(self) -> int:
        return len(self.paths)

    def image(self, number: int) -> np.ndarray:
        return read_image(self.paths[number], AS_STORED, white=self.white)


def _of_matte(options: Options) -> tuple[list[Path], dict[str, Any]]:
    """Photographs of a matte sphere, and their scenes."""
    refuse(options, "exposures", "expected them or --matte, got both")
    data = open_captured(
        options.photographs,
        AS_STORED,
        sphere=options.matte,
        lights=options.lights,
        white=options.white,
    )
    if DIRECTION in data.unknown:
        raise ValueError(
            "lights: expected lights.json or an .lp, the lamps that shine on the matte "
            "sphere, got none; `phongfit calibrate` finds them by chrome spheres"
        )
    folder = options.photographs
    folder = folder if folder.is_dir() else folder.parent
    return [folder / name for name in data.names], {"scenes": data.scenes}


def _of_brackets(options: Options) -> tuple[Sequence[Path], dict[str, Any]]:
    """Photographs of one view, and their exposures."""
    refuse(options, "lights", "expected --matte with them, the sphere they shine on")
    paths, exposures = list_photographs(options.photographs), options.exposures
    series = open_photographs(paths, AS_STORED, white=options.white)
    if exposures and len(exposures) != len(paths):
        names = ", ".join(path.name for path in paths)
        raise ValueError(
            f"exposures: expected {len(paths)}, one for each of {names}, "
            f"got {len(exposures)}"
        )
    if not exposures:
        exposures = series.relative_exposures.tolist()
        if np.ptp(exposures) == 0:
            raise ValueError(
                "exposures: expected --exposures, how much light each photograph got, "
                "since their EXIF data do not say that they differ; or --matte"
            )
        for note in series.notes:
            print(note)
    return paths, {"exposures": exposures}


def _record(found: Response) -> dict:
    return {
        "format": RESPONSE_FORMAT,
        "version": 1,
        "light": list(found.curve.light),
        "light_error": found.error.tolist(),
        "numbers_seen": list(found.seen),
        "checks": {name: check._asdict() for name, check in found.checks.items()},
        "warnings": list(found.warnings),
    }
