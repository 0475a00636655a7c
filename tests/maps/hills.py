"""Hills on a plane, mapped: every number of it is known, and nobody fitted it."""

from pathlib import Path

import numpy as np

import phongfit as pf
from phongfit.files.fits import DataRecord, DataSettings
from phongfit.maps.folder import MapOptions, save_folder
from phongfit.maps.result import MAP_PARAMETERS, Maps, ParameterMaps

SIZE = (32, 40)
CAMERA = pf.OrthographicCamera(40, 32, view_height=3.2, position=(0, 0, 5))
LIGHTS = (
    pf.DirectionalLight((1, 0.2, 0.8), (0.9, 0.8, 0.7)),
    pf.PointLight((-1.5, 1, 2), 2.0, attenuation=(0, 0, 0.2)),
)


def bumps() -> np.ndarray:
    """Three hills on a plane, world units."""
    y, x = np.mgrid[:32, :40]
    hills = ((10, 10, 0.5), (20, 26, 0.8), (8, 30, 0.4))
    each = [h * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 18) for cy, cx, h in hills]
    return np.sum(each, axis=0)


def made(camera: pf.geometry.AbstractCamera = CAMERA) -> Maps:
    """Maps of the hills whose every number is known, fitted by nobody."""
    height = bumps()
    down, right = np.gradient(height, 0.1)
    normals = np.stack([-right, down, np.ones(SIZE)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    rng = np.random.default_rng(0)
    grey = np.ones((*SIZE, 3))
    return Maps(
        ambient=0.1 * grey,
        diffuse=rng.uniform(0.3, 0.6, (*SIZE, 3)),
        specular=0.3 * grey,
        shininess=np.full((*SIZE, 1), 30.0),
        stderr=ParameterMaps(0 * grey, 0 * grey, 0 * grey, np.zeros((*SIZE, 1))),
        noise=np.full(SIZE, 0.01),
        samples=np.full(SIZE, 90),
        flags=np.zeros(SIZE, int),
        unknowns=MAP_PARAMETERS,
        noise_given=None,
        normals=normals,
        normals_stderr=np.full(SIZE, 0.5),
        depth=np.full(SIZE, np.nan),
        camera=camera,
        specular_model=pf.BlinnPhong(),
        ambient_light=(0.2, 0.2, 0.2),
    )


def write_hills(folder: Path, camera: pf.geometry.AbstractCamera = CAMERA) -> None:
    """A folder as `phongfit maps` makes it, of sRGB photographs."""
    maps = made(camera)
    assert maps.specular_model is not None
    save_folder(
        folder,
        maps,
        data=DataRecord(name="hills", reading=DataSettings(), inputs={}),
        settings=MapOptions(),
        model=maps.specular_model,
        encoding="srgb",
    )
