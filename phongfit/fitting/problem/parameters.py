"""Parameters that can be unknown: of the material, of the scenes, and exposure.

A parameter of the material has its own name (`diffuse`), an array of the scene its path
(`scene.lights[0].direction`), and `exposure` multiplies the light of each image.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from phongfit.scene import Scene

REFLECTANCES = ("ambient", "diffuse", "specular", "emission")
MATERIAL_PARAMETERS = ("ambient", "diffuse", "specular", "shininess", "emission")
EXPOSURE = "exposure"
OF_MODEL = "scene.specular_model."
TEXTURE = ".texture"
"""Suffix of a parameter's name, for a separate value in each texel."""
CHANNELS = ("red", "green", "blue")
# Last names of a scene's arrays: RGB, unit vectors, and numbers that cannot be
# negative.
_COLOURS = {"intensity", "specular", "ambient", "color", "background"}
_DIRECTIONS = {"direction", "axis"}
_ROTATION = "rotation"
_NOT_NEGATIVE = {"attenuation", "exponent", "density"} | _COLOURS
_NOT_NEGATIVE |= {"radius", "height", "view_height", "fx", "fy"}

DEFAULT_BOUNDS = {
    "ambient": (0.0, 1.0),
    "diffuse": (0.0, 1.0),
    "specular": (0.0, 1.0),
    # Textbooks stop at 200; a real, shiny ball fits 600-800 with Blinn's model.
    "shininess": (1.0, 1000.0),
    "emission": (0.0, 1.0),
    EXPOSURE: (0.0, np.inf),
}
# Bounds of angles in degrees, by the last names of a scene's arrays.
_ANGLES = {"fov_y": (0.0, 180.0), _ROTATION: (-180.0, 180.0)}

