"""The report: a self-contained HTML page of a fit, which needs no network."""

import os
from collections.abc import Mapping, Sequence

from phongfit.edge import checked
from phongfit.files.outputs import replacing
from phongfit.fitting.result import Fit
from phongfit.fitting.uncertainty.diagnostics import Diagnostics
from phongfit.plain import readable
from phongfit.report.html import fill, parameters
from phongfit.report.panels import (
    about_pictures,
    convergence,
    correlations,
    profiles,
    residuals,
    shown,
    trio,
)
from phongfit.report.pictures import Title
from phongfit.report.plots import brightening, chosen, names_of
from phongfit.report.repeat import call, names as names_in_call
from phongfit.report.style import styled
from phongfit.report.words import (
    as_tuple,
    assumptions as assumed,
    listed,
    summary,
)


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
    text = page(
        fit,
        title=title,
        names=names,
        assumptions=assumptions,
        command=command,
        loading=loading,
        diagnostics=diagnostics,
    )
    with replacing(path) as temporary:
        temporary.write_text(readable(text), encoding="utf-8")


def page(
    fit: Fit,
    *,
    title: Title,
    names: Sequence[Title] = (),
    assumptions: Mapping[str, str] | None = None,
    command: str = "",
    loading: str = "",
    diagnostics: Diagnostics | None = None,
) -> str:
    """The text of the page: see [`write_page`][]."""
    every = names_of(fit, names)
    images = chosen(fit.n_images)
    factor = brightening(as_tuple(fit.photographs)[k] for k in images)
    with styled():
        pictures = [trio(shown(fit, k), every[k], factor) for k in images]
        curves, about_curves = profiles(fit, diagnostics)
        course, about_course = convergence(fit, diagnostics)
        matrix, about_matrix = correlations(fit)
        left_over = residuals(fit)
    return fill(
        "page.html",
        title=str(title),
        converged=fit.converged,
        sections=_sections(bool(fit.warnings)),
        sentences=summary(fit),
        warnings=[full_stop(warning) for warning in fit.warnings],
        images=pictures,
        about_pictures=about_pictures(factor, len(images), fit.n_images),
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


def _sections(warned: bool) -> list[tuple[str, str]]:
    names = {
        "summary": "Summary",
        **({"warnings": "Warnings"} if warned else {}),
        "pictures": "Pictures",
        "parameters": "Parameters",
        "profiles": "Profiles",
        "correlations": "Correlations",
        "residuals": "Residuals",
        "convergence": "Convergence",
        "assumptions": "Assumptions",
        "repeat": "How to repeat",
    }
    return list(names.items())


def full_stop(words: str) -> str:
    """A warning as a sentence; without a full stop after a code."""
    return words if words.endswith((".", "]")) else f"{words}."
