"""Light that arrives at pixels from the lights of all images.

Scenes whose lights are of the same kinds are stacked and batched with `vmap`, so that a
hundred scenes of one lamp each compile as one.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.environment import Fog
from phongfit.geometry.cameras import AbstractCamera
from phongfit.lights import AbstractLight
from phongfit.scene import Scene
from phongfit.vectors import Scalar, Vec3


class _Alike(eqx.Module):
    """Lights and fog of scenes of one kind, stacked along a first axis."""

    lights: tuple[AbstractLight, ...]
    ambient: Float[Array, "*scenes 3"]
    fog: Fog | None


class Lighting(eqx.Module):
    """The lights of all images.

    `order` has the number of the image of each row: images of one kind are consecutive.
    `camera` is the camera of all scenes if any has fog, else `None`.
    """

    kinds: tuple[_Alike, ...]
    camera: AbstractCamera | None
    order: tuple[int, ...] = eqx.field(static=True)

    @property
    def lobes(self) -> int:
        """The largest number of lights in an image."""
        return max([len(kind.lights) for kind in self.kinds] + [1])

    @property
    def directed(self) -> np.ndarray:
        """True for directed lights, (images, lobes); rows as in `order`."""
        rows = []
        for kind in self.kinds:
            row = np.zeros(self.lobes, bool)
            row[: len(kind.lights)] = [light.directed for light in kind.lights]
            rows += [row] * kind.ambient.shape[0]
        return np.array(rows)

    @property
    def surrounds(self) -> bool:
        """True if any light comes from all around."""
        return not all(light.directed for kind in self.kinds for light in kind.lights)

    def around(
        self, position: Float[Array, "#pixels 3"], normal: Float[Array, "pixels 3"]
    ) -> Float[Array, "images 3 pixels"] | None:
        """Diffuse light from all around; `None` if no light surrounds the scene."""
        if not self.surrounds:
            return None

        def point(kind: _Alike, position: Vec3, normal: Vec3) -> Vec3:
            total = jnp.zeros_like(normal)
            for light in kind.lights:
                if not light.directed:
                    total = total + light.surround(normal)
            if kind.fog is None or self.camera is None:
                return total
            return kind.fog.transmittance(self.camera.depth(position)) * total

        axis = None if len(position) == 1 else 0
        position = position[0] if axis is None else position
        over_pixels = jax.vmap(point, in_axes=(None, axis, 0), out_axes=-1)
        over_scenes = jax.vmap(over_pixels, in_axes=(0, None, None))
        return jnp.concatenate(
            [over_scenes(kind, position, normal) for kind in self.kinds]
        )

    def arriving(
        self, kind: _Alike, position: Vec3
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Light that arrives at one point in one image, independent of the normal.

        **Arguments:** `kind`: one of `kinds`, but without the axis along scenes.

        **Returns:** (lobes, 3) each: unit vectors to the lights, and their intensity
        for the diffuse and the specular term; (3,) each: ambient light, and what fog
        adds. Lights that the image lacks are zeros.
        """
        ambient, none = kind.ambient, jnp.zeros_like(kind.ambient)
        lights = [light.illuminate(position) for light in kind.lights]
        for light in lights:
            ambient = ambient + light.ambient
        missing = [none] * (self.lobes - len(lights))
        to_light = jnp.stack([*(light.to_light for light in lights), *missing])
        diffuse = jnp.stack([*(light.intensity for light in lights), *missing])
        specular = jnp.stack([*(light.specular for light in lights), *missing])
        if kind.fog is None or self.camera is None:
            return to_light, diffuse, specular, ambient, none
        through = kind.fog.transmittance(self.camera.depth(position))
        veil = (1 - through) * kind.fog.color
        return to_light, through * diffuse, through * specular, through * ambient, veil


def make_lighting(scenes: tuple[Scene, ...]) -> Lighting:
    """The lights, and the fog, of scenes that share surface, camera and model."""
    members: dict[object, list[int]] = {}
    for k, scene in enumerate(scenes):
        kind = jax.tree.structure((scene.lights, scene.fog))
        members.setdefault(kind, []).append(k)
    kinds = []
    for indices in members.values():
        alike = [
            _Alike(scenes[k].lights, scenes[k].ambient, scenes[k].fog) for k in indices
        ]
        kinds.append(jax.tree.map(_stack, *alike))
    order = tuple(k for indices in members.values() for k in indices)
    foggy = any(scene.fog is not None for scene in scenes)
    camera = scenes[0].camera if foggy else None
    return Lighting(tuple(kinds), camera, order)


