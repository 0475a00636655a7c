"""`fit.json`: a fit with its standard errors and the settings that repeat it."""

import dataclasses
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
from phongfit.files.encodings import EncodingField, describe_encoding
from phongfit.files.inputs import naming
from phongfit.files.outputs import write_json
from phongfit.files.records import AbstractRecord, Many, Vector, read_record, validated
from phongfit.files.schema import MaterialRecord, SpecularRecord, describe_material
from phongfit.fitting.problem.losses import LOSSES
from phongfit.fitting.problem.specification import (
    DEFAULT_PER_CHANNEL,
    DEFAULT_UNKNOWNS,
    Specification,
    as_names,
)
from phongfit.fitting.result import Fit
from phongfit.material import Material
from phongfit.plain import plain
from phongfit.reflectance import AbstractSpecular
from phongfit.rendering.film import Film
from phongfit.rendering.jpeg import JpegCompression
from phongfit.scene import Scene

FIT_FORMAT = "phongfit fit"
FIT_VERSION = 2
# Keys of version 1, and their names in version 2.
_RENAMED = {"untold": "unidentified", "samples": "n_samples", "images": "n_images"}
LossName = Literal["linear", "huber", "soft_l1", "cauchy", "tukey"]


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


Numbers = Many[float | None]
"""Numbers, where null is infinity or NaN."""

Edges = Annotated[tuple[float | None, float | None], BeforeValidator(_as_tuple)]
"""(low, high), where null is infinity."""

Follows = Annotated[tuple[float, str], BeforeValidator(_as_tuple)]
"""(factor, label)."""

Nested = float | None | Numbers | Many[Numbers]
"""A parameter: one number, RGB, or a row for each of several materials."""

Entries = float | Many[float] | Many[Many[float]]
"""A number, or a vector or matrix of them."""

Prior = Annotated[tuple[Entries, Entries], BeforeValidator(_as_tuple)]
"""(mean, standard deviation); each is one number or one for each entry."""

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""A SHA-256 in hexadecimal digits."""


class JpegRecord(AbstractRecord):
    """The arguments of [`JpegCompression`][]."""

    tables: Many[Many[Many[int]]]
    sampling: Many[Annotated[tuple[int, int], BeforeValidator(_as_tuple)]]
    ycbcr: bool = True


class FilmRecord(AbstractRecord):
    """The arguments of a [`Film`][]."""

    clamp: bool = True
    encoding: EncodingField = "linear"
    bits: int | None = None
    jpeg: JpegRecord | None = None

    def build(self) -> Film:
        """The film. **Raises:** `ValueError` that names the argument."""
        jpeg = None if self.jpeg is None else JpegCompression(**dict(self.jpeg))
        return Film(self.clamp, self.encoding, self.bits, jpeg)


class UncertainRecord(AbstractRecord):
    """Arrays of the scenes, and the covariance or standard deviations of all."""

    arrays: Annotated[Many[str], Field(min_length=1)]
    covariance: Entries


class FitSettings(AbstractRecord):
    """Settings of a fit, as arguments of [`fit`][]."""

    unknowns: Many[str] = list(DEFAULT_UNKNOWNS)
    per_channel: Many[str] = list(DEFAULT_PER_CHANNEL)
    per_image: Many[str] = []
    known: MaterialRecord | None = None
    bounds: dict[str, Edges] = {}
    fixed: dict[str, Entries] = {}
    ties: dict[str, Follows] = {}
    priors: dict[str, Prior] = {}
    noise: Annotated[float, Field(gt=0)] | None = None
    loss: LossName = "linear"
    max_steps: Annotated[int, Field(ge=1)] = 200
    tolerance: float | None = None
    # A fit.json has neither of these, which are read with the data.
    uncertain: Many[UncertainRecord] = []
    film: FilmRecord | Many[FilmRecord] | None = None

    def specification(self) -> Specification:
        """The specification.

        **Raises:** `ValueError` that names the option.
        """
        with naming("known"):
            known = None if self.known is None else self.known.build()
        with naming("film"):
            films = self.film if isinstance(self.film, list) else [self.film]
            film = [None if one is None else one.build() for one in films]
        bounds = {
            name: (
                -math.inf if low is None else low,
                math.inf if high is None else high,
            )
            for name, (low, high) in self.bounds.items()
        }
        uncertain = {
            one.arrays[0] if len(one.arrays) == 1 else tuple(one.arrays): one.covariance
            for one in self.uncertain
        }
        given = dict(self) | {
            "known": known,
            "bounds": bounds,
            "uncertain": uncertain,
            "film": film if isinstance(self.film, list) else film[0],
        }
        del given["noise"]
        return Specification(**given)


def describe_specification(specification: Specification) -> dict[str, Any]:
    """The options of a fit as JSON, which [`FitSettings`][] reads.

    **Raises:** `ValueError` that names an option that JSON cannot hold.
    """
    known, film, loss = (getattr(specification, n) for n in ("known", "film", "loss"))
    names = [name for name, one in LOSSES.items() if one == loss]
    if not names:
        raise ValueError(f"loss: expected one of {', '.join(LOSSES)}, got {loss}")
    with naming("known"):
        known = None if known is None else describe_material(known)
    described = None
    if film is not None:
        several = isinstance(film, tuple)
        described = [*map(_describe_film, film)] if several else _describe_film(film)
    uncertain = [
        {"arrays": as_names(key), "covariance": covariance}
        for key, covariance in specification.uncertain.items()
    ]
    content = plain(
        specification.options
        | {
            "known": known,
            "loss": names[0],
            "film": described,
            "uncertain": uncertain,
        }
    )
    validated(content, FitSettings)
    return content


def read_specification(data: Any) -> Specification:
    """The specification that [`describe_specification`][] wrote.

    **Raises:** `ValueError` that names the option.
    """
    settings = validated(data, FitSettings)
    if settings.noise is not None:
        raise ValueError("noise: expected none, since it is given beside the options")
    return settings.specification()


def _describe_film(film: Film) -> dict[str, Any]:
    jpeg = None if film.jpeg is None else dataclasses.asdict(film.jpeg)
    encoding = describe_encoding(film.encoding)
    return {"clamp": film.clamp, "encoding": encoding, "bits": film.bits, "jpeg": jpeg}


def _settings(specification: Specification, noise: float | None) -> dict[str, Any]:
    """The settings of a fit.json: without what is read with the data."""
    given = describe_specification(specification) | {"noise": plain(noise)}
    if given["tolerance"] is None:
        # Older versions do not read it.
        del given["tolerance"]
    del given["film"], given["uncertain"]
    return given


class DataSettings(AbstractRecord):
    """Options with which photographs were read: see `phongfit fit --help`."""

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
    """A data set's name, its reading options, and SHA-256 of every file read."""

    name: str
    reading: DataSettings
    inputs: dict[str, Digest]


