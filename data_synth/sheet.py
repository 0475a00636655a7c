"""The contact sheet: one figure of all images of a data set."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phongfit import AbstractLight, DirectionalLight, Material, PointLight, SpotLight
from phongfit.files.dataset import Dataset
from phongfit.files.images import to_levels

PAPER, INK, PALE = "#1e1f22", "#f0f0ec", "#a8a8a2"
"""Colours of the background, of text, and of less important text."""

HEAD, GAP = 0.85, 0.4
"""Inches above the images, and below each for its caption."""

LABELS = {"linear": "linear", "srgb": "sRGB"}
"""Names of encodings for readers."""


def contact_sheet(
    dataset: Dataset, *, noise: float | None = None, seed: int | None = None
) -> Figure:
    """A figure of all images, captioned by their lights, with the truth as title.

    **Arguments:** `noise`, `seed`: what the images were made with, for the line below
    the title; `None` leaves them out.
    """
    count = len(dataset.images)
    columns = _columns(count)
    rows = math.ceil(count / columns)
    # Sizes and positions are in inches.
    cell = {1: 4.6, 2: 3.4}.get(columns, 2.6)
    width = max(columns * cell + 0.3, 7.0)
    height = rows * (cell + GAP) + HEAD
    figure = Figure(figsize=(width, height), facecolor=PAPER)
    for text, color, size, below_top in (
        (_truth(dataset.truth), INK, 12, 0.3),
        (_settings(dataset, noise, seed), PALE, 9, 0.58),
    ):
        # A letter is about 0.53 of its size wide, and an inch has 72 points.
        size = min(size, 72 * width * 0.96 / (0.53 * len(text)))
        y = 1 - below_top / height
        figure.text(0.5, y, text, color=color, size=size, ha="center")
    left = (width - columns * cell) / 2
    for index in range(count):
        row, column = divmod(index, columns)
        # From the left and from the top; `add_axes` takes fractions from the bottom.
        x = left + column * cell + 0.08
        y = HEAD + row * (cell + GAP)
        side = cell - 0.16
        axes = figure.add_axes(
            (x / width, 1 - (y + side) / height, side / width, side / height)
        )
        _show(axes, dataset, index)
    return figure


def _columns(count: int) -> int:
    """Number of columns for `count` images.

    First as few cells as possible stay empty; then the sheet is about 1.6 times as wide
    as high.
    """
    root = math.sqrt(count)
    choices = range(math.ceil(root), math.ceil(2 * root) + 1)
    return min(choices, key=lambda n: (-count % n, abs(n**2 / count - 1.6)))


def _show(axes: Axes, dataset: Dataset, index: int) -> None:
    """Draw image number `index`, with its name and its lights below."""
    axes.imshow(_screen(dataset.images[index]))
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#4a4b50")
    lights = caption(dataset.scenes[index].lights)
    name = Path(dataset.names[index]).stem
    axes.set_xlabel(f"{name}   {lights}", color=INK, size=7.5, labelpad=5)


def _screen(image: Float[np.ndarray, "height width 3"]) -> np.ndarray:
    """Linear light as a screen shows it: 8-bit sRGB."""
    return to_levels(image, "srgb", 8)


def caption(lights: tuple[AbstractLight, ...]) -> str:
    """The lights in a few words: one with its direction or position, several counted.

    For example "point, at (0.00, 1.00, 4.00)" or "2 point + 1 spot lights".
    """
    if len(lights) == 1:
        return _describe(lights[0])
    # The kind of a light stands before the comma.
    kinds = [_describe(light).split(",")[0] for light in lights]
    counts = {kind: kinds.count(kind) for kind in kinds}
    words = " + ".join(f"{number} {kind}" for kind, number in counts.items())
    return f"{words} lights" if lights else "no light"


def _describe(light: AbstractLight) -> str:
    """A light's kind, and its direction (unit vector) or position (world units)."""
    match light:
        case DirectionalLight():
            direction = np.asarray(light.direction)
            return f"directional, from {_vector(direction / np.linalg.norm(direction))}"
        case PointLight():
            return f"point, at {_vector(np.asarray(light.position))}"
        case SpotLight():
            return f"spot, at {_vector(np.asarray(light.position))}"
    return type(light).__name__


def _vector(vector: Float[np.ndarray, "3"]) -> str:
    """A vector with two decimals, such as "(0.50, −0.25, 1.00)"."""
    numbers = ", ".join(f"{number:.2f}" for number in vector)
    return f"({numbers})".replace("-", "\N{MINUS SIGN}")


def _truth(material: Material | None) -> str:
    """The material's parameters in one line; emission only if there is any."""
    if material is None:
        return "material unknown"
    parameters = [
        ("diffuse", material.diffuse),
        ("specular", material.specular),
        ("shininess", material.shininess),
        ("ambient", material.ambient),
    ]
    if np.any(np.asarray(material.emission)):
        parameters.append(("emission", material.emission))
    return "     ".join(
        f"{name} {_text(np.asarray(values))}" for name, values in parameters
    )


def _text(values: np.ndarray) -> str:
    """A parameter as RGB, or as one number if all are equal; "map" for an array."""
    values = values.ravel()
    if values.size > 3:
        return "map"
    numbers = values[:1] if np.ptp(values) == 0 else values
    return " ".join(f"{number:.3g}" for number in numbers)


def _settings(dataset: Dataset, noise: float | None, seed: int | None) -> str:
    """How the images were made, in one line."""
    height, width, _ = dataset.images[0].shape
    film = dataset.films[0]
    depth = "float" if film.bits is None else f"{film.bits}-bit"
    parts = [
        f"{len(dataset.images)} × {width} × {height} pixels",
        f"{depth} {LABELS.get(str(film.encoding), film.encoding)}",
        type(dataset.scenes[0].specular_model).__name__,
    ]
    parts += [] if noise is None else [f"noise {noise:g}"]
    parts += [] if seed is None else [f"seed {seed}"]
    return "   ·   ".join(parts)