Form = Literal["plain", "logarithm", "direction", "rotation"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One unknown parameter, with the names of its numbers.

    `rows` are the materials or images with separate values, `parts` the numbers of a
    row: a colour's channels, a vector's components, or one. `box` has the bounds that a
    specular model states for its parameters. A `nuisance` is uncertain: it is fitted
    with its prior, but a result does not list it.
    """

    name: str
    rows: tuple[str, ...]
    parts: tuple[str, ...]
    form: Form
    per_image: bool = False
    box: tuple[float, float] | None = None
    nuisance: bool = False

    @property
    def size(self) -> int:
        """Number of the parameter's values."""
        return len(self.rows) * len(self.parts)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the values: `diffuse[2].red`, `scenes[1].lights[0].position.x`."""
        if self.per_image and is_of_scene(self.name):
            path = self.name.removeprefix("scene")
            names = [f"scenes{row}{path}" for row in self.rows]
        else:
            names = [self.name + row for row in self.rows]
        return tuple(name + part for name in names for part in self.parts)

    @property
    def channels(self) -> tuple[int, ...]:
        """The channel of each part; −1 for parts that all channels share."""
        colours = {f".{name}": channel for channel, name in enumerate(CHANNELS)}
        return tuple(colours.get(part, -1) for part in self.parts)

    @property
    def default_bounds(self) -> tuple[float, float]:
        """Default lower and upper bound of the parameter's values."""
        if self.box is not None:
            return self.box
        if self.name in DEFAULT_BOUNDS:
            return DEFAULT_BOUNDS[self.name]
        last = self.name.rpartition(".")[2]
        if last in _ANGLES:
            return _ANGLES[last]
        return (0.0 if last in _NOT_NEGATIVE else -np.inf), np.inf


class Entries(NamedTuple):
    """The numbers of parameters, one after the other; each column is an array.

    - `label`, `form`, `parameter`: label, form, and name of the parameter.
    - `row`: index of the material or image; 0 if all share the entry.
    - `part`, `channel`: index in the row, and the channel; −1 if all share the entry.
    - `per_image`, `nuisance`: whether it belongs to one image, or to a nuisance.
    - `low`, `high`: default bounds.
    """

    label: np.ndarray
    form: np.ndarray
    parameter: np.ndarray
    row: np.ndarray
    part: np.ndarray
    channel: np.ndarray
    per_image: np.ndarray
    nuisance: np.ndarray
    low: np.ndarray
    high: np.ndarray


@functools.cache
def list_entries(parameters: tuple[Parameter, ...]) -> Entries:
    """The numbers of all parameters."""
    entries = [
        (label, p.form, p.name, row, part, channel, p.per_image, p.nuisance, low, high)
        for p in parameters
        for low, high in [p.default_bounds]
        for label, (row, (part, channel)) in zip(
            p.labels,
            itertools.product(range(len(p.rows)), enumerate(p.channels)),
            strict=True,
        )
    ]
    return Entries(*map(np.array, zip(*entries, strict=True)))


def is_of_scene(name: str) -> bool:
    """Whether a parameter belongs to the scene, not to the material."""
    return name.startswith("scene.")


def is_of_model(name: str) -> bool:
    """Whether a parameter belongs to the specular model, and so shapes lobes."""
    return name.startswith(OF_MODEL)


def scales_light(name: str) -> bool:
    """Whether light is linear in a parameter: a reflectance, a colour, an exposure."""
    last = name.rpartition(".")[2]
    return name in (*REFLECTANCES, EXPOSURE) or (is_of_scene(name) and last in _COLOURS)


def moves_geometry(name: str) -> bool:
    """Whether rays must be traced again when it changes."""
    return name.startswith(("scene.surface", "scene.camera"))


def parameter(
    name: str, colours: bool, materials: int, scenes: Sequence[Scene], per_image: bool
) -> Parameter:
    """A parameter by its name.

    **Arguments:**

    - `colours`: whether a colour has separate values for red, green and blue.
    - `materials`: number of materials of the surface.
    - `per_image`: whether each image has its own.

    **Raises:** `ValueError` for any other name; the message lists the possible ones.
    """
    several = len(scenes) > 1
    rgb = tuple(f".{channel}" for channel in CHANNELS) if colours else ("",)
    if name == EXPOSURE:
        return Parameter(name, _rows(len(scenes)), ("",), "plain", several)
    if name in MATERIAL_PARAMETERS:
        scale: Form = "logarithm" if name == "shininess" else "plain"
        return Parameter(name, _rows(materials), rgb, scale)
    if name.endswith(TEXTURE):
        raise ValueError(f"unknowns: texels are fitted by fit_texture, got {name!r}")
    value = scene_arrays(scenes[0])[name] if is_known(name, scenes) else None
    if value is None or name.startswith("scene.background"):
        raise ValueError(f"unknowns: expected one of {_choice(scenes)}, got {name!r}")
    if name in _jumps(scenes):
        raise ValueError(
            f"unknowns: {name} cannot be fitted: where it ends the light, pixels jump "
            "from lit to dark as it changes, and between jumps none depends on it. "
            "Hold it fixed at its value, and mask out the pixels near that edge if it "
            "is not known well"
        )
    last = name.rpartition(".")[2]
    parts = ("",)
    if last in _COLOURS:
        parts = rgb
    elif _is_rotation(name, value) or (value.shape == (3,) and last != "attenuation"):
        parts = (".x", ".y", ".z")
    elif value.ndim:
        parts = tuple(f"[{','.join(map(str, at))}]" for at in np.ndindex(value.shape))
    form: Form = "direction" if last in _DIRECTIONS else "plain"
    if _is_rotation(name, value):
        form = "rotation"
    rows = _rows(len(scenes)) if per_image else ("",)
    box = None
    if is_of_model(name):
        own = scenes[0].specular_model.bounds
        box = own.get(name.removeprefix(OF_MODEL))
    return Parameter(name, rows, parts, form, per_image and several, box)


def _is_rotation(name: str, array: Array) -> bool:
    """Whether an array is a rotation, for which a fit has three angles."""
    return name.endswith(f".{_ROTATION}") and array.shape == (3, 3)


def _rows(count: int) -> tuple[str, ...]:
    return ("",) if count == 1 else tuple(f"[{row}]" for row in range(count))


def _jumps(scenes: Sequence[Scene]) -> set[str]:
    """Arrays of the scenes' lights in which light is not continuous."""
    return {
        f"scene.lights[{k}].{field}"
        for scene in scenes
        for k, light in enumerate(scene.lights)
        for field in light.jumps
    }


def is_known(name: Any, scenes: Sequence[Scene]) -> bool:
    """Whether all scenes have an array of this name."""
    return all(name in scene_arrays(scene) for scene in scenes)


def scene_arrays(scene: Scene) -> dict[str, Array]:
    """All arrays of floats in a scene, by their paths."""
    floats = eqx.filter(scene, eqx.is_inexact_array)
    found = jax.tree_util.tree_flatten_with_path(floats)[0]
    return {"scene" + jax.tree_util.keystr(path): array for path, array in found}


def with_arrays(scene: Scene, arrays: Mapping[str, Any]) -> Scene:
    """A scene with some arrays replaced; one number may stand for a colour's three."""

    def put(path: Any, old: Any) -> Any:
        new = arrays.get("scene" + jax.tree_util.keystr(path))
        if new is None:
            return old
        return jnp.broadcast_to(
            new[0] if len(new) == 1 else new.reshape(old.shape), old.shape
        )

    return jax.tree_util.tree_map_with_path(put, scene)


def _choice(scenes: Sequence[Scene]) -> str:
    """Possible names of unknowns, without those of large arrays."""
    arrays = [
        name
        for name, array in scene_arrays(scenes[0]).items()
        if (array.size <= 3 or _is_rotation(name, array))
        and is_known(name, scenes)
        and "background" not in name
        and name not in _jumps(scenes)
    ]
    return ", ".join((*MATERIAL_PARAMETERS, EXPOSURE, *arrays))
