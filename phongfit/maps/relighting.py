"""Maps under other lights: diffuse light, highlight, attached and cast shadows.

With photographs, their interpolated residual images are added, which contain the cast
shadows.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from phongfit.geometry.height import HeightField, shadow_shares
from phongfit.geometry.surfaces import NormalMap
from phongfit.geometry.tracing import trace
from phongfit.lights import AbstractLight
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.remainder import find_remainder
from phongfit.maps.result import Maps
from phongfit.maps.stacks import AbstractStack
from phongfit.rendering.film import Film
from phongfit.rendering.render import render
from phongfit.scene import Scene


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
