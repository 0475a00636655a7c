"""The call that repeats a fit, written out from what the fit itself knows."""

from typing import Any

import numpy as np

from phongfit.fitting.fit import DEFAULT_PER_CHANNEL, DEFAULT_UNKNOWNS
from phongfit.fitting.leaves import LEAVES, is_of_scene
from phongfit.fitting.losses import LOSSES
from phongfit.fitting.result import Fit
from phongfit.fitting.unknowns import Unknowns
from phongfit.material import Material


def call(fit: Fit) -> str:
    """`pf.fit(scene, image, ...)` with all settings that are not the defaults.

    Scenes, images, masks and weights are the caller's: they are named, not written out.
    """
    unknowns = fit.found.problem.unknowns
    plural = fit.images > 1
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
        "loss": _loss(fit),
    }
    lines = ["scenes, images" if plural else "scene, image"]
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
