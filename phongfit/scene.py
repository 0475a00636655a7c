"""Everything but the material: what is looked at, from where, under which light."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from phongfit.checks import as_light
from phongfit.geometry.cameras import AbstractCamera, OrthographicCamera
from phongfit.geometry.surfaces import AbstractSurface, NormalMap
from phongfit.lights import AbstractLight, DirectionalLight
from phongfit.reflectance import AbstractSpecular, BlinnPhong


class Scene(eqx.Module):
    """Surface, camera and lights, and the model of the highlight."""

    surface: AbstractSurface
    camera: AbstractCamera
    lights: tuple[AbstractLight, ...]
    ambient: Float[Array, "3"]
    specular: AbstractSpecular
    background: Float[Array, "3"]

    def __init__(
        self,
        surface: AbstractSurface,
        camera: AbstractCamera | None = None,
        lights: Iterable[AbstractLight] | AbstractLight = (),
        ambient: Any = 0.0,
        *,
        specular: AbstractSpecular | None = None,
        background: Any = 0.0,
    ):
        """**Arguments:**

        - `surface`: what is looked at.
        - `camera`: from where; default an [`OrthographicCamera`][] of 256 × 256 pixels.
        - `lights`: any number, of any kinds.
        - `ambient`: the ambient light I_a, RGB or one number.
        - `specular`: model of the highlight, default [`BlinnPhong`][].
        - `background`: RGB where a pixel sees no surface.

        **Raises:** `ValueError` that names the argument.
        """
        camera = OrthographicCamera() if camera is None else camera
        lights = (lights,) if isinstance(lights, AbstractLight) else lights
        if not isinstance(lights, Iterable):
            raise ValueError(f"lights: {lights!r} came, a list of lights is wanted")
        lights = tuple(lights)
        specular = BlinnPhong() if specular is None else specular
        for name, value, kind in (
            ("surface", surface, AbstractSurface),
            ("camera", camera, AbstractCamera),
            ("specular", specular, AbstractSpecular),
            *(("lights", light, AbstractLight) for light in lights),
        ):
            if not isinstance(value, kind):
                raise ValueError(f"{name}: {value!r} came, {kind.__name__} wanted")
        if isinstance(surface, NormalMap) and surface.positions is None:
            if not all(isinstance(light, DirectionalLight) for light in lights):
                raise ValueError(
                    "lights: a normal map without positions can be lit by directional "
                    "lights only, since no other light knows its distance"
                )
        self.surface = surface
        self.camera = camera
        self.lights = lights
        self.ambient = as_light("ambient", ambient)
        self.specular = specular
        self.background = as_light("background", background)
