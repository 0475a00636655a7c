"""`fit.json`: a fit with its errors, and all that is needed to repeat it."""

import importlib.metadata
import math
import os
import platform
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
from jaxtyping import Float
from pydantic import BeforeValidator, Field, model_validator

from phongfit.files.arguments import describe
from phongfit.files.inputs import naming
from phongfit.files.outputs import write_json
from phongfit.files.records import AbstractRecord, Many, Vector, read_record
from phongfit.files.schema import MaterialRecord, SpecularRecord, describe_material
from phongfit.fitting.problem.losses import LOSSES
from phongfit.fitting.problem.specification import (
    DEFAULT_PER_CHANNEL,
    DEFAULT_UNKNOWNS,
    Specification,
)
from phongfit.fitting.result import Fit
from phongfit.material import Material
from phongfit.plain import plain
from phongfit.reflectance import AbstractSpecular
from phongfit.scene import Scene

FIT_FORMAT = "phongfit fit"
FIT_VERSION = 2
# What version 1 called otherwise.
_RENAMED = {"untold": "unidentified", "samples": "n_samples", "images": "n_images"}
LossName = Literal["linear", "huber", "soft_l1", "cauchy", "tukey"]


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


Numbers = Many[float | None]
"""Numbers, where null stands for what is not finite."""

Edges = Annotated[tuple[float | None, float | None], BeforeValidator(_as_tuple)]
"""(low, high), where null is infinity."""

Pair = Annotated[tuple[float, float], BeforeValidator(_as_tuple)]
"""Two numbers."""

Follows = Annotated[tuple[float, str], BeforeValidator(_as_tuple)]
"""(factor, label)."""

