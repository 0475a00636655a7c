"""Texels fitted by Mitsuba 3: its renderer and its Adam, with Blinn-Phong added.

Mitsuba has no Blinn-Phong model; a BSDF in Python with phongfit's formulas makes its
pictures agree with phongfit's. As in Mitsuba's examples of inverse rendering, the
gradients of all photographs are added up, then Adam takes a step.

Mitsuba needs a shared library of LLVM: `pip install mitsuba`, `apt install libllvm19`.
LLVM 14 to 16 crash the process in Mitsuba 3.9's first program.
"""

import dataclasses
import importlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

import phongfit as pf

# Adam's learning rate.
RATE = 0.03
# Start of Adam: reflectances in mid-range, f = 8.
START_REFLECTANCE, START_EXPONENT = 0.5, 8.0
# Steps between two comparisons with the truth.
STEPS_PER_CHECK = 10
VARIANT, LIBRARY = "llvm_ad_rgb", "DRJIT_LIBLLVM_PATH"
PROBE = f"""
import mitsuba as mi
mi.set_variant("{VARIANT}")
mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
"""


def mitsuba_works() -> bool:
    """Whether Mitsuba renders here, tried in another process since it may crash.

    If the variable `LIBRARY` of the environment is not set, it becomes the newest LLVM.
    """
    if LIBRARY not in os.environ and (newest := _newest_llvm()) is not None:
        os.environ[LIBRARY] = newest
    tried = subprocess.run([sys.executable, "-c", PROBE], capture_output=True)
    return tried.returncode == 0


def _newest_llvm() -> str | None:
    """Path of the newest LLVM library known to the linker; `None` if there is none."""
    try:
        known = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True)
    except OSError:
        return None
    # Pairs of path and version.
    libraries = re.findall(r"=> (\S*/libLLVM\D*(\d+)\S*)", known.stdout)
    newest = max(libraries, key=lambda library: int(library[1]), default=None)
    return None if newest is None else newest[0]


@dataclasses.dataclass(frozen=True)
class Descent:
    """Result of a fit by Adam.

    - `seconds`: CPU time of the steps alone.
    - `steps`: number of steps taken.
    - `texels`: the fitted texture.
    - `shared`: fitted ρ_s and f of each material.
    """

    seconds: float
    steps: int
    texels: Float[np.ndarray, "rows columns 3"]
    shared: Float[np.ndarray, "materials 2"]


