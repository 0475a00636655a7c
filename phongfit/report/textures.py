"""Figures and the HTML report of fitted textures."""

import os
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from phongfit.files.dataset import Dataset
from phongfit.files.outputs import replacing
from phongfit.fitting.result import film_words
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texels.sums import AbstractTexels, Grid
from phongfit.fitting.texels.vertices import Vertices
from phongfit.geometry.meshes import Mesh
from phongfit.plain import readable
from phongfit.rendering.render import render
from phongfit.report.html import fill, row, source
from phongfit.report.page import full_stop
from phongfit.report.panels import FittedImage, Panel, about_pictures, trio
from phongfit.report.pictures import Row, comparison
from phongfit.report.plots import brightening, chosen
from phongfit.report.scales import TITLES, draw_numbers, draw_scale
from phongfit.report.style import picture, styled
from phongfit.report.words import listed, settings, versions
from phongfit.scene import Scene


def draw_texture(found: TextureFit, name: str, scene: Scene) -> Figure:
    """A figure of a texture: its colours, numbers with a scale, and standard errors.

    Unidentified texels are grey. Textures of several materials are stacked vertically;
    numbers at vertices are shown from the camera of `scene`.
    """
    values, inside = _laid_out(found, found.values[name], scene)
    errors, _ = _laid_out(found, found.stderr[name], scene)
    places = "pixels" if isinstance(found.texels, Vertices) else "texels"
    return draw_numbers(name, values, errors, inside, places)


def draw_seen(found: TextureFit, scene: Scene) -> Figure:
    """A figure of the number of pixels that see each texel; unseen ones are grey."""
    seen, inside = _laid_out(found, found.seen[..., None], scene)
    seen = seen[..., 0]
    height, width = seen.shape
    none, one = int((found.seen == 0).sum()), found.texels.one
    with styled():
        side = float(np.clip(3.2 * width / height, 2.4, 6))
        figure = picture(side + 0.6, 3.5)
        unseen = f", {none:,} by none" if none else ""
        title = f"pixels that see a {one}{unseen}"
        draw_scale(figure.subplots(), seen, inside & (seen > 0), title)
    return figure


