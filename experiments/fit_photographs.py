"""Question: how well does one material explain real photographs of a real object?

Reads a folder of photographs (DiLiGenT's layout, or that of `data_synth`), fits one
material to the 1st, 3rd, 5th, … and predicts the 2nd, 4th, 6th, …, which the fit has
not seen. Printed are the parameters with their errors, exponents once for each channel
and once shared, and the root mean square of the prediction's error over the mean of the
photographs, channel by channel. There is no true material to compare with. The exit
status is 1 if a prediction is no better than that of a matte surface, or if a fit does
not converge.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import phongfit as pf
from experiments.output import (
    JsonFile,
    PictureFile,
    check_outputs,
    save_numbers,
    save_picture,
)
from phongfit.cli import run
from phongfit.commands.data import DataOptions, read_data
from phongfit.files.dataset import Dataset
from phongfit.report.pictures import Row, comparison

# Number of left-out photographs that are drawn.
SHOWN = 3

MATTE_PARAMETERS = ("ambient", "diffuse")
ALL_PARAMETERS = ("ambient", "diffuse", "specular", "shininess")


def read(folder: Path) -> Dataset:
    """The photographs of a folder, with masks.

    **Raises:** `ValueError` that names the file.
    """
    return read_data(DataOptions(folder))[0]


def every_second(data: Dataset, first: int) -> Dataset:
    """Every second photograph, beginning with index `first`, counted from 0."""
    pick = slice(first, None, 2)
    return dataclasses.replace(
        data,
        scenes=data.scenes[pick],
        images=data.images[pick],
        masks=data.masks[pick],
        names=data.names[pick],
    )


def predict(data: Dataset, material: pf.Material) -> list[np.ndarray]:
    """Render each photograph's scene with this material, in linear light (H, W, 3)."""
    film = pf.Film(clamp=data.films[0].clamp)
    return [np.asarray(pf.render(s, material, film=film)) for s in data.scenes]


def rmse_over_mean(data: Dataset, predicted: list[np.ndarray]) -> np.ndarray:
    """Root mean square of predicted − measured over the mean light, for each channel.

    Over all pixels of all photographs that are in the mask and show the surface.
    """
    sums, squares, counts = [], [], []
    for image, prediction, mask, scene in zip(
        data.images, predicted, data.masks, data.scenes, strict=True
    ):
        used = mask & np.asarray(pf.geometry.trace(scene.surface, scene.camera).mask)
        counts.append(used.sum())
        sums.append(image[used].sum(axis=0, dtype=float))
        squares.append(((prediction - image)[used].astype(float) ** 2).sum(axis=0))
    count = np.sum(counts)
    return np.sqrt(np.sum(squares, axis=0) / count) / (np.sum(sums, axis=0) / count)


def fit(data: Dataset, unknowns: tuple[str, ...], shared: tuple[str, ...]) -> pf.Fit:
    """Fit one material to all photographs of a data set.

    **Arguments:** `shared`: unknowns with one value for all channels; the others have
    a value for each.
    """
    return pf.fit(
        data.scenes,
        data.images,
        mask=data.masks,
        film=data.film,
        unknowns=unknowns,
        per_channel=tuple(name for name in unknowns if name not in shared),
        # Polished metal goes beyond the default bound of 1000.
        bounds={"shininess": (1.0, 5000.0)},
    )


def show(title: str, result: pf.Fit, score: np.ndarray) -> None:
    """Print a fit, and its score from [`rmse_over_mean`][]."""
    print(f"{title}\n{result}\n")
    print(f"  left-out photographs, RMSE / mean (R G B): {_format_channels(score)}\n")


def _format_channels(score: np.ndarray) -> str:
    return " ".join(f"{value:.4f}" for value in score)


def main(
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    picture: PictureFile = Path("out/fit_photographs.png"),
    json: JsonFile = None,
) -> int:
    """How well does one material explain real photographs of a real object?

    Fits one material to the 1st, 3rd, 5th, … photograph of a folder and predicts the
    2nd, 4th, 6th, …; prints the parameters with errors, and for each channel the
    root mean square error of the prediction over the mean of the photographs; draws
    photograph, prediction and difference.

    Args:
        folder: DiLiGenT's layout, or that of data_synth.
        picture: File for the picture.
        json: File for the numbers: rmse_over_mean, material, stderr, and more.
    """
    if not folder.is_dir():
        print(f"skipped: there is no folder {folder}")
        return 0
    check_outputs(picture, json)
    data = read(folder)
    if len(data.images) < 2:
        raise ValueError(f"{folder}: expected at least two photographs, got one")
    fitted, left_out = every_second(data, 0), every_second(data, 1)
    fits = {
        "free": fit(fitted, ALL_PARAMETERS, ()),
        "shared": fit(fitted, ALL_PARAMETERS, ("specular", "shininess")),
        "matte": fit(fitted, MATTE_PARAMETERS, ()),
    }
    predictions = {
        name: predict(left_out, result.material) for name, result in fits.items()
    }
    scores = {
        name: rmse_over_mean(left_out, prediction)
        for name, prediction in predictions.items()
    }
    counts = f"{len(fitted.images)} photographs, {len(left_out.images)} left out"
    print(f"{data.name}: fitted to {counts}\n")
    show("each channel its own ρ_s and f", fits["free"], scores["free"])
    show("ρ_s and f shared by the channels", fits["shared"], scores["shared"])
    matte = _format_channels(scores["matte"])
    print(f"matte surface, for comparison: RMSE / mean {matte}")
    save_picture(picture, _figure(left_out, predictions["free"]))
    save_numbers(json, _numbers(fits, scores))
    better = all((scores[name] < scores["matte"]).all() for name in ("free", "shared"))
    return 0 if better and all(f.converged for f in fits.values()) else 1


def _numbers(fits: dict[str, pf.Fit], scores: dict[str, np.ndarray]) -> dict:
    """Numbers for the JSON file: those of the fit "free" at the top, others by name."""
    numbers: dict = {"rmse_over_mean": scores["free"]}
    numbers |= fits["free"].to_dict()
    numbers["shared"] = {"rmse_over_mean": scores["shared"], **fits["shared"].to_dict()}
    numbers["matte"] = {"rmse_over_mean": scores["matte"], **fits["matte"].to_dict()}
    return numbers


def _figure(data: Dataset, predicted: list[np.ndarray]):
    """Draw a few of the left-out photographs, their predictions and the differences."""
    # Spread evenly over the photographs, without the first and the last.
    shown = np.unique(np.linspace(0, len(data.images) - 1, SHOWN + 2)[1:-1].astype(int))
    # Photographs are brightened by one factor, so that 99.5 % of the samples of each
    # are below white.
    brightest = max(float(np.quantile(data.images[k], 0.995)) for k in shown)
    rows = []
    for k in shown:
        mask = data.masks[k][..., None]
        difference = np.where(mask, data.images[k] - predicted[k], 0)
        rows.append(Row(data.images[k], predicted[k], difference, data.names[k]))
    return comparison(
        rows, ("photograph", "prediction"), brighten=1 / max(brightest, 1e-6)
    )


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.fit_photographs"))
