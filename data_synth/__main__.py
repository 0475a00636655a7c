"""`python -m data_synth OUT_DIR`: a data set with known truth."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from data_synth.dataset import distribute_lights, make_dataset
from data_synth.lights import LightKind, brightest_intensity, make_lights
from data_synth.writing import write_dataset
from phongfit import (
    AbstractLight,
    BlinnPhong,
    Material,
    OrthographicCamera,
    PerspectiveCamera,
    Phong,
    Scene,
    Sphere,
    preset,
)
from phongfit.cli import run
from phongfit.files.dataset import Dataset
from phongfit.geometry import AbstractCamera
from phongfit.rendering.film import NamedEncoding

Numbers = tuple[float, ...]

PLASTIC = Material((0.6, 0.3, 0.2), 0.3, 60.0, (0.5, 0.25, 0.15))
"""The default material: diffuse, specular, shininess, ambient."""

MAX_RESOLUTION = 8192
"""Largest width and height of the images, pixels."""


def _shown(metavar: str, default: str) -> Any:
    """Help of an option: the words for its value, and for its default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


Parameter = Annotated[Numbers, _shown("X|R G B", "the material's")]


@dataclass(frozen=True)
class Options:
    """The scene, material and noise of the images.

    Args:
        out_dir: Folder to make: images, scene.json, truth.json, contact_sheet.png.
        material: An orange plastic, or preset:NAME for one of the 24 classic OpenGL
            materials, such as preset:brass. The five options below replace single
            values of it.
        diffuse: Lambert reflectance.
        specular: Strength of the highlight.
        shininess: Exponent of the highlight; larger is sharper.
        ambient: Fraction of the ambient light that is reflected.
        emission: Emitted light, where white is 1.
        model: Model of the highlight.
        lights: Number of lights, spread around the camera.
        light_kind: Kind of the lights; mixed cycles through the three.
        images: Number of images, among which the lights are distributed; 1 has all
            lights in one image.
        intensity: Light that arrives at the ball's centre from each light.
        ambient_light: The ambient light.
        center: Centre of the ball, world units.
        radius: Radius of the ball, world units.
        camera: Kind of the camera, which looks along -z.
        resolution: Width and height of the images, pixels.
        noise: Standard deviation of Gaussian noise in linear light, where white is
            1.
        bits: Bits per sample of the PNG images.
        encoding: Encoding of the PNG images.
        seed: Seed of the noise; the same seed gives the same files.
        overwrite: Replace an older data set in OUT_DIR.
    """

    out_dir: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT_DIR")]

    material: str = "plastic"

    diffuse: Parameter = ()

    specular: Parameter = ()

    shininess: Parameter = ()

    ambient: Parameter = ()

    emission: Parameter = ()

    model: Literal["blinn-phong", "phong"] = "blinn-phong"

    lights: int = 4

    light_kind: LightKind = "directional"

    images: Annotated[int | None, _shown("INT", "one for each light")] = None

    intensity: Annotated[
        Numbers, _shown("X|R G B", "the brightest sample reaches 95 % of white")
    ] = ()

    ambient_light: Annotated[Numbers, _shown("X|R G B", "0.15")] = (0.15,)

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    radius: float = 1.0

    camera: Literal["orthographic", "perspective"] = "orthographic"

    resolution: int = 256

    noise: float = 0.0

    bits: Literal[8, 16] = 8

    encoding: NamedEncoding = "srgb"

    seed: int = 0

    overwrite: bool = False


