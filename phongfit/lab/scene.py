"""Scene and material from the settings of the sliders."""

from typing import Any, NamedTuple

import numpy as np

from phongfit.geometry.cameras import AbstractCamera, OrthographicCamera, look_at
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.shading import (
    AbstractShading,
    FlatShading,
    GouraudShading,
    PhongShading,
)
from phongfit.geometry.surfaces import AbstractSurface
from phongfit.lab.settings import SPHERE, Settings
from phongfit.lights import AbstractLight, DirectionalLight, PointLight, SpotLight
from phongfit.material import Material
from phongfit.reflectance import BlinnPhong, Phong
from phongfit.scene import Scene

# Height of the view: a sphere of radius 1 fills 10/11 of the picture.
VIEW_HEIGHT = 2.2
# Distance of the image plane from the origin, outside the sphere of radius 1.
AWAY = 5.0


class Frame(NamedTuple):
    """A picture's size in pixels; `free` if the sliders set origin and scale."""

    height: int
    width: int
    free: bool = False


def make_material(settings: Settings) -> Material:
    """The material from the settings."""
    return Material(
        diffuse=settings.diffuse,
        specular=settings.specular,
        shininess=settings.shininess,
        ambient=settings.ambient,
    )


def make_scene(settings: Settings, surface: AbstractSurface, frame: Frame) -> Scene:
    """The scene from the settings: at most one light, and ambient light."""
    return Scene(
        surface,
        make_camera(settings, frame),
        make_lights(settings),
        settings.ambient_light,
        specular_model=Phong() if settings.specular_model == "phong" else BlinnPhong(),
        shading=make_shading(settings),
    )


def make_shading(settings: Settings) -> AbstractShading:
    """The shading method, from its name in the settings."""
    kinds = {"flat": FlatShading, "gouraud": GouraudShading, "phong": PhongShading}
    return kinds[settings.shading]()


def make_lights(settings: Settings) -> tuple[AbstractLight, ...]:
    """The light of the chosen kind, or none for ambient light only.

    A spot light points at the origin. Intensities are those at the origin, independent
    of the distance.
    """
    towards = _direction(settings.azimuth, settings.elevation)
    position = settings.distance * towards
    share = settings.falloff
    attenuation = (1 - share, 0.0, share / settings.distance**2)
    near: dict[str, Any] = {"attenuation": attenuation}
    match settings.light:
        case "directional":
            return (DirectionalLight(towards, settings.intensity),)
        case "point":
            return (PointLight(position, settings.intensity, **near),)
        case "spot":
            near |= {"cutoff": settings.cutoff, "exponent": settings.exponent}
            return (SpotLight(position, -towards, settings.intensity, **near),)
    return ()


def make_camera(settings: Settings, frame: Frame) -> AbstractCamera:
    """A camera with parallel rays that looks at the origin.

    In a free frame the sliders set the origin and the unit of length in the picture, to
    align the surface with a photograph.
    """
    height, width, free = frame
    view, x, y = VIEW_HEIGHT, 0.5, 0.5
    if free:
        view = 100 / settings.radius
        x, y = settings.centre_x / 100, settings.centre_y / 100
    # For a sphere the view is fixed, so that the light stays in place.
    still = settings.surface == SPHERE
    turn, tilt = (0, 0) if still else (settings.turn, settings.tilt)
    position = AWAY * _direction(turn, tilt)
    rotation = np.asarray(look_at(position, (0, 0, 0)), float)
    shift = view * np.array([(0.5 - x) * width / height, y - 0.5, 0])
    return OrthographicCamera(
        width,
        height,
        view_height=view,
        position=position + rotation @ shift,
        rotation=rotation,
    )


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit vector from angles in degrees; 0, 0 is +z, and 90, 0 is +x."""
    a, e = np.deg2rad([azimuth, elevation])
    return np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])


def angles(vector: Any) -> tuple[float, float, float]:
    """Azimuth and elevation of a vector in degrees, and its length."""
    x, y, z = np.asarray(vector, float)
    azimuth, elevation = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    length = float(np.linalg.norm([x, y, z]))
    return float(np.rad2deg(azimuth)), float(np.rad2deg(elevation)), length


def fitted_into_view(mesh: Mesh) -> Mesh:
    """A mesh moved and scaled into the sphere of radius 1, with one material.

    It is two-sided, since files differ in the orientation of faces.

    **Raises:** `ValueError` if all vertices are at one point.
    """
    vertices = np.asarray(mesh.vertices, float)
    used = vertices[np.asarray(mesh.faces).ravel()]
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    size = np.linalg.norm(used - centre, axis=1).max()
    if size <= 0:
        raise ValueError("its vertices are all in one place")
    return Mesh(
        (vertices - centre) / size, np.asarray(mesh.faces), mesh.normals, two_sided=True
    )
