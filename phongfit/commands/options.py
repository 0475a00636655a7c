"""Options that commands share: unknowns, constraints and priors."""

import dataclasses
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from tyro.conf import arg

from phongfit.files.calibrations import load_calibration
from phongfit.files.fits import LossName
from phongfit.files.inputs import naming
from phongfit.files.lp import read_lp
from phongfit.files.materials import read_material
from phongfit.fitting.problem.specification import (
    DEFAULT_PER_CHANNEL,
    DEFAULT_UNKNOWNS,
    Specification,
)
from phongfit.geometry.cameras import AbstractCamera
from phongfit.lights import AbstractLight, DirectionalLight
from phongfit.material import Material

Value = TypeVar("Value")


def optional(metavar: str) -> Any:
    """An option whose help text describes its default."""
    return arg(metavar=metavar, help_behavior_hint="")


def changed(options: Any) -> dict[str, Any]:
    """Options that differ from their defaults, by name."""
    values = {f: getattr(options, f.name) for f in dataclasses.fields(options)}
    return {f.name: value for f, value in values.items() if value != f.default}


def refuse(options: Any, names: str, why: str) -> None:
    """Raise `ValueError` that names an option of `names` that was given, and why not.

    **Arguments:** `names`: separated by spaces.
    """
    for name in changed(options):
        if name in names.split():
            raise ValueError(f"{name}: {why}")


Names = Annotated[tuple[str, ...], arg(metavar="NAME ...")]
Words = tuple[str, ...]

OutFolder = Annotated[Path, arg(aliases=["-o"], metavar="OUT")]
OutFile = Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
MaterialName = Annotated[str, arg(metavar="preset:NAME|FILE")]
EncodingName = Annotated[str | None, optional("linear|srgb|FILE")]
WhiteLevel = Annotated[int | None, optional("LEVEL")]
JsonFile = Annotated[Path | None, optional("FILE")]


@dataclass(frozen=True)
class UnknownOptions:
    """The unknowns of a fit. Labels are those of the table, such as diffuse.red.

    Args:
        unknowns: Parameters of the material (ambient diffuse specular shininess
            emission), arrays of the scene such as scene.lights[0].direction, or
            exposure.
        per_channel: Unknowns with a value for each of red, green and blue.
        per_image: Arrays of the scene with a value for each image.
        bounds: Other bounds than 0:1 (reflectances) and 1:1000 (shininess).
        fixed: Labels that are held at a value.
        ties: Labels that are tied to another, such as specular.green=specular.red.
        priors: Prior knowledge of a label: mean and standard deviation.
    """

    unknowns: Names = DEFAULT_UNKNOWNS

    per_channel: Names = DEFAULT_PER_CHANNEL

    per_image: Annotated[Words, optional("NAME ...")] = ()

    bounds: Annotated[tuple[str, ...], optional("NAME=LOW:HIGH ...")] = ()

    fixed: Annotated[tuple[str, ...], optional("LABEL=VALUE ...")] = ()

    ties: Annotated[tuple[str, ...], optional("LABEL=[X*]OTHER ...")] = ()

    priors: Annotated[tuple[str, ...], optional("LABEL=MEAN:SD ...")] = ()

    def given(self) -> dict[str, Any]:
        """Keyword arguments of a [`Specification`][].

        **Raises:** `ValueError` that names the option.
        """
        return {
            "unknowns": self.unknowns,
            "per_channel": self.per_channel,
            "per_image": self.per_image,
            "bounds": parse_bounds(self.bounds),
            "fixed": pairs("fixed", self.fixed, float),
            "ties": pairs("ties", self.ties, _tie),
            "priors": pairs("priors", self.priors, _two_numbers),
        }


@dataclass(frozen=True)
class FitOptions:
    """Options of the fit.

    Args:
        known: A material (a preset, .mtl, .json, fit.json) for the parameters that are
            not unknown. Default: no reflectance, exponent 32.
        noise: Standard deviation of the sensor's noise in linear light, where white
            is 1. Default: estimated from the residuals.
        loss: Loss function of the residuals; all but linear are robust to outliers,
            tukey the most.
        max_steps: Maximum number of the solver's steps, in each of its passes.
        tolerance: The solver ends at a smaller step. Default: 1e-8, or 1.4e-5 in single
            precision.
    """

    known: Annotated[str | None, optional("preset:NAME|FILE")] = None

    noise: Annotated[float | None, optional("SD")] = None

    loss: LossName = "linear"

    max_steps: Annotated[int, arg(metavar="N")] = 200

    tolerance: Annotated[float | None, optional("T")] = None


def specification_of(unknowns: UnknownOptions, options: FitOptions) -> Specification:
    """The specification of a fit, without the film, which is read with the data.

    **Raises:** `ValueError` that names the option.
    """
    for name, wanted in (("noise", "a number > 0"), ("max_steps", "1 or more")):
        value = getattr(options, name)
        if value is not None and not 0 < value < float("inf"):
            raise ValueError(f"{name}: expected {wanted}, got {value}")
    return Specification(
        **unknowns.given(),
        known=known_material(options.known),
        loss=options.loss,
        max_steps=options.max_steps,
        tolerance=options.tolerance,
    )


def read_lights(
    path: Path, camera: AbstractCamera | None = None
) -> tuple[list[str], Sequence[AbstractLight]]:
    """Names of photographs and their lights, from lights.json or from an .lp.

    **Arguments:** `camera`: whose axes an .lp has; default the world's.

    **Raises:** `ValueError` that names the file.
    """
    if path.suffix.lower() != ".lp":
        found = load_calibration(path)
        return [lamp.photograph for lamp in found.lamps], found.lights
    listed = read_lp(path)
    axes = np.eye(3) if camera is None else np.asarray(camera.rotation, float)
    lights = [DirectionalLight(vector) for vector in listed.vectors @ axes.T]
    return list(listed.base_names), lights


def known_material(word: str | None) -> Material | None:
    """The material of the option `--known`; raises as [`read_material`][] does."""
    with naming("known"):
        return None if word is None else read_material(word).material


def parse_bounds(words: Sequence[str]) -> dict[str, tuple[float, float]]:
    """`NAME=LOW:HIGH` for each word; raises as [`pairs`][] does."""
    return pairs("bounds", words, _two_numbers)


def pairs(
    option: str, words: Sequence[str], parse: Callable[[str], Value]
) -> dict[str, Value]:
    """`NAME=VALUE` for each word.

    **Raises:** `ValueError` that names the option and the word.
    """
    found: dict[str, Value] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not name or not equals or name in found:
            raise ValueError(f"{option}: expected NAME=VALUE, once each, got {word!r}")
        try:
            found[name] = parse(value)
        except ValueError:
            raise ValueError(
                f"{option}: expected {_WANTED[parse]} for {name}, got {value!r}"
            ) from None
    return found


def _two_numbers(text: str) -> tuple[float, float]:
    low, high = text.split(":")
    return float(low), float(high)


def _tie(text: str) -> tuple[float, str]:
    factor, star, other = text.rpartition("*")
    if not re.fullmatch(r"[\w.\[\],]+", other):
        raise ValueError("no label")
    return (float(factor) if star else 1.0), other


_WANTED: dict[Callable[[str], Any], str] = {
    float: "a number",
    _two_numbers: "two numbers with a colon",
    _tie: "a label, or FACTOR*LABEL,",
}
