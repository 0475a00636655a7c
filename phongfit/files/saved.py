"""Save a whole [`Fit`][] in one file, to view or continue it elsewhere.

The structure is JSON and numbers are NumPy arrays, both in one `.npz`. No code is
stored or run: a class is named, and its module must be loaded when the file is read.
"""

import dataclasses
import importlib.metadata
import json
import os
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from phongfit.edge import checked
from phongfit.files import scenes as scenes  # all kinds that scenes are made of
from phongfit.files.arrays import unpack
from phongfit.files.inputs import naming, read_bytes
from phongfit.files.outputs import replacing
from phongfit.files.strict_json import parse_json, shorten
from phongfit.fitting.result import Fit

FORMAT = "phongfit saved fit"
VERSION = 1
STRUCTURE = "structure"
_REMEDIES = {
    "version": "read it with the phongfit that wrote it",
    "precision": "set JAX_ENABLE_X64=1 for float64, 0 for float32",
}


@checked
def save_fit(path: str | os.PathLike[str], fit: Fit) -> None:
    """Write a fit with its images, geometry and statistics: see [`load_fit`][].

    For numbers that other programs read, use [`Fit`][]`.to_dict`.

    **Arguments:** `path`: the file; `.npz` by custom.

    **Raises:** `OSError` that names the file; `ValueError` that names a part that
    cannot be saved: a function, such as that of a custom [`ImplicitSurface`][].
    """
    whole = dataclasses.replace(fit, region=fit.region.evaluated())
    made_with = importlib.metadata.version("phongfit")
    write_packed(Path(path), {**header(), "made_with": made_with}, whole)


@checked
def load_fit(path: str | os.PathLike[str]) -> Fit:
    """Read a fit that [`save_fit`][] wrote; it prints, draws and predicts as before.

    Modules of custom classes, such as a light, must have been imported. The file holds
    no code.

    **Raises:** `ValueError` that names the file, what was expected and what was got:
    another version of the format, or the other floating-point precision.
    """
    data = read_bytes(Path(path))
    with naming(str(path)):
        try:
            arrays = unpack(data)
            structure = parse_json(arrays[STRUCTURE].tobytes())
            _check_header({name: structure[name] for name in header()})
            found = _Unpacker(arrays).unpack(structure["value"])
        except (ValueError, MemoryError):
            raise
        except Exception as error:
            # Broken or handmade files can raise nearly any exception.
            raise ValueError("is no file that Fit.save has written") from error
        if not isinstance(found, Fit):
            raise ValueError(f"expected a Fit, got a {type(found).__name__}")
    return found


def header() -> dict[str, object]:
    """Header of a saved fit in this version and precision."""
    precision = str(jnp.result_type(float))
    return {"format": FORMAT, "version": VERSION, "precision": precision}


def write_packed(path: Path, header: dict[str, Any], value: Any) -> None:
    """Write a value, whole or not at all.

    **Arguments:**

    - `header`: further JSON, which is checked first when the file is read.
    - `value`: numbers, text, arrays, sequences, dictionaries and dataclasses of these.

    **Raises:** `OSError` that names the file; `ValueError` that names the part of
    `value` that cannot be stored, such as a function.
    """
    packer = _Packer()
    structure = {**header, "value": packer.pack(value, "")}
    text = np.frombuffer(json.dumps(structure).encode(), np.uint8)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, **packer.arrays | {STRUCTURE: text}
        )


def _check_header(found: dict[str, Any]) -> None:
    for name, wanted in header().items():
        if found[name] != wanted:
            remedy = f"; {_REMEDIES[name]}" if name in _REMEDIES else ""
            got = shorten(found[name]).strip('"')
            raise ValueError(f"{name}: expected {wanted}, got {got}{remedy}")


class _Packer:
    """Packs values: structure as JSON, and each array once."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self._known: dict[int, tuple[Any, str]] = {}

    def pack(self, value: Any, where: str) -> Any:
        if value is None or isinstance(value, bool | str):
            return value
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            kind = "jax" if isinstance(value, jax.Array) else "array"
            return {kind: self._array(value)}
        if isinstance(value, int | float):
            return {"number": repr(value)} if isinstance(value, float) else value
        if isinstance(value, dict):
            items = value.items()
            return {"dict": [[k, self.pack(v, f"{where}[{k!r}]")] for k, v in items]}
        if isinstance(value, list):
            return [self.pack(v, f"{where}[{k}]") for k, v in enumerate(value)]
        names = _fields(type(value))
        if names is not None:
            if not isinstance(value, tuple):
                # Other fields are only defaults of the class.
                names = [name for name in names if name in vars(value)]
            parts = {n: self.pack(getattr(value, n), f"{where}.{n}") for n in names}
            return {"class": _name(type(value)), "fields": parts}
        if isinstance(value, tuple):
            parts = [self.pack(v, f"{where}[{k}]") for k, v in enumerate(value)]
            return {"tuple": parts}
        kind = "a function" if callable(value) else f"a {type(value).__name__}"
        raise ValueError(
            f"{where.removeprefix('.')}: {kind} cannot be saved, expected numbers, "
            "arrays, or a dataclass of these"
        )

    def _array(self, value: Any) -> str:
        # Keep the value alive, so that its id is not reused.
        _, name = self._known.setdefault(id(value), (value, f"a{len(self._known)}"))
        self.arrays[name] = np.asarray(value)
        return name


class _Unpacker:
    """Unpacks values from their structure and arrays."""

    def __init__(self, arrays: dict[str, np.ndarray]):
        self._arrays = arrays
        self._shared: dict[str, jax.Array] = {}

    def unpack(self, node: Any) -> Any:
        match node:
            case list():
                return [self.unpack(one) for one in node]
            case {"array": name}:
                array = self._arrays[name]
                return array if array.ndim else array[()]
            case {"jax": name}:
                if name not in self._shared:
                    self._shared[name] = jnp.asarray(self._arrays[name])
                return self._shared[name]
            case {"number": text}:
                return float(text)
            case {"dict": items}:
                return {key: self.unpack(one) for key, one in items}
            case {"tuple": parts}:
                return tuple(self.unpack(one) for one in parts)
            case {"class": name, "fields": parts}:
                return self._made(name, parts)
        return node

    def _made(self, name: str, parts: dict[str, Any]) -> Any:
        kind = _class(name)
        fields = _fields(kind)
        if fields is not None:
            # A field that this version does not have may be left out if it is empty.
            parts = {
                field: part
                for field, part in parts.items()
                if field in fields or part is not None
            }
        missing = {name for name in fields or () if not hasattr(kind, name)}
        if fields is None or not missing <= set(parts) <= set(fields):
            name, got = shorten(name), shorten(", ".join(map(str, parts)))
            raise ValueError(
                f"{name}: expected its fields {fields}, got {got}: the file is of "
                "another version"
            )
        values = {field: self.unpack(part) for field, part in parts.items()}
        if issubclass(kind, tuple):
            return kind(**values)
        made = object.__new__(kind)
        for field, value in values.items():
            object.__setattr__(made, field, value)
        return made


def _fields(kind: type) -> list[str] | None:
    """Names of the fields of a dataclass or named tuple; `None` for other classes."""
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind)]
    names = getattr(kind, "_fields", None)
    return list(names) if issubclass(kind, tuple) and names is not None else None


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> type:
    """A class by its name; its module must be loaded, nothing is imported."""
    module, _, path = name.partition(":")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        path, module = shorten(path), shorten(module)
        raise ValueError(f"{path}: there is no such class; import {module} first")
    return found
