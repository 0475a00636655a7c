"""Solved fits that tests of errors, warnings and summaries share, in float64.

Each is solved once in a process. Compilation is nearly all of what a first fit takes,
so a test that needs an image of its own takes the scene and the options of one of
these: `two_lights` for most.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import imageio.v3 as iio
import numpy as np

import phongfit as pf
from phongfit.files.images import from_levels, to_levels
from phongfit.geometry.shading import AbstractShading
from phongfit.material import stack_materials
from tests.fitting.scenes import SIZE, ball, photograph, truth, two_lights

NOISE = 0.01
JPEG_SIZE, JPEG_NOISE = 64, 0.003
FREE = pf.Film(clamp=False)
COLOURS = ("red", "green", "blue")


class Solved(NamedTuple):
    """A made-up photograph, what lies behind it, and its fit."""

    scene: pf.Scene
    material: pf.Material
    image: np.ndarray
    fit: pf.Fit

    @property
    def mask(self) -> np.ndarray:
        """Pixels that see the surface."""
        return np.asarray(self.scene.trace().mask)

    def pulls(self) -> np.ndarray:
        """(estimate − truth) / standard error, entry by entry."""
        return pulls(self.fit, self.material)


def pulls(fit: pf.Fit, material: pf.Material) -> np.ndarray:
    """(estimate − truth) / standard error, entry by entry."""
    return (fit.values - true_values(fit.labels, material)) / fit.errors


def true_values(labels: Sequence[str], material: pf.Material) -> np.ndarray:
    """A material's numbers in the order of these labels, whatever their shape."""
    values = []
    for label in labels:
        name, _, channel = label.partition(".")
        name, _, row = name.rstrip("]").partition("[")
        value = np.asarray(getattr(material, name), float)
        value = np.broadcast_to(value[int(row)] if row else value, (3,))
        values.append(value[COLOURS.index(channel)] if channel else value[0])
    return np.array(values)


def solved(
    scene: pf.Scene,
    material: pf.Material,
    *,
    noise: float = NOISE,
    film: pf.Film | None = None,
    seed: int = 0,
    **options: Any,
) -> Solved:
    """A noisy photograph, fitted by the scene that it is of."""
    image = photograph(scene, material, noise=noise, film=film, seed=seed)
    return Solved(scene, material, image, pf.fit(scene, image, **options))


@functools.cache
def two_directional() -> Solved:
    """The ten default unknowns under two directional lights, noise estimated."""
    return solved(ball(), truth())


@functools.cache
def no_highlight() -> Solved:
    """A matte ball: the exponent is not identified."""
    return solved(ball(), matte())


@functools.cache
def one_light() -> Solved:
    return solved(one_light_scene(), truth())


@functools.cache
def three_lights() -> Solved:
    """A light of each kind, seen in perspective."""
    return solved(three_lights_scene(), truth())


@functools.cache
def unknown_direction() -> Solved:
    """The direction of one of two lights beside a material's colour, from far off."""
    scene, material = ball(), truth()
    start = (pf.DirectionalLight((-1, 2, 1), 0.35), scene.lights[1])
    image = photograph(scene, material, noise=NOISE)
    fit = pf.fit(
        pf.Scene(scene.surface, scene.camera, start, scene.ambient),
        image,
        unknowns=("diffuse", "shininess", "scene.lights[0].direction"),
        known=material,
    )
    return Solved(scene, material, image, fit)


@functools.cache
def eight_bits() -> Solved:
    return solved(ball(), truth(), film=pf.Film(encoding="srgb", bits=8))


@functools.cache
def robust() -> Solved:
    """A fifth of the pixels replaced by any colour, under Tukey's loss."""
    scene, material = ball(), truth()
    image = with_garbage(photograph(scene, material, noise=NOISE))
    return Solved(scene, material, image, pf.fit(scene, image, loss="tukey"))