class Mitsuba:
    """Mitsuba's scenes of a mesh under several cameras and lamps.

    **Arguments:**

    - `scenes`: of one mesh with uv, each with a camera in perspective and one distant
        lamp.
    - `rows`: texels along each side of the texture.
    """

    def __init__(self, scenes: Sequence[pf.Scene], rows: int):
        self.mi: Any = importlib.import_module("mitsuba")
        self.dr: Any = importlib.import_module("drjit")
        self.mi.set_variant(VARIANT)
        self.mi.register_bsdf("blinn", _blinn(self.mi, self.dr))
        mesh = scenes[0].surface
        assert isinstance(mesh, pf.Mesh)
        uniform = np.full((rows, rows, 3), START_REFLECTANCE, np.float32)
        texture = self.mi.load_dict(
            {
                "type": "bitmap",
                "bitmap": self.mi.Bitmap(uniform),
                "raw": True,
                "filter_type": "bilinear",
                "wrap_mode": "repeat",
            }
        )
        parts = [self._part(mesh, which, texture) for which in range(mesh.materials)]
        self.scenes = [self._scene(one, parts) for one in scenes]
        self.cameras = [self._camera(one.camera) for one in scenes]
        self.parameters = self.mi.traverse(self.scenes[0])
        keys = [key for key in self.parameters.keys() if ".bsdf." in key]
        (self.texels,) = (key for key in keys if key.endswith("diffuse.data"))
        self.shared = {
            name: [key for key in keys if key.endswith(name)]
            for name in ("specular", "log_shininess")
        }

    def _part(self, mesh: pf.Mesh, which: int, texture: Any) -> Any:
        """Mitsuba's mesh of the faces of one material, without shared vertices."""
        assert mesh.uv is not None
        of_material = np.asarray(mesh.material_index) == which
        corners = np.asarray(mesh.faces)[of_material].ravel()
        properties = self.mi.Properties()
        properties["bsdf"] = self.mi.load_dict(
            {
                "type": "blinn",
                "diffuse": texture,
                "specular": START_REFLECTANCE,
                "shininess": START_EXPONENT,
            }
        )
        count = int(of_material.sum())
        mesh_part = self.mi.Mesh(
            f"part{which}", 3 * count, count, properties, True, True
        )
        arrays = self.mi.traverse(mesh_part)
        arrays["vertex_positions"] = _flat(np.asarray(mesh.vertices)[corners])
        arrays["vertex_normals"] = _flat(np.asarray(mesh.normals)[corners])
        arrays["vertex_texcoords"] = _flat(np.asarray(mesh.uv)[of_material])
        arrays["faces"] = np.arange(3 * count, dtype=np.uint32)
        arrays.update()
        return mesh_part

    def _scene(self, scene: pf.Scene, parts: list[Any]) -> Any:
        """Mitsuba's scene of mesh parts under the lamp of `scene`, without a camera."""
        (lamp,) = scene.lights
        assert isinstance(lamp, pf.DirectionalLight)
        away = (-np.asarray(lamp.direction, float)).tolist()
        strength = np.broadcast_to(np.asarray(lamp.intensity, float), 3).tolist()
        light = {"type": "rgb", "value": strength}
        return self.mi.load_dict(
            {
                "type": "scene",
                "integrator": {
                    "type": "direct",
                    "emitter_samples": 1,
                    "bsdf_samples": 0,
                },
                "lamp": {"type": "directional", "direction": away, "irradiance": light},
                **{f"part{k}": part for k, part in enumerate(parts)},
            }
        )

    def _camera(self, camera: Any) -> Any:
        """A camera that looks through the middle of each pixel once."""
        pose = pf.geometry.camera_to_world(camera, "mitsuba")
        return self.mi.load_dict(
            {
                "type": "perspective",
                "fov": float(camera.fov_y),
                "fov_axis": "y",
                "to_world": self.mi.ScalarTransform4f(pose.tolist()),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
                "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
            }
        )

    def picture(
        self, which: int, texels: np.ndarray, shared: np.ndarray
    ) -> Float[np.ndarray, "height width 3"]:
        """Render scene number `which`, in linear light.

        **Arguments:** `texels`: (rows, columns, 3); `shared`: ρ_s and f of each
        material, (materials, 2).
        """
        unknowns = self._start_unknowns()
        unknowns["texels"] = self.mi.TensorXf(texels.astype(np.float32))
        for name, values in zip(
            self.shared, (shared[:, 0], np.log(shared[:, 1])), strict=True
        ):
            for k, value in enumerate(values):
                unknowns[f"{name}{k}"] = self.mi.Float(float(value))
        self._show(unknowns)
        return np.array(self._render(which))

    def _render(self, which: int) -> Any:
        """Image of scene number `which`, differentiable in the current parameters."""
        scene, camera = self.scenes[which], self.cameras[which]
        return self.mi.render(scene, params=self.parameters, sensor=camera, spp=1)

    def _start_unknowns(self) -> Any:
        """A new Adam optimiser, which holds the unknowns at their starting values.

        They are `"texels"`, and for the material number k `"specular0"`, … (ρ_s) and
        `"log_shininess0"`, … (log f).
        """
        shape = self.dr.shape(self.parameters[self.texels])
        unknowns = self.mi.ad.Adam(lr=RATE)
        start = np.full(shape, START_REFLECTANCE, np.float32)
        unknowns["texels"] = self.mi.TensorXf(start)
        starts = START_REFLECTANCE, np.log(START_EXPONENT)
        for name, value in zip(self.shared, starts, strict=True):
            for k in range(len(self.shared[name])):
                unknowns[f"{name}{k}"] = self.mi.Float(float(value))
        return unknowns

    def _show(self, unknowns: Any) -> None:
        """Set the scenes' parameters to the current values of the unknowns."""
        self.parameters[self.texels] = unknowns["texels"]
        for name, keys in self.shared.items():
            for k, key in enumerate(keys):
                self.parameters[key] = unknowns[f"{name}{k}"]
        self.parameters.update()

    def descend(
        self,
        images: Sequence[np.ndarray],
        near_enough: Callable[[np.ndarray], bool],
        max_steps: int,
    ) -> Descent:
        """Minimise the mean square residual by Adam until the texels are near enough.

        **Arguments:**

        - `images`: photographs of all scenes, in linear light clamped at 1.
        - `near_enough`: whether texels (rows, columns, 3) need no more steps; called
            every tenth step, and its time does not count.
        - `max_steps`: steps after which Adam ends in any case.
        """
        dr, targets = self.dr, [self.mi.TensorXf(one) for one in images]
        unknowns, seconds, steps = self._start_unknowns(), 0.0, 0
        while steps < max_steps:
            begin = time.process_time()
            for which, target in enumerate(targets):
                # Rendered again for each target, since backward() frees the graph.
                self._show(unknowns)
                shown = dr.minimum(self._render(which), 1)
                dr.backward(dr.mean(dr.square(shown - target), axis=None))
            unknowns.step()
            unknowns["texels"] = dr.clip(unknowns["texels"], 0, 1)
            for k in range(len(self.shared["specular"])):
                unknowns[f"specular{k}"] = dr.clip(unknowns[f"specular{k}"], 0, 1)
            dr.eval(unknowns["texels"])
            dr.sync_thread()
            seconds += time.process_time() - begin
            steps += 1
            if steps % STEPS_PER_CHECK == 0 and near_enough(
                np.array(unknowns["texels"])
            ):
                break
        specular, log_shininess = (
            [float(unknowns[f"{name}{k}"][0]) for k in range(len(keys))]
            for name, keys in self.shared.items()
        )
        shared = np.stack([specular, np.exp(log_shininess)], axis=-1)
        return Descent(seconds, steps, np.array(unknowns["texels"]), shared)


