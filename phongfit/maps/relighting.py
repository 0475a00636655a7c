"""Maps under other lights: diffuse light, highlight, attached and cast shadows.

With photographs, their interpolated residual images are added, which contain the cast
shadows.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from phongfit.files.budget import afford
from phongfit.files.inputs import naming
from phongfit.geometry.height import HeightField, shadow_shares
from phongfit.geometry.surfaces import NormalMap
from phongfit.geometry.tracing import trace
from phongfit.lights import AbstractLight
from phongfit.maps.pixel.settings import Flag
from phongfit.maps.result import Maps
from phongfit.maps.stacks import AbstractStack
from phongfit.rendering.film import Film
from phongfit.rendering.render import render
from phongfit.scene import Scene

WIDTHS = np.geomspace(0.05, 5, 60)
"""Widths that are tried, radians: from below lamps' angles to over a hemisphere."""

NUGGET = 1e-6
"""Added to the diagonal of the correlation, since two lamps may have one position."""

SAMPLE = 30_000
"""Approximate number of pixels from which the width is estimated."""


class Remainder(NamedTuple):
    """Residual images of photographs, scaled to lamps of strength 1.

    - `middle`: point at which lamps' directions and strengths are taken, world units.
    - `directions`: unit vectors to the lamps.
    - `images`: linear light, of half precision.
    - `width`: angle of the correlation between lamps, radians.
    """

    middle: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "lamps 3"]
    images: Float[np.ndarray, "lamps height width 3"]
    width: float

    def under(self, light: AbstractLight) -> Float[np.ndarray, "height width 3"]:
        """Interpolated residual image under another lamp, linear light."""
        direction, strength = _lamp("lights", light, self.middle)
        shared = _common(self.directions, direction[None], self.width)[:, 0]
        weights = np.linalg.solve(_among(self.directions, self.width), shared)
        total = np.zeros(self.images.shape[1:], np.float32)
        for weight, image in zip(weights, self.images, strict=True):
            total += np.float32(weight) * image
        return total * strength.astype(np.float32)


def find_remainder(
    show: Callable[[AbstractLight, Any], np.ndarray],
    scenes: Sequence[Scene],
    stack: AbstractStack,
    middle: Float[np.ndarray, "3"],
) -> Remainder:
    """Compute the residual images of maps and the width of their correlation.

    They contain cast shadows, interreflections and errors of the maps, and differ
    little between lamps at similar directions, so they are interpolated by kriging. The
    correlation of two lamps is exp(−angle / width), with the width that best predicts
    each photograph's residual image from the others.

    A masked or white sample is a lower bound of the light, so its residual is at
    least 0.

    **Arguments:**

    - `show`: function from a light and ambient light to the maps' image, (H, W, 3).
    - `scenes`, `stack`: the photographs, one lamp each.
    - `middle`: middle of the object.

    **Raises:** `ValueError` that names the argument.

    ??? cite "Source"
        Rasmussen and Williams, *Gaussian Processes for Machine Learning*, 2006,
        equations 2.25 and, for cross-validation from a single inverse, 5.12.
    """
    count, height, width = stack.shape
    if len(scenes) != count:
        raise ValueError(f"scenes: expected {count}, one an image, got {len(scenes)}")
    size = 2 * count * height * width * 3
    with naming("images"):
        afford(size, f"{count} photographs of {height} × {width} pixels to relight")
    images = np.empty((count, height, width, 3), np.float16)
    directions, every = np.empty((count, 3)), np.arange(height * width)
    for k, scene in enumerate(scenes):
        if len(scene.lights) != 1:
            raise ValueError(
                f"scenes[{k}]: expected one light, got {len(scene.lights)}"
            )
        (light,) = scene.lights
        directions[k], strength = _lamp(f"scenes[{k}]", light, middle)
        shown = show(light, scene.ambient)
        (taken,) = stack.take(every, [k])
        seen = np.ma.getdata(taken).reshape(shown.shape)
        hidden = np.ma.getmaskarray(taken).reshape(shown.shape) | (seen >= 1)
        left = np.where(hidden, np.maximum(seen - shown, 0), seen - shown)
        # A channel without light is not scaled, to avoid a division by 0.
        left = left / np.where(strength > 0, strength, 1)
        images[k] = np.nan_to_num(left, posinf=0, neginf=0)
    return Remainder(middle, directions, images, _width(directions, images))


