"""HTML templates, with pictures as data URIs and rows of numbers."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from phongfit.codes import paragraph, warning_code
from phongfit.files.formats import data_uri
from phongfit.fitting.result import Fit, lopsided
from phongfit.fitting.uncertainty.numbers import number_with_error
from phongfit.report.style import png
from phongfit.report.words import unit

DPI = 160


@functools.cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("phongfit.report"),
        # Escape names of files and titles, which are not trusted.
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["linked"] = linked
    return environment


def fill(template: str, **values: Any) -> str:
    """A filled template; values are escaped as text."""
    return _environment().get_template(template).render(**values)


def linked(warning: str) -> Markup:
    """A warning whose code links to its paragraph in the documentation."""
    code = warning_code(warning)
    if code is None:
        return escape(warning)
    words, place = warning.removesuffix(f"[{code}]"), paragraph(code)
    if place.startswith("https://"):
        return Markup('{}<a href="{}">[{}]</a>').format(words, place, code)
    return Markup('{}<span title="{}">[{}]</span>').format(words, place, code)


def panel(
    figure: Figure, alt: str, caption: str = "", dpi: float = DPI, **more: Any
) -> dict[str, Any]:
    """A picture embedded in a page: `source`, `alt`, `caption` and further values."""
    source = data_uri(png(figure, dpi))
    return {"source": source, "alt": alt, "caption": caption, **more}


def parameters(fit: Fit) -> list[dict[str, Any]]:
    """Rows of the table of unknowns: label, value, error, percent, unit, and note."""
    words, rows = lopsided(fit), []
    for k, label in enumerate(fit.labels):
        notes = ["at its bound"] * bool(fit.at_bound[k])
        notes += ["tied"] * bool(fit.tied[k])
        notes += [words[k]] if words.get(k) else []
        error = math.inf if fit.unidentified[k] else float(fit.errors[k])
        rows.append(row(label, float(fit.values[k]), error, notes))
    return rows


def row(
    label: str, value: float, error: float, notes: Sequence[str] = ()
) -> dict[str, Any]:
    """One row of the table; an infinite error is shown as "not identifiable"."""
    known = np.isfinite(error)
    shown = {
        "label": label,
        "value": number_with_error(value, error),
        "unit": unit(label),
    }
    if not known:
        return shown | {"error": "∞", "percent": "", "note": "not identifiable"}
    percent = 100 * error / abs(value) if value else math.inf
    # Above 100 % the exact number is not informative.
    words = f"{percent:.2g} %" if percent < 99.5 else "> 99 %" if value else "–"
    return shown | {
        "error": f"{error:.2g}",
        "percent": words,
        "note": ", ".join(notes),
    }