def _laid_out(
    found: TextureFit, layers: np.ndarray, scene: Scene
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of texels or vertices as a picture, and a mask of valid pixels."""
    if not isinstance(found.texels, Vertices):
        # Stack layers vertically.
        whole = layers.reshape(-1, *layers.shape[2:])
        return whole, np.ones(whole.shape[:2], bool)
    assert isinstance(scene.surface, Mesh)
    buffer = scene.trace()
    place = scene.surface.place(buffer)
    corners, weights = np.asarray(place.corners), np.asarray(place.weights)
    layer = np.zeros(corners.shape[:2], int)
    if place.material_index is not None and len(layers) > 1:
        layer = np.asarray(place.material_index)
    rows = layers[layer[..., None], corners]
    # Errors may be infinite, and infinity times weight 0 is NaN.
    with np.errstate(invalid="ignore"):
        return (weights[..., None] * rows).sum(axis=-2), np.asarray(buffer.mask)


def draw_photographs(found: TextureFit, data: Dataset) -> Figure:
    """A figure of photograph, fit and residual of some of the photographs."""
    images, factor = _some(found, data)
    brighter = f"  (shown {factor:.2g} × brighter)" if factor > 1 else ""
    rows = [Row(*one.shown, f"{one.name}{brighter}") for one in images]
    return comparison(rows, ("photograph", "fit"), brighten=factor)


class _Named(NamedTuple):
    name: str
    shown: FittedImage


def _some(found: TextureFit, data: Dataset) -> tuple[list[_Named], float]:
    """Some of the photographs with their fits, and a common factor for display."""
    images = []
    for k in chosen(len(data.images)):
        fitted = np.asarray(render(found.scene(data.scenes[k]), found.material))
        parts = FittedImage(data.images[k], fitted, found.residuals[k])
        images.append(_Named(data.names[k], parts))
    return images, brightening(one.shown.photograph for one in images)


def write_page(
    path: str | os.PathLike[str], found: TextureFit, data: Dataset, *, command: str
) -> None:
    """Write a report of fitted textures: a self-contained page.

    **Arguments:** `data`: the fitted photographs; `command`: command line that repeats
    the fit.

    **Raises:** `OSError` that names `path`.
    """
    images, factor = _some(found, data)
    with styled():
        shown = [trio(one.shown, one.name, factor) for one in images]
        first, one = data.scenes[0], found.texels.one
        textures = [
            _panel(draw_texture(found, n, first), TITLES[n]) for n in found.names
        ]
        textures.append(
            _panel(draw_seen(found, first), f"How many pixels see each {one}")
        )
    names = {
        "summary": "Summary",
        **({"warnings": "Warnings"} if found.warnings else {}),
        "textures": "Textures",
        "pictures": "Pictures",
        **({"parameters": "Numbers"} if found.shared else {}),
        "assumptions": "Assumptions",
        "repeat": "How to repeat",
    }
    text = fill(
        "textures.html",
        title=data.name,
        converged=found.converged,
        sections=list(names.items()),
        sentences=_summary(found),
        warnings=[full_stop(warning) for warning in found.warnings],
        textures=textures,
        images=shown,
        places=found.texels.word,
        about_pictures=about_pictures(factor, len(images), len(data.images)),
        rows=[row(*one) for one in found.shared],
        assumptions=_assumptions(found, data),
        command=command,
    )
    with replacing(path) as temporary:
        temporary.write_text(readable(text), encoding="utf-8")


def _panel(figure: Figure, alt: str) -> Panel:
    inches = float(figure.get_size_inches()[0])
    return {"source": source(figure), "alt": alt, "caption": "", "inches": inches}


def _summary(found: TextureFit) -> list[str]:
    layers, *size = found.seen.shape
    count = len(found.residuals)
    of = "one photograph" if count == 1 else f"{count} photographs"
    several = f" for each of {layers} materials" if layers > 1 else ""
    samples = f"{found.n_samples:,} samples (pixels times channels)"
    steps = f"in {found.steps} steps"
    sentences = [
        f"Textures of {listed(found.names)}, {_sized(size)}{several}, were fitted to "
        f"{of}: {samples}.",
        f"The solver {'converged' if found.converged else 'did not converge'} {steps}.",
        f"Of {found.seen.size:,} {found.texels.word} {int((found.seen > 0).sum()):,} "
        "are seen.",
    ]
    for name in found.names:
        known = np.isfinite(found.stderr[name])
        median = f"{np.median(found.stderr[name][known]):.2g}" if known.any() else "∞"
        sentences.append(
            f"{int(known.all(axis=-1).sum()):,} of {name} are identified, with a "
            f"median standard error of {median}."
        )
    return sentences


def _sized(size: list[int]) -> str:
    if len(size) == 1:
        return f"a number for each of {size[0]:,} vertices"
    rows, columns = size
    return f"{columns} × {rows} texels"


def _interpolated(texels: AbstractTexels) -> str:
    if not isinstance(texels, Grid):
        return "at vertices, linear over each triangle"
    ends = "repeated" if texels.wrap == "repeat" else "clamped"
    return f"{texels.filter}, {ends}"


def _assumptions(found: TextureFit, data: Dataset) -> dict[str, str]:
    scene = data.scenes[0]
    lights = sorted({type(one).__name__ for s in data.scenes for one in s.lights})
    films = dict.fromkeys(film_words(film) for film in data.films)
    return {
        **({"exposures": "; ".join(data.notes)} if data.notes else {}),
        "specular model": settings(scene.specular_model),
        "shading": type(scene.shading).__name__,
        "lights": listed(lights) or "none",
        "textures": _interpolated(found.texels),
        "film": f"{' / '.join(films)}; light is linear, white = 1",
        "noise": f"{found.noise:.3g}",
        "versions": versions(),
    }
