"""`python -m experiments.textured_object`: are fitted texels within their errors?

A vase of two materials, its diffuse texture checkered with some chance in it, is
photographed from eight places under two lamps each: 1 % noise, 8 bits. `fit_texture`
finds the texels, and of each material ρ_s and f. Asked are

- texels seen at least three times: (found − true) / error has an RMS of 0.9 … 1.1;
- ρ_s and f lie within four standard errors of the truth;
- a photograph from a ninth place, under a third lamp, is predicted to 1.1 times its
  noise.

Result, x86-64 with two busy cores, November 2026, float32, `--full` (256 × 256 texels,
16 photographs of 400 × 400 pixels): all 65 536 texels identified and seen three times,
pulls 1.009; ρ_s and f within 2.3 errors; the ninth place 1.036 times its noise; 98 s of
processor time and 1 GB. By default (48 × 48, 80 × 80): 1.000, 1.7 errors, 1.027.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import phongfit as pf
from phongfit.cli import run
from phongfit.files.outputs import check_file, write_json

NOISE = 0.01
VIEWS = 8


class Size(NamedTuple):
    """Texels and pixels along a side, and cells of the mesh around and along."""

    texels: int
    pixels: int
    around: int
    along: int


SMALL, FULL = Size(48, 80, 48, 24), Size(256, 400, 96, 48)


def vase(around: int, along: int) -> pf.Mesh:
    """A surface of revolution with uv: two materials, one above the other."""
    u, v = np.linspace(0, 1, around + 1), np.linspace(0, 1, along + 1)
    radius = 0.55 + 0.25 * np.sin(np.pi * v) + 0.08 * np.sin(3 * np.pi * v)
    angle = 2 * np.pi * u
    rim = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    height = (1 - 2 * v)[:, None] * 0.9
    corners = radius[:, None, None] * rim + height[..., None] * [0, 1, 0]
    row, column = (index.ravel() for index in np.indices((along, around)))
    a = row * (around + 1) + column
    b, c, d = a + around + 1, a + around + 2, a + 1
    # u runs to the left seen from outside, and v down.
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    # The seam is smooth: normals are those of the closed surface.
    slope = np.gradient(radius, v)[:, None, None]
    fall = np.gradient((1 - 2 * v) * 0.9, v)[:, None, None]
    normals = -fall * rim + slope * np.array([0, 1, 0])
    return pf.Mesh(
        corners.reshape(-1, 3),
        faces,
        normals.reshape(-1, 3),
        (np.concatenate([row, row]) >= along // 2).astype(int),
        uv=places[faces],
    )


def checkered(texels: int, seed: int = 0) -> np.ndarray:
    """Checks of two colours, (texels, texels, 3), each texel a little its own."""
    squares = np.indices((texels, texels)) // max(texels // 12, 1)
    even = (squares.sum(axis=0) % 2)[..., None]
    colour = np.where(even, [0.7, 0.55, 0.3], [0.15, 0.25, 0.45])
    chance = np.random.default_rng(seed).normal(0, 0.04, colour.shape)
    return np.clip(colour + chance, 0.02, 0.95)


TRUTH = pf.Material(
    1.0, np.array([[0.25], [0.1]]), np.array([[60.0], [15.0]]), ambient=0.0
)


def views(mesh: pf.Mesh, size: Size, count: int = VIEWS) -> list[pf.Scene]:
    """Cameras around the vase, each with two lamps, one after the other."""
    scenes = []
    for k in range(count):
        angle = 2 * np.pi * k / VIEWS
        height = 1.6 if k % 2 else -1.2
        scenes += view(mesh, size.pixels, angle, height, (0.5, -0.7))
    return scenes


def view(
    mesh: pf.Mesh, pixels: int, angle: float, height: float, lamps: tuple[float, ...]
) -> list[pf.Scene]:
    """One camera, with a lamp at each of some angles from it."""
    place = (4 * np.cos(angle), height, 4 * np.sin(angle))
    camera = pf.PerspectiveCamera.look_at(
        place, width=pixels, height=pixels, fov_y=32.0
    )
    made = []
    for k, aside in enumerate(lamps):
        lamp = np.cos(angle + aside), 0.5 - 0.6 * k, np.sin(angle + aside)
        made.append(pf.Scene(mesh, camera, pf.DirectionalLight(lamp, 1.1)))
    return made


def photograph(scene: pf.Scene, material: pf.Material, seed: int) -> np.ndarray:
    """What a camera of 8 bits makes of it."""
    light = pf.render(scene, material, film=pf.Film(clamp=False))
    light = light + NOISE * jax.random.normal(jax.random.key(seed), light.shape)
    return np.asarray(pf.Film(bits=8).expose(light))


class Answer(NamedTuple):
    """What was found, as numbers.

    - `pulls`: RMS of (found − true) / error of the texels that are seen thrice.
    - `texels`: how many these are, and of how many.
    - `few`: of ρ_s and f: label, value, error, and the distance to the truth in errors.
    - `predicted`: RMS of what is left of the ninth place, over its noise.
    """

    pulls: float
    texels: tuple[int, int]
    few: list[tuple[str, float, float, float]]
    predicted: float
    seconds: float

    @property
    def right(self) -> bool:
        """Whether all is as it should be."""
        return (
            0.9 <= self.pulls <= 1.1
            and all(abs(one[3]) < 4 for one in self.few)
            and self.predicted <= 1.1
        )


def ask(size: Size, seed: int = 0) -> tuple[Answer, pf.TextureFit]:
    """Photograph, fit, compare."""
    mesh = vase(size.around, size.along)
    true = checkered(size.texels, seed)
    painted = mesh.with_textures(pf.Textures(diffuse=pf.Texture(true)))
    images = [
        photograph(scene, TRUTH, 100 * seed + k)
        for k, scene in enumerate(views(painted, size))
    ]
    started = time.perf_counter()
    fit = pf.fit_texture(
        views(mesh, size),
        images,
        size=true.shape[:2],
        unknowns=("specular", "shininess"),
        per_channel=(),
        known=pf.Material(ambient=0.0),
    )
    seconds = time.perf_counter() - started
    found, errors = fit.values["diffuse"][0], fit.stderr["diffuse"][0]
    thrice = (fit.seen[0] >= 3)[..., None] & np.isfinite(errors)
    pulls = ((found - true) / errors)[thrice]
    truths = [*np.ravel(TRUTH.specular), *np.ravel(TRUTH.shininess)]
    few = [
        (one.label, one.value, one.stderr, float((one.value - true) / one.stderr))
        for one, true in zip(fit.shared, truths, strict=True)
    ]
    (ninth,) = view(painted, size.pixels, 2 * np.pi * 0.56 / VIEWS, 0.3, (0.2,))
    taken = photograph(ninth, TRUTH, 100 * seed + 99)
    predicted = pf.render(fit.scene(ninth), fit.material)
    known = np.asarray(ninth.trace().mask) & (taken < 1).all(axis=-1)
    left = (taken - np.asarray(predicted))[known]
    return (
        Answer(
            float(np.sqrt(np.mean(pulls**2))),
            (int(thrice.all(axis=-1).sum()), true[..., 0].size),
            few,
            float(np.sqrt(np.mean(left**2)) / NOISE),
            seconds,
        ),
        fit,
    )


@dataclass(frozen=True)
class Options:
    full: bool = False
    """A texture of 256 × 256 texels and photographs of 400 × 400 pixels."""

    json: Path | None = None
    """File to write the numbers to as well."""


def main(options: Options) -> int:
    """Are fitted texels within their errors?

    Exits with 1 if they are not, or if the ninth place is not predicted.
    """
    if options.json is not None:
        check_file(options.json)
    answer, fit = ask(FULL if options.full else SMALL)
    print(fit)
    seen, total = answer.texels
    print(
        f"{seen:,} of {total:,} texels seen three times: pulls have an RMS of "
        f"{answer.pulls:.3f}"
    )
    for label, value, error, pull in answer.few:
        print(f"{label}: {value:.4g} ± {error:.2g}, {pull:+.2f} errors from the truth")
    print(f"ninth place: {answer.predicted:.3f} times its noise")
    print(f"{answer.seconds:.1f} s; {'right' if answer.right else 'FALLS SHORT'}")
    if options.json is not None:
        numbers: dict[str, Any] = answer._asdict() | {"right": answer.right}
        write_json(options.json, numbers)
    return int(not answer.right)


if __name__ == "__main__":
    sys.exit(run(main, prog="python -m experiments.textured_object"))
