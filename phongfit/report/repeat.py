"""The call that repeats a fit: what was asked, written out."""

import dataclasses
from typing import Any

import equinox as eqx
import jax

from phongfit.fitting.problem.losses import LOSSES, AbstractLoss
from phongfit.fitting.result import Fit
from phongfit.material import Material
from phongfit.plain import plain
from phongfit.rendering.film import Film
from phongfit.rendering.response import ResponseCurve


def names(fit: Fit) -> list[str]:
    """What the call takes from the caller, by the names that it has there."""
    plural = _plural(fit)
    return [f"scene{plural}", f"image{plural}", *_arrays(fit).values()]


def _plural(fit: Fit) -> str:
    return "s" if isinstance(fit.scene, tuple) else ""


def _arrays(fit: Fit) -> dict[str, str]:
    """Arguments that came as arrays, and the name that each has in the call."""
    arrays = list(fit.arrays)
    if "weights" in arrays and fit.noise_given and "noise" not in arrays:
        # The samples know what the two make together.
        arrays.append("noise")
    if _is_table(fit):
        arrays.append("film")
    if fit.specification.uncertain:
        arrays.append("uncertain")
    shown = {"mask": f"mask{_plural(fit)}"}
    return {name: shown.get(name, name) for name in arrays}


def _is_table(fit: Fit) -> bool:
    """Whether the film is made of a file's tables, which are no part of a call."""
    return any(
        film.jpeg is not None or isinstance(film.encoding, ResponseCurve)
        for film in fit.films
    )


def call(fit: Fit) -> str:
    """`pf.fit(scene, image, ...)` with all settings that are not the defaults.

    Scenes, images and other arrays are the caller's: see [`names`][].
    """
    arrays, changed = _arrays(fit), fit.specification.changed
    asked = {name: _written(v) for name, v in changed.items() if name not in arrays}
    noise = {"noise": f"{fit.noise:.6g}"} if fit.noise_given else {}
    given = asked | noise | arrays
    lines = [", ".join(names(fit)[:2])]
    lines += [f"{name}={value}" for name, value in given.items()]
    inside = "".join(f"    {line},\n" for line in lines)
    return f"fit = pf.fit(\n{inside})"


def _written(value: Any) -> str:
    """As Python writes it, in the fewest digits of its own precision."""
    match value:
        case AbstractLoss() if value in LOSSES.values():
            return repr(next(name for name in LOSSES if LOSSES[name] == value))
        case AbstractLoss():
            return _made(value)
        case Material():
            return _made(value, Material())
        case Film():
            return _made(value, Film())
        case (Film(), *_):
            return f"({', '.join(map(_written, value))},)"
    return repr(value)


def _made(value: eqx.Module, usual: eqx.Module | None = None) -> str:
    """The call that makes it, of arguments that differ from the usual ones."""
    fields = {
        f.name: _numbers(getattr(value, f.name)) for f in dataclasses.fields(value)
    }
    inside = ", ".join(
        f"{name}={number!r}"
        for name, number in fields.items()
        if usual is None or number != _numbers(getattr(usual, name))
    )
    # A class of the caller's own stands under its own name.
    ours = type(value).__module__.partition(".")[0] == __name__.partition(".")[0]
    return f"{'pf.' if ours else ''}{type(value).__name__}({inside})"


def _numbers(value: Any) -> Any:
    """An array as nested lists of short numbers."""
    return plain(value) if isinstance(value, jax.Array) else value
