"""JSON files as records: read strictly, with errors that a person can act on."""

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
from phongfit.files.strict_json import parse_json, shorten

MOST = 10_000
"""Lights, images, numbers, … in one list."""


class AbstractRecord(BaseModel):
    """An object in a JSON file; keys that it does not know are errors."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        strict=True,
        frozen=True,
        # A command reads one or two of all these kinds.
        defer_build=True,
    )

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        # Before pydantic's own check, which does not say what the known keys are.
        known = [field.alias or name for name, field in cls.model_fields.items()]
        for key in data if isinstance(data, dict) else ():
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {known}"
                raise complain(f"{shorten(key)} is no key of it; {hint}")
        return data


def complain(text: str) -> PydanticCustomError:
    """What a validator raises to say what was expected, in its own words."""
    # The text is not the template itself, since it may hold braces.
    return PydanticCustomError("phongfit", "{text}", {"text": text})


def _as_three(value: Any) -> Any:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise complain(f"expected three numbers, got {shorten(value)}")
    return tuple(value)


def _as_rows(value: Any) -> Any:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise complain(f"expected three rows, got {shorten(value)}")
    return tuple(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _as_colour(value: Any) -> Any:
    leaf = _as_leaf(value)
    return leaf * 3 if len(leaf) == 1 else leaf


def _as_leaf(value: Any) -> Any:
    if _is_number(value):
        return (value,)
    if isinstance(value, list | tuple) and len(value) in (1, 3):
        return tuple(value)
    raise complain(f"expected one number or three, got {shorten(value)}")


Vector = Annotated[tuple[float, float, float], BeforeValidator(_as_three)]
"""Three numbers."""

Matrix = Annotated[tuple[Vector, Vector, Vector], BeforeValidator(_as_rows)]
"""Three rows of three numbers."""

Colour = Annotated[tuple[float, float, float], BeforeValidator(_as_colour)]
"""RGB; one number stands for three equal ones."""

Leaf = Annotated[tuple[float, ...], BeforeValidator(_as_leaf)]
"""A leaf of a material: one number for all channels, or RGB."""

Harmonics = Annotated[list[Colour], Field(min_length=9, max_length=9)]
"""Nine RGB, of the spherical harmonics up to order 2."""

FileName = Annotated[str, StringConstraints(min_length=1, max_length=255)]
"""A file in the folder of the file that names it."""

Item = TypeVar("Item")

Many = Annotated[list[Item], Field(fail_fast=True, max_length=MOST)]
"""As many as files of ours have; of wrong ones the first is told, and no other kept."""

Record = TypeVar("Record", bound=AbstractRecord)
Model = TypeVar("Model", bound=BaseModel)


def read_record(path: Path, kind: type[Record]) -> Record:
    """The record that a JSON file holds.

    **Raises:** `ValueError` that names the file and, for the first thing that is wrong,
    the field, what was expected and what was got.
    """
    text = read_text(path)
    with naming(str(path)):
        return parse_record(text, kind, path.parent)


def parse_record(text: str, kind: type[Record], folder: Path | None = None) -> Record:
    """The record that a JSON text holds; raises as [`read_record`][] does.

    **Arguments:** `folder`: where the files lie that the text names.
    """
    return validated(parse_json(text), kind, folder)


def validated(data: Any, kind: type[Model], folder: Path | None = None) -> Model:
    """The record that parsed JSON holds.

    **Raises:** `ValueError` for the first thing that is wrong, as [`read_record`][].
    """
    try:
        return kind.model_validate(data, context=folder)
    except ValidationError as error:
        raise ValueError(_explain(error.errors()[0], data)) from None


def read_one_of(
    path: Path, kinds: Mapping[str, type[AbstractRecord]]
) -> AbstractRecord:
    """The record that a JSON file holds, of the kind that its `format` names.

    **Raises:** `ValueError` as [`read_record`][] does, and for another `format`.
    """
    with naming(str(path)):
        data = parse_json(read_text(path))
        format = data.get("format") if isinstance(data, dict) else None
        if not isinstance(format, str) or format not in kinds:
            wanted = " or ".join(repr(name) for name in kinds)
            raise ValueError(f"format: expected {wanted}, got {shorten(format)}")
        return validated(data, kinds[format], path.parent)


def _explain(error: ErrorDetails, data: Any) -> str:
    """`lights[1].direction: expected what, got what`."""
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
    """A place in a JSON file in the usual notation; its end may be `absent` there."""
    place = ""
    for step in location[:-1] if absent else location:
        # Some steps are of the record alone: one number may stand for three.
        if isinstance(data, list) and isinstance(step, int) and step < len(data):
            place, data = f"{place}[{step}]", data[step]
        elif isinstance(data, dict) and step in data:
            place, data = f"{place}.{step}", data[step]
    place += f".{location[-1]}" if absent else ""
    return place.removeprefix(".") or "the file"
