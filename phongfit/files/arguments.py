"""Records of objects: the arguments of a constructor, read off its class.

Names, defaults and shapes are written once, in the class. [`arguments_of`][] makes the
record of them, and [`describe`][] writes what the record reads.
"""

import abc
import dataclasses
import functools
import inspect
import operator
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import equinox as eqx
import numpy as np
from jaxtyping import AbstractArray, Bool, Float
from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    create_model,
)

from phongfit.files.arrays import read_array
from phongfit.files.images import read_mask
from phongfit.files.inputs import inside, naming_field
from phongfit.files.records import (
    AbstractRecord,
    Colour,
    FileName,
    Harmonics,
    Leaf,
    Many,
    Matrix,
    Vector,
    complain,
)
from phongfit.files.strict_json import shorten
from phongfit.plain import plain


class AbstractPart(AbstractRecord):
    """The file's record of one object of the class `makes`."""

    makes: ClassVar[type]

    @abc.abstractmethod
    def build(self) -> Any:
        """Make the object. **Raises:** `ValueError` that begins with a field's name."""


class Arguments(AbstractPart):
    """The arguments of a constructor: see [`arguments_of`][].

    A subclass may override `given` if a file's fields are not the arguments themselves.
    """

    def given(self) -> dict[str, Any]:
        """Arguments for the constructor; omitted fields have its defaults."""
        return {name: _built(name, getattr(self, name)) for name in _kept(self.makes)}

    def build(self) -> Any:
        try:
            return self.makes(**self.given())
        except ValueError as error:
            # The message begins with the argument's name; the file's key may differ.
            name, colon, reason = str(error).partition(":")
            raise ValueError(f"{_key(type(self), name)}{colon}{reason}") from error


def _built(place: str, value: Any) -> Any:
    """The object of a record, and those of a list of records; other values as is."""
    if isinstance(value, list):
        return [_built(f"{place}[{at}]", item) for at, item in enumerate(value)]
    if not isinstance(value, AbstractPart):
        return value
    with naming_field(place):
        return value.build()


RECORDS: dict[type, type[AbstractPart]] = {}
"""Records by the class of the objects that they make."""

UNSAID: dict[type, str] = {}
"""Default kinds, by base class, for records without a `kind`."""

R = TypeVar("R", bound=Arguments)


def arguments_of(
    made: type,
    keys: Mapping[str, str] | None = None,
    *,
    kind: str | None = None,
    required: Collection[str] = (),
) -> Callable[[type[R]], type[R]]:
    """Decorate a record class: its fields become the arguments of a constructor.

    **Arguments:**

    - `made`, `keys`, `kind`: see [`register`][].
    - `required`: arguments without a default in files, though they have one in Python.

    **Raises:** `ValueError` for a class that files cannot hold.
    """
    keys = {} if keys is None else keys
    arguments, hints = _kept(made), get_type_hints(made)
    for name, parameter in inspect.signature(made).parameters.items():
        if name not in arguments and parameter.default is parameter.empty:
            raise ValueError(f"{name}: {made.__name__} keeps it in no field")
    for name in keys:
        if name not in arguments:
            raise ValueError(f"{name}: {made.__name__} takes no such argument")
    fields: dict[str, Any] = {} if kind is None else {"kind": (Literal[kind], kind)}
    for name, default in arguments.items():
        if name in fields:
            raise ValueError(f"{name}: files have another use for this name")
        if name in required or default is inspect.Parameter.empty:
            default = ...
        stored = _stored(f"{made.__name__}.{name}", hints[name])
        fields[name] = (stored, Field(default, alias=keys.get(name)))

    def derive(base: type[R]) -> type[R]:
        record = create_model(
            base.__name__, __base__=base, __module__=base.__module__, **fields
        )
        record.makes = made
        RECORDS[made] = record
        return record

    return derive


def _kept(made: type) -> dict[str, Any]:
    """Defaults of a constructor's arguments that are kept in fields, in their order."""
    parameters = inspect.signature(made).parameters
    names = [field.name for field in dataclasses.fields(made)]
    return {name: parameters[name].default for name in names if name in parameters}


def _key(record: type[AbstractRecord], name: str) -> str:
    """The key of a field in files."""
    field = record.model_fields.get(name)
    return name if field is None or field.alias is None else field.alias


