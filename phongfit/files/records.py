"""JSON files as records: read strictly, with helpful errors."""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from phongfit.files.inputs import naming, read_text
from phongfit.files.strict_json import parse_json, shorten, unexpected

MOST = 10_000
"""Maximum length of a list, such as of lights or images."""


class AbstractRecord(BaseModel):
    """An object in a JSON file; unknown keys are errors."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        strict=True,
        frozen=True,
        # Validators are built on demand: a command needs only a few of the classes.
        defer_build=True,
    )

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        # Before pydantic's check, whose message does not list the known keys.
        known = [field.alias or name for name, field in cls.model_fields.items()]
        for key in data if isinstance(data, dict) else ():
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {known}"
                raise complain(f"{shorten(key)} is no key of it; {hint}")
        return data


def complain(text: str) -> PydanticCustomError:
    """A validator's error with a message of its choice."""
    # The text is not used as the template, since it may contain braces.
    return PydanticCustomError("phongfit", "{text}", {"text": text})


def _three(what: str) -> BeforeValidator:
    """A validator that makes a tuple of three items."""

    def as_tuple(value: Any) -> Any:
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise complain(f"expected three {what}, got {shorten(value)}")
        return tuple(value)

    return BeforeValidator(as_tuple)


def _as_colour(value: Any) -> Any:
    leaf = _as_leaf(value)
    return leaf * 3 if len(leaf) == 1 else leaf


def _as_leaf(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (value,)
    if isinstance(value, list | tuple) and len(value) in (1, 3):
        return tuple(value)
    raise complain(f"expected one number or three, got {shorten(value)}")


Vector = Annotated[tuple[float, float, float], _three("numbers")]
"""Three numbers."""

Matrix = Annotated[tuple[Vector, Vector, Vector], _three("rows")]
"""Three rows of three numbers."""

Colour = Annotated[tuple[float, float, float], BeforeValidator(_as_colour)]
"""RGB, or one number for three equal ones."""

Leaf = Annotated[tuple[float, ...], BeforeValidator(_as_leaf)]
"""A parameter of a material: one number for all channels, or RGB."""

Harmonics = Annotated[list[Colour], Field(min_length=9, max_length=9)]
"""Nine RGB coefficients of the spherical harmonics up to order 2."""

FileName = Annotated[str, StringConstraints(min_length=1, max_length=255)]
"""Name of a file in the folder of the JSON file."""

Item = TypeVar("Item")

Many = Annotated[list[Item], Field(fail_fast=True, max_length=MOST)]
"""A list of limited length; validation stops at the first error."""

Record = TypeVar("Record", bound=AbstractRecord)
Model = TypeVar("Model", bound=BaseModel)


def read_record(path: Path, kind: type[Record]) -> Record:
    """The record in a JSON file.

    **Raises:** `ValueError` that names the file and, for the first error, the field,
    what was expected and what was got.
    """
    text = read_text(path)
    with naming(str(path)):
        return parse_record(text, kind, path.parent)


def parse_record(text: str, kind: type[Record], folder: Path | None = None) -> Record:
    """The record in a JSON text; raises as [`read_record`][] does.

    **Arguments:** `folder`: of files that the text names.
    """
    return validated(parse_json(text), kind, folder)


def validated(data: Any, kind: type[Model], folder: Path | None = None) -> Model:
    """The record from parsed JSON.

    **Raises:** `ValueError` for the first error, as [`read_record`][] does.
    """
    try:
        return kind.model_validate(data, context=folder)
    except ValidationError as error:
        raise ValueError(_explain(error.errors()[0], data)) from None


def read_one_of(
    path: Path, kinds: Mapping[str, type[AbstractRecord]]
) -> AbstractRecord:
    """The record in a JSON file, of the kind that its `format` names.

    **Raises:** `ValueError` as [`read_record`][] does, and for another `format`.
    """
    with naming(str(path)):
        data = parse_json(read_text(path))
        format = data.get("format") if isinstance(data, dict) else None
        if not isinstance(format, str) or format not in kinds:
            wanted = " or ".join(repr(name) for name in kinds)
            raise unexpected("format", wanted, format)
        return validated(data, kinds[format], path.parent)


def _explain(error: ErrorDetails, data: Any) -> str:
    """Message for an error, such as `lights[1].direction: expected …, got …`."""
    place = _locate(error["loc"], data, absent=error["type"] == "missing")
    came = error["input"]
    message = error["msg"]
    match error["type"]:
        case "missing":
            return f"{place}: is missing"
        case "model_type" | "model_attributes_type":
            return f"{place}: expected an object {{…}}, got {shorten(came)}"
        case "phongfit":
            return f"{place}: {message}"
        case "value_error":
            return f"{place}: {error.get('ctx', {}).get('error', message)}"
    wanted = message.removeprefix("Input should be ")
    return f"{place}: expected {wanted}, got {shorten(came)}"


def _locate(location: tuple[int | str, ...], data: Any, absent: bool) -> str:
    """A place in a JSON file, as `lights[1].name`; its last key may be missing."""
    place = ""
    for step in location[:-1] if absent else location:
        # Skip steps that exist only in the record, as one number may replace three.
        if isinstance(data, list) and isinstance(step, int) and step < len(data):
            place, data = f"{place}[{step}]", data[step]
        elif isinstance(data, dict) and step in data:
            place, data = f"{place}.{step}", data[step]
    place += f".{location[-1]}" if absent else ""
    return place.removeprefix(".") or "the file"
