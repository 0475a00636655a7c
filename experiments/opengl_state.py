"""Convert materials, lights and fog to parameters of OpenGL 1.x and back.

Parameters of the fixed-function pipeline are dicts from OpenGL's names to numbers, for
`glMaterialfv`, `glLightfv` and `glFogfv`. OpenGL itself is not needed here.

??? cite "Source"
    Segal and Akeley, *The OpenGL graphics system, version 1.5*, section 2.14.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from phongfit.environment import Fog, FogMode
from phongfit.files.limits import limited
from phongfit.files.opengl import FORMAT, Parameters, rgba
from phongfit.lights import AbstractLight, DirectionalLight, PointLight, SpotLight
from phongfit.material import Material

MAX_SPOT_EXPONENT = 128.0
"""Largest GL_SPOT_EXPONENT that OpenGL accepts."""

FOG_MODES: dict[FogMode, str] = {
    "linear": "GL_LINEAR",
    "exp": "GL_EXP",
    "exp2": "GL_EXP2",
}


def check_names(record: str, parameters: Mapping[str, Any], known: set[str]) -> None:
    """Check that all names of `parameters` are in `known`.

    **Arguments:** `record`: a word for `parameters`, for the message.

    **Raises:** `ValueError` that names the first unknown one.
    """
    for name in parameters:
        if name not in known:
            raise ValueError(f"{record}: it has no {name}; known: {sorted(known)}")


def material_from_opengl(parameters: Mapping[str, Any]) -> Material:
    """A material from OpenGL's parameters; missing ones have OpenGL's defaults.

    The inverse of [`material_to_opengl`][]. Of RGBA the alpha is dropped. GL_AMBIENT
    and GL_DIFFUSE win over GL_AMBIENT_AND_DIFFUSE.

    **Raises:** `ValueError` for a name that materials do not have.
    """
    both = parameters.get("GL_AMBIENT_AND_DIFFUSE")
    defaults = {
        "GL_AMBIENT": (0.2, 0.2, 0.2) if both is None else both,
        "GL_DIFFUSE": (0.8, 0.8, 0.8) if both is None else both,
        "GL_SPECULAR": (0.0, 0.0, 0.0),
        "GL_EMISSION": (0.0, 0.0, 0.0),
        "GL_SHININESS": 0.0,
    }
    check_names("material", parameters, {*defaults, "GL_AMBIENT_AND_DIFFUSE"})
    values = defaults | dict(parameters)
    return Material(
        diffuse=values["GL_DIFFUSE"][:3],
        specular=values["GL_SPECULAR"][:3],
        shininess=values["GL_SHININESS"],
        ambient=values["GL_AMBIENT"][:3],
        emission=values["GL_EMISSION"][:3],
    )


def light_to_opengl(light: AbstractLight, *, nearest: bool = False) -> Parameters:
    """A light as the arguments of `glLightfv` and `glLightf`.

    Position and direction are in world axes: set them while the modelview matrix is
    that of the camera alone, from world to camera axes.

    **Arguments:**

    - `light`: a directional, point or spot light.
    - `nearest`: replace a spot's exponent above 128 by 128, with a warning instead of
        an error.

    **Returns:** GL_AMBIENT, GL_DIFFUSE, GL_SPECULAR, GL_POSITION (w = 0 for a
    direction); for point and spot lights also the three attenuations; for spot lights
    also GL_SPOT_DIRECTION, GL_SPOT_EXPONENT and GL_SPOT_CUTOFF (degrees from the axis).

    **Raises:** `ValueError` for another kind of light, and for a spot's exponent above
    128 unless `nearest`.
    """
    if not isinstance(light, DirectionalLight | PointLight | SpotLight):
        raise ValueError(f"light: OpenGL has no {type(light).__name__}")
    # `None`: the specular light is the diffuse one.
    specular = light.intensity if light.specular is None else light.specular
    parameters: Parameters = {
        "GL_AMBIENT": rgba(light.ambient),
        "GL_DIFFUSE": rgba(light.intensity),
        "GL_SPECULAR": rgba(specular),
    }
    if isinstance(light, DirectionalLight):
        return parameters | {"GL_POSITION": [*_floats(light.direction), 0.0]}
    constant, linear, quadratic = _floats(light.attenuation)
    parameters |= {
        "GL_POSITION": [*_floats(light.position), 1.0],
        "GL_CONSTANT_ATTENUATION": constant,
        "GL_LINEAR_ATTENUATION": linear,
        "GL_QUADRATIC_ATTENUATION": quadratic,
    }
    if isinstance(light, PointLight):
        return parameters
    exponent = limited("exponent", light.exponent, MAX_SPOT_EXPONENT, FORMAT, nearest)
    return parameters | {
        "GL_SPOT_DIRECTION": _floats(light.axis),
        "GL_SPOT_EXPONENT": float(exponent),
        "GL_SPOT_CUTOFF": float(light.cutoff),
    }


def _floats(array: Float[Array, " n"]) -> list[float]:
    """Numbers of an array as Python's floats."""
    return [float(value) for value in np.asarray(array)]