def _stack(*leaves: Array) -> Array:
    # Stacked by NumPy, which needs no compilation for a hundred small arrays.
    return jnp.asarray(np.stack([np.asarray(leaf) for leaf in leaves]))


T = TypeVar("T")


class Lamps(NamedTuple):
    """Light at pixels. The last axis is the pixels, or 1 if all get equal light.

    - `to_light`: (images, lights, 3, pixels) unit vectors; zeros where an image has
        fewer lights than another.
    - `diffuse`, `specular`: (images, lights, channels, pixels): reflected light of a
        surface that faces the light for ρ_d = 1, and of a highlight's centre for
        ρ_s = 1.
    - `ambient`, `veil`: (images, channels, pixels): ambient light for ρ_a = 1, and the
        light that fog adds.
    - `to_viewer`: (3, pixels) unit vectors.
    - `around`: (images, channels, pixels): reflected light from all around for ρ_d = 1;
        only if the normals are known.
    """

    to_light: Float[Array, "images lights 3 #pixels"]
    diffuse: Float[Array, "images lights channels #pixels"]
    specular: Float[Array, "images lights channels #pixels"]
    ambient: Float[Array, "images channels #pixels"]
    veil: Float[Array, "images channels #pixels"]
    to_viewer: Float[Array, "3 #pixels"]
    around: Float[Array, "images channels #pixels"] | None = None


def make_lamps(
    lighting: Lighting,
    position: Float[Array, "#pixels 3"],
    to_viewer: Float[Array, "#pixels 3"],
    visibility: Float[Array, "images lobes #pixels"] | None = None,
) -> Lamps:
    """Light at pixels in all images, in the order of the lighting's rows.

    **Arguments:**

    - `position`: world units, (pixels, 3), or (1, 3) if equal for all pixels.
    - `to_viewer`: unit vectors, (pixels, 3) or (1, 3).
    - `visibility`: fraction of each light that arrives, in [0, 1]; `None`: 1.
    """
    over_pixels = jax.vmap(lighting.arriving, in_axes=(None, 0), out_axes=-1)
    parts = [
        jax.vmap(over_pixels, in_axes=(0, None))(kind, position)
        for kind in lighting.kinds
    ]
    leaves = zip(*parts, strict=True)
    light, diffuse, specular, ambient, veil = map(jnp.concatenate, leaves)
    if visibility is not None:
        seen = visibility[:, :, None]
        diffuse, specular = diffuse * seen, specular * seen
    return Lamps(light, diffuse, specular, ambient, veil, to_viewer.T)


def at_pixels(function: Callable[..., T], *vectors: Float[Array, "3 #pixels"]) -> T:
    """Apply a function of one pixel's vectors to all pixels, which come last.

    Each component of a vector is passed as a separate array over the pixels. As rows of
    an array with an axis of three, XLA would process them one by one, which takes five
    times as long.
    """
    pixels = max(vector.shape[1] for vector in vectors)

    def of_numbers(*numbers: tuple[Scalar, ...]) -> T:
        return function(*map(jnp.stack, numbers))

    # Vectors that are equal for all pixels are not batched, so they are used once.
    each = [vector.shape[1] == pixels for vector in vectors]
    rows = [
        tuple(vector) if own else tuple(vector[:, 0])
        for own, vector in zip(each, vectors, strict=True)
    ]
    axes = tuple(0 if own else None for own in each)
    return jax.vmap(of_numbers, in_axes=axes, out_axes=-1)(*rows)


def grey(lamps: Lamps) -> Lamps:
    """Lamps with one channel: the mean over the channels."""
    return lamps._replace(
        diffuse=jnp.mean(lamps.diffuse, axis=2, keepdims=True),
        specular=jnp.mean(lamps.specular, axis=2, keepdims=True),
        ambient=jnp.mean(lamps.ambient, axis=1, keepdims=True),
        veil=jnp.mean(lamps.veil, axis=1, keepdims=True),
    )


def facing(lamps: Lamps) -> Float[Array, "images 3 pixels"]:
    r"""Light vector $\sum_j e_j s_j$ of each image, grey.

    A matte surface shows $\rho\, n$ times this vector if none of the image's lights is
    behind it.
    """
    strength = jnp.mean(lamps.diffuse, axis=2, keepdims=True)
    return jnp.sum(lamps.to_light * strength, axis=1)
