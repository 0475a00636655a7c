"""Question: how well are photographs under lamps that were left out predicted?

Reads folders of photographs with an .lp file, as reflectance-transformation imaging
makes them: with `Dome` and `Test` folders the first are fitted and the second
predicted, else every sixth photograph, from the fourth on, is left out. Each is
predicted by polynomial texture maps (6 coefficients), by hemispherical harmonics of
orders 2 and 3 (9 and 16), which are least squares on the values as stored, and by maps:
normals and materials per pixel, fitted to light, and the shadows that the height of the
normals throws; or, in its place, with what the maps leave of the photographs. Printed
is the mean over the photographs of the peak signal-to-noise ratio, in dB. Without
folders a synthetic stand-in is made: a bumpy shiny plate that throws shadows on itself.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.special import lpmv

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.output import (
    JsonFile,
    PictureFile,
    check_outputs,
    save_numbers,
    save_picture,
)
from phongfit.cli import run
from phongfit.files.fits import LossName
from phongfit.files.lp import base_name
from phongfit.files.seen import camera_of
from phongfit.geometry.planes import plane_before
from phongfit.rendering.film import Encoding, decode, encode

SIZE, SMALL = 96, 32
LAMPS, LEFT_OUT = 49, 12

Folders = Annotated[
    tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER ...")
]


class Lamps(NamedTuple):
    """Photographs, each under one lamp: unit vectors, and values as stored."""

    directions: Float[np.ndarray, "lamps 3"]
    images: Float[np.ndarray, "lamps height width 3"]


class Photographed(NamedTuple):
    """Photographs to fit and photographs to predict, with their encoding."""

    name: str
    fitted: Lamps
    left_out: Lamps
    encoding: Encoding


def polynomials(directions: Float[np.ndarray, "lamps 3"]) -> np.ndarray:
    """Basis of a polynomial texture map: x², y², xy, x, y, 1.

    ??? cite "Source"
        Malzbender, Gelb and Wolters, *Polynomial texture maps*, SIGGRAPH 2001.
    """
    x, y, _ = directions.T
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=-1)


def harmonics(directions: Float[np.ndarray, "lamps 3"], order: int) -> np.ndarray:
    """Basis of hemispherical harmonics up to an order: (order + 1)² of them.

    ??? cite "Source"
        Gautron et al., *A novel hemispherical basis for accurate and efficient
        rendering*, EGSR 2004.
    """
    x, y, z = directions.T
    turn, up = np.arctan2(y, x), 2 * np.clip(z, 0, 1) - 1
    columns = []
    for band in range(order + 1):
        for m in range(-band, band + 1):
            k = abs(m)
            scale = (2 * band + 1) * math.factorial(band - k) / math.factorial(band + k)
            legendre = math.sqrt(scale / (2 * math.pi)) * lpmv(k, band, up)
            wave = np.cos(k * turn) if m >= 0 else np.sin(k * turn)
            columns.append(legendre * wave * (math.sqrt(2) if m else 1))
    return np.stack(columns, axis=-1)


def regress(basis: Any, data: Photographed) -> Float[np.ndarray, "lamps h w 3"]:
    """Predict the left-out photographs by least squares, for each pixel and channel."""
    known, asked = basis(data.fitted.directions), basis(data.left_out.directions)
    images = data.fitted.images
    weights, *_ = np.linalg.lstsq(known, images.reshape(len(images), -1), rcond=None)
    return (asked @ weights).reshape(-1, *images.shape[1:])


def mapped(
    data: Photographed,
    loss: LossName = "cauchy",
    fov: float | None = None,
    passes: int = 1,
) -> dict[str, Float[np.ndarray, "lamps h w 3"]]:
    """Predict the left-out photographs by maps, without and with residual images."""
    height, width = data.fitted.images.shape[1:3]
    camera = camera_of(height, width, None, fov)
    camera = camera or pf.OrthographicCamera(width, height)
    plane = plane_before(camera)
    # Ambient light stands for light reflected by the surroundings.
    scenes = [
        pf.Scene(plane, camera, pf.DirectionalLight(vector), ambient=1.0)
        for vector in data.fitted.directions
    ]
    light = np.asarray(decode(data.fitted.images, data.encoding), np.float32)
    maps = pf.fit_maps(
        scenes, light, normals="fit", film=pf.Film(), loss=loss, passes=passes
    )
    lamps = [pf.DirectionalLight(vector) for vector in data.left_out.directions]
    surface = maps.height()
    relit = {
        MAPS: maps.relight(lamps, surface=surface),
        BOTH: maps.relight(lamps, surface=surface, scenes=scenes, images=light),
    }
    return {
        name: np.asarray(encode(np.clip(images, 0, 1), data.encoding))
        for name, images in relit.items()
    }


REGRESSIONS: dict[str, Callable[[Photographed], np.ndarray]] = {
    "PTM": lambda data: regress(polynomials, data),
    "HSH 2": lambda data: regress(lambda d: harmonics(d, 2), data),
    "HSH 3": lambda data: regress(lambda d: harmonics(d, 3), data),
}

MAPS, BOTH = "maps", "maps, photographs"


def ratio(shown: np.ndarray, wanted: np.ndarray) -> float:
    """Peak signal-to-noise ratio of values in [0, 1], dB."""
    off = float(np.mean((np.clip(shown, 0, 1) - wanted) ** 2))
    return 10 * math.log10(1 / max(off, 1e-12))


def read_lamps(folder: Path) -> Lamps:
    """A folder's photographs, in the order of its list.

    The count in a list's first line may be wrong, so it is not read. Lines whose
    photograph is not in the folder are left out.

    **Raises:** `ValueError` that names the folder.
    """
    lists = sorted(folder.glob("*.lp"))
    if not lists:
        raise ValueError(f"{folder}: expected an .lp file, got none")
    names, vectors = [], []
    for line in lists[0].read_text().splitlines()[1:]:
        words = line.rsplit(maxsplit=3)
        if len(words) == 4:
            names.append(base_name(words[0]))
            vectors.append([float(word) for word in words[1:]])
    there = [at for at, name in enumerate(names) if (folder / name).is_file()]
    if not there:
        raise ValueError(f"{folder}: expected photographs that {lists[0].name} names")
    paths = [folder / names[at] for at in there]
    directions = np.array(vectors)[there]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    # Values as stored: linear leaves them as they are.
    images = [np.asarray(pf.read_image(path, "linear")) for path in paths]
    return Lamps(directions, np.stack(images))


def read(folder: Path) -> Photographed:
    """Read a folder: the photographs to fit, and those left out."""
    if (folder / "Dome").is_dir() and (folder / "Test").is_dir():
        parts = read_lamps(folder / "Dome"), read_lamps(folder / "Test")
        return Photographed(folder.name, *parts, "srgb")
    every = read_lamps(folder)
    left = np.zeros(len(every.directions), bool)
    left[3::6] = True
    return Photographed(folder.name, _some(every, ~left), _some(every, left), "srgb")


def _some(lamps: Lamps, which: Any) -> Lamps:
    return Lamps(lamps.directions[which], lamps.images[which])


def stand_in(size: int) -> Photographed:
    """A bumpy, shiny plate with its own shadows, rendered as sRGB of 8 bits."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    height = 0.05 * size * np.sin(9 * x) * np.sin(11 * y)
    height += 0.06 * size * np.exp(-80 * ((x - 0.5) ** 2 + (y - 0.4) ** 2))
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(x)], axis=-1)
    camera = pf.OrthographicCamera(size, size, view_height=float(size))
    surface = pf.HeightField(height, np.ones((size, size), int), camera)
    checks = (np.floor(8 * x) + np.floor(8 * y)) % 2
    diffuse = np.where(checks[..., None] > 0, [0.5, 0.3, 0.2], [0.25, 0.35, 0.5])
    material = pf.Material(diffuse, 0.35, 30.0 + 30 * x[..., None], 0.0)
    shape = pf.NormalMap(normals, positions=surface.positions())
    directions = np.asarray(spread_directions(LAMPS + LEFT_OUT), float)
    directions[:, 2] = np.abs(directions[:, 2])
    order = np.random.default_rng(0).permutation(len(directions))
    film = pf.Film(encoding="srgb", bits=8)
    images = []
    for direction in directions[order]:
        light = pf.DirectionalLight(direction)
        (shadow,) = pf.cast_shadows(height, camera, [light])
        lit = pf.render(pf.Scene(shape, camera, light), material, film=film)
        images.append(np.where(shadow[..., None], 0, np.asarray(lit)))
    whole = Lamps(directions[order], np.stack(images))
    parts = _some(whole, slice(LAMPS)), _some(whole, slice(LAMPS, None))
    return Photographed("stand-in", *parts, "srgb")