def light_from_opengl(parameters: Mapping[str, Any]) -> AbstractLight:
    """A light from OpenGL's parameters; missing ones have the defaults of GL_LIGHT0.

    The inverse of [`light_to_opengl`][]. `GL_POSITION` and `GL_SPOT_DIRECTION` are in
    world axes, as if set while the modelview matrix is that of the camera alone. Of
    RGBA the alpha is dropped.

    **Returns:** a directional light for a position with w = 0; otherwise a point light
    for GL_SPOT_CUTOFF = 180, and a spot for any other.

    **Raises:** `ValueError` for a name that lights do not have, a position that is not
    four numbers, or a spot whose position is at infinity (w = 0).
    """
    defaults = {
        "GL_AMBIENT": (0.0, 0.0, 0.0),
        "GL_DIFFUSE": (1.0, 1.0, 1.0),
        "GL_SPECULAR": (1.0, 1.0, 1.0),
        "GL_POSITION": (0.0, 0.0, 1.0, 0.0),
        "GL_CONSTANT_ATTENUATION": 1.0,
        "GL_LINEAR_ATTENUATION": 0.0,
        "GL_QUADRATIC_ATTENUATION": 0.0,
        "GL_SPOT_DIRECTION": (0.0, 0.0, -1.0),
        "GL_SPOT_EXPONENT": 0.0,
        "GL_SPOT_CUTOFF": 180.0,
    }
    check_names("light", parameters, set(defaults))
    values = defaults | dict(parameters)
    intensity = values["GL_DIFFUSE"][:3]
    colours = {
        "specular": values["GL_SPECULAR"][:3],
        "ambient": values["GL_AMBIENT"][:3],
    }
    homogeneous = np.asarray(values["GL_POSITION"], float)
    if homogeneous.shape != (4,):
        raise ValueError(f"GL_POSITION: expected shape (4,), got {homogeneous.shape}")
    # A cone of 180° to each side of its axis is no cone.
    is_spot = values["GL_SPOT_CUTOFF"] != 180
    if homogeneous[3] == 0:
        if is_spot:
            raise ValueError(
                "GL_SPOT_CUTOFF: expected 180, since a directional light (w = 0) "
                "cannot be a spot"
            )
        return DirectionalLight(homogeneous[:3], intensity, **colours)
    falloff = [
        values[f"GL_{name}_ATTENUATION"] for name in ("CONSTANT", "LINEAR", "QUADRATIC")
    ]
    position = homogeneous[:3] / homogeneous[3]
    if not is_spot:
        return PointLight(position, intensity, attenuation=falloff, **colours)
    return SpotLight(
        position,
        values["GL_SPOT_DIRECTION"],
        intensity,
        cutoff=values["GL_SPOT_CUTOFF"],
        exponent=values["GL_SPOT_EXPONENT"],
        attenuation=falloff,
        **colours,
    )


def fog_to_opengl(fog: Fog | None, *, nearest: bool = False) -> Parameters | None:
    """Fog as names and values of `glFogfv`, such as `GL_FOG_MODE`; `None` for no fog.

    Density is per world unit; start and end are depths in world units.

    **Arguments:** `nearest`: replace a colour above 1 by 1, with a warning instead of
    an error.

    **Raises:** `ValueError` for a colour above 1, unless `nearest`.
    """
    if fog is None:
        return None
    color = limited("color", fog.color, 1.0, FORMAT, nearest)
    return {
        "GL_FOG_MODE": FOG_MODES[fog.mode],
        "GL_FOG_COLOR": rgba(color),
        "GL_FOG_DENSITY": float(fog.density),
        "GL_FOG_START": float(fog.start),
        "GL_FOG_END": float(fog.end),
    }


def fog_from_opengl(parameters: Mapping[str, Any] | None) -> Fog | None:
    """Fog from OpenGL's parameters; missing ones have OpenGL's defaults.

    The inverse of [`fog_to_opengl`][]: `None` is no fog.

    **Raises:** `ValueError` for a name or a mode that fog does not have.
    """
    if parameters is None:
        return None
    defaults = {
        "GL_FOG_MODE": "GL_EXP",
        "GL_FOG_COLOR": (0.0, 0.0, 0.0),
        "GL_FOG_DENSITY": 1.0,
        "GL_FOG_START": 0.0,
        "GL_FOG_END": 1.0,
    }
    check_names("fog", parameters, set(defaults))
    values: Parameters = defaults | dict(parameters)
    modes: dict[str, FogMode] = {name: mode for mode, name in FOG_MODES.items()}
    mode = values["GL_FOG_MODE"]
    if mode not in modes:
        raise ValueError(
            f"GL_FOG_MODE: expected {list(modes)}, got {values['GL_FOG_MODE']!r}"
        )
    return Fog(
        values["GL_FOG_COLOR"][:3],
        modes[mode],
        density=values["GL_FOG_DENSITY"],
        start=values["GL_FOG_START"],
        end=values["GL_FOG_END"],
    )
