"""Question: how well are photographs under lamps that were left out predicted?

Reads folders of photographs with an .lp file, as reflectance-transformation imaging
makes them: with `Dome` and `Test` folders the first are fitted and the second
predicted, else every sixth photograph, from the fourth on, is left out. Each is
predicted by polynomial texture maps (6 coefficients), by hemispherical harmonics of
orders 2 and 3 (9 and 16), which are least squares on the values as stored, and by maps:
normals and materials per pixel, fitted to linear light, with the shadows of the height
field of the normals; and by maps plus interpolated residual images. The mean peak
signal-to-noise ratio of the photographs, in dB, is printed. Without folders, a
synthetic data set is made: a bumpy shiny plate with its own shadows.
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

# Width and height of synthetic photographs in pixels, and with `--small`.
SIZE, SMALL = 96, 32
# Number of synthetic photographs that are fitted, and that are predicted.
LAMPS, LEFT_OUT = 49, 12

Folders = Annotated[
    tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER ...")
]


class LitPhotographs(NamedTuple):
    """Photographs under one lamp each.

    `directions` are unit vectors to the lamps in the camera's axes (x right, y up, z to
    the camera); `images` are values in [0, 1] as files have them, not decoded.
    """

    directions: Float[np.ndarray, "lamps 3"]
    images: Float[np.ndarray, "lamps height width 3"]


class Split(NamedTuple):
    """Photographs to fit and photographs to predict, with their encoding.

    `name` is that of the data set.
    """

    name: str
    fitted: LitPhotographs
    left_out: LitPhotographs
    encoding: Encoding


def polynomials(directions: Float[np.ndarray, "lamps 3"]) -> np.ndarray:
    """Basis of a polynomial texture map: x², y², xy, x, y, 1, of shape (lamps, 6).

    ??? cite "Source"
        Malzbender, Gelb and Wolters, *Polynomial texture maps*, SIGGRAPH 2001.
    """
    x, y, _ = directions.T
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=-1)


def harmonics(directions: Float[np.ndarray, "lamps 3"], order: int) -> np.ndarray:
    """Basis of hemispherical harmonics up to `order`, of shape (lamps, (order + 1)²).

    Spherical harmonics whose argument cos θ is replaced by 2 cos θ − 1, so that they
    are orthonormal on the hemisphere z ≥ 0.

    ??? cite "Source"
        Gautron et al., *A novel hemispherical basis for accurate and efficient
        rendering*, EGSR 2004.
    """
    x, y, z = directions.T
    azimuth, shifted_cosine = np.arctan2(y, x), 2 * np.clip(z, 0, 1) - 1
    columns = []
    for band in range(order + 1):
        for m in range(-band, band + 1):
            k = abs(m)
            scale = (2 * band + 1) * math.factorial(band - k) / math.factorial(band + k)
            legendre = math.sqrt(scale / (2 * math.pi)) * lpmv(k, band, shifted_cosine)
            wave = np.cos(k * azimuth) if m >= 0 else np.sin(k * azimuth)
            columns.append(legendre * wave * (math.sqrt(2) if m else 1))
    return np.stack(columns, axis=-1)


def predict_by_regression(basis: Any, data: Split) -> Float[np.ndarray, "lamps h w 3"]:
    """Predict the left-out photographs by linear regression on a basis of directions.

    The weights of the basis are fitted for each pixel and channel, to stored values.

    **Arguments:** `basis`: function from directions (lamps, 3) to (lamps, functions).
    """
    fitted_basis = basis(data.fitted.directions)
    predicted_basis = basis(data.left_out.directions)
    images = data.fitted.images
    weights, *_ = np.linalg.lstsq(
        fitted_basis, images.reshape(len(images), -1), rcond=None
    )
    return (predicted_basis @ weights).reshape(-1, *images.shape[1:])


def predict_by_maps(
    data: Split,
    loss: LossName = "cauchy",
    fov: float | None = None,
    passes: int = 1,
) -> dict[str, Float[np.ndarray, "lamps h w 3"]]:
    """Predict the left-out photographs by maps, without and with residual images.

    **Arguments:**

    - `loss`, `passes`: of [`fit_maps`][phongfit.fit_maps].
    - `fov`: the camera's angle of view from the lower to the upper edge, degrees;
        `None` or 0: parallel rays.

    **Returns:** stored values in [0, 1], by method: `MAPS`, `BOTH`.
    """
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


REGRESSIONS: dict[str, Callable[[Split], np.ndarray]] = {
    "PTM": lambda data: predict_by_regression(polynomials, data),
    "HSH 2": lambda data: predict_by_regression(lambda d: harmonics(d, 2), data),
    "HSH 3": lambda data: predict_by_regression(lambda d: harmonics(d, 3), data),
}

MAPS, BOTH = "maps", "maps, photographs"
"""Names of prediction by maps, and by maps plus interpolated residual images."""


def psnr(predicted: np.ndarray, true: np.ndarray) -> float:
    """Peak signal-to-noise ratio of values clipped to [0, 1], dB: 10 log₁₀(1 / MSE)."""
    mean_square = float(np.mean((np.clip(predicted, 0, 1) - true) ** 2))
    return 10 * math.log10(1 / max(mean_square, 1e-12))


def read_photographs(folder: Path) -> LitPhotographs:
    """A folder's photographs, in the order of its .lp file.

    The count in the first line of an .lp may be wrong, so it is not read. Lines whose
    photograph is not in the folder are left out.

    **Raises:** `ValueError` that names the folder, if it has no .lp file or none of the
    photographs that this names.
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
    present = [at for at, name in enumerate(names) if (folder / name).is_file()]
    if not present:
        raise ValueError(f"{folder}: expected photographs that {lists[0].name} names")
    paths = [folder / names[at] for at in present]
    directions = np.array(vectors)[present]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    # Values as stored: reading them as linear does not decode them.
    images = [np.asarray(pf.read_image(path, "linear")) for path in paths]
    return LitPhotographs(directions, np.stack(images))