def _flat(values: np.ndarray) -> np.ndarray:
    """Values as a one-dimensional array of float32, as Mitsuba's meshes want them."""
    return np.ascontiguousarray(values, np.float32).ravel()


def _blinn(mi: Any, dr: Any) -> Callable[[Any], Any]:
    """A BSDF class for Mitsuba with the formulas of [`BlinnPhong`][], not normalised.

    The parameters are a diffuse texture, ρ_s and log f. Vectors are in Mitsuba's local
    frame, whose z is the normal.
    """

    class Blinn(mi.BSDF):
        """Reflection under distant lamps alone: directions are never sampled."""

        def __init__(self, properties: Any):
            mi.BSDF.__init__(self, properties)
            self.diffuse = properties["diffuse"]
            self.specular = mi.Float(properties["specular"])
            self.log_shininess = mi.Float(np.log(properties["shininess"]))
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flags], flags

        def traverse(self, callback: Any) -> None:
            """Register the differentiable parameters with Mitsuba's traversal."""
            for name in ("diffuse", "specular", "log_shininess"):
                value = getattr(self, name)
                callback.put(name, value, mi.ParamFlags.Differentiable)

        def sample(self, context: Any, point: Any, *rest: Any) -> Any:
            """Zeros: required by Mitsuba, but the integrator takes no such samples."""
            del context, point, rest
            return dr.zeros(mi.BSDFSample3f), mi.Spectrum(0)

        def eval(self, context: Any, point: Any, to_light: Any, active: Any) -> Any:
            """Light towards the viewer (`point.wi`), with the factor n · l included."""
            del context
            cosine = dr.maximum(dr.normalize(point.wi + to_light).z, 1e-6)
            lobe = dr.exp(dr.exp(self.log_shininess) * dr.log(cosine))
            matte = self.diffuse.eval(point, active) * to_light.z
            lit = (to_light.z > 0) & active
            return dr.select(lit, matte + self.specular * lobe, 0)

        def pdf(self, context: Any, point: Any, to_light: Any, active: Any) -> Any:
            """0, the probability density of a direction, since none is sampled."""
            del context, point, to_light, active
            return mi.Float(0)

        def eval_pdf(self, context: Any, point: Any, to_light: Any, active: Any) -> Any:
            """The results of `eval` and of `pdf`."""
            light = self.eval(context, point, to_light, active)
            return light, mi.Float(0)

    return Blinn
