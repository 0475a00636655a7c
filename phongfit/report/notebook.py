"""HTML of a fit, a material and a scene for notebooks."""

import dataclasses
import io
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np

from phongfit.files.formats import data_uri
from phongfit.fitting.result import Fit
from phongfit.geometry.cameras import OrthographicCamera
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.surfaces import AbstractSurface, NormalMap, Sphere
from phongfit.lights import AbstractLight, DirectionalLight
from phongfit.material import Material, unstack_materials
from phongfit.rendering.render import block_means, render
from phongfit.report.html import fill, panel, parameters
from phongfit.report.pictures import displayed
from phongfit.report.plots import plot
from phongfit.report.words import settings, summary
from phongfit.scene import Scene

SHOWN = ("diffuse", "specular", "shininess", "ambient", "emission")
MOST_MATERIALS, MOST_LIGHTS = 8, 12
SWATCH, PIXELS, FINER = 144, 240, 2


def of_fit(fit: Fit) -> str:
    """HTML of a fit: table, warnings and a small picture."""
    words = "Photograph, fit and residual of the first image."
    return fill(
        "fit.html",
        rows=parameters(fit),
        sentences=summary(fit)[:3],
        warnings=list(fit.warnings),
        picture=panel(plot(fit, most=1), words, dpi=80),
    )


def of_material(material: Material) -> str:
    """HTML of a material: a rendered ball, or maps, and its numbers."""
    numbers = {name: np.asarray(getattr(material, name)) for name in SHOWN}
    if max(leaf.ndim for leaf in numbers.values()) > 2:
        maps = [
            (_map(leaf), f"Map of {name}.", name)
            for name, leaf in numbers.items()
            if leaf.ndim > 2
        ]
        ranges = [(name, _range(leaf)) for name, leaf in numbers.items()]
        return _shown(maps, [([], ranges)])
    every = unstack_materials(material)
    shown = every[:MOST_MATERIALS]
    names = [""] if len(every) == 1 else [f"[{k}]" for k in range(len(shown))]
    balls = [
        (_ball(one), f"A ball of material {name}.", name)
        for one, name in zip(shown, names, strict=True)
    ]
    rows = [
        (name, *(_numbers(np.asarray(getattr(one, name))) for one in shown))
        for name in SHOWN
    ]
    heads = ["", *names] if len(every) > 1 else []
    return _shown(balls, [(heads, rows)], len(every) - len(shown), "materials")


def of_scene(scene: Scene) -> str:
    """HTML of a scene: a picture of its shape, its settings and its lights."""
    camera, surface = scene.camera, scene.surface
    facts = {
        "surface": _surface_words(surface),
        "camera": f"{type(camera).__name__}, {camera.width} × {camera.height} pixels",
        "ambient light": _numbers(np.asarray(scene.ambient)),
        "specular model": settings(scene.specular_model),
        "shading": type(scene.shading).__name__,
        "shadows": "yes" if scene.shadows else "no",
    }
    if scene.fog is not None:
        colour = _numbers(np.asarray(scene.fog.color))
        facts["fog"] = f"{scene.fog.mode}, colour {colour}"
    lights = [_light_words(light) for light in scene.lights[:MOST_LIGHTS]]
    heads = ["light", "where", "intensity (white = 1)"] if lights else []
    tables = [([], list(facts.items())), (heads, lights or [("no light",)])]
    picture = _shape(scene), "The surface as the camera sees it, lit from there.", ""
    return _shown([picture], tables, len(scene.lights) - MOST_LIGHTS, "lights")


def _shown(
    pictures: list[tuple[str, str, str]],
    tables: Sequence[tuple[Sequence[str], Sequence[tuple[str, ...]]]],
    more: int = 0,
    of: str = "",
) -> str:
    """HTML of pictures and tables.

    **Arguments:**

    - `pictures`: source, alternative text and caption of each.
    - `tables`: heads of the columns, and rows.
    - `more`: number of things, `of` this name, that are not shown.
    """
    return fill("shown.html", pictures=pictures, tables=tables, more=more, of=of)


