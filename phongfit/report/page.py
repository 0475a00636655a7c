"""The report: a self-contained HTML page of a fit, which needs no network."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from phongfit.edge import checked
from phongfit.files.outputs import replacing
from phongfit.fitting.result import Fit
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.uncertainty.diagnostics import Diagnostics
from phongfit.plain import readable
from phongfit.report.html import fill, parameters
from phongfit.report.panels import (
    convergence,
    correlations,
    pictures,
    profiles,
    residuals,
)
from phongfit.report.pictures import Row, Title
from phongfit.report.plots import rows_of
from phongfit.report.repeat import call, names as names_in_call
from phongfit.report.style import styled
from phongfit.report.words import assumptions as assumed, listed, summary


@checked
def write_page(
    path: str | os.PathLike[str],
    fit: Fit,
    *,
    title: Title,
    names: Sequence[Title] = (),
    assumptions: Mapping[str, str] | None = None,
    command: str = "",
    loading: str = "",
    diagnostics: Diagnostics | None = None,
) -> None:
    """Write a report of a fit: a self-contained page, whole or not at all.

    **Arguments:**

    - `path`: the HTML file.
    - `title`: its headline.
    - `names`: of the photographs; default their numbers.
    - `assumptions`: names and values of further assumptions, such as the encoding of
        the files; shown before those that the fit contains.
    - `command`: the command line that repeats the fit, if there was one.
    - `loading`: lines of Python that make the arguments of `fit`: scene, image, mask.
    - `diagnostics`: result of [`Fit`][]`.diagnose`: profiles, and the course of the
        convergence; without it the page has neither.

    **Raises:** `OSError` that names `path`; `ValueError` if there are names, but not
    one for each image.
    """
    with styled():
        curves, about_curves = profiles(fit, diagnostics)
        course, about_course = convergence(fit, diagnostics)
        matrix, about_matrix = correlations(fit)
        left_over = residuals(fit)
    fill_page(
        path,
        "page.html",
        fit,
        rows_of(fit, names),
        fit.n_images,
        title=str(title),
        sentences=summary(fit),
        rows=parameters(fit),
        profiles=curves,
        about_profiles=about_curves,
        correlations=matrix,
        about_correlations=about_matrix,
        residuals=left_over,
        convergence=course,
        about_convergence=about_course,
        assumptions={**(assumptions or {}), **assumed(fit)},
        command=command,
        loading=loading,
        call=call(fit),
        given=listed(names_in_call(fit)),
    )


def fill_page(
    path: str | os.PathLike[str],
    template: str,
    found: Fit | TextureFit,
    images: Sequence[Row],
    n_images: int,
    **values: Any,
) -> None:
    """Write a page with warnings and pictures of a fit, whole or not at all.

    **Arguments:** `images`: those to show, of `n_images`; `values` of the template.
    """
    with styled():
        shown = pictures(images, n_images)
    # A full stop ends a warning, except after a code.
    warnings = [w if w.endswith((".", "]")) else f"{w}." for w in found.warnings]
    values |= {"converged": found.converged, "warnings": warnings, **shown}
    text = readable(fill(template, **values))
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