def draw(data: Photographed, shown: dict[str, np.ndarray]) -> Figure:
    """Draw the left-out photograph with the lowest lamp, and all predictions of it."""
    lowest = int(np.argmin(data.left_out.directions[:, 2]))
    pictures = {"photograph": data.left_out.images} | shown
    figure = Figure(figsize=(3 * len(pictures), 3.4), layout="constrained")
    for axes, (name, images) in zip(
        figure.subplots(1, len(pictures)), pictures.items(), strict=True
    ):
        axes.imshow(np.clip(images[lowest], 0, 1))
        axes.set_axis_off()
        suffix = "" if name == "photograph" else f", {_mean(images, data):.1f} dB"
        axes.set_title(f"{name}{suffix}")
    figure.suptitle(
        f"{data.name}: the lowest left-out lamp; dB: mean of all left-out photographs"
    )
    return figure


def _mean(images: np.ndarray, data: Photographed) -> float:
    pairs = zip(images, data.left_out.images, strict=True)
    return float(np.mean([ratio(a, b) for a, b in pairs]))


def main(
    folders: Folders = (),
    loss: LossName = "cauchy",
    fov: Annotated[float | None, tyro.conf.arg(metavar="DEGREES")] = None,
    passes: int = 1,
    small: bool = False,
    picture: PictureFile = Path("out/relighting.png"),
    json: JsonFile = None,
) -> int:
    """Compare maps with texture maps and harmonics, on lamps that were left out.

    Args:
        folders: Folders of photographs with an .lp, or with folders Dome and Test of
        them.
        loss: Loss of the maps' fit. With shorter tails, more light that the model lacks
        (interreflections, the wide foot of a highlight) counts as an outlier: tukey is
        better on a smooth glossy panel, cauchy on a statue.
        fov: The camera's angle of view, from the lower to the upper edge. Default:
            parallel rays.
        passes: Passes of the maps' fit; all but the first leave out samples in shadow.
        small: A small stand-in, where no folder is given.
        picture: The figure to write, for the first folder.
        json: The table as JSON.
    """
    check_outputs(picture, json)
    sets = [read(folder) for folder in folders] or [stand_in(SMALL if small else SIZE)]
    console, table = Console(), Table(title="Mean PSNR of left-out lamps, dB")
    for column in ("set", *REGRESSIONS, MAPS, BOTH):
        table.add_column(column, justify="left" if column == "set" else "right")
    numbers: dict[str, dict[str, float]] = {}
    for at, data in enumerate(sets):
        shown = {}
        for name, method in REGRESSIONS.items():
            with console.status(f"{data.name}: {name}"):
                shown[name] = method(data)
        with console.status(f"{data.name}: {MAPS}"):
            shown |= mapped(data, loss, fov, passes)
        numbers[data.name] = {name: _mean(shown[name], data) for name in shown}
        table.add_row(data.name, *(f"{v:.2f}" for v in numbers[data.name].values()))
        if at == 0:
            save_picture(picture, draw(data, shown))
    console.print(table)
    save_numbers(json, numbers)
    return 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.relighting"))
