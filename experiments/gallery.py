"""Question: what does it all look like?

Draws the pictures of `docs/gallery.md`: fits, maps, normals, heights and other lamps,
of the photographs of Ying Xiong's PSBox that `docs/how-to/capture.md` goes through, and
the figures of the experiments that draw the model. Prints how large they are.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import phongfit as pf
from experiments import day_to_night, highlights, light_kinds, model, shading_methods
from experiments.capture import run_page
from experiments.style import page, quiet, show, styled
from phongfit.cli import run
from phongfit.files.outputs import check_file
from phongfit.report.pictures import Row, comparison

DRAWN_EXPERIMENTS = (model, highlights, shading_methods, light_kinds, day_to_night)
"""Experiments whose figures the gallery has."""

ASIDE = (1.6, 0.9, 1.5)
"""Direction from which the cat's mesh is drawn: x right, y up, z to the camera."""

WIDEST = 1400
"""Largest width and height of a picture, pixels.

Twice the width of a page's text, for screens with two pixels in place of one.
"""

LAMPS = ((-1, 0.6, 0.5), (1, 0.2, 0.7), (0.2, -1, 0.8))
"""Directions to new lamps, which none of the cat's photographs has.

In the axes of [`ASIDE`][].
"""


class Cat(NamedTuple):
    """Maps of PSBox's statue of a cat, and one of its photographs in linear light."""

    maps: pf.Maps
    photograph: Float[np.ndarray, "height width 3"]


def map_cat() -> Cat:
    """Run `docs/how-to/capture.md`; returns its maps and one of its photographs."""
    with tempfile.TemporaryDirectory() as folder:
        names = run_page(Path(folder))
    return Cat(names["maps"], names["images"][4])


@styled
def draw_ball() -> Figure:
    """Draw photographs of two balls, their fits, and the residuals."""
    rows = []
    for name in ("ruby", "brass"):
        image, fit = _fitted_ball(name)
        exponent = fit["shininess"]
        title = f"{name}: f = {exponent.value:.4g} ± {exponent.error:.1g}"
        rows.append(Row(image, fit.fitted, fit.residuals, title))
    return comparison(rows, ("photograph", "fit"), blocks=2)


def _fitted_ball(name: str) -> tuple[np.ndarray, pf.Fit]:
    """A noisy rendered photograph of a ball, and its fit.

    **Arguments:** `name`: a classic material, as in [`preset`][phongfit.preset].
    """
    camera, lamp = pf.OrthographicCamera(160, 160), pf.DirectionalLight((1, 1, 2))
    scene = pf.Scene(pf.Sphere(), camera, lamp, ambient=0.3)
    light = np.array(pf.render(scene, pf.preset(name), film=pf.Film(clamp=False)))
    light += np.random.default_rng(0).normal(0, 0.01, light.shape)
    # Noise comes before a camera's clamp.
    image = np.clip(light, 0, 1)
    return image, pf.fit(scene, image)


@styled
def draw_home(cat: Cat) -> Figure:
    """Draw a photograph, its fit with numbers, and the cat: its normals, and relit."""
    image, fit = _fitted_ball("ruby")
    drawing = page(2.3)
    panels = drawing.subplots(1, 5)
    show(panels[0], image, "a photograph")
    show(panels[1], np.clip(fit.fitted, 0, 1), "its fit", _estimates(fit))
    show(panels[2], cat.photograph / np.quantile(cat.photograph, 0.995), "1 of 12")
    inside = ~cat.maps.flagged(pf.Flag.OUTSIDE)
    normals = np.where(inside[..., None], (cat.maps.normals + 1) / 2, 1)
    show(panels[3], normals, "normals")
    (picture,) = cat.maps.relight([pf.DirectionalLight(LAMPS[1])])
    show(panels[4], picture / np.quantile(picture, 0.99), "relit")
    for axes in panels:
        axes.set_anchor("N")
    return drawing


def _estimates(fit: pf.Fit) -> str:
    """Estimates ± standard errors of red ρ_d, red ρ_s and f, one a line."""
    lines = {"diffuse.red": "ρ_{d}", "specular.red": "ρ_{s}", "shininess": "f"}
    return "\n".join(
        f"${letter}$ = {fit[label].value:.4g} ± {fit[label].error:.1g}"
        for label, letter in lines.items()
    )


