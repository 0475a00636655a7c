"""Reading scenes with the images that other renderers made of them.

`NAME.json` describes a scene, `NAME.npz` contains its mesh and image. There are two
kinds: scenes of OpenGL's fixed-function pipeline, and scenes of a ray tracer (POV-Ray).
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

import phongfit as pf
from experiments.opengl_scene import scene_from_opengl
from experiments.opengl_state import material_from_opengl
from phongfit.files.inputs import naming, read_text
from phongfit.material import stack_materials

Arrays = dict[str, np.ndarray]

# Folders of the references that come with the project, relative to the current folder.
REFERENCES = Path(__file__).parents[1] / "tests" / "data" / "references"
KEPT = tuple(Path(os.path.relpath(REFERENCES / by)) for by in ("opengl", "povray"))

OPENGL_STATE = (
    "light_model",
    "shade_model",
    "clamp_vertex_color",
    "lights",
    "background",
)
"""Entries of a scene's JSON that are entries of OpenGL's state as they stand."""


class VertexColors(NamedTuple):
    """Light at some of a mesh's vertices, before interpolation and fog.

    - `vertices`: indices of these vertices;
    - `colors`: light at each of them, where 1 is white.
    """

    vertices: Int[np.ndarray, " n"]
    colors: Float[np.ndarray, "n 3"]


class Reference(NamedTuple):
    """A scene with its material, and the image that another renderer made of it.

    - `film`: makes phongfit's image comparable with `image`;
    - `covered`: true where `image` shows the mesh;
    - `vertex_colors`: the other renderer's light at vertices; `None` for a ray tracer,
        which has none;
    - `bound`: largest difference of a pixel that counts as agreement, where 1 is white.
    """

    name: str
    scene: pf.Scene
    material: pf.Material
    film: pf.Film
    image: Float[np.ndarray, "height width 3"]
    covered: Bool[np.ndarray, "height width"]
    vertex_colors: VertexColors | None
    bound: float


def find_references(folder: Path) -> list[Path]:
    """Paths of the scenes (`NAME.json`) in a folder, sorted.

    **Raises:** `ValueError` if there are none.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise ValueError(f"{folder}: there is no NAME.json of a scene in this folder")
    return paths


def read_reference(path: Path) -> Reference:
    """Read one scene from `NAME.json` and `NAME.npz` beside it.

    **Raises:** `ValueError` that names the file and what is wrong with it.
    """
    with naming(str(path)):
        try:
            record = json.loads(read_text(path))
            with np.load(path.with_suffix(".npz")) as file:
                arrays = dict(file)
            reader: Callable[..., Reference]
            reader = _opengl if "shade_model" in record else _raytraced
            return reader(path.stem, record, arrays)
        except KeyError as error:
            raise ValueError(f"{error} is missing") from error
        except (OSError, TypeError) as error:
            raise ValueError(str(error)) from error


def _opengl(name: str, record: dict[str, Any], arrays: Arrays) -> Reference:
    """A scene of OpenGL's pipeline, from its JSON and its arrays."""
    state = {name: record[name] for name in OPENGL_STATE}
    state["fog"] = _parameters(record["fog"])
    mesh = pf.Mesh(arrays["vertices"], arrays["faces"], arrays["normals"])
    scene = scene_from_opengl(mesh, _opengl_camera(record), state)
    return Reference(
        name=name,
        scene=scene,
        material=material_from_opengl(record["material"]),
        film=pf.Film(clamp=scene.shading.clamp),
        image=arrays["image"],
        covered=arrays["depth"] < 1,
        vertex_colors=_vertex_colors(record["shade_model"], arrays),
        bound=1e-4,
    )


def _opengl_camera(record: dict[str, Any]) -> pf.geometry.AbstractCamera:
    """The camera of an OpenGL scene.

    **Raises:** `ValueError` for a projection off the axis or without square pixels,
    which phongfit's cameras do not have.
    """
    projection = record["projection"]
    pose = record["eye"], record["target"], record["up"]
    width, height = record["width"], record["height"]
    if projection["kind"] == "perspective":
        return pf.PerspectiveCamera.look_at(
            *pose, width=width, height=height, fov_y=projection["fovy_degrees"]
        )
    right, top = projection["right"], projection["top"]
    if projection["left"] != -right or projection["bottom"] != -top:
        raise ValueError("projection: expected a centred one, got one off the axis")
    if not np.isclose(right / top, width / height):
        raise ValueError("projection: expected square pixels, got others")
    return pf.OrthographicCamera.look_at(
        *pose, width=width, height=height, view_height=2 * top
    )


def _parameters(record: dict[str, Any] | None) -> dict[str, Any] | None:
    """Entries with OpenGL's names; the others are notes. `None` remains `None`."""
    if record is None:
        return None
    return {name: value for name, value in record.items() if name.startswith("GL_")}


def _vertex_colors(shade_model: str, arrays: Arrays) -> VertexColors:
    """Light at the vertices where OpenGL computes it for this shade model."""
    # With flat shading a face is lit at its last vertex.
    faces = arrays["faces"]
    lit = faces[:, 2] if shade_model == "GL_FLAT" else np.unique(faces)
    return VertexColors(lit, arrays["vertex_colors"][lit])


def _raytraced(name: str, record: dict[str, Any], arrays: Arrays) -> Reference:
    """A scene of a ray tracer (POV-Ray), from its JSON and its arrays."""
    camera, model = record["camera"], record["specular_model"]
    models = {"phong": pf.Phong(), "blinn-phong": pf.BlinnPhong()}
    if model not in models:
        raise ValueError(
            f"specular_model: expected one of {list(models)}, got {model!r}"
        )
    scene = pf.Scene(
        pf.Mesh(
            arrays["vertices"],
            arrays["faces"],
            arrays["normals"],
            arrays.get("face_material"),
        ),
        pf.PerspectiveCamera.look_at(
            camera["eye"],
            camera["target"],
            camera["up"],
            width=record["width"],
            height=record["height"],
            fov_y=camera["fovy_degrees"],
        ),
        [pf.PointLight(one["position"], one["intensity"]) for one in record["lights"]],
        record["ambient_light"],
        specular_model=models[model],
        shadows=True,
        background=record["background"],
    )
    return Reference(
        name=name,
        scene=scene,
        material=stack_materials(pf.Material(**one) for one in record["materials"]),
        film=pf.Film(bits=16),
        image=arrays["image"],
        covered=covered_pixels(arrays["image"], np.asarray(record["background"])),
        vertex_colors=None,
        bound=2 / 255,
    )


def covered_pixels(
    image: Float[np.ndarray, "height width 3"], background: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "height width"]:
    """Pixels that differ from the background by more than half a step of 16 bits."""
    return np.asarray(np.any(abs(image - background) > 0.5 / 65535, axis=-1))
