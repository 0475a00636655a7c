"""What may stand in our JSON files, record by record, and what is built from it.

A record checks names and kinds; values are checked by the constructor that `build`
calls, so that a rule stands in one place. To add a light, a surface or a camera, write
its record, with a `kind` of its own, add it to the union after it, and say under
`describe` in [`phongfit.files.describe`][] how it is saved.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from phongfit.environment import Fog, FogMode
from phongfit.files.arrays import read_array
from phongfit.files.formats import MAX_PIXELS
from phongfit.files.images import read_mask
from phongfit.files.inputs import inside, naming
from phongfit.files.records import (
    AbstractRecord,
    Colour,
    FileName,
    Leaf,
    Matrix,
    Vector,
)
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
    look_at,
)
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.normals import Weighting
from phongfit.geometry.shading import (
    AbstractShading,
    FlatShading,
    GouraudShading,
    PhongShading,
    Place,
)
from phongfit.geometry.surfaces import AbstractSurface, NormalMap, Sphere
from phongfit.lights import AbstractLight, DirectionalLight, PointLight, SpotLight
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular, BlinnPhong, Phong
from phongfit.rendering.film import Encoding, Film

SCENE_FORMAT = "phongfit scene"
TRUTH_FORMAT = "phongfit truth"


# Surfaces.


class SphereRecord(AbstractRecord):
    kind: Literal["sphere"]
    center: Vector = (0.0, 0.0, 0.0)
    radius: float = 1.0

    def build(self, folder: Path) -> AbstractSurface:
        del folder
        return Sphere(self.center, self.radius)


class NormalMapRecord(AbstractRecord):
    kind: Literal["normal_map"]
    normals: FileName
    mask: FileName | None = None
    positions: FileName | None = None

    def build(self, folder: Path) -> AbstractSurface:
        def read(name: str, file: str | None, reader: Any) -> Any:
            with naming(name):
                return None if file is None else reader(inside(folder, file))

        return NormalMap(
            read("normals", self.normals, lambda path: read_array(path, "normals")),
            read("mask", self.mask, read_mask),
            read("positions", self.positions, lambda p: read_array(p, "positions")),
        )


class MeshRecord(AbstractRecord):
    """Arrays in files of their own, as [`save_scene`][] writes them."""

    kind: Literal["mesh"]
    vertices: FileName
    faces: FileName
    normals: FileName | None = None
    material_index: FileName | None = None
    weighting: Weighting = "area"
    two_sided: bool = False

    def build(self, folder: Path) -> AbstractSurface:
        def read(name: str, file: str | None) -> Any:
            with naming(name):
                return None if file is None else read_array(inside(folder, file), name)

        return Mesh(
            read("vertices", self.vertices),
            read("faces", self.faces),
            read("normals", self.normals),
            read("material_index", self.material_index),
            weighting=self.weighting,
            two_sided=self.two_sided,
        )


class MeshFileRecord(AbstractRecord):
    """A mesh in a common format: see [`load_mesh`][]."""

    kind: Literal["mesh_file"]
    file: FileName
    two_sided: bool = False

    def build(self, folder: Path) -> AbstractSurface:
        # Here, since trimesh takes long to import.
        from phongfit.files.meshes import load_mesh

        with naming("file"):
            path = inside(folder, self.file)
        return load_mesh(path, two_sided=self.two_sided).mesh


SurfaceRecord = Annotated[
    SphereRecord | NormalMapRecord | MeshRecord | MeshFileRecord,
    Field(discriminator="kind"),
]


# Cameras.


Pixels = Annotated[int, Field(ge=1, le=MAX_PIXELS)]


def _rotation(
    position: Vector, target: Vector | None, up: Vector | None, rotation: Any
) -> Any:
    """Either a rotation, or the look-at that `target` and `up` ask for, or None."""
    if target is None and up is None:
        return rotation
    if rotation is not None:
        raise ValueError("rotation: came beside target or up, one of the two is wanted")
    return look_at(position, target or (0.0, 0.0, 0.0), up or (0.0, 1.0, 0.0))


def _check_pixels(width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"width: {width} × {height} pixels came, at most {MAX_PIXELS} are wanted"
        )


class OrthographicRecord(AbstractRecord):
    kind: Literal["orthographic"]
    width: Pixels
    height: Pixels
    view_height: float = 2.2
    position: Vector = (0.0, 0.0, 5.0)
    target: Vector | None = None
    up: Vector | None = None
    rotation: Matrix | None = None

    def build(self) -> AbstractCamera:
        _check_pixels(self.width, self.height)
        return OrthographicCamera(
            self.width,
            self.height,
            view_height=self.view_height,
            position=self.position,
            rotation=_rotation(self.position, self.target, self.up, self.rotation),
        )


class PerspectiveRecord(AbstractRecord):
    kind: Literal["perspective"]
    width: Pixels
    height: Pixels
    fov_y_degrees: Annotated[float, Field(gt=0, lt=180)] = 30.0
    position: Vector = (0.0, 0.0, 5.0)
    target: Vector | None = None
    up: Vector | None = None
    rotation: Matrix | None = None

    def build(self) -> AbstractCamera:
        _check_pixels(self.width, self.height)
        return PerspectiveCamera(
            self.width,
            self.height,
            fov_y=self.fov_y_degrees,
            position=self.position,
            rotation=_rotation(self.position, self.target, self.up, self.rotation),
        )


CameraRecord = Annotated[
    OrthographicRecord | PerspectiveRecord, Field(discriminator="kind")
]


# Lights.


class DirectionalRecord(AbstractRecord):
    kind: Literal["directional"]
    direction: Vector
    intensity: Colour = (1.0, 1.0, 1.0)
    specular: Colour | None = None
    ambient: Colour = (0.0, 0.0, 0.0)

    def build(self) -> AbstractLight:
        return DirectionalLight(
            self.direction,
            self.intensity,
            specular=self.specular,
            ambient=self.ambient,
        )


class PointRecord(AbstractRecord):
    kind: Literal["point"]
    position: Vector
    intensity: Colour = (1.0, 1.0, 1.0)
    attenuation: Vector = (1.0, 0.0, 0.0)
    specular: Colour | None = None
    ambient: Colour = (0.0, 0.0, 0.0)

    def build(self) -> AbstractLight:
        return PointLight(
            self.position,
            self.intensity,
            attenuation=self.attenuation,
            specular=self.specular,
            ambient=self.ambient,
        )


class SpotRecord(AbstractRecord):
    kind: Literal["spot"]
    position: Vector
    axis: Vector
    cutoff_degrees: Annotated[float, Field(gt=0, le=90)] = 45.0
    exponent: float = 0.0
    intensity: Colour = (1.0, 1.0, 1.0)
    attenuation: Vector = (1.0, 0.0, 0.0)
    specular: Colour | None = None
    ambient: Colour = (0.0, 0.0, 0.0)

    def build(self) -> AbstractLight:
        return SpotLight(
            self.position,
            self.axis,
            self.intensity,
            cutoff=self.cutoff_degrees,
            exponent=self.exponent,
            attenuation=self.attenuation,
            specular=self.specular,
            ambient=self.ambient,
        )


LightRecord = Annotated[
    DirectionalRecord | PointRecord | SpotRecord, Field(discriminator="kind")
]


# Models of the highlight.


class PhongRecord(AbstractRecord):
    kind: Literal["phong"]
    gate: bool = True

    def build(self) -> AbstractSpecular:
        return Phong(self.gate)


class BlinnPhongRecord(AbstractRecord):
    kind: Literal["blinn-phong"]
    gate: bool = True
    normalized: bool = False

    def build(self) -> AbstractSpecular:
        return BlinnPhong(self.gate, self.normalized)


SpecularRecord = Annotated[PhongRecord | BlinnPhongRecord, Field(discriminator="kind")]


# Shading methods and fog.


class FlatRecord(AbstractRecord):
    kind: Literal["flat"]
    at: Place = "centroid"
    clamp: bool = False

    def build(self) -> AbstractShading:
        return FlatShading(self.at, self.clamp)


class GouraudRecord(AbstractRecord):
    kind: Literal["gouraud"]
    clamp: bool = False

    def build(self) -> AbstractShading:
        return GouraudShading(self.clamp)


class PhongShadingRecord(AbstractRecord):
    kind: Literal["phong"]

    def build(self) -> AbstractShading:
        return PhongShading()


ShadingRecord = Annotated[
    FlatRecord | GouraudRecord | PhongShadingRecord, Field(discriminator="kind")
]


class FogRecord(AbstractRecord):
    color: Colour
    mode: FogMode = "exp"
    density: float = 1.0
    start: float = 0.0
    end: float = 1.0

    def build(self) -> Fog:
        return Fog(
            self.color,
            self.mode,
            density=self.density,
            start=self.start,
            end=self.end,
        )


# Whole files.


class ImageRecord(AbstractRecord):
    """One photograph; `lights` counts from 0 and defaults to all."""

    file: FileName
    lights: list[int] | None = None
    mask: FileName | None = None


class SceneRecord(AbstractRecord):
    """`scene.json`: a scene and, for a data set, the images that were taken of it."""

    format: Literal["phongfit scene"]
    version: Literal[1]
    surface: SurfaceRecord
    camera: CameraRecord
    lights: list[LightRecord] = []
    ambient: Colour = (0.0, 0.0, 0.0)
    background: Colour = (0.0, 0.0, 0.0)
    specular: SpecularRecord = BlinnPhongRecord(kind="blinn-phong")
    shading: ShadingRecord = PhongShadingRecord(kind="phong")
    fog: FogRecord | None = None
    shadows: bool = False
    local_viewer: bool | None = None
    encoding: Encoding | None = None
    bits: Annotated[int, Field(ge=1, le=16)] | None = None
    clamped: bool = True
    images: list[ImageRecord] = []

    def film(self) -> Film:
        """How light became the images' numbers."""
        if not self.clamped:
            return Film(clamp=False)
        return Film(encoding=self.encoding or "linear", bits=self.bits)


class MaterialRecord(AbstractRecord):
    diffuse: Leaf
    specular: Leaf
    shininess: Leaf
    ambient: Leaf
    emission: Leaf = (0.0,)

    def build(self) -> Material:
        return Material(
            *(
                leaf[0] if len(leaf) == 1 else leaf
                for leaf in (
                    self.diffuse,
                    self.specular,
                    self.shininess,
                    self.ambient,
                    self.emission,
                )
            )
        )


class TruthRecord(AbstractRecord):
    """`truth.json`: what the images of a data set were made of."""

    format: Literal["phongfit truth"]
    version: Literal[1]
    material: MaterialRecord
    noise: Annotated[float, Field(ge=0)] | None = None
    seed: int | None = None