def _numbers(leaf: np.ndarray) -> str:
    """A parameter of one material: one number, or three that differ."""
    values = leaf.ravel()
    values = values[:1] if np.ptp(values) == 0 else values
    return ", ".join(f"{value:.4g}" for value in values)


def _range(leaf: np.ndarray) -> str:
    low, high = float(np.min(leaf)), float(np.max(leaf))
    return f"{low:.4g}" if low == high else f"{low:.4g} … {high:.4g}"


def _png(rgba: np.ndarray) -> str:
    """Pixels (H, W, 3 or 4) in [0, 1] as a data URI."""
    stream = io.BytesIO()
    matplotlib.image.imsave(stream, np.clip(rgba, 0, 1), format="png")
    return data_uri(stream.getvalue())


def _over_nothing(image: Any, mask: Any, times: int) -> np.ndarray:
    """An RGBA image that is transparent where there is no surface.

    A pixel is the mean of `times` × `times` finer ones, so that outlines are smooth.
    """
    light = (
        np.concatenate([image, np.ones((*mask.shape, 1))], axis=-1) * mask[..., None]
    )
    mean = block_means(light, times)
    cover = mean[..., 3:]
    shown = displayed(mean[..., :3] / np.where(cover > 0, cover, 1))
    return np.concatenate([shown, cover], axis=-1)


def _ball(material: Material) -> str:
    scene = Scene(
        Sphere(),
        OrthographicCamera(FINER * SWATCH, FINER * SWATCH, view_height=2.05),
        DirectionalLight((-1, 1.2, 2), 0.9),
        ambient=0.3,
    )
    gbuffer = scene.trace()
    # Convert a material that was made in another precision.
    floats = jnp.result_type(float)
    material = jax.tree.map(lambda leaf: jnp.asarray(leaf, floats), material)
    image = render(scene, material, gbuffer=gbuffer)
    return _png(_over_nothing(image, np.asarray(gbuffer.mask), FINER))


def _map(leaf: np.ndarray) -> str:
    step = -(-max(leaf.shape[:2]) // PIXELS)
    small = np.broadcast_to(leaf, (*leaf.shape[:2], 3))[::step, ::step]
    # Exponents above 1 are scaled to a maximum of 1.
    top = max(float(np.nanmax(small)), 1e-9)
    return _png(displayed(small / max(top, 1.0)))


def _shape(scene: Scene) -> str:
    """A picture of the surface lit from the camera, independent of the lights."""
    camera = scene.camera
    step = -(-max(camera.height, camera.width) // PIXELS)
    if step == 1 and not isinstance(scene.surface, NormalMap):
        step, scene = FINER, dataclasses.replace(scene, camera=camera.finer(FINER))
    gbuffer = scene.trace()
    normal, viewer, mask = (
        np.asarray(some) for some in (gbuffer.normal, gbuffer.to_viewer, gbuffer.mask)
    )
    facing = np.abs(np.sum(normal * viewer, axis=-1, keepdims=True))
    return _png(_over_nothing(np.repeat(0.05 + 0.6 * facing, 3, axis=-1), mask, step))


def _surface_words(surface: AbstractSurface) -> str:
    words = type(surface).__name__
    if isinstance(surface, Mesh):
        words += f", {len(surface.faces):,} faces"
    return words + (f", {surface.materials} materials" if surface.materials > 1 else "")


def _light_words(light: AbstractLight) -> tuple[str, str, str]:
    """Kind, position or direction, and intensity of a light, as far as it has these."""
    shown = ("direction", "position", "axis", "intensity")
    parts = {
        name: np.asarray(vars(light)[name])
        for name in shown
        if vars(light).get(name) is not None
    }
    intensity = _numbers(parts.pop("intensity")) if "intensity" in parts else ""
    where = ", ".join(f"{name} {_vector(part)}" for name, part in parts.items())
    return type(light).__name__, where, intensity


def _vector(vector: np.ndarray) -> str:
    numbers = ", ".join(f"{number:.3g}" for number in vector)
    return f"({numbers})".replace("-", "−")
