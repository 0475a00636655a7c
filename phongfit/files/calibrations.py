"""`lights.json`: the result of a calibration."""

import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from phongfit.calibration.outlines import View
from phongfit.calibration.result import CalibratedSphere, Calibration, Lamp
from phongfit.checks import as_covariance
from phongfit.files.inputs import naming
from phongfit.files.outputs import write_json
from phongfit.files.records import AbstractRecord, Colour, Matrix, Vector, read_record

LIGHTS_FILE = "lights.json"

Positive = Annotated[float, Field(gt=0)]
Pixel = Annotated[list[float], Field(min_length=2, max_length=2)]
Fraction = Annotated[float, Field(ge=0, le=2)]


class ViewRecord(AbstractRecord):
    """The camera: a pinhole with an angle of view, or parallel rays."""

    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    fov_y_degrees: Annotated[float, Field(gt=0, lt=180)] | None = None
    view_height: Positive | None = None


class LampRecord(AbstractRecord):
    """A photograph's lamp: distant with a direction, or near with a position."""

    photograph: Annotated[str, Field(min_length=1)]
    direction: Vector | None = None
    position: Vector | None = None
    attenuation: Vector | None = None
    intensity: Colour
    intensity_error: Colour | None = None
    direction_error_degrees: Annotated[float, Field(ge=0)]
    covariance: Matrix
    highlights: list[Pixel | None] = []


class SphereRecord(AbstractRecord):
    """A sphere's outline, pixels from the upper left corner."""

    kind: Literal["chrome", "matte"]
    outline: Vector
    covariance: Matrix


class LightsRecord(AbstractRecord):
    """`lights.json`, in the camera's axes: x right, y up, z back to the viewer."""

    format: Literal["phongfit lights"]
    version: Literal[1]
    camera: ViewRecord
    reference: Vector
    lights: Annotated[list[LampRecord], Field(min_length=1)]
    spheres: list[SphereRecord] = []
    sphere_radius: Positive = 1.0
    falloff: Fraction = 0.0
    falloff_error: Annotated[float, Field(ge=0)] = 0.0
    covariance: list[list[float]] | None = None
    ambient: Colour = (0.0, 0.0, 0.0)
    ambient_error: Colour = (0.0, 0.0, 0.0)
    left_out: dict[str, str] = {}
    warnings: list[str] = []

    def build(self) -> Calibration:
        view, covariance = self.camera, None
        if (view.fov_y_degrees is None) == (view.view_height is None):
            raise ValueError("camera: expected either fov_y_degrees or view_height")
        lamps = tuple(self._lamp(at, lamp) for at, lamp in enumerate(self.lights))
        if len({lamp.position is None for lamp in lamps}) > 1:
            raise ValueError("lights: expected directions alone, or positions alone")
        if self.covariance is not None:
            count, size = len(self.lights), len(self.covariance)
            rows = {len(row) for row in self.covariance}
            if size not in (3 * count, 6 * count + 1) or rows != {size}:
                raise ValueError(
                    f"covariance: expected {3 * count} rows of as many, three for a "
                    f"light, or with strengths and falloff {6 * count + 1}"
                )
            covariance = as_covariance("covariance", self.covariance)
        return Calibration(
            View(view.width, view.height, view.fov_y_degrees),
            lamps,
            tuple(
                CalibratedSphere(
                    s.kind,
                    np.array(s.outline),
                    as_covariance(f"spheres[{at}].covariance", s.covariance),
                )
                for at, s in enumerate(self.spheres)
            ),
            self.sphere_radius,
            np.array(self.reference),
            self.falloff,
            np.array(self.ambient),
            self.left_out,
            tuple(self.warnings),
            view.view_height,
            covariance,
            self.falloff_error,
            np.array(self.ambient_error),
        )

    def _lamp(self, at: int, lamp: LampRecord) -> Lamp:
        if (lamp.direction is None) == (lamp.position is None):
            raise ValueError(f"lights[{at}]: expected either direction or position")
        where = np.array(lamp.position or lamp.direction, float)
        offset = where - self.reference if lamp.position else where
        length = np.linalg.norm(offset)
        if not length > 0:
            raise ValueError(f"lights[{at}]: expected a direction, got zeros")
        unknown = np.full(3, np.nan)
        error = lamp.intensity_error
        nowhere = (np.nan, np.nan)
        return Lamp(
            lamp.photograph,
            offset / length,
            where if lamp.position else None,
            as_covariance(f"lights[{at}].covariance", lamp.covariance),
            lamp.direction_error_degrees,
            unknown if error is None else np.array(lamp.intensity),
            unknown if error is None else np.array(error),
            np.array([pixel or nowhere for pixel in lamp.highlights]).reshape(-1, 2),
        )


def save_calibration(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration to a file that [`load_calibration`][] reads.

    **Raises:** `OSError` that names `path`.
    """
    head = {"format": "phongfit lights", "version": 1}
    write_json(Path(path), head | calibration.to_dict())


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """A calibration from its `lights.json`, or from the folder that holds it.

    **Raises:** `ValueError` that names the file, the field, what was expected and
    what was got.
    """
    path = Path(path)
    path = path / LIGHTS_FILE if path.is_dir() else path
    record = read_record(path, LightsRecord)
    with naming(str(path)):
        found = record.build()
        # Made here, so that errors for impossible lamps or cameras name the file.
        _ = found.lights, found.camera
        return found