@functools.cache
def priors_and_ties() -> Solved:
    """A highlight that is half as bright as the diffuse light, and its known width."""
    material = pf.Material((0.6, 0.3, 0.2), (0.3, 0.15, 0.1), 20.0, truth().ambient)
    return solved(
        ball(),
        material,
        ties={"specular": (0.5, "diffuse")},
        priors={"shininess": (20.5, 0.5)},
    )


@functools.cache
def mesh() -> Solved:
    """A coarse mesh of two materials in fog, lit in its corners."""
    material = stack_materials([truth(), plastic()])
    return solved(mesh_scene(pf.GouraudShading()), material)


@functools.cache
def jpeg() -> Solved:
    """A photograph that went through a file, whose tables are known."""
    scene, material = ball(size=JPEG_SIZE), truth()
    image = jpeg_photograph(0, 95, scene)
    return Solved(scene, material, image, pf.fit(scene, image, film=jpeg_film(95)))


def matte() -> pf.Material:
    return pf.Material(truth().diffuse, 0.0, 20.0, truth().ambient)


def plastic() -> pf.Material:
    return pf.Material((0.4, 0.3, 0.2), 0.5, 10.0, 0.3)


def one_light_scene() -> pf.Scene:
    light = pf.DirectionalLight((1, 1, 2), 0.5)
    return pf.Scene(pf.Sphere(), ball().camera, light, ambient=0.3)


def three_lights_scene() -> pf.Scene:
    kinds = ("directional", "point", "spot")
    lights = [two_lights(kind)[kind != "directional"] for kind in kinds]
    camera = pf.PerspectiveCamera(SIZE, SIZE, position=(0.5, 0.2, 4.5), fov_y=28)
    return pf.Scene(pf.Sphere(), camera, lights, ambient=(0.3, 0.2, 0.4))


def plate_scene() -> pf.Scene:
    return pf.Scene(
        pf.NormalMap(np.broadcast_to([0.0, 0.0, 1.0], (SIZE, SIZE, 3))),
        pf.OrthographicCamera(SIZE, SIZE),
        pf.DirectionalLight((1, 1, 2), 0.7),
        ambient=0.3,
    )


def mesh_scene(shading: AbstractShading) -> pf.Scene:
    """The left and the right half are of two materials, each with a highlight."""
    made = pf.shapes.Ball().mesh(16, 8)
    right = np.asarray(made.vertices)[np.asarray(made.faces)].mean(axis=1)[:, 0] > 0
    surface = pf.Mesh(made.vertices, made.faces, made.normals, right.astype(np.int32))
    return pf.Scene(
        surface,
        pf.PerspectiveCamera(SIZE, SIZE, position=(0, 0, 5), fov_y=28),
        (pf.DirectionalLight((1, 1, 2), 0.7), pf.PointLight((-2, 1, 2), 0.5)),
        ambient=0.3,
        shading=shading,
        fog=pf.Fog((0.5, 0.6, 0.7), "exp", density=0.1),
    )


def with_garbage(image: np.ndarray, share: float = 0.2, seed: int = 0) -> np.ndarray:
    """The image with a share of its pixels replaced by any colour."""
    rng = np.random.default_rng(seed)
    hit = rng.random((*image.shape[:2], 1)) < share
    return np.where(hit, rng.random(image.shape), image)


def jpeg_photograph(seed: int, quality: int | None, scene: pf.Scene) -> np.ndarray:
    """As it is read from a file; from one without losses where `quality` is `None`."""
    light = np.asarray(pf.render(scene, truth(), film=FREE), float)
    noise = np.random.default_rng(seed).normal(size=light.shape)
    levels = to_levels(light + JPEG_NOISE * noise, "srgb", 8)
    if quality is None:
        return from_levels(levels, "srgb")
    options: dict[str, Any] = {"quality": quality, "subsampling": 2}
    data = iio.imwrite("<bytes>", levels, extension=".jpg", plugin="pillow", **options)
    return from_levels(iio.imread(data, extension=".jpg"), "srgb")


def jpeg_film(quality: int) -> pf.Film:
    return pf.Film(
        encoding="srgb", jpeg=pf.rendering.JpegCompression.at_quality(quality)
    )
