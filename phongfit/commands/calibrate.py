"""`phongfit calibrate`: photographs with spheres in; lights, with errors, out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, UseAppendAction, arg

from phongfit.calibration.calibrate import calibrate
from phongfit.calibration.result import Calibration
from phongfit.commands.data import tell
from phongfit.commands.keeping import keeping
from phongfit.commands.options import EncodingName, OutFolder, WhiteLevel, optional
from phongfit.commands.progress import stage
from phongfit.files.calibrations import LIGHTS_FILE, save_calibration
from phongfit.files.captures import Capture, open_capture
from phongfit.files.encodings import parse_encoding
from phongfit.files.lp import write_lp

LIST_FILE = "lights.lp"
PICTURE_FILE = "calibration.png"
OURS = (LIGHTS_FILE, LIST_FILE, PICTURE_FILE)


@dataclass(frozen=True)
class Options:
    """Options of `phongfit calibrate`.

    Args:
        photographs: A folder of photographs of a standing camera, one lamp each, with
            chrome spheres in view, a matte one, or both.
        out: Folder to make: lights.json (lamps, camera, errors), lights.lp (directions
            alone, for other programs), calibration.png.
        sphere: A chrome sphere: x and y of its centre and its radius in pixels, from
            the upper left corner. Once for each sphere. Default: chrome and matte
            spheres are looked for; calibration.png shows the result.
        matte: A matte grey or white sphere, stated in the same way, from which the
            strengths of the lamps are found.
        sphere_radius: Radius of the chrome spheres, in the unit of all lengths.
        fov: The camera's angle of view, from the lower to the upper edge.
        orthographic: Parallel rays: a long lens, far away. The default without --fov.
        lamps: distant: parallel light, a direction each. near: a position each; needs
            two spheres.
        encoding: Encoding of the photographs' numbers, or the file of a response curve
            from `phongfit response`. Default: srgb for JPEG.
        white: The number in the photographs that is white, such as 4095 of 12 bits in
            PNGs of 16. Default: the largest of the format.
        ambient: A photograph without a lamp, which is subtracted from all others.
        flat: A photograph of a white card, by which all others are divided.
        overwrite: Replace an older calibration in OUT.
    """

    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")]

    out: OutFolder

    sphere: Annotated[
        UseAppendAction[tuple[tuple[float, ...], ...]], optional("X Y R")
    ] = ()

    matte: Annotated[tuple[float, float, float] | None, optional("X Y R")] = None

    sphere_radius: Annotated[float, arg(metavar="LENGTH")] = 1.0

    fov: Annotated[float | None, optional("DEGREES")] = None

    orthographic: bool = False

    lamps: Literal["distant", "near"] = "distant"

    encoding: EncodingName = None

    white: WhiteLevel = None

    ambient: Annotated[Path | None, optional("PHOTO")] = None

    flat: Annotated[Path | None, optional("PHOTO")] = None

    overwrite: bool = False


def main(options: Options) -> int:
    """Find the lamps of a capture by spheres in its photographs.

    A chrome sphere mirrors each lamp, a matte one is shaded by it. Directions are in
    the camera's axes: x right, y up, z towards the camera. Look at calibration.png
    before you use the numbers.

    For example:
      phongfit calibrate photos -o out/lights --sphere 179 565 88 --sphere 781 565 88
      phongfit calibrate photos -o out/matte --fov 14 --matte 179 155 81
      phongfit calibrate photos -o out/near --lamps near --sphere-radius 30 --fov 14
    """
    may_replace = OURS.__contains__ if options.overwrite else None
    if options.orthographic and options.fov is not None:
        raise ValueError("fov: expected it or --orthographic, got both")
    with keeping(options.out, may_replace) as (folder, drawing):
        capture = open_capture(
            options.photographs,
            parse_encoding(options.encoding),
            ambient=options.ambient,
            flat=options.flat,
            white=options.white,
        )
        tell(capture.notes)
        with stage("looking at the photographs"):
            found = _calibrate(capture, options)
        save_calibration(folder / LIGHTS_FILE, found)
        vectors = np.array([lamp.direction for lamp in found.lamps])
        names = [lamp.photograph for lamp in found.lamps]
        write_lp(folder / LIST_FILE, names, vectors)
        with drawing():
            print(found, flush=True)
            with stage("drawing"):
                _draw(folder / PICTURE_FILE, found, capture)
    return 0


def _calibrate(capture: Capture, options: Options) -> Calibration:
    circles = _threes(options.sphere)
    return calibrate(
        capture,
        chrome=circles if circles or options.matte is not None else None,
        matte=options.matte,
        sphere_radius=options.sphere_radius,
        fov=options.fov,
        lamps=options.lamps,
        names=capture.names,
    )


def _threes(given: tuple[tuple[float, ...], ...]) -> list[tuple[float, ...]]:
    """Circles as triples, from repeated options or several in one option."""
    found = []
    for numbers in given:
        if len(numbers) % 3 or not numbers:
            raise ValueError(
                f"sphere: expected x, y and radius, got {len(numbers)} numbers"
            )
        found += [numbers[at : at + 3] for at in range(0, len(numbers), 3)]
    return found


def _draw(path: Path, found: Calibration, capture: Capture) -> None:
    # Imported here, since matplotlib takes long to import.
    from phongfit.report.calibration import brightest, calibration_figure
    from phongfit.report.style import png

    path.write_bytes(png(calibration_figure(found, brightest(capture)), 140))
