"""Scenes: surface, camera and lights; everything but the material."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx

from phongfit.checks import as_light
from phongfit.edge import checked
from phongfit.environment import Fog
from phongfit.geometry.cameras import AbstractCamera, OrthographicCamera
from phongfit.geometry.shading import AbstractShading, PhongShading
from phongfit.geometry.surfaces import AbstractSurface, GBuffer, NormalMap
from phongfit.geometry.tracing import trace
from phongfit.lights import AbstractLight, DirectionalLight, HarmonicLight
from phongfit.reflectance import AbstractSpecular, BlinnPhong
from phongfit.vectors import Rgb


class Scene(eqx.Module):
    """All that an image depends on except the material: surface, camera, lights, …"""

    surface: AbstractSurface
    camera: AbstractCamera
    lights: tuple[AbstractLight, ...]
    ambient: Rgb
    background: Rgb
    specular_model: AbstractSpecular
    shading: AbstractShading
    shadows: bool = eqx.field(static=True)
    fog: Fog | None
    local_viewer: bool | None = eqx.field(static=True)

    @checked
    def __init__(
        self,
        surface: AbstractSurface,
        camera: AbstractCamera | None = None,
        lights: Iterable[AbstractLight] | AbstractLight = (),
        ambient: Any = 0.0,
        *,
        specular_model: AbstractSpecular | None = None,
        shading: AbstractShading | None = None,
        fog: Fog | None = None,
        shadows: bool = False,
        background: Any = 0.0,
        local_viewer: bool | None = None,
    ):
        """**Arguments:**

        - `surface`: the object in the image.
        - `camera`: default an [`OrthographicCamera`][] of 256 × 256 pixels.
        - `lights`: one, or any number of any kinds.
        - `ambient`: the ambient light I_a ≥ 0, RGB or one number.
        - `specular_model`: formula of the highlight, default [`BlinnPhong`][].
        - `shading`: where light is computed, default [`PhongShading`][]: per pixel.
        - `fog`: default none.
        - `shadows`: whether the surface casts hard shadows on itself.
        - `background`: RGB where a pixel sees no surface; there is no fog there.
        - `local_viewer`: position of the viewer for highlights. By default it is the
            camera's: the pinhole, or infinitely far away for parallel rays. `True` and
            `False` are OpenGL's GL_LIGHT_MODEL_LOCAL_VIEWER: at the camera's position,
            also for parallel rays; infinitely far along the camera's axis, also for a
            pinhole.

        **Raises:** `ValueError` that names the argument, also if the surface cannot
        have these lights, fog, shadows or shading method.
        """
        camera = OrthographicCamera() if camera is None else camera
        lights = (lights,) if isinstance(lights, AbstractLight) else lights
        lights = tuple(lights)
        specular_model = BlinnPhong() if specular_model is None else specular_model
        shading = PhongShading() if shading is None else shading
        if isinstance(surface, NormalMap) and surface.positions is None:
            distant = DirectionalLight | HarmonicLight
            if not all(isinstance(light, distant) for light in lights):
                raise ValueError(
                    "lights: a normal map without positions can be lit by directional "
                    "and harmonic lights only, since others depend on the distance"
                )
            if fog is not None or shadows:
                raise ValueError(
                    f"{'fog' if fog is not None else 'shadows'}: a normal map without "
                    "positions has neither depths nor cast shadows"
                )
        shading.check(surface)
        self.surface = surface
        self.camera = camera
        self.lights = lights
        self.ambient = as_light("ambient", ambient)
        self.specular_model = specular_model
        self.shading = shading
        self.fog = fog
        self.background = as_light("background", background)
        self.shadows = bool(shadows)
        self.local_viewer = local_viewer

    def trace(self) -> GBuffer:
        """The surface point that each pixel sees, and the shadows: see [`trace`][]."""
        return trace(
            self.surface,
            self.camera,
            self.lights,
            shadows=self.shadows,
            shading=self.shading,
        )

    def _repr_html_(self) -> str:
        from phongfit.report.notebook import of_scene

        return of_scene(self)
