"""Answers to the page's requests: pictures, targets and fits."""

import dataclasses
import functools
import itertools
import time
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.capture_data import DIRECTION
from phongfit.files.dataset import Photographs
from phongfit.files.formats import data_uri
from phongfit.fitting.fit import fit
from phongfit.fitting.problem.specification import DEFAULT_UNKNOWNS
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.shapes import Ball
from phongfit.geometry.surfaces import AbstractSurface, GBuffer, Sphere
from phongfit.lab.cache import Cache
from phongfit.lab.given import settings_of
from phongfit.lab.pictures import brightening, outline_path, png, residual_png
from phongfit.lab.responses import differences, fit_response
from phongfit.lab.scene import Frame, make_lights, make_material, make_scene
from phongfit.lab.settings import (
    SPHERE,
    ChosenRequest,
    FitOptions,
    FitRequest,
    PictureRequest,
    Settings,
    TargetRequest,
)
from phongfit.lab.uploads import (
    read_mesh,
    read_photograph,
    read_photograph_mask,
    shrunk,
)
from phongfit.rendering.film import Encoding, Film, as_encoding
from phongfit.rendering.render import block_means, render

# Shown pixels are averages of FINER × FINER rendered ones; targets and fits have one.
FINER = 2
# Default smallest n·v for photographs: pixels at the rim average over many normals.
RIM = 0.15
# Settings that determine the geometry.
GEOMETRY = ("surface", "shading", "turn", "tilt", "centre_x", "centre_y", "radius")
# The sphere as triangles, for the shading methods that need them.
COLUMNS, ROWS = 48, 24


@dataclasses.dataclass(frozen=True)
class Target:
    """An image to be fitted, in linear light.

    `shrunk`: factor by which a photograph was shrunk. `brighten`: factor for the
    display of the photograph and of pictures beside it. `encoding`: of the photograph's
    file, `None` if that does not clamp light. `truth`: settings of a synthetic target.
    """

    image: Float[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]
    truth: Settings | None = None
    shrunk: int = 1
    brighten: float = 1.0
    encoding: Encoding | None = None

    @property
    def film(self) -> Film | None:
        """The film of a shrunk photograph, whose averaged numbers do not reveal it."""
        if self.encoding is None or self.shrunk == 1:
            return None
        return Film(encoding=self.encoding)

    @property
    def frame(self) -> Frame:
        """Frame of pictures that are shown beside the target."""
        height, width, _ = self.image.shape
        return Frame(height, width, free=self.truth is None)