Nested = float | None | Numbers | Many[Numbers]
"""A parameter: one number, RGB, or a row for each of several materials."""

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""A SHA-256 in hexadecimal digits."""


class FitSettings(AbstractRecord):
    """What a fit was asked for: see [`fit`][]."""

    unknowns: Many[str] = list(DEFAULT_UNKNOWNS)
    per_channel: Many[str] = list(DEFAULT_PER_CHANNEL)
    per_image: Many[str] = []
    known: MaterialRecord | None = None
    bounds: dict[str, Edges] = {}
    fixed: dict[str, float] = {}
    ties: dict[str, Follows] = {}
    priors: dict[str, Pair] = {}
    noise: Annotated[float, Field(gt=0)] | None = None
    loss: LossName = "linear"
    max_steps: Annotated[int, Field(ge=1)] = 200

    @classmethod
    def of(cls, specification: Specification, noise: float | None) -> "FitSettings":
        """What stands in the file of a specification.

        Its film, and what is uncertain, are the data's.

        **Raises:** `ValueError` for a loss that has no name.
        """
        given = dict(specification.options)
        del given["film"], given["uncertain"]
        known, loss = specification.known, specification.loss
        names = [name for name, one in LOSSES.items() if one == loss]
        if not names:
            raise ValueError(f"loss: expected one of {', '.join(LOSSES)}, got {loss}")
        given |= {
            "known": None if known is None else describe_material(known),
            "loss": names[0],
            "noise": noise,
        }
        return cls.model_validate(plain(given))

    def specification(self) -> Specification:
        """What was asked, but for the film, which the data know."""
        with naming("known"):
            known = None if self.known is None else self.known.build()
        bounds = {
            name: (
                -math.inf if low is None else low,
                math.inf if high is None else high,
            )
            for name, (low, high) in self.bounds.items()
        }
        return Specification(
            unknowns=self.unknowns,
            per_channel=self.per_channel,
            per_image=self.per_image,
            known=known,
            bounds=bounds,
            fixed=self.fixed,
            ties=self.ties,
            priors=self.priors,
            loss=self.loss,
            max_steps=self.max_steps,
        )


class DataSettings(AbstractRecord):
    """How photographs were read: see `phongfit fit --help`."""

    encoding: str | None = None
    min_cosine: float = 0.05
    min_facing: float = 0.15
    room_light: Annotated[float, Field(ge=0)] = 1.0
    sphere: Vector | None = None
    normals: str | None = None
    lights: str | None = None
    fov: Annotated[float, Field(ge=0, lt=180)] | None = None
    white: Annotated[int, Field(ge=1, le=65535)] | None = None


class DataRecord(AbstractRecord):
    """The data: its name, how it was read, and SHA-256 of every file that was."""

    name: str
    reading: DataSettings
    inputs: dict[str, Digest]


class ParametersRecord(AbstractRecord):
    """A material of any shape, or its errors."""

    ambient: Nested
    diffuse: Nested
    specular: Nested
    shininess: Nested
    emission: Nested


class FitRecord(AbstractRecord):
    """`fit.json`."""

    format: Literal["phongfit fit"]
    version: Literal[2]
    data: DataRecord
    settings: FitSettings
    model: SpecularRecord
    material: ParametersRecord
    stderr: ParametersRecord
    labels: Annotated[Many[str], Field(min_length=1)]
    values: Many[float]
    errors: Numbers
    at_bound: Many[bool]
    unidentified: Many[bool]
    tied: Many[bool]
    bounds: Many[Edges]
    covariance: Many[Numbers]
    # Of 95 %; files that are older have none.
    intervals: Many[Edges] | None = None
    exposure: Many[float]
    noise: float
    noise_given: bool
    n_samples: int
    n_images: int
    degrees_of_freedom: int
    reduced_chi_squared: float | None
    neighbour_correlation: float
    # Since version 0.2.
    misfit_significance: float | None = None
    residuals_over_repeatability: float | None = None
    film: str
    converged: bool
    steps: int
    reason: str
    warnings: Many[str]
    made_with: dict[str, str]

    @model_validator(mode="before")
    @classmethod
    def _upgrade(cls, data: Any) -> Any:
        # In place, so that errors find in it what they name.
        if isinstance(data, dict) and data.get("version") == 1:
            for old, new in _RENAMED.items():
                if old in data:
                    data.setdefault(new, data.pop(old))
            data["version"] = FIT_VERSION
        return data

    def build(self) -> Material:
        """The material: parameters () or (3,), or (M, 3) and (M, 1) of M materials.

        **Raises:** `ValueError` that names the parameter.
        """
        parameters = {name: _array(given) for name, given in self.material}
        with naming("material"):
            return Material(**parameters)

    def numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """Values and errors; an error of null is infinite."""
        return _array(self.values), np.nan_to_num(_array(self.errors), nan=np.inf)

    def specular(self) -> AbstractSpecular:
        """The model of the highlight."""
        return self.model.build()


def _array(numbers: Any) -> np.ndarray:
    try:
        return np.array(numbers, float)
    except ValueError as error:
        raise ValueError("expected rows of one length") from error


def made_with() -> dict[str, str]:
    """Versions of what numbers rest on, and the precision."""
    names = ("phongfit", "jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy")
    machine = f"{platform.system()} {platform.machine()}"
    return {
        **{name: importlib.metadata.version(name) for name in names},
        "python": platform.python_version(),
        "precision": str(jax.numpy.result_type(float)),
        "platform": f"{machine}, {jax.default_backend()}",
    }


def write_fit_record(
    path: str | os.PathLike[str], fit: Fit, *, data: DataRecord, noise: float | None
) -> None:
    """Write a fit, in one piece, so that it can be repeated elsewhere.

    **Arguments:**

    - `data`: what it was made from.
    - `noise`: that was given, if it was.

    **Raises:** `OSError` that names the file.
    """
    numbers = fit.to_dict()
    # The model is described below, the loss is a setting, and rows are columns here.
    for name in ("model", "loss", "parameters"):
        del numbers[name]
    scene = fit.scene if isinstance(fit.scene, Scene) else fit.scene[0]
    content: dict[str, Any] = {
        "format": FIT_FORMAT,
        "version": FIT_VERSION,
        "data": data.model_dump(),
        "settings": FitSettings.of(fit.specification, noise).model_dump(),
        "model": describe(scene.specular_model),
        **numbers,
        "made_with": made_with(),
    }
    write_json(path, content)


def read_fit_record(path: str | os.PathLike[str]) -> FitRecord:
    """The record of a fit from its file.

    **Raises:** `ValueError` that names the file, the field, what was expected and
    what was got.
    """
    path = Path(path)
    record = read_record(path, FitRecord)
    with naming(str(path)):
        check_fit(record)
    return record


def check_fit(record: FitRecord) -> None:
    """Are there as many values, errors, … as labels, and is there a material?

    **Raises:** `ValueError` that names the field.
    """
    count = len(record.labels)
    for name in ("values", "errors", "at_bound", "unidentified", "tied", "bounds"):
        length = len(getattr(record, name))
        if length != count:
            raise ValueError(f"{name}: expected {count}, one a label, got {length}")
    if record.intervals is not None and len(record.intervals) != count:
        raise ValueError(
            f"intervals: expected {count}, one a label, got {len(record.intervals)}"
        )
    rows = [len(row) for row in record.covariance]
    if rows != [count] * count:
        raise ValueError(f"covariance: expected {count} rows of {count} numbers")
    record.build()


def distances(record: FitRecord, fit: Fit) -> Float[np.ndarray, " n"]:
    """How far a fit is from a recorded one, in the recorded standard errors.

    **Returns:** a number for each label: infinite where only one of the two identifies
    the value, NaN where neither does.

    **Raises:** `ValueError` if the labels differ.
    """
    if tuple(record.labels) != fit.labels:
        raise ValueError(
            f"labels: expected those of the recorded fit, {', '.join(record.labels)}, "
            f"got {', '.join(fit.labels)}"
        )
    values, errors = record.numbers()
    finite = np.isfinite(errors), np.isfinite(fit.errors)
    # No finer than the numbers themselves: at a bound an error may be 0.
    scale = np.maximum(errors, 1e-5 * np.abs(values) + 1e-7)
    distance = np.abs(fit.values - values) / scale
    distance = np.where(finite[0] == finite[1], distance, np.inf)
    return np.where(finite[0] | finite[1], distance, np.nan)
