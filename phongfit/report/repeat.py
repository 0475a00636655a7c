"""The call that repeats a fit, as Python text."""

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
    """Names of the variables that the call uses: scene, image and other arrays."""
    plural = _plural(fit)
    return [f"scene{plural}", f"image{plural}", *_arrays(fit).values()]


def _plural(fit: Fit) -> str:
    return "s" if isinstance(fit.scene, tuple) else ""


def _arrays(fit: Fit) -> dict[str, str]:
    """Arguments that were arrays, with the name of each variable in the call."""
    arrays = list(fit.arrays)
    if "weights" in arrays and fit.noise_given and "noise" not in arrays:
        # Samples keep only the combination of weights and noise.
        arrays.append("noise")
    if _is_table(fit):
        arrays.append("film")
    if fit.specification.uncertain:
        arrays.append("uncertain")
    shown = {"mask": f"mask{_plural(fit)}"}
    return {name: shown.get(name, name) for name in arrays}


def _is_table(fit: Fit) -> bool:
    """True if the film has tables from a file, which cannot be written in a call."""
    return any(
        film.jpeg is not None or isinstance(film.encoding, ResponseCurve)
        for film in fit.films
    )


def call(fit: Fit) -> str:
    """`pf.fit(scene, image, ...)` with all settings that are not the defaults.

    Scenes, images and other arrays are variables of the caller: see [`names`][].
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
    """A value as Python text, with the fewest digits of its precision."""
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
    """The constructor's call for a value, with arguments that differ from `usual`."""
    fields = {
        f.name: _numbers(getattr(value, f.name)) for f in dataclasses.fields(value)
    }
    inside = ", ".join(
        f"{name}={number!r}"
        for name, number in fields.items()
        if usual is None or number != _numbers(getattr(usual, name))
    )
    # Classes of other packages have no prefix.
    ours = type(value).__module__.partition(".")[0] == __name__.partition(".")[0]
    return f"{'pf.' if ours else ''}{type(value).__name__}({inside})"


def _numbers(value: Any) -> Any:
    """An array as nested lists of short numbers."""
    return plain(value) if isinstance(value, jax.Array) else value
