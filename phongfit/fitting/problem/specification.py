"""The options of a fit: everything but the data."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict, Unpack

import numpy as np

from phongfit.checks import untraced
from phongfit.edge import checked
from phongfit.fitting.problem.losses import AbstractLoss, as_loss
from phongfit.fitting.problem.parameters import (
    MATERIAL_PARAMETERS,
    is_of_model,
    is_of_scene,
)
from phongfit.material import Material
from phongfit.rendering.film import Film

DEFAULT_UNKNOWNS = ("ambient", "diffuse", "specular", "shininess")
DEFAULT_PER_CHANNEL = ("ambient", "diffuse", "specular")

# A name, or a factor and a name.
Tie = str | tuple[float, str]
# Keys are a name, or several names of arrays with correlated errors.
Uncertain = Mapping[Any, Any]


class SpecificationOptions(TypedDict, total=False):
    """The options of a fit as they may be written: see [`fit`][]."""

    unknowns: Sequence[str] | None
    per_channel: Sequence[str] | None
    per_image: Sequence[str] | None
    known: Material | None
    bounds: Mapping[str, tuple[float, float]] | None
    fixed: Mapping[str, Any] | None
    ties: Mapping[str, Tie] | None
    priors: Mapping[str, tuple[Any, Any]] | None
    uncertain: Uncertain | None
    film: Film | Sequence[Film] | None
    loss: str | AbstractLoss | None
    max_steps: int
    tolerance: float | None


@dataclasses.dataclass(frozen=True, init=False)
class Specification:
    """The options of [`fit`][] in a normal form, to be compared, stored and reused.

    Sequences become tuples, arrays nested tuples of numbers, a tie a factor and a name,
    and a loss's name that loss. Whether names and numbers suit a scene is checked
    later, together with the scene.
    """

    unknowns: tuple[str, ...]
    per_channel: tuple[str, ...]
    per_image: tuple[str, ...]
    known: Material | None
    bounds: Mapping[str, tuple[float, float]]
    fixed: Mapping[str, Any]
    ties: Mapping[str, tuple[float, str]]
    priors: Mapping[str, tuple[Any, Any]]
    uncertain: Uncertain
    film: Film | tuple[Film, ...] | None
    loss: AbstractLoss
    max_steps: int
    # Files of older versions have none.
    tolerance: float | None = None

    @checked
    def __init__(self, **options: Unpack[SpecificationOptions]):
        """**Arguments:** those of [`fit`][] except the data: `scene`, `image`, `mask`,
        `weights`, `noise`.

        **Raises:** `ValueError` that names the argument; `TypeError` for an unknown
        option.
        """
        given: dict[str, Any] = {**_DEFAULTS, **options}
        steps, film = given["max_steps"], given["film"]
        if not isinstance(steps, int) or not 0 < steps < 2**31:
            raise ValueError(
                f"max_steps: expected a whole number from 1 to {2**31 - 1}, got "
                f"{steps!r}"
            )
        tolerance = given["tolerance"]
        if tolerance is not None and not 0 < tolerance < 1:
            raise ValueError(f"tolerance: expected a number in (0, 1), got {tolerance}")
        # A static field of the problem, which an array cannot be.
        given["tolerance"] = None if tolerance is None else float(tolerance)
        for name in ("unknowns", "per_channel", "per_image"):
            given[name] = _names(name, given[name])
        for name in ("bounds", "fixed", "ties", "priors", "uncertain"):
            given[name] = _comparable(given[name] or {})
        ties = given["ties"].items()
        given["ties"] = {k: (1.0, v) if isinstance(v, str) else v for k, v in ties}
        given["film"] = film if isinstance(film, Film | None) else tuple(film)
        given["loss"] = as_loss("linear" if given["loss"] is None else given["loss"])
        for name, value in given.items():
            object.__setattr__(self, name, value)
        self._check_names()

    @property
    def options(self) -> dict[str, Any]:
        """All options, as keyword arguments of [`fit`][]."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    def to_dict(self) -> dict[str, Any]:
        """All options as types that `json.dumps` accepts, for `from_dict`.

        **Raises:** `ValueError` that names an option that JSON cannot hold: a loss that
        has no name, or `known` with a row for each material.
        """
        from phongfit.files.fits import describe_specification

        return describe_specification(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Specification":
        """The specification that `to_dict` wrote; options that are left out are usual.

        **Raises:** `ValueError` that names the option.
        """
        from phongfit.files.fits import read_specification

        return read_specification(data)

    @property
    def uncertain_arrays(self) -> tuple[str, ...]:
        """Names of the scenes' arrays that are uncertain."""
        return tuple(name for key in self.uncertain for name in as_names(key))

    def _check_names(self) -> None:
        if not self.unknowns:
            raise ValueError("unknowns: expected at least one, got none")
        if len(set(self.unknowns)) != len(self.unknowns):
            raise ValueError(
                f"unknowns: expected each name once, got {', '.join(self.unknowns)}"
            )
        there = tuple(dict.fromkeys((*MATERIAL_PARAMETERS, *self.unknowns)))
        for argument in ("per_channel", "per_image"):
            for name in getattr(self, argument):
                if name not in there:
                    raise ValueError(
                        f"{argument}: expected one of {', '.join(there)}, got {name!r}"
                    )
        for name in self.uncertain_arrays:
            if self.uncertain_arrays.count(name) > 1:
                raise ValueError(f"uncertain: expected each name once, got {name} more")
        for name in self.per_image:
            if not is_of_scene(name) or is_of_model(name):
                raise ValueError(
                    f"per_image: expected an array of the scenes, got {name!r}: "
                    "all images show the same material"
                )

    @property
    def asks_as_usual(self) -> bool:
        """True if all options of the unknowns have their defaults."""
        return not self.changed.keys() - {"film", "loss", "max_steps", "tolerance"}

    @property
    def changed(self) -> dict[str, Any]:
        """Options that differ from the defaults."""
        given = self.options.items()
        return {name: v for name, v in given if v != getattr(_USUAL, name)}

    def refuse(self, names: str, function: str) -> None:
        """Raise `ValueError` that names an option of `names` that is not the default.

        **Arguments:** `names`: separated by spaces; `function`: has no use for them.
        """
        for name in names.split():
            if name in self.changed:
                raise ValueError(f"{name}: expected its default in {function}")


def as_names(key: Any) -> tuple[str, ...]:
    """Names of the arrays in a key of `uncertain`.

    **Raises:** `ValueError` if it is neither a name nor several.
    """
    names = (key,) if isinstance(key, str) else key
    if not isinstance(names, tuple) or not all(isinstance(n, str) for n in names):
        raise ValueError(f"uncertain: expected a name, or several, got {key!r}")
    return names


def _names(argument: str, given: Sequence[Any] | None) -> tuple[Any, ...]:
    if isinstance(given, str):
        raise ValueError(f"{argument}: expected a list of names, got {given!r}")
    return () if given is None else tuple(given)


def _comparable(value: Any) -> Any:
    """Convert arrays to nested tuples of numbers, which can be compared."""
    if isinstance(value, Mapping):
        return {key: _comparable(one) for key, one in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(map(_comparable, value))
    return _comparable(np.asarray(value).tolist()) if hasattr(value, "dtype") else value


_DEFAULTS: SpecificationOptions = {
    "unknowns": DEFAULT_UNKNOWNS,
    "per_channel": DEFAULT_PER_CHANNEL,
    "per_image": (),
    "known": None,
    "bounds": None,
    "fixed": None,
    "ties": None,
    "priors": None,
    "uncertain": None,
    "film": None,
    "loss": "linear",
    "max_steps": 200,
    "tolerance": None,
}
_USUAL = Specification()


def specified(
    specification: Specification | None,
    options: Mapping[str, Any],
    instead: str,
    default: Specification = _USUAL,
) -> Specification:
    """A function's options: `options`, what a specification changes, and the default.

    **Arguments:**

    - `options`: those given beside the specification; a loss of `None` is none.
    - `instead`: see [`untraced`][].
    - `default`: the function's own defaults.

    **Raises:** `ValueError` that names an option, also if it is traced.
    """
    options = {k: v for k, v in options.items() if k != "loss" or v is not None}
    chosen = {**(specification or default).options, **options}
    lists = {k: [*v.values()] for k, v in chosen.items() if isinstance(v, Mapping)}
    untraced(instead, **chosen | lists)
    if specification is not None:
        chosen = {**default.options, **specification.changed, **options}
    return Specification(**chosen)