@styled
def draw_maps(cat: Cat) -> Figure:
    """Draw a photograph, and the maps of its pixels."""
    maps = cat.maps
    drawing = page(3.0)
    panels = drawing.subplots(1, 4)
    show(panels[0], cat.photograph / np.quantile(cat.photograph, 0.995), "photograph")
    inside = ~maps.flagged(pf.Flag.OUTSIDE)
    _draw_map(panels[1], maps.diffuse[..., 0], inside, "diffuse $ρ_{d}$")
    panels[2].imshow(np.where(inside[..., None], (maps.normals + 1) / 2, 1))
    panels[2].set_title("normals")
    _draw_map(panels[3], maps.normals_stderr, inside, "their error, degrees")
    for axes in panels:
        quiet(axes)
        axes.set_anchor("N")
    return drawing


def _draw_map(axes: Axes, values: np.ndarray, inside: np.ndarray, title: str) -> None:
    """Draw a map (H, W) with its colour bar, from 0 to its 98 % quantile.

    **Arguments:** `inside`: pixels of the object; others stay empty.
    """
    known = np.where(inside & np.isfinite(values), values, np.nan)
    image = axes.imshow(known, vmin=0, vmax=np.nanquantile(known, 0.98), cmap="viridis")
    figure: Any = axes.get_figure(root=True)
    figure.colorbar(image, ax=axes, location="bottom", fraction=0.06, pad=0.02)
    axes.set_title(title)


@styled
def draw_relit(cat: Cat) -> Figure:
    """Draw the cat under new lamps, with shadows, and its mesh from the side."""
    maps, surface = cat.maps, cat.maps.height()
    pictures = maps.relight([pf.DirectionalLight(lamp) for lamp in LAMPS])
    drawing = page(2.9)
    panels = drawing.subplots(1, 4)
    bright = np.quantile(pictures, 0.99)
    for axes, picture, lamp in zip(panels, pictures, LAMPS, strict=False):
        where = ", ".join(f"{x:g}" for x in lamp)
        show(axes, picture / bright, f"lamp at {where}")
    show(panels[3], _mesh(surface), "as a mesh, from aside")
    return drawing


def _mesh(surface: pf.geometry.HeightField) -> np.ndarray:
    """Render a surface's mesh under one lamp, from the direction `ASIDE`."""
    mesh, points = surface.mesh(), surface.positions()[surface.mask]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    size = float(np.ptp(points, axis=0).max())
    camera = pf.OrthographicCamera.look_at(
        tuple(middle + 3 * size * np.array(ASIDE)),
        tuple(middle),
        width=240,
        height=310,
        view_height=1.15 * size,
    )
    lit = pf.Scene(mesh, camera, pf.DirectionalLight((0.2, 1, 1.5)), 0.2, background=1)
    return np.asarray(pf.render(lit, pf.Material(0.8, 0.1, 12, 0.5), samples=4))


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a small JPEG."""
    with tempfile.TemporaryDirectory() as folder:
        sharp = Path(folder) / "figure.png"
        figure.savefig(sharp, dpi=140)
        picture = Image.open(sharp).convert("RGB")
        picture.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
        picture.save(path, quality=82, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} kB")


def main(pictures: Path = Path("out/gallery")) -> int:
    """What does it all look like?

    Draws the pictures of docs/gallery.md.

    Args:
        pictures: The folder for them; docs/pictures, to replace those that are there.
    """
    check_file(pictures / "ball.jpg")
    pictures.mkdir(parents=True, exist_ok=True)
    cat = map_cat()
    drawings: dict[str, Callable[[], Figure]] = {
        "home": lambda: draw_home(cat),
        "ball": draw_ball,
        "cat_maps": lambda: draw_maps(cat),
        "cat_relit": lambda: draw_relit(cat),
    }
    for module in DRAWN_EXPERIMENTS:
        experiment = module.EXPERIMENT
        drawings[experiment.name] = lambda experiment=experiment: (
            experiment.find(False).figure
        )
    for name, draw in drawings.items():
        save(draw(), pictures / f"{name}.jpg")
    return 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.gallery"))