class ParametersRecord(AbstractRecord):
    """A material of any shape, or its standard errors."""

    ambient: Nested
    diffuse: Nested
    specular: Nested
    shininess: Nested
    emission: Nested


class FitRecord(AbstractRecord):
    """Content of a `fit.json`."""

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
    # 95 % intervals; older files have none.
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
        # In place: messages look up values in this same object.
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
        """Values and standard errors; null errors become infinite."""
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
    """Versions of the libraries and the platform, and the floating-point precision."""
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
    """Write a fit and the settings that repeat it, whole or not at all.

    **Arguments:**

    - `data`: record of the fitted data.
    - `noise`: noise that was passed to the fit, or `None`.

    **Raises:** `OSError` that names the file.
    """
    numbers = fit.to_dict()
    # The file has the model and the loss elsewhere, and columns instead of rows.
    for name in ("model", "loss", "parameters"):
        del numbers[name]
    scene = fit.scene if isinstance(fit.scene, Scene) else fit.scene[0]
    content: dict[str, Any] = {
        "format": FIT_FORMAT,
        "version": FIT_VERSION,
        "data": data.model_dump(),
        "settings": _settings(fit.specification, noise),
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
    """Check that a record has as many values, errors, … as labels, and a material.

    **Raises:** `ValueError` that names the field.
    """
    count = len(record.labels)
    names = ("values", "errors", "at_bound", "unidentified", "tied", "bounds")
    for name in (*names, "intervals"):
        given = getattr(record, name)
        if given is not None and len(given) != count:
            raise ValueError(f"{name}: expected {count}, one a label, got {len(given)}")
    rows = [len(row) for row in record.covariance]
    if rows != [count] * count:
        raise ValueError(f"covariance: expected {count} rows of {count} numbers")
    record.build()


def distances(record: FitRecord, fit: Fit) -> Float[np.ndarray, " n"]:
    """Distance of a fit from a recorded one, in units of the recorded standard errors.

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
    # At least the rounding of the values: at a bound a standard error may be 0.
    scale = np.maximum(errors, 1e-5 * np.abs(values) + 1e-7)
    distance = np.abs(fit.values - values) / scale
    distance = np.where(finite[0] == finite[1], distance, np.inf)
    return np.where(finite[0] | finite[1], distance, np.nan)
