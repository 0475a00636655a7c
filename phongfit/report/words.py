"""A fit in plain words: summary, units and assumptions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from phongfit.files.fits import made_with
from phongfit.fitting.problem.parameters import REFLECTANCES
from phongfit.fitting.result import Fit, Images
from phongfit.fitting.uncertainty.numbers import number_with_error
from phongfit.scene import Scene

_MATERIAL = ("ambient", "diffuse", "specular", "shininess")
# By the last word of a label.
_UNITS = {
    "shininess": "exponent",
    "exposure": "factor",
    "direction": "unit vector",
    "axis": "unit vector",
    "rotation": "degrees from where it was",
    "fov_y": "degrees",
    "fx": "pixels",
    "fy": "pixels",
    "cx": "pixels",
    "cy": "pixels",
    "skew": "pixels",
    "intensity": "light, white = 1",
    "coefficients": "light, white = 1",
    "color": "light, white = 1",
    "cutoff": "degrees",
    "exponent": "exponent",
    "density": "per world unit",
    "attenuation": "per world unit and its square",
}
# Descriptions of a model's switches, off and on.
_SWITCHES = {
    "gate": (
        "a highlight even where the light is behind",
        "no highlight where the light is behind",
    ),
    "normalized": (
        "highlights equally high for all exponents",
        "highlights of about equal energy for all exponents",
    ),
}
_REFLECTANCE, _LENGTH = "reflectance, 0 … 1", "world units"


def unit(label: str) -> str:
    """The unit of an unknown, from its label."""
    parameter = label.partition("[")[0].partition(".")[0]
    if parameter in REFLECTANCES:
        return "light, white = 1" if parameter == "emission" else _REFLECTANCE
    words = label.removesuffix(".x").removesuffix(".y").removesuffix(".z")
    for channel in (".red", ".green", ".blue"):
        words = words.removesuffix(channel)
    last = words.rpartition(".")[2].partition("[")[0]
    if ".distortion." in label:
        return "coefficient of the lens"
    if last in ("ambient", "specular"):
        return "light, white = 1"
    return _UNITS.get(last, _LENGTH)


def as_tuple(images: Images) -> tuple[np.ndarray, ...]:
    """Images of a fit as a tuple, even if there is only one."""
    return images if isinstance(images, tuple) else (images,)


def summary(fit: Fit) -> list[str]:
    """The result of a fit in a few sentences."""
    sentences = [_what(fit), _how_it_ended(fit), _residual_words(fit)]
    known = [name for name in _MATERIAL if _identified_parameter(fit, name)]
    if known:
        found = "; ".join(_parameter_words(fit, name) for name in known)
        sentences.append(f"Found: {found}.")
    for flags, what in (
        (fit.unidentified, "The data do not identify {}: the warnings say why."),
        (fit.at_bound, "At the end of what was allowed: {}."),
    ):
        labels = [label for label, flag in zip(fit.labels, flags, strict=True) if flag]
        if labels:
            sentences.append(what.format(listed(labels)))
    if fit.identified.all():
        sentences.append("The data identify everything that was asked.")
    return sentences


def listed(words: Sequence[str], most: int = 6) -> str:
    """Words with commas; if many, the first ones and the number of the others."""
    shown = list(words[:most])
    if len(words) > most:
        return f"{', '.join(shown)} and {len(words) - most} more"
    return " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]]))


def _what(fit: Fit) -> str:
    count = "one photograph" if fit.n_images == 1 else f"{fit.n_images} photographs"
    materials = fit.solution.problem.unknowns.materials
    what = "One material was" if materials == 1 else f"{materials} materials were"
    samples = f"{fit.n_samples:,} samples (pixels times channels)"
    return f"{what} fitted to {count}: {samples}, {len(fit.labels)} unknowns."


def _how_it_ended(fit: Fit) -> str:
    if fit.converged:
        return f"The solver converged after {fit.steps} steps."
    return f"The solver did not converge in {fit.steps} steps: {fit.reason}."


def _residual_words(fit: Fit) -> str:
    level = f"{fit.noise:.3g} ({100 * fit.noise:.2g} % of white)"
    if fit.noise_given:
        times = np.sqrt(fit.reduced_chi_squared)
        return f"Residuals are {times:.2f} times the noise that was given, {level}."
    if fit.misfit.significant or fit.neighbour_correlation > 0.1:
        return f"Residuals are of size {level}, but they are not noise alone."
    words = f"What is left over looks like noise of standard deviation {level}"
    if fit.misfit.noise_differs:
        words += ", not the same in all channels or all light; errors include this"
    return f"{words}."


def _identified_parameter(fit: Fit, name: str) -> bool:
    entries = [k for k, label in enumerate(fit.labels) if _is_of(label, name)]
    return bool(entries) and len(entries) <= 3 and bool(fit.identified[entries].all())


def _is_of(label: str, name: str) -> bool:
    return label == name or label.startswith(f"{name}.")


def _parameter_words(fit: Fit, name: str) -> str:
    numbers = [
        f"{number_with_error(value, error)} ± {error:.2g}"
        for label, value, error in zip(fit.labels, fit.values, fit.errors, strict=True)
        if _is_of(label, name)
    ]
    return f"{name} {', '.join(numbers)}"


def assumptions(fit: Fit) -> dict[str, str]:
    """Assumptions of a fit, as names and values."""
    scenes = fit.scene if isinstance(fit.scene, tuple) else (fit.scene,)
    unknowns = fit.solution.problem.unknowns
    noise = f"{fit.noise:.3g} of white, {'given' if fit.noise_given else 'estimated'}"
    return {
        **scene_words(scenes),
        "film": f"{fit.film}; light is linear, white = 1",
        "noise": noise,
        "loss": fit.loss,
        "unknown": ", ".join(unknowns.sought),
        "bounds": bounds_words(fit),
        "known beforehand": known_words(fit),
        "versions": versions(),
    }


def scene_words(scenes: Sequence[Scene]) -> dict[str, str]:
    """Assumptions that all scenes of a fit share, as names and values."""
    scene = scenes[0]
    kinds = sorted({type(light).__name__ for one in scenes for light in one.lights})
    lights = f"{len(scene.lights)} an image ({', '.join(kinds) or 'none'})"
    return {
        "specular model": settings(scene.specular_model),
        "shading": type(scene.shading).__name__,
        "surface": type(scene.surface).__name__,
        "lights": f"{lights}, shadows {'thrown' if scene.shadows else 'not thrown'}",
    }


def versions() -> str:
    """Versions of the libraries, the precision and the platform, in words."""
    return ", ".join(f"{name} {version}" for name, version in made_with().items())


def settings(module: Any) -> str:
    """The class of a model, its switches and its numbers, in words."""
    words = []
    for name, value in vars(module).items():
        if isinstance(value, bool):
            off, on = _SWITCHES.get(name, (f"{name}: no", f"{name}: yes"))
            words.append(on if value else off)
        elif value is not None and np.ndim(value) == 0:
            words.append(f"{name}: {float(value):.4g}")
    kind = type(module).__name__
    return f"{kind} ({'; '.join(words)})" if words else kind


def bounds_words(fit: Fit) -> str:
    """Bounds of the unknowns in words, with equal bounds grouped."""
    unknowns = fit.solution.problem.unknowns
    parameters = unknowns.table.parameter[unknowns.reported]
    groups: dict[tuple[float, float], list[str]] = {}
    for parameter, (low, high) in zip(
        parameters.tolist(), fit.bounds.tolist(), strict=True
    ):
        names = groups.setdefault((low, high), [])
        if parameter not in names:
            names.append(parameter)
    return "; ".join(
        f"{listed(names)} {low:g} … {high:g}".replace("inf", "∞").replace("-", "−")
        for (low, high), names in groups.items()
    )


def known_words(fit: Fit) -> str:
    """Constraints in words: unknowns that were held, tied or had a prior."""
    unknowns = fit.solution.problem.unknowns
    labels = unknowns.table.label
    groups = (
        ("held", labels, unknowns.fixed),
        ("tied", fit.labels, fit.tied),
        ("with a prior", labels, unknowns.has_prior & ~unknowns.table.nuisance),
        ("with an error of its own", *_uncertain(fit)),
    )
    words = [
        f"{what}: {listed(chosen)}"
        for what, names, flags in groups
        if (chosen := [n for n, flag in zip(names, flags, strict=True) if flag])
    ]
    return "; ".join(words) or "nothing"


def _uncertain(fit: Fit) -> tuple[list[str], list[bool]]:
    """Arrays of the scenes with a given covariance that are not among the unknowns."""
    asked = fit.specification
    names = [n for n in asked.uncertain_arrays if n not in asked.unknowns]
    return names, [True] * len(names)
