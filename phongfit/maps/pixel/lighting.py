"""All images' lights at one pixel: what its samples are made of, save for the material.

Scenes whose lights are of the same kinds are stacked and batched with `vmap`: a hundred
scenes of one lamp each compile as one.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.environment import Fog
from phongfit.geometry.cameras import AbstractCamera
from phongfit.lights import AbstractLight
from phongfit.maps.pixel.lobes import AbstractLobes, Angles, lobes_of
from phongfit.rendering.terms import point_terms
from phongfit.scene import Scene
from phongfit.vectors import Scalar, Vec3, dot


class _Alike(eqx.Module):
    """Lights and fog of scenes of one kind, stacked along a first axis."""

    lights: tuple[AbstractLight, ...]
    ambient: Float[Array, "*scenes 3"]
    fog: Fog | None


class Basis(eqx.Module):
    """What the samples of one pixel are made of; see [`PixelSamples`][]."""

    ambient: Float[Array, "3 *images"]
    diffuse: Float[Array, "3 *images"]
    strength: tuple[Float[Array, "3 *images"], ...]
    angles: Angles
    lit: Float[Array, "*images"]
    veil: Float[Array, "3 *images"] | None


class Lighting(eqx.Module):
    """The lights of all images, asked for one pixel.

    `order` says which image each of its rows is: images of one kind stand together.
    `camera` is that of all scenes, if there is fog in any.
    """

    kinds: tuple[_Alike, ...]
    shape: AbstractLobes
    camera: AbstractCamera | None
    order: tuple[int, ...] = eqx.field(static=True)

    @property
    def lobes(self) -> int:
        """The largest number of lights in an image."""
        return max([len(kind.lights) for kind in self.kinds] + [1])

    def basis(
        self,
        position: Vec3,
        normal: Vec3,
        to_viewer: Vec3,
        visibility: Float[Array, "images lobes"] | None,
        min_cosine: float,
    ) -> Basis:
        """The basis of one pixel's samples.

        **Arguments:**

        - `position`: world units; `normal`, `to_viewer`: unit vectors.
        - `visibility`: how much of each light arrives, in [0, 1], rows as in `order`.
        - `min_cosine`: an image is lit if a light of it reaches the pixel at more than
            this, or if it has none and shows ambient light alone.
        """
        parts, first = [], 0
        for kind in self.kinds:
            count = kind.ambient.shape[0]
            seen = None
            if visibility is not None:
                seen = visibility[first : first + count, : len(kind.lights)]

            def image(kind: _Alike, seen: Array | None) -> Basis:
                return self._image(kind, position, normal, to_viewer, seen, min_cosine)

            axis = None if seen is None else 0
            parts.append(jax.vmap(image, in_axes=(0, axis))(kind, seen))
            first += count
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
        return Basis(
            _channels_first(joined.ambient),
            _channels_first(joined.diffuse),
            tuple(_channels_first(strength) for strength in joined.strength),
            joined.angles,
            joined.lit,
            None if joined.veil is None else _channels_first(joined.veil),
        )

    def arriving(
        self, kind: _Alike, position: Vec3
    ) -> tuple[Array, Array, Array, Array, Array]:
        """What arrives at one point in one image, whatever the normal there.

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

    def _image(
        self,
        kind: _Alike,
        position: Vec3,
        normal: Vec3,
        to_viewer: Vec3,
        seen: Float[Array, " lights"] | None,
        min_cosine: float,
    ) -> Basis:
        """The basis of one image: of `kind`, but without the axis along scenes."""
        lights, dark = kind.lights, jnp.zeros_like(kind.ambient)
        terms = point_terms(
            lights, kind.ambient, self.shape.model, position, normal, to_viewer, seen
        )
        missing = self.lobes - len(lights)
        strength = (*terms.strength, *[dark] * missing)
        none = jax.tree.map(lambda _: dark[0], terms.cosine)
        cosines = [
            jax.tree.map(lambda one, k=k: one[k], terms.cosine)
            for k in range(len(lights))
        ]
        cosines += [none] * missing
        directed = [k for k, light in enumerate(lights) if light.directed]
        lit = jnp.array(not directed)
        for k in directed:
            light = lights[k]
            to_light = light.illuminate(position).to_light
            reached = dot(normal, to_light) > min_cosine
            lit = lit | (reached if seen is None else reached & (seen[k] > 0))
        angles = tuple(map(self.shape.angles, cosines))
        lit = lit.astype(normal.dtype)
        veil = None if self.camera is None else dark
        basis = Basis(terms.ambient, terms.diffuse, strength, angles, lit, veil)
        if kind.fog is None or self.camera is None:
            return basis
        return _fogged(basis, kind.fog, self.camera.depth(position))


def _fogged(basis: Basis, fog: Fog, depth: Scalar) -> Basis:
    """What fog leaves of one image's light, and what it adds."""
    through = fog.transmittance(depth)
    return Basis(
        through * basis.ambient,
        through * basis.diffuse,
        tuple(through * strength for strength in basis.strength),
        basis.angles,
        basis.lit,
        (1 - through) * fog.color,
    )


def _channels_first(colours: Float[Array, "images 3"]) -> Float[Array, "3 images"]:
    # Not a mere transposition: the compiler would keep the old order in memory.
    return jnp.stack([colours[:, k] for k in range(3)])


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
    return Lighting(tuple(kinds), lobes_of(scenes[0].specular_model), camera, order)


def _stack(*leaves: Array) -> Array:
    # By way of NumPy: a hundred small arrays need no compilation.
    return jnp.asarray(np.stack([np.asarray(leaf) for leaf in leaves]))
