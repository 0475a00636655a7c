"""Conversion of whole scenes to and from the state of fixed-function OpenGL 1.x.

Light model, shade model and matrices are here; lights, materials and fog are in
`experiments.opengl_state`.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.opengl_state import (
    check_names,
    fog_from_opengl,
    fog_to_opengl,
    light_from_opengl,
    light_to_opengl,
)
from phongfit.files.limits import limited, lost
from phongfit.files.opengl import FORMAT, Parameters, rgba
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
)
from phongfit.geometry.shading import AbstractShading, FlatShading, GouraudShading
from phongfit.geometry.surfaces import AbstractSurface
from phongfit.reflectance import BlinnPhong
from phongfit.scene import Scene

MAX_LIGHTS = 8
"""Number of lights that every OpenGL 1.x has."""


def shading_to_opengl(shading: AbstractShading, *, nearest: bool = False) -> str:
    """A shading method as the argument of `glShadeModel`: GL_FLAT or GL_SMOOTH.

    OpenGL has Gouraud shading, and flat shading lit at a face's last vertex.

    **Arguments:** `nearest`: for Phong shading return GL_SMOOTH, for flat shading lit
    at the centroid GL_FLAT, each with a warning instead of an error.

    **Raises:** `ValueError` for these methods, unless `nearest`.
    """
    if isinstance(shading, FlatShading):
        if shading.at == "centroid":
            lost(f"shading: {FORMAT} lights a face at its last vertex", nearest)
        return "GL_FLAT"
    if not isinstance(shading, GouraudShading):
        lost(f"shading: {FORMAT} has no {type(shading).__name__}", nearest)
    return "GL_SMOOTH"


def shading_from_opengl(shade_model: str, clamp: bool = True) -> AbstractShading:
    """A shading method from the argument of `glShadeModel`.

    **Arguments:** `shade_model`: GL_FLAT or GL_SMOOTH; `clamp`: whether light at
    vertices is clamped to [0, 1] (OpenGL's GL_CLAMP_VERTEX_COLOR).

    **Raises:** `ValueError` for any other `shade_model`.
    """
    if shade_model == "GL_FLAT":
        return FlatShading("last_vertex", clamp)
    if shade_model == "GL_SMOOTH":
        return GouraudShading(clamp)
    raise ValueError(f"shade_model: expected GL_FLAT or GL_SMOOTH, got {shade_model!r}")


def camera_to_opengl(
    camera: AbstractCamera, near: float = 0.1, far: float = 100.0
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]:
    """Projection and modelview matrix, for `glLoadTransposeMatrixd`.

    **Arguments:**

    - `camera`: an orthographic or perspective one.
    - `near`, `far`: depths between which OpenGL draws, world units.

    **Returns:** matrices that multiply column vectors from the left. The first takes
    camera axes (x right, y up, view along −z) to OpenGL's clip coordinates, the second
    world axes to camera axes.

    **Raises:** `ValueError` for a camera of another kind.
    """
    aspect = camera.width / camera.height
    projection = np.zeros((4, 4))
    if isinstance(camera, OrthographicCamera):
        scale = 2 / float(camera.view_height)
        projection[2, 2:] = -2 / (far - near), -(far + near) / (far - near)
        projection[3, 3] = 1
    elif isinstance(camera, PerspectiveCamera):
        scale = 1 / math.tan(math.radians(float(camera.fov_y)) / 2)
        projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
        projection[3, 2] = -1
    else:
        raise ValueError(f"camera: OpenGL has no {type(camera).__name__}")
    projection[0, 0], projection[1, 1] = scale / aspect, scale
    rotation = np.asarray(camera.rotation, float)
    modelview = np.eye(4)
    modelview[:3, :3] = rotation.T
    modelview[:3, 3] = -rotation.T @ np.asarray(camera.position, float)
    return projection, modelview


def scene_to_opengl(scene: Scene, *, nearest: bool = False) -> Parameters:
    """State of OpenGL for a scene: all but its mesh, camera and material.

    **Arguments:**

    - `scene`: lit by at most 8 lights, with OpenGL's own highlight, [`BlinnPhong`][].
    - `nearest`: warn instead of raising an error, and leave out or replace by the
        nearest what OpenGL does not have: shadows, Phong shading, another model of the
        highlight, fog and background above 1, a spot's exponent above 128.

    **Returns:** `light_model`, `shade_model`, `clamp_vertex_color`, `lights`, `fog`
    (`None` without fog) and `background`.

    **Raises:** `ValueError` that names the field, unless `nearest`; for more than 8
    lights, or another kind of light, always.
    """
    if len(scene.lights) > MAX_LIGHTS:
        raise ValueError(
            f"lights: expected at most {MAX_LIGHTS}, as OpenGL has, got "
            f"{len(scene.lights)}"
        )
    if scene.specular_model != BlinnPhong():
        lost(
            f"specular_model: {FORMAT} has {BlinnPhong()}, got {scene.specular_model}",
            nearest,
        )
    if scene.shadows:
        lost(f"shadows: {FORMAT} throws none", nearest)
    local = scene.local_viewer
    # `None`: local for a perspective camera.
    if local is None:
        local = not isinstance(scene.camera, OrthographicCamera)
    background = limited("background", scene.background, 1.0, FORMAT, nearest)
    return {
        "light_model": {
            "GL_LIGHT_MODEL_AMBIENT": rgba(scene.ambient),
            "GL_LIGHT_MODEL_LOCAL_VIEWER": local,
        },
        "shade_model": shading_to_opengl(scene.shading, nearest=nearest),
        "clamp_vertex_color": scene.shading.clamp,
        "lights": [light_to_opengl(light, nearest=nearest) for light in scene.lights],
        "fog": fog_to_opengl(scene.fog, nearest=nearest),
        "background": [float(channel) for channel in background],
    }


def scene_from_opengl(
    surface: AbstractSurface, camera: AbstractCamera, state: Mapping[str, Any]
) -> Scene:
    """A scene from OpenGL's state: the inverse of [`scene_to_opengl`][].

    **Arguments:**

    - `surface`, `camera`: those of the scene, which are not in `state`.
    - `state`: entries as [`scene_to_opengl`][] returns them; a missing one has OpenGL's
        default.

    **Raises:** `ValueError` for an unknown name, and for values that the parts of the
    scene refuse.
    """
    defaults: Parameters = {
        "light_model": {},
        "shade_model": "GL_SMOOTH",
        "clamp_vertex_color": True,
        "lights": [],
        "fog": None,
        "background": (0.0, 0.0, 0.0),
    }
    check_names("state", state, set(defaults))
    values = defaults | dict(state)
    model: Parameters = {
        "GL_LIGHT_MODEL_AMBIENT": (0.2, 0.2, 0.2),
        "GL_LIGHT_MODEL_LOCAL_VIEWER": False,
    }
    check_names("light_model", values["light_model"], set(model))
    model |= values["light_model"]
    return Scene(
        surface,
        camera,
        [light_from_opengl(light) for light in values["lights"]],
        model["GL_LIGHT_MODEL_AMBIENT"][:3],
        shading=shading_from_opengl(
            values["shade_model"], values["clamp_vertex_color"]
        ),
        fog=fog_from_opengl(values["fog"]),
        background=values["background"],
        local_viewer=bool(model["GL_LIGHT_MODEL_LOCAL_VIEWER"]),
    )
