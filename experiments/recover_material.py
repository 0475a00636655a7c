"""Question: does a fit give back the material that an image was made with?

Targets of known truth (plastic, metal, matte; one and several lights; rounded to 8
bits, with and without noise) are fitted without a starting guess. Truth and estimate ±
standard error are printed side by side. The exit status is 1 if a fit does not
converge, if an estimate is more than 4 standard errors off, or if a parameter that the
image does not identify has a finite error.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import phongfit as pf
from data_synth import make_dataset, make_lights
from experiments.output import (
    JsonFile,
    PictureFile,
    check_outputs,
    print_warnings,
    save_numbers,
    save_picture,
)
from phongfit.cli import run
from phongfit.files.dataset import Dataset
from phongfit.report.pictures import Row, comparison

PARAMETERS = ("ambient", "diffuse", "specular", "shininess")


@dataclasses.dataclass(frozen=True)
class Case:
    """One target: a material, its lights, and the noise of its images.

    - `lights`: `None`: four directional ones, see [`make_dataset`][];
    - `noise`: standard deviation in linear light, where white is 1;
    - `images`: number of images, among which the lights are distributed;
    - `specular`: model of the highlight.
    """

    name: str
    material: pf.Material
    lights: tuple[pf.AbstractLight, ...] | None = None
    noise: float = 0.0
    images: int = 1
    specular: pf.AbstractSpecular = dataclasses.field(default_factory=pf.BlinnPhong)


def cases() -> list[Case]:
    """The targets, from the easiest to those with unidentified parameters."""
    plastic = pf.Material((0.55, 0.25, 0.15), 0.3, 10.0, (0.5, 0.25, 0.15))
    phong = pf.Material((0.1, 0.35, 0.5), 0.35, 25.0, (0.2, 0.5, 0.6))
    matte = pf.Material((0.35, 0.5, 0.3), 0.0, 32.0, (0.4, 0.5, 0.3))
    one_light = make_lights(1, intensity=0.9)
    return [
        Case("plastic, 1 light, 8 bits", plastic, one_light),
        Case("plastic, 1 light, noise 1 %", plastic, one_light, 0.01),
        Case("plastic, 4 lights in 1 image, noise 1 %", plastic, None, 0.01),
        Case("Phong's model, point light, 8 bits", phong, make_lights(1, "point")),
        Case("brass, 1 light, noise 1 %", pf.preset("brass"), one_light, 0.01),
        Case("chrome, 4 images, noise 1 %", pf.preset("chrome"), None, 0.01, 4),
        Case(
            "gold, 3 kinds of light, noise 2 %",
            pf.preset("gold"),
            make_lights(3, "mixed", intensity=0.5),
            0.02,
        ),
        Case("matte, 1 light, noise 1 %", matte, one_light, 0.01),
    ]


def target(case: Case, resolution: int, seed: int) -> Dataset:
    """The images of a case: linear, 8 bits, `resolution` × `resolution` pixels."""
    return make_dataset(
        case.material,
        key=jax.random.key(seed),
        camera=pf.OrthographicCamera(resolution, resolution),
        lights=case.lights,
        images=case.images,
        ambient=0.4,
        specular_model=case.specular,
        noise=case.noise,
        bits=8,
        encoding="linear",
    )


def numbers(case: Case, fit: pf.Fit) -> dict:
    """Truth, estimate and error of every unknown, in the order of `labels`.

    `wrong` has a sentence for each failed check.
    """
    truth = truth_values(case.material, fit.labels)
    deviation = np.abs(fit.values - truth)
    failed_checks = [
        f"{label} is {off:.2g} off, {off / error:.1f} standard errors"
        for label, off, error in zip(fit.labels, deviation, fit.errors, strict=True)
        if np.isfinite(error) and off > 4 * error
    ]
    dark = not np.asarray(case.material.specular).any()
    if dark and np.isfinite(fit.errors[fit.labels.index("shininess")]):
        failed_checks.append("shininess has an error bar, though there is no highlight")
    if not fit.converged:
        failed_checks.append("not converged")
    return {
        "name": case.name,
        "labels": list(fit.labels),
        "truth": truth,
        "estimate": fit.values,
        "stderr": fit.errors,
        "converged": fit.converged,
        "steps": fit.steps,
        "noise": fit.noise,
        "warnings": list(fit.warnings),
        "wrong": failed_checks,
    }


def truth_values(material: pf.Material, labels: Sequence[str]) -> np.ndarray:
    """The true material in the order of a fit's labels."""
    channels = ("red", "green", "blue")
    values = []
    for label in labels:
        name, _, channel = label.partition(".")
        value = np.broadcast_to(np.asarray(getattr(material, name)), (3,))
        # A label without a channel is of a parameter that all channels share.
        values.append(value[channels.index(channel)] if channel else value[0])
    return np.array(values, float)


def show(result: dict) -> Table:
    """Table of truth and estimate, from a result of [`numbers`][]."""
    state = f"converged in {result['steps']} steps" if result["converged"] else "FAILED"
    table = Table(title=f"{result['name']}: {state}", title_justify="left")
    for column in ("", "truth", "estimate", "± std. error", "off by"):
        table.add_column(column, justify="right" if column else "left")
    for label, truth, estimate, error in zip(
        result["labels"],
        result["truth"],
        result["estimate"],
        result["stderr"],
        strict=True,
    ):
        if np.isfinite(error):
            off = f"{(estimate - truth) / error:+.1f} σ"
            row = (f"{estimate:.5g}", f"± {error:.2g}", off)
        else:
            row = (f"{estimate:.5g}", "not identifiable", "")
        table.add_row(label, f"{truth:.5g}", *row)
    return table


def main(
    resolution: int = 192,
    seed: int = 0,
    picture: PictureFile = Path("out/recover_material.png"),
    json: JsonFile = None,
) -> int:
    """Does a fit give back the material that an image was made with?

    Makes targets of known truth (plastic, metal, matte; one and several lights; 8 bits,
    with and without noise), fits them without a starting guess, prints truth against
    estimate ± standard error, and draws target, fit and residual side by side. Exit
    status 1 if an estimate is more than 4 standard errors off.

    Args:
        resolution: Width and height of the targets, pixels.
        seed: Seed of the noise.
        picture: File for the picture.
        json: File for the numbers: a list of cases with truth, estimate and stderr.
    """
    check_outputs(picture, json)
    console = Console()
    results, rows = [], []
    for at, case in enumerate(
        track(cases(), "fitting", console=console, disable=not console.is_terminal)
    ):
        data = target(case, resolution, seed + at)
        fit = pf.fit(data.scenes, data.images, film=data.film)
        results.append(numbers(case, fit))
        rows.append(Row(data.images[0], fit.fitted[0], fit.residuals[0], case.name))
    for result in results:
        console.print(show(result))
        print_warnings(console, (*result["warnings"], *result["wrong"]))
        console.print()
    save_picture(picture, comparison(rows, blocks=2))
    save_numbers(json, results)
    failed = [result["name"] for result in results if result["wrong"]]
    identified = sum(int(np.isfinite(result["stderr"]).sum()) for result in results)
    verdict = (
        f"FAILED: {'; '.join(failed)}" if failed else "all within 4 standard errors"
    )
    console.print(
        f"{len(results)} targets, {identified} parameters identified: {verdict}"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.recover_material"))