def read(folder: Path) -> Split:
    """Read a folder: the photographs to fit, and those left out.

    With folders `Dome` and `Test` these are the two; otherwise every sixth photograph,
    from the fourth on, is left out.

    **Raises:** as [`read_photographs`][].
    """
    if (folder / "Dome").is_dir() and (folder / "Test").is_dir():
        parts = read_photographs(folder / "Dome"), read_photographs(folder / "Test")
        return Split(folder.name, *parts, "srgb")
    whole = read_photographs(folder)
    is_left_out = np.zeros(len(whole.directions), bool)
    is_left_out[3::6] = True
    parts = _select(whole, ~is_left_out), _select(whole, is_left_out)
    return Split(folder.name, *parts, "srgb")


def _select(photographs: LitPhotographs, which: Any) -> LitPhotographs:
    """A part of the photographs; `which` is any index of NumPy for the first axis."""
    return LitPhotographs(photographs.directions[which], photographs.images[which])


def synthetic_plate(size: int) -> Split:
    """Photographs of a bumpy, shiny plate with cast shadows, as 8-bit sRGB.

    **Arguments:** `size`: width and height in pixels, and in world units.
    """
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    height = 0.05 * size * np.sin(9 * x) * np.sin(11 * y)
    height += 0.06 * size * np.exp(-80 * ((x - 0.5) ** 2 + (y - 0.4) ** 2))
    slope_down, slope_right = np.gradient(height)
    # Rows run down, and y runs up.
    normals = np.stack([-slope_right, slope_down, np.ones_like(x)], axis=-1)
    camera = pf.OrthographicCamera(size, size, view_height=float(size))
    surface = pf.geometry.HeightField(height, np.ones((size, size), int), camera)
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
        (shadow,) = pf.geometry.cast_shadows(height, camera, [light])
        lit = pf.render(pf.Scene(shape, camera, light), material, film=film)
        images.append(np.where(shadow[..., None], 0, np.asarray(lit)))
    whole = LitPhotographs(directions[order], np.stack(images))
    parts = _select(whole, slice(LAMPS)), _select(whole, slice(LAMPS, None))
    return Split("stand-in", *parts, "srgb")


def draw(data: Split, predictions: dict[str, np.ndarray]) -> Figure:
    """Draw the left-out photograph with the lowest lamp, and all predictions of it."""
    lowest = int(np.argmin(data.left_out.directions[:, 2]))
    pictures = {"photograph": data.left_out.images} | predictions
    figure = Figure(figsize=(3 * len(pictures), 3.4), layout="constrained")
    for axes, (name, images) in zip(
        figure.subplots(1, len(pictures)), pictures.items(), strict=True
    ):
        axes.imshow(np.clip(images[lowest], 0, 1))
        axes.set_axis_off()
        suffix = "" if name == "photograph" else f", {_mean_psnr(images, data):.1f} dB"
        axes.set_title(f"{name}{suffix}")
    figure.suptitle(
        f"{data.name}: the lowest left-out lamp; dB: mean of all left-out photographs"
    )
    return figure


def _mean_psnr(images: np.ndarray, data: Split) -> float:
    """Mean PSNR of predicted `images` over the left-out photographs, dB."""
    pairs = zip(images, data.left_out.images, strict=True)
    return float(np.mean([psnr(a, b) for a, b in pairs]))


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
            them. Default: a synthetic data set.
        loss: Loss of the maps' fit. A robust loss leaves out light that the model lacks
            (interreflections, the wide foot of a highlight) as outliers: tukey leaves
            out more and is better on a smooth glossy panel, cauchy on a statue.
        fov: The camera's angle of view, from the lower to the upper edge. Default:
            parallel rays.
        passes: Passes of the maps' fit; all but the first leave out samples in shadow.
        small: A small synthetic data set, where no folder is given.
        picture: The figure to write, for the first folder.
        json: The table as JSON.
    """
    check_outputs(picture, json)
    sets = [read(folder) for folder in folders]
    sets = sets or [synthetic_plate(SMALL if small else SIZE)]
    console, table = Console(), Table(title="Mean PSNR of left-out lamps, dB")
    for column in ("set", *REGRESSIONS, MAPS, BOTH):
        table.add_column(column, justify="left" if column == "set" else "right")
    numbers: dict[str, dict[str, float]] = {}
    for at, data in enumerate(sets):
        predictions = {}
        for name, method in REGRESSIONS.items():
            with console.status(f"{data.name}: {name}"):
                predictions[name] = method(data)
        with console.status(f"{data.name}: {MAPS}"):
            predictions |= predict_by_maps(data, loss, fov, passes)
        numbers[data.name] = {
            name: _mean_psnr(predictions[name], data) for name in predictions
        }
        table.add_row(data.name, *(f"{v:.2f}" for v in numbers[data.name].values()))
        if at == 0:
            save_picture(picture, draw(data, predictions))
    console.print(table)
    save_numbers(json, numbers)
    return 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.relighting"))
