"""Encodings in files: a name, or a camera's response curve."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PlainValidator, ValidationInfo

from phongfit.files.inputs import naming
from phongfit.files.records import AbstractRecord, complain, read_record
from phongfit.files.strict_json import shorten
from phongfit.rendering.film import ENCODINGS, Encoding, NamedEncoding
from phongfit.rendering.response import MOST, ResponseCurve

RESPONSE_FORMAT = "phongfit response"

Samples = Annotated[list[float], Field(max_length=MOST, fail_fast=True)]


class CurveRecord(AbstractRecord):
    """A response curve in place of an encoding's name."""

    kind: Literal["response_curve"]
    light: Samples


def _as_encoding(data: Any, info: ValidationInfo) -> Encoding:
    if isinstance(data, dict):
        record = CurveRecord.model_validate(data, context=info.context)
        return ResponseCurve(tuple(record.light))
    if isinstance(data, str) and data in ENCODINGS:
        return data
    raise complain(
        f"expected 'linear' or 'srgb', or a response curve, got {shorten(data)}"
    )


EncodingField = Annotated[
    Any,
    PlainValidator(_as_encoding, json_schema_input_type=NamedEncoding | CurveRecord),
]
"""An encoding in one of phongfit's JSON files."""


def describe_encoding(encoding: Encoding) -> str | dict[str, Any]:
    """The value of an encoding in phongfit's JSON files."""
    if isinstance(encoding, ResponseCurve):
        return {"kind": "response_curve", "light": list(encoding.light)}
    return encoding


class ResponseRecord(AbstractRecord):
    """The file of `phongfit response`: a curve with its standard errors."""

    format: Literal["phongfit response"]
    version: Literal[1]
    light: Samples
    light_error: Samples = []
    numbers_seen: Annotated[list[float], Field(min_length=2, max_length=2)] = [0.0, 1.0]
    checks: dict[str, dict[str, float]] = {}
    warnings: list[str] = []


def read_response(path: Path) -> ResponseCurve:
    """The response curve from a file of `phongfit response`.

    **Raises:** `ValueError` that names the file, the field, what was expected and what
    was got.
    """
    record = read_record(path, ResponseRecord)
    with naming(str(path)):
        return ResponseCurve(tuple(record.light))


def parse_encoding(word: str | None) -> Encoding | None:
    """An encoding from its name or the file of a response curve; `None` for `None`.

    **Raises:** `ValueError` that names the option or the file.
    """
    if word is None:
        return None
    for name in ENCODINGS:
        if word == name:
            return name
    if not Path(word).exists():
        raise ValueError(
            "encoding: expected linear, srgb or the file of a response curve, got "
            f"{word!r}"
        )
    return read_response(Path(word))
