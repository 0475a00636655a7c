"""A fit as data for the page: a table of plain text, warnings, and the material."""

import dataclasses
from typing import Any

import numpy as np

from phongfit.fitting.problem.parameters import CHANNELS, REFLECTANCES
from phongfit.fitting.result import Fit
from phongfit.fitting.uncertainty.numbers import number_with_error
from phongfit.lab.scene import angles, make_lights
from phongfit.lab.settings import Settings, matters
from phongfit.lab.words import in_page_words

SYMBOLS = {"diffuse": "ρ_d", "specular": "ρ_s", "ambient": "ρ_a", "shininess": "f"}
OF_MATERIAL = ("diffuse", "specular", "ambient", "shininess")


def fit_response(fit: Fit, truth: Settings | None) -> dict[str, Any]:
    """Data of a fit for the page, without pictures.

    **Arguments:** `truth`: the settings of a synthetic target, else `None`.

    **Returns:** plain text and numbers: `rows` of the table; `head`, a summary of the
    solution; `warnings`; `text`, the printed fit; `settings`, for the sliders, without
    unidentified parameters.
    """
    known = {} if truth is None else true_numbers(truth)
    words = tuple(map(in_page_words, fit.warnings))
    fit = dataclasses.replace(fit, warnings=words)
    return {
        "rows": [_row(fit, k, known) for k in range(len(fit.labels))],
        "head": _head(fit),
        "warnings": list(fit.warnings),
        "text": str(fit),
        "settings": _material_found(fit) | _light_found(fit),
    }


def _material_found(fit: Fit) -> dict[str, Any]:
    return {
        name: np.asarray(getattr(fit.material, name), float).tolist()
        for name in OF_MATERIAL
        if not np.any(fit[name].unidentified)
    }


def _light_found(fit: Fit) -> dict[str, float]:
    """Angles and distance of a light whose direction or position was unknown."""
    labels = [label for label in fit.labels if label.startswith("scene.lights[0]")]
    if not labels or any(fit[label].unidentified for label in labels):
        return {}
    azimuth, elevation, distance = angles([fit[label].value for label in labels])
    found = {"azimuth": azimuth, "elevation": elevation}
    return found | ({} if "direction" in labels[0] else {"distance": distance})


def true_numbers(settings: Settings) -> dict[str, float]:
    """True values of a target made from these settings, by label."""
    numbers = {"shininess": settings.shininess}
    for name in REFLECTANCES:
        for channel, value in zip(CHANNELS, getattr(settings, name, ()), strict=False):
            numbers[f"{name}.{channel}"] = value
    for light in make_lights(settings):
        for place in ("direction", "position"):
            for axis, value in zip("xyz", getattr(light, place, ()), strict=False):
                numbers[f"scene.lights[0].{place}.{axis}"] = float(value)
    return numbers


def differences(assumed: Settings, truth: Settings) -> list[str]:
    """Titles of settings in which a fit's assumptions differ from its target."""
    return [
        str(Settings.model_fields[name].title)
        for name in matters(assumed)
        if name in matters(truth) and name not in OF_MATERIAL
        if getattr(assumed, name) != getattr(truth, name)
    ]


def _head(fit: Fit) -> str:
    state = "Converged" if fit.converged else "Did not converge"
    noise = "given" if fit.noise_given else "estimated"
    return (
        f"{state} after {fit.steps} steps on {fit.n_samples:,} samples; "
        f"noise {fit.noise:.2g} ({noise})"
    )


def _row(fit: Fit, k: int, known: dict[str, float]) -> dict[str, str]:
    label, value, error = fit.labels[k], float(fit.values[k]), float(fit.errors[k])
    truth = known.get(label)
    identified = not fit.unidentified[k]
    row = {
        "label": label,
        "name": _name(label),
        "truth": "" if truth is None else f"{truth:.4g}",
        "value": number_with_error(value, error) if identified else "–",
        "error": f"± {error:.2g}" if identified else "± ∞",
        "off": "",
        "note": "" if identified else "not identifiable",
    }
    if fit.at_bound[k]:
        row["note"] = "at its bound"
    if truth is not None and identified and error > 0:
        row["off"] = f"{(value - truth) / error:+.1f} σ".replace("-", "−")
    return row


def _name(label: str) -> str:
    """`diffuse.red` as ρ_d red, `scene.lights[0].direction.x` as light direction x."""
    first, *rest = label.removeprefix("scene.lights[0].").split(".")
    start = SYMBOLS.get(first, f"light {first}")
    return " ".join((start, *rest))
