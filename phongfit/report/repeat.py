"""The call that repeats a fit, written out from what the fit itself knows."""

from typing import Any

import numpy as np

from phongfit.fitting.fit import DEFAULT_PER_CHANNEL, DEFAULT_UNKNOWNS
from phongfit.fitting.leaves import LEAVES, is_of_scene
from phongfit.fitting.losses import LOSSES
from phongfit.fitting.noise import find_film
from phongfit.fitting.result import Fit
from phongfit.fitting.summary import film_words
from phongfit.fitting.unknowns import Unknowns
from phongfit.material import Material
from phongfit.rendering.film import ENCODINGS, Film


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
    if _is_jpeg(fit):
        arrays.append("film")
    shown = {"mask": f"mask{_plural(fit)}"}
    return {name: shown.get(name, name) for name in arrays}


def _is_jpeg(fit: Fit) -> bool:
    """Whether the film stands in files: its tables of numbers are no part of a call."""
    return "JPEG" in fit.film


def call(fit: Fit) -> str:
    """`pf.fit(scene, image, ...)` with all settings that are not the defaults.

    Scenes, images and other arrays are the caller's: see [`names`][].
    """
    unknowns = fit.found.problem.unknowns
    given = {
        "unknowns": _unless(DEFAULT_UNKNOWNS, _names(unknowns)),
        "per_channel": _unless(_default_channels(unknowns), _per_channel(unknowns)),
        "per_image": _unless((), _per_image(unknowns)),
        "known": _known(unknowns),
        "bounds": _unless({}, _bounds(fit)),
        "fixed": _unless({}, _fixed(unknowns)),
        "ties": _unless({}, _ties(unknowns)),
        "priors": _unless({}, _priors(unknowns)),
        "noise": f"{fit.noise:.6g}" if fit.noise_given else "",
        "film": _film(fit),
        "loss": _loss(fit),
    }
    given |= _arrays(fit)
    lines = [", ".join(names(fit)[:2])]
    lines += [f"{name}={value}" for name, value in given.items() if value]
    inside = "".join(f"    {line},\n" for line in lines)
    return f"fit = pf.fit(\n{inside})"


def _unless(default: Any, value: Any) -> str:
    return "" if value == default else repr(value)


def _names(unknowns: Unknowns) -> tuple[str, ...]:
    return tuple(unknowns.names)


def _default_channels(unknowns: Unknowns) -> tuple[str, ...]:
    return tuple(name for name in unknowns.names if name in DEFAULT_PER_CHANNEL)


def _per_channel(unknowns: Unknowns) -> tuple[str, ...]:
    return tuple(leaf.name for leaf in unknowns.leaves if max(leaf.channels) >= 0)


def _per_image(unknowns: Unknowns) -> tuple[str, ...]:
    return tuple(
        leaf.name
        for leaf in unknowns.leaves
        if leaf.per_image and is_of_scene(leaf.name)
    )


def _known(unknowns: Unknowns) -> str:
    """The material's leaves that were not unknown, where they are not the defaults."""
    plain = Material(0.0, 0.0, 32.0, 0.0)
    leaves = {}
    for name in LEAVES:
        value = np.asarray(getattr(unknowns.known, name))
        default = np.asarray(getattr(plain, name))
        if name not in unknowns.names and not np.all(value == default):
            leaves[name] = [_short(number) for number in value.ravel()]
            leaves[name] = leaves[name][0] if value.ndim == 0 else leaves[name]
            if value.ndim > 1:
                leaves[name] = [[_short(n) for n in row] for row in value]
    if not leaves:
        return ""
    # Those that are left out must say so, since a Material has defaults of its own.
    full = {"diffuse": 0.0, "ambient": 0.0} | leaves
    return f"pf.Material({', '.join(f'{k}={v!r}' for k, v in full.items())})"


def _bounds(fit: Fit) -> dict[str, tuple[float, float]]:
    unknowns = fit.found.problem.unknowns
    defaults = [f.default_bounds for f in unknowns.leaves for _ in f.labels]
    forms = unknowns.forms
    found = {}
    for label, entry, box in zip(
        fit.labels, unknowns.reported, fit.bounds, strict=True
    ):
        low, high = (float(edge) for edge in box)
        own = unknowns.source[entry] == entry and forms[entry] != "direction"
        if own and (low, high) != defaults[entry]:
            found[label] = (low, high)
    return found


def _fixed(unknowns: Unknowns) -> dict[str, float]:
    offset = np.asarray(unknowns.offset)
    labels = unknowns.entry_labels
    held = np.flatnonzero(unknowns.fixed)
    return {labels[entry]: _short(offset[entry]) for entry in held}


def _ties(unknowns: Unknowns) -> dict[str, tuple[float, str]]:
    factor, labels = np.asarray(unknowns.factor), unknowns.entry_labels
    return {
        labels[entry]: (_short(factor[entry]), labels[source])
        for entry, source in enumerate(unknowns.source)
        if entry != source
    }


def _priors(unknowns: Unknowns) -> dict[str, tuple[float, float]]:
    mean = np.asarray(unknowns.prior_mean)
    deviation = np.asarray(unknowns.prior_deviation)
    labels = unknowns.entry_labels
    return {
        labels[entry]: (_short(mean[entry]), _short(deviation[entry]))
        for entry in np.flatnonzero(unknowns.has_prior)
    }


def _film(fit: Fit) -> str:
    """The film, where the images' values would not tell it."""
    if _is_jpeg(fit):
        return "film"
    samples = fit.found.problem.samples
    used = np.asarray(samples.target)[np.asarray(samples.weight) > 0]
    if film_words(find_film([used])) == fit.film:
        return ""
    films: list[dict[str, Any]] = [{}, {"clamp": False}]
    films += [{"encoding": e, "bits": b} for e in ENCODINGS for b in range(1, 17)]
    settings = next(one for one in films if film_words(Film(**one)) == fit.film)
    return f"pf.Film({', '.join(f'{k}={v!r}' for k, v in settings.items())})"


def _loss(fit: Fit) -> str:
    loss = fit.found.problem.loss
    names = [name for name, known in LOSSES.items() if known == loss]
    if names:
        return _unless("linear", names[0])
    settings = ", ".join(f"{key}={value!r}" for key, value in vars(loss).items())
    return f"pf.{type(loss).__name__}({settings})"


def _short(number: Any) -> float:
    """A number in the fewest digits of its own precision."""
    return float(str(number))