def make(options: Options) -> Dataset:
    """The data set that the options describe.

    **Raises:** `ValueError` that names the option.
    """
    if not 1 <= options.resolution <= MAX_RESOLUTION:
        raise ValueError(
            f"resolution: expected 1 … {MAX_RESOLUTION}, got {options.resolution}"
        )
    if not 0 <= options.seed < 2**32:
        raise ValueError(f"seed: expected 0 … {2**32 - 1}, got {options.seed}")
    material = _material(options)
    scene = Scene(
        Sphere(options.center, options.radius),
        _camera(options),
        ambient=_number("ambient_light", options.ambient_light),
        specular_model=BlinnPhong() if options.model == "blinn-phong" else Phong(),
    )
    if options.intensity:
        intensity = _number("intensity", options.intensity)
    else:
        scenes = distribute_lights(scene, _lights(options, 1.0), options.images)
        intensity = brightest_intensity(scenes, material)
    return make_dataset(
        material,
        key=jax.random.key(options.seed),
        surface=scene.surface,
        camera=scene.camera,
        lights=_lights(options, intensity),
        images=options.images,
        ambient=scene.ambient,
        specular_model=scene.specular_model,
        noise=options.noise,
        bits=options.bits,
        encoding=options.encoding,
        name=options.out_dir.resolve().name,
    )


def _number(name: str, values: Numbers) -> float | Numbers:
    """The values of option `name`: a number if there is one, RGB if there are three.

    **Raises:** `ValueError` for any other count.
    """
    if len(values) not in (1, 3):
        raise ValueError(f"{name}: expected 1 or 3 numbers, got {len(values)}")
    return values[0] if len(values) == 1 else values


def _material(options: Options) -> Material:
    """The named material, with the parameters that are given as options replaced.

    **Raises:** `ValueError` for an unknown name or preset, or a wrong count of numbers.
    """
    kind, _, name = options.material.partition(":")
    if kind not in ("plastic", "preset") or (kind == "plastic" and name):
        raise ValueError(
            f"material: expected plastic or preset:NAME, got {options.material!r}"
        )
    base = PLASTIC if kind == "plastic" else preset(name)
    parameters = {
        "diffuse": options.diffuse,
        "specular": options.specular,
        "shininess": options.shininess,
        "ambient": options.ambient,
        "emission": options.emission,
    }
    given = {name: _number(name, value) for name, value in parameters.items() if value}
    return Material(**({name: getattr(base, name) for name in parameters} | given))


def _lights(options: Options, intensity: float | Numbers) -> tuple[AbstractLight, ...]:
    """The lights around the ball; each brings `intensity` to the ball's centre."""
    return make_lights(
        options.lights,
        options.light_kind,
        intensity=intensity,
        center=options.center,
        radius=options.radius,
    )


def _camera(options: Options) -> AbstractCamera:
    """A camera at +z from the ball, whose diameter is 10/11 of the image's height."""
    x, y, z = options.center
    size, position = options.resolution, (x, y, z + 5 * options.radius)
    if options.camera == "orthographic":
        view = 2.2 * options.radius
        return OrthographicCamera(size, size, view_height=view, position=position)
    # From a distance of 5 radii, the ball's outline is asin(1 / 5) off the axis.
    fov = 1.1 * 2 * math.degrees(math.asin(1 / 5))
    return PerspectiveCamera(size, size, fov_y=fov, position=position)


def main(options: Options) -> int:
    """Make a data set with a known material: rendered images of a ball, to be fitted.

    It holds PNG images, scene.json (camera, surface, lights, models, encoding),
    truth.json (the material) and contact_sheet.png, which shows all images.

    For example:
      phongfit synth out/brass --material preset:brass --noise 0.01
      phongfit synth out/metal --shininess 200 --lights 16 --bits 16
    """
    dataset = make(options)
    write_dataset(
        dataset,
        options.out_dir,
        noise=options.noise,
        seed=options.seed,
        overwrite=options.overwrite,
    )
    height, width, _ = dataset.images[0].shape
    white = np.mean([image >= 1 for image in dataset.images])
    print(
        f"{options.out_dir}: {len(dataset.images)} × {width} × {height} pixels, "
        f"{options.bits}-bit {options.encoding}; {100 * white:.2g} % of the samples "
        "are white"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m data_synth"))
