"""Maps under other lights: diffuse light, highlight, attached and cast shadows."""

from collections.abc import Iterable, Iterator
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
from phongfit.maps.result import Maps
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
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """A picture for one light after the other: see [`Maps`][]`.relight`.

    **Arguments:** `surface`: the maps' height.
    """
    assert maps.camera is not None
    camera, inside = maps.camera, surface.mask
    lights = tuple(lights)
    normals = maps.normals @ np.asarray(camera.rotation).T
    positions = jnp.asarray(surface.positions(), jnp.result_type(float))
    shape = NormalMap(np.where(inside[..., None], normals, 0), inside, positions)
    black = ~inside | maps.flagged(Flag.OUTSIDE)
    shares: Iterable[np.ndarray] = (np.zeros(inside.shape) for _ in lights)
    if shadows:
        shares = shadow_shares(surface.height, camera, lights)
    seen = trace(shape, camera)
    for light, share in zip(lights, shares, strict=True):
        scene = Scene(
            shape,
            camera,
            light,
            ambient,
            specular_model=maps.specular_model,
            shadows=True,
        )
        lit = jnp.asarray(1 - share[..., None], seen.position.dtype)
        shaded = eqx.tree_at(
            lambda g: g.visibility, seen, lit, is_leaf=lambda leaf: leaf is None
        )
        picture = render(scene, maps.material, film=film, gbuffer=shaded)
        yield np.where(black[..., None], 0, np.asarray(picture))