class Session:
    """Answers requests of the page, from any thread.

    Geometry is computed once and cached; a change of material or light costs one
    evaluation of a compiled program.
    """

    def __init__(self, resolution: int = 256, given: Photographs | None = None):
        """**Arguments:**

        - `resolution`: width and height of pictures, pixels.
        - `given`: photographs of a ball, for the page's menu.
        """
        self.given = given
        self.frame = Frame(resolution, resolution)
        self._meshes: Cache[Mesh] = Cache("mesh")
        self._targets: Cache[Target] = Cache("target")
        self._geometry = functools.lru_cache(maxsize=8)(self._trace)

    def picture(self, request: PictureRequest) -> bytes:
        """A PNG file of the settings, in the frame of the target if there is one.

        **Raises:** `ValueError` if the mesh or the target is no longer in the cache.
        """
        if request.target is None:
            return png(self._smooth(request.settings, self.frame))
        target = self._targets.get(request.target)
        return png(self._smooth(request.settings, target.frame, target.brighten))

    def outline(self, request: PictureRequest) -> dict[str, str]:
        """The outline of the surface in the target's frame: see [`outline_path`][].

        **Raises:** as [`picture`][phongfit.lab.session.Session.picture] does.
        """
        if request.target is None:
            raise ValueError("target: expected one over which it is drawn, got none")
        frame = self._targets.get(request.target).frame
        _, gbuffer = self._geometry(_geometry_of(request.settings), frame)
        return {"path": outline_path(np.asarray(gbuffer.mask))}

    def add_mesh(self, name: str, content: bytes) -> dict[str, Any]:
        """Add a mesh from a file as a surface: see [`read_mesh`][]."""
        mesh = read_mesh(name, content)
        return {"surface": self._meshes.put(mesh), "faces": len(mesh.faces)}

    def add_photograph(
        self, name: str, content: bytes, encoding: Encoding
    ) -> dict[str, Any]:
        """Add a photograph from a file as a target: see [`read_photograph`][]."""
        encoding = as_encoding(encoding)
        image, shrunk, clamps = read_photograph(name, content, encoding)
        mask = np.ones(image.shape[:2], bool)
        of_file = encoding if clamps else None
        target = Target(image, mask, None, shrunk, brightening(image), of_file)
        return self._keep(target)

    def choose(self, request: ChosenRequest) -> dict[str, Any]:
        """Make one of the given photographs the target, with settings for its scene.

        **Returns:** the target with `settings` of the sliders; `options` of a fit, with
        the light's direction unknown unless it was given; and `notes`, sentences on
        assumptions.

        **Raises:** `ValueError` for an invalid number, or if the file is missing.
        """
        given = self.given
        count = 0 if given is None else len(given.names)
        if given is None or request.number >= count:
            raise ValueError(f"number: expected one below {count}")
        photograph = given.read(request.number)
        image, times = shrunk(photograph.image)
        known = np.atleast_3d(photograph.mask).astype(float).min(axis=-1, keepdims=True)
        mask = shrunk(known)[0][..., 0] >= 1
        encoding = given.film.encoding if given.film.clamp else None
        target = Target(image, mask, None, times, brightening(image), encoding)
        settings = settings_of(given.scenes[request.number])
        return self._keep(target) | {
            "settings": settings,
            "options": {"light_too": DIRECTION in given.unknown, "rim": RIM},
            "notes": list(given.notes),
        }

    def add_mask(self, target: str, name: str, content: bytes) -> dict[str, Any]:
        """Add a mask of the surface to a photograph.

        **Returns:** the target with its mask, and a circle fitted to the mask's extent,
        in the units of the settings.

        **Raises:** `ValueError` if the file cannot be read or is of another size.
        """
        held = self._targets.get(target)
        height, width, _ = held.image.shape
        mask = read_photograph_mask(name, content, held.shrunk, (height, width))
        if not mask.any():
            raise ValueError(f"{name}: it leaves no pixel")
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        circle = {
            "centre_x": 50 * (left + right) / width,
            "centre_y": 50 * (top + bottom) / height,
            "radius": 25 * (bottom - top + right - left) / height,
        }
        masked = dataclasses.replace(
            held, mask=mask, brighten=brightening(held.image[mask])
        )
        return self._keep(masked) | circle

    def make_target(self, request: TargetRequest) -> dict[str, Any]:
        """Make a target from the settings, with added noise, clamped to [0, 1]."""
        light = self._render(request.settings, self.frame, Film(clamp=False))
        noise = np.random.default_rng(request.seed).normal(0, 1, light.shape)
        image = np.clip(light + request.noise * noise, 0, 1).astype(light.dtype)
        mask = np.ones(image.shape[:2], bool)
        return self._keep(Target(image, mask, request.settings))

    def fit(self, request: FitRequest) -> dict[str, Any]:
        """Fit the material to the target, under the settings' light and model.

        **Raises:** `ValueError` that names the missing mesh, target or light.
        """
        settings, options = request.settings, request.options
        target = self._targets.get(request.target)
        surface, gbuffer = self._geometry(_geometry_of(settings), target.frame)
        unknowns = (*DEFAULT_UNKNOWNS, *_unknown_of_light(settings, options))
        used = target.mask & _faces_viewer(gbuffer, options.rim)
        start = time.perf_counter()
        found = fit(
            make_scene(settings, surface, target.frame),
            target.image,
            unknowns=unknowns,
            mask=used,
            film=target.film,
            loss=options.loss,
        )
        seconds = time.perf_counter() - start
        residual, scale = residual_png(np.asarray(found.residuals), used)
        truth = target.truth
        return fit_response(found, truth) | {
            "seconds": seconds,
            "differs": [] if truth is None else differences(settings, truth),
            "fitted": data_uri(png(found.fitted, target.brighten)),
            "residual": data_uri(residual),
            "scale": scale,
        }

    def warm_up(self) -> None:
        """Compile programs for the first requests, the likeliest first."""
        kinds = ("directional", "point", "spot", "none")
        for light in kinds:
            self.picture(
                PictureRequest(settings=Settings.model_validate({"light": light}))
            )
        made = self.make_target(TargetRequest(settings=Settings()))
        self.fit(FitRequest(settings=Settings(), target=made["target"]))
        models = "blinn-phong", "phong"
        for shading in ("phong", "gouraud", "flat"):
            for model, light in itertools.product(models, kinds):
                look = {"light": light, "specular_model": model, "shading": shading}
                settings = Settings.model_validate(look)
                self.picture(PictureRequest(settings=settings))

    def _keep(self, target: Target) -> dict[str, Any]:
        height, width, _ = target.image.shape
        return {
            "target": self._targets.put(target),
            "picture": data_uri(png(target.image, target.brighten)),
            "height": height,
            "width": width,
            "shrunk": target.shrunk,
            "brighten": target.brighten,
            "photograph": target.truth is None,
        }

    def _render(
        self, settings: Settings, frame: Frame, film: Film | None = None
    ) -> np.ndarray:
        surface, gbuffer = self._geometry(_geometry_of(settings), frame)
        scene = make_scene(settings, surface, frame)
        material = make_material(settings)
        return np.asarray(render(scene, material, film=film, gbuffer=gbuffer))

    def _smooth(
        self, settings: Settings, frame: Frame, brighten: float = 1.0
    ) -> np.ndarray:
        """A picture with smooth outlines: the mean over finer pixels."""
        height, width, _ = frame
        fine = frame._replace(height=FINER * height, width=FINER * width)
        light = self._render(settings, fine, Film(clamp=False))
        # Clamp before averaging: otherwise bright outlines would be jagged.
        light = np.minimum(brighten * light, 1)
        return block_means(light, FINER)

    def _trace(
        self, geometry: tuple[Any, ...], frame: Frame
    ) -> tuple[AbstractSurface, GBuffer]:
        settings = Settings(**dict(zip(GEOMETRY, geometry, strict=True)))
        surface = self._surface(settings)
        gbuffer = make_scene(settings, surface, frame).trace()
        return surface, jax.block_until_ready(gbuffer)

    def _surface(self, settings: Settings) -> AbstractSurface:
        if settings.surface != SPHERE:
            return self._meshes.get(settings.surface)
        return Sphere() if settings.shading == "phong" else Ball().mesh(COLUMNS, ROWS)


def _geometry_of(settings: Settings) -> tuple[Any, ...]:
    """Values of the settings that determine the geometry, as ordered in `GEOMETRY`."""
    return tuple(getattr(settings, name) for name in GEOMETRY)


def _faces_viewer(gbuffer: GBuffer, rim: float) -> Bool[np.ndarray, "height width"]:
    """Pixels where the cosine between normal and view is at least `rim`."""
    normal, view = np.asarray(gbuffer.normal), np.asarray(gbuffer.to_viewer)
    return np.asarray(gbuffer.mask) & (np.sum(normal * view, axis=-1) >= rim)


def _unknown_of_light(settings: Settings, options: FitOptions) -> tuple[str, ...]:
    if not options.light_too:
        return ()
    if not make_lights(settings):
        raise ValueError(
            "light: there is no light whose direction or position could be unknown"
        )
    path = "direction" if settings.light == "directional" else "position"
    return (f"scene.lights[0].{path}",)
