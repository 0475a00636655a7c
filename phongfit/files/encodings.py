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
    """A response curve where the name of an encoding might stand."""

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
"""An encoding in a JSON file of ours."""


def describe_encoding(encoding: Encoding) -> str | dict[str, Any]:
    """What stands for it in a JSON file of ours."""
    if isinstance(encoding, ResponseCurve):
        return {"kind": "response_curve", "light": list(encoding.light)}
    return encoding


class ResponseRecord(AbstractRecord):
    """What `phongfit response` writes: a curve, and how well it is known."""

    format: Literal["phongfit response"]
    version: Literal[1]
    light: Samples
    light_error: Samples = []
    numbers_seen: Annotated[list[float], Field(min_length=2, max_length=2)] = [0.0, 1.0]
    checks: dict[str, dict[str, float]] = {}
    warnings: list[str] = []


def read_response(path: Path) -> ResponseCurve:
    """The curve of a file that `phongfit response` has written.

    **Raises:** `ValueError` that names the file, the field, what was expected and what
    was got.
    """
    record = read_record(path, ResponseRecord)
    with naming(str(path)):
        return ResponseCurve(tuple(record.light))


def parse_encoding(word: str | None) -> Encoding | None:
    """An encoding by its name, or by the file of a response curve; `None` is none.

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
