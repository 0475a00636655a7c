"""Photographs from a data set's folder, or one image with its scene file."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from tyro.conf import Positional, arg

from phongfit.commands.options import EncodingName, WhiteLevel, changed, optional
from phongfit.files.dataset import Dataset, Photographs
from phongfit.files.fits import DataRecord, DataSettings
from phongfit.files.inputs import recording
from phongfit.files.opening import open_data
from phongfit.files.scenes import TRUTH_FILE
from phongfit.files.seen import SOUGHT
from phongfit.maps.stacks import DatasetStack
from phongfit.plain import readable

T = TypeVar("T")


@dataclass(frozen=True)
class DataOptions:
    """The photographs to fit, and how they are read.

    Args:
        dataset: A data set's folder, as `phongfit synth` makes it or in DiLiGenT's
            layout; one image, with --scene; or photographs, one or a folder of them,
            with --sphere or --normals.
        scene: With one image: its scene.json.
        sphere: The photographs show a ball: x and y of its centre and its radius in
            pixels, from the upper left corner.
        normals: The photographs show a surface with these normals: an .npz with
            normals, and optionally positions and mask, or an .npy. fit: fit the
            normals too, with `phongfit maps`, under known lights.
        lights: With photographs: their lights, from `phongfit calibrate`, or an .lp
            list, in which a photograph's lamp is found by its name. Default: those in
            the folder; else the lights are fitted.
        fov: With photographs: the camera's angle of view, from the lower to the upper
            edge; 0 for parallel rays, as of a long lens from far away. fit: find it,
            with --normals fit and distant lamps. Default: that of the calibration, else
            by the photographs' EXIF data, else 0.
        mask: With an image or photographs: white where a pixel may be used. Default,
            with a folder of photographs: the mask in it, mask.png or NAME.mask.png, if
            there is one.
        encoding: With an image or photographs: encoding of their numbers, or the file
            of a response curve from `phongfit response`. Default: that of the scene
            file, and srgb for JPEG.
        white: With an image or photographs: the number in the files that is white, such
            as 4095 for 12 bits in PNGs of 16. Default: that of the scene file, and the
            largest of the format.
        min_cosine: With photographs: samples with n·l up to this are left out, since
            there interreflections dominate.
        min_facing: With photographs: pixels with n·v up to this are left out, since
            pixels at the rim average over many normals.
        room_light: With photographs: ambient light, which stands for light reflected
            by the room; 0 for none.
    """

    dataset: Annotated[Positional[Path], arg(metavar="DATASET")]

    scene: Annotated[Path | None, optional("FILE")] = None

    sphere: Annotated[tuple[float, float, float] | None, optional("X Y R")] = None

    normals: Annotated[Path | None, optional("FILE|fit")] = None

    lights: Annotated[Path | None, optional("FILE")] = None

    fov: Annotated[float | Literal["fit"] | None, optional("DEGREES|fit")] = None

    mask: Annotated[Path | None, optional("FILE")] = None

    encoding: EncodingName = None

    white: WhiteLevel = None

    min_cosine: Annotated[float, arg(metavar="X")] = 0.05

    min_facing: Annotated[float, arg(metavar="X")] = 0.15

    room_light: Annotated[float, arg(metavar="X")] = 1.0

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of [`open_data`][] that are not the defaults."""
        given = changed(self)
        given |= {n: str(v) for n, v in given.items() if isinstance(v, Path)}
        return given | ({} if self.fov is None else {"fov": self.known_fov})

    def settings(self) -> DataSettings:
        """Settings of reading, for records."""
        given = self.arguments.items()
        return DataSettings(
            **{n: v for n, v in given if n in DataSettings.model_fields}
        )

    def like(self, reading: DataSettings) -> "DataOptions":
        """Options with the same photographs and the settings of reading of a record."""
        given = reading.model_dump()
        for name in ("normals", "lights"):
            given[name] = None if given[name] is None else Path(given[name])
        return dataclasses.replace(self, **given)

    @property
    def sought(self) -> bool:
        """True if normals are to be fitted."""
        return self.normals is not None and str(self.normals) == SOUGHT

    @property
    def known_fov(self) -> float | None:
        """The given angle of view; 0 if it is to be fitted."""
        return 0.0 if self.fov == "fit" else self.fov


def read_data(options: DataOptions) -> tuple[Dataset, DataRecord]:
    """The photographs in memory, and a record of the files and settings.

    **Raises:** `ValueError` that names the file or the option.
    """
    if options.sought:
        raise ValueError(
            "normals: expected a file, got fit: only `phongfit maps` seeks normals"
        )
    if options.fov == "fit":
        raise ValueError(
            "fov: expected degrees, got fit: only `phongfit maps --normals fit` fits it"
        )
    return _recorded(options, Photographs.load)


def stack_data(options: DataOptions) -> tuple[DatasetStack, DataRecord]:
    """The photographs as a stack that holds one in memory at a time, and a record."""
    return _recorded(options, DatasetStack)


def _recorded(
    options: DataOptions, make: Callable[[Photographs], T]
) -> tuple[T, DataRecord]:
    """The result of `make`, which must read all photographs, and a record of files."""
    with recording() as checksums:
        photographs = open_data(**options.arguments)
        made = make(photographs)
    files = {path.resolve(): digest for path, digest in checksums.items()}
    home = options.dataset.resolve()
    home = home if home.is_dir() else home.parent
    inputs = {
        readable(str(p.relative_to(home)) if p.is_relative_to(home) else p.name): digest
        for p, digest in sorted(files.items())
        # The true material is not an input of a fit.
        if p.name != TRUTH_FILE
    }
    name = readable(photographs.name)
    return made, DataRecord(name=name, reading=options.settings(), inputs=inputs)


def tell(notes: Sequence[str]) -> None:
    """Print assumptions about photographs."""
    for note in notes:
        print(f"assumed: {note}", flush=True)