def _stored(name: str, hint: Any) -> Any:
    """The type that a file's record has for an annotated type."""
    if get_origin(hint) in (Union, UnionType):
        options = (_stored(name, option) for option in get_args(hint))
        return functools.reduce(operator.or_, options)
    if get_origin(hint) is tuple:
        return Many[_stored(name, get_args(hint)[0])]
    if get_origin(hint) is Literal or hint in (bool, int, float, str, NoneType):
        return hint
    if _is_a(hint, AbstractArray):
        in_file = {None: _NUMBERS.get(hint.dim_str), ".png": _Mask, ".npy": _Array}
        return in_file[_suffix(hint)]
    if _is_a(hint, eqx.Module):
        if inspect.isabstract(hint):
            return Annotated[AbstractPart, PlainValidator(one_of(hint))]
        return RECORDS.get(hint) or arguments_of(hint)(Arguments)
    raise ValueError(f"{name}: files have no place for {hint}")


def _is_a(hint: Any, base: type) -> bool:
    return isinstance(hint, type) and issubclass(hint, base)


def _suffix(hint: Any) -> str | None:
    """Suffix of the separate file for an array; `None` if it is written in the JSON."""
    for option in get_args(hint) or (hint,):
        if _is_a(option, AbstractArray):
            if option.dtype is Float and option.dim_str in _NUMBERS:
                return None
            return ".png" if option.dtype is Bool else ".npy"
    return None


def _beside(name: str, info: ValidationInfo) -> str:
    if not isinstance(info.context, Path):
        raise ValueError(f"expected a text in a folder, which {name!r} lies in")
    return str(inside(info.context, name))


def _read_array(path: str, info: ValidationInfo) -> np.ndarray:
    return read_array(Path(path), str(info.field_name))


def _read_mask(path: str) -> np.ndarray:
    return read_mask(Path(path))


FileBeside = Annotated[FileName, AfterValidator(_beside)]
"""The path of a file, from its name in a JSON file of the same folder."""

_Array = Annotated[FileBeside, AfterValidator(_read_array)]
_Mask = Annotated[FileBeside, AfterValidator(_read_mask)]
_NUMBERS = {
    "": float,
    "3": Vector,
    "rgb=3": Colour,
    "3 3": Matrix,
    "9 3": Harmonics,
    "...": Leaf,
}


def kinds_of(base: type) -> dict[str, type[AbstractPart]]:
    """Records of the classes derived from `base`, by their `kind` in files."""
    return {
        record.model_fields["kind"].default: record
        for made, record in RECORDS.items()
        if issubclass(made, base) and "kind" in record.model_fields
    }


def one_of(base: type) -> Callable[[Any, ValidationInfo], AbstractPart]:
    """A validator for records of classes derived from `base`, by their `kind`."""

    def read(data: Any, info: ValidationInfo) -> AbstractPart:
        if not isinstance(data, dict):
            raise complain(f"expected an object {{…}}, got {shorten(data)}")
        kinds = kinds_of(base)
        if base in UNSAID:
            data = {"kind": UNSAID[base], **data}
        kind = data.get("kind")
        if isinstance(kind, str) and kind in kinds:
            return kinds[kind].model_validate(data, context=info.context)
        wanted = ", ".join(repr(name) for name in kinds)
        wrong = complain(f"expected one of {wanted}, got {shorten(kind)}")
        error = "missing" if "kind" not in data else wrong
        raise ValidationError.from_exception_data(
            "kind", [{"type": error, "loc": ("kind",), "input": data}]
        )

    return read


def describe(
    value: Any, stem: str = "", beside: dict[str, np.ndarray] | None = None
) -> dict[str, Any]:
    """The content of an object's record, as JSON.

    **Arguments:**

    - `stem`: start of the names of files for arrays.
    - `beside`: filled with these arrays, by the names of their files.

    **Raises:** `ValueError` if its class, or that of a part, is not registered, or
    there is an array and no `beside`.
    """
    record = RECORDS.get(type(value))
    if record is None:
        raise ValueError(
            f"{type(value).__name__}: cannot be saved in a scene file; "
            "phongfit.register makes a class known"
        )

    def written(name: str, part: Any) -> Any:
        if isinstance(part, eqx.Module):
            return describe(part, stem, beside)
        if isinstance(part, tuple):
            return [written(name, item) for item in part]
        suffix = _suffix(hints[name])
        if suffix is None or part is None:
            return plain(part)
        if beside is None:
            raise ValueError(f"{name}: only a scene file can have an array beside it")
        file = f"{stem}_{name}{suffix}"
        if file in beside:
            file = f"{stem}_{name}_{len(beside)}{suffix}"
        beside[file] = np.asarray(part)
        return file

    hints = get_type_hints(type(value))
    kind = record.model_fields.get("kind")
    content: dict[str, Any] = {} if kind is None else {"kind": kind.default}
    for name, default in _kept(type(value)).items():
        part = getattr(value, name)
        if part is not None or default is not None:
            content[_key(record, name)] = written(name, part)
    return content