def _lamp(
    name: str, light: AbstractLight, middle: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Direction and strength of a lamp at a point."""
    if not light.directed:
        raise ValueError(f"{name}: expected a lamp, got light from all around")
    found = light.illuminate(jnp.asarray(middle, jnp.result_type(float)))
    return np.asarray(found.to_light, float), np.asarray(found.intensity, float)


def _common(
    some: Float[np.ndarray, "m 3"], others: Float[np.ndarray, "n 3"], width: float
) -> Float[np.ndarray, "m n"]:
    """Correlation between lamps, from the angles between them."""
    # The chord is more precise than a cosine for small angles.
    apart = np.linalg.norm(some[:, None] - others, axis=-1)
    angle = 2 * np.arcsin(np.minimum(apart / 2, 1))
    return np.exp(-angle / width)


def _among(directions: Float[np.ndarray, "n 3"], width: float) -> np.ndarray:
    """Correlation matrix of the photographs' lamps, with the nugget."""
    own = NUGGET * np.eye(len(directions))
    return _common(directions, directions, width) + own


def _width(
    directions: Float[np.ndarray, "lamps 3"], images: Float[np.ndarray, "lamps h w 3"]
) -> float:
    """The width of least cross-validation error: Rasmussen and Williams, 5.12."""
    flat = images.reshape(len(images), -1, 3)
    some = flat[:, :: max(flat.shape[1] // SAMPLE, 1)].reshape(len(images), -1)
    products = some.astype(float) @ some.astype(float).T

    def missed(width: float) -> float:
        inverse = np.linalg.inv(_among(directions, width))
        return float(
            (np.diag(inverse @ products @ inverse) / np.diag(inverse) ** 2).sum()
        )

    return float(min(WIDTHS, key=missed))


def relit(
    maps: Maps,
    lights: Iterable[AbstractLight],
    surface: HeightField,
    *,
    ambient: Any,
    shadows: bool,
    film: Film,
    photographs: tuple[Sequence[Scene], AbstractStack] | None = None,
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Yield a picture for each light: see [`Maps`][]`.relight`.

    **Arguments:**

    - `surface`: the maps' height.
    - `photographs`: scenes and images. Their residual images contain cast shadows, so
        that no shadows of the height are rendered.
    """
    assert maps.camera is not None
    camera, inside = maps.camera, surface.mask
    lights = tuple(lights)
    normals = maps.normals @ np.asarray(camera.rotation).T
    positions = surface.positions()
    shape = NormalMap(
        np.where(inside[..., None], normals, 0),
        inside,
        jnp.asarray(positions, jnp.result_type(float)),
    )
    seen = trace(shape, camera)

    def show(
        light: AbstractLight, ambient: Any, share: np.ndarray | None = None
    ) -> np.ndarray:
        """Linear light without clipping; `share`: fraction of the light in shadow."""
        scene = Scene(
            shape,
            camera,
            light,
            ambient,
            specular_model=maps.specular_model,
            shadows=True,
        )
        share = np.zeros(inside.shape) if share is None else share
        lit = jnp.asarray(1 - share[..., None], seen.position.dtype)
        shaded = eqx.tree_at(
            lambda g: g.visibility, seen, lit, is_leaf=lambda leaf: leaf is None
        )
        picture = render(scene, maps.material, film=Film(clamp=False), gbuffer=shaded)
        return np.asarray(picture)

    rest = None
    if photographs is not None:
        rest = find_remainder(show, *photographs, np.median(positions[inside], axis=0))
    shares: Iterable[np.ndarray | None] = [None] * len(lights)
    if shadows and rest is None:
        shares = shadow_shares(surface.height, camera, lights)
    black = ~inside | maps.flagged(Flag.OUTSIDE)
    for light, share in zip(lights, shares, strict=True):
        picture = show(light, ambient, share)
        if rest is not None:
            picture = np.maximum(picture + rest.under(light), 0)
        picture = np.asarray(film.expose(jnp.asarray(picture)))
        yield np.where(black[..., None], 0, picture)
