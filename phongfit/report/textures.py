"""Figures and the HTML report of fitted textures."""

import os

import numpy as np
from matplotlib.figure import Figure

from phongfit.files.dataset import Dataset
from phongfit.fitting.result import film_words
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texels.sums import AbstractTexels, Grid
from phongfit.fitting.texels.vertices import Vertices
from phongfit.geometry.meshes import Mesh
from phongfit.rendering.render import render
from phongfit.report.html import panel, row
from phongfit.report.page import fill_page
from phongfit.report.pictures import Row
from phongfit.report.plots import chosen, compared
from phongfit.report.scales import TITLES, draw_numbers, draw_scale
from phongfit.report.style import picture, styled
from phongfit.report.words import listed, scene_words, versions
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
    return compared(_rows(found, data))


def _rows(found: TextureFit, data: Dataset) -> list[Row]:
    """Some of the photographs with their fits."""
    rows = []
    for k in chosen(len(data.images)):
        fitted = np.asarray(render(found.scene(data.scenes[k]), found.material))
        rows.append(Row(data.images[k], fitted, found.residuals[k], data.names[k]))
    return rows


def write_page(
    path: str | os.PathLike[str], found: TextureFit, data: Dataset, *, command: str
) -> None:
    """Write a report of fitted textures: a self-contained page.

    **Arguments:** `data`: the fitted photographs; `command`: command line that repeats
    the fit.

    **Raises:** `OSError` that names `path`.
    """
    first, one = data.scenes[0], found.texels.one
    figures = {TITLES[n]: draw_texture(found, n, first) for n in found.names}
    figures[f"How many pixels see each {one}"] = draw_seen(found, first)
    fill_page(
        path,
        "textures.html",
        found,
        _rows(found, data),
        len(data.images),
        title=data.name,
        sentences=_summary(found),
        textures=[
            panel(figure, alt, inches=float(figure.get_size_inches()[0]))
            for alt, figure in figures.items()
        ],
        places=found.texels.word,
        rows=[row(*one) for one in found.shared],
        assumptions=_assumptions(found, data),
        command=command,
    )


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
    films = dict.fromkeys(film_words(film) for film in data.films)
    return {
        **({"exposures": "; ".join(data.notes)} if data.notes else {}),
        **scene_words(data.scenes),
        "textures": _interpolated(found.texels),
        "film": f"{' / '.join(films)}; light is linear, white = 1",
        "noise": f"{found.noise:.3g}",
        "versions": versions(),
    }
