"""From objects back to what the records of [`phongfit.files.schema`][] read."""

from typing import Any

import numpy as np

from phongfit.environment import Fog
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
)
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.shading import (
    AbstractShading,
    FlatShading,
    GouraudShading,
    PhongShading,
)
from phongfit.geometry.surfaces import AbstractSurface, NormalMap, Sphere
from phongfit.lights import AbstractLight, DirectionalLight, PointLight, SpotLight
from phongfit.material import Material
from phongfit.plain import plain
from phongfit.reflectance import AbstractSpecular, BlinnPhong, Phong

Described = dict[str, Any]


def describe(
    value: AbstractCamera | AbstractLight | AbstractSpecular | AbstractShading | Fog,
) -> Described:
    """A part of a scene as its record reads it.

    **Raises:** `ValueError` if there is no record for its kind.
    """
    match value:
        case OrthographicCamera():
            own = {"kind": "orthographic", "view_height": value.view_height}
            return plain(own | _place(value))
        case PerspectiveCamera():
            own = {"kind": "perspective", "fov_y_degrees": value.fov_y}
            return plain(own | _place(value))
        case DirectionalLight():
            own = {"kind": "directional", "direction": value.direction}
            return plain(own | _colours(value))
        case PointLight():
            own = {"kind": "point", "position": value.position}
            return plain(own | {"attenuation": value.attenuation} | _colours(value))
        case SpotLight():
            own = {
                "kind": "spot",
                "position": value.position,
                "axis": value.axis,
                "cutoff_degrees": value.cutoff,
                "exponent": value.exponent,
                "attenuation": value.attenuation,
            }
            return plain(own | _colours(value))
        case FlatShading():
            return {"kind": "flat", "at": value.at, "clamp": value.clamp}
        case GouraudShading():
            return {"kind": "gouraud", "clamp": value.clamp}
        case PhongShading():
            return {"kind": "phong"}
        case Fog():
            return plain(
                {
                    "color": value.color,
                    "mode": value.mode,
                    "density": value.density,
                    "start": value.start,
                    "end": value.end,
                }
            )
        case Phong():
            return {"kind": "phong", "gate": value.gate}
        case BlinnPhong():
            own = {"kind": "blinn-phong", "gate": value.gate}
            return own | {"normalized": value.normalized}
    raise ValueError(f"{type(value).__name__}: cannot be saved in a scene file")


def _place(camera: AbstractCamera) -> Described:
    return {
        "width": camera.width,
        "height": camera.height,
        "position": camera.position,
        "rotation": camera.rotation,
    }


def _colours(light: DirectionalLight | PointLight | SpotLight) -> Described:
    own = {} if light.specular is None else {"specular": light.specular}
    return {"intensity": light.intensity, **own, "ambient": light.ambient}


def describe_surface(
    surface: AbstractSurface, stem: str
) -> tuple[Described, dict[str, np.ndarray]]:
    """A surface as its record reads it, and the arrays that go into files beside it.

    **Arguments:** `stem`: how the names of these files begin.

    **Raises:** `ValueError` if there is no record for its kind.
    """
    match surface:
        case Sphere():
            own = {"center": surface.center, "radius": surface.radius}
            return plain({"kind": "sphere", **own}), {}
        case NormalMap():
            files = {
                "normals": f"{stem}_normals.npy",
                "mask": f"{stem}_mask.png",
                "positions": f"{stem}_positions.npy",
            }
            named, arrays = _in_files(surface, files)
            return {"kind": "normal_map", **named}, arrays
        case Mesh():
            names = ("vertices", "faces", "normals", "material_index")
            files = {name: f"{stem}_{name}.npy" for name in names}
            named, arrays = _in_files(surface, files)
            own = {"weighting": surface.weighting, "two_sided": surface.two_sided}
            return {"kind": "mesh", **named, **own}, arrays
    raise ValueError(f"{type(surface).__name__}: cannot be saved in a scene file")


def _in_files(
    surface: AbstractSurface, files: dict[str, str]
) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Which file holds which of a surface's arrays, and what goes into each."""
    arrays = {
        file: np.asarray(array)
        for name, file in files.items()
        if (array := getattr(surface, name)) is not None
    }
    return {name: file for name, file in files.items() if file in arrays}, arrays


def describe_material(material: Material) -> Described:
    """A material as its record reads it: every leaf one number, or RGB.

    **Raises:** `ValueError` for a leaf of another shape.
    """
    leaves = {
        "diffuse": material.diffuse,
        "specular": material.specular,
        "shininess": material.shininess,
        "ambient": material.ambient,
        "emission": material.emission,
    }
    for name, leaf in leaves.items():
        if leaf.shape not in ((), (3,)):
            raise ValueError(f"{name}: shape {leaf.shape} came, () or (3,) is wanted")
    return plain(leaves)
