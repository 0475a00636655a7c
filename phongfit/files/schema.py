"""Schema of phongfit's JSON files: kinds of objects, and whole files.

To add a light, a surface, a camera, …, add a line where the others are registered.
"""

import inspect
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PlainValidator

from phongfit.edge import checked
from phongfit.files.arguments import (
    RECORDS,
    UNSAID,
    AbstractPart,
    Arguments,
    FileBeside,
    arguments_of,
    describe,
    kinds_of,
    one_of,
)
from phongfit.files.encodings import EncodingField
from phongfit.files.records import AbstractRecord, FileName, Many, Vector
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
    PinholeCamera,
    look_at,
)
from phongfit.geometry.distortion import (
    AbstractDistortion,
    BrownDistortion,
    FisheyeDistortion,
)
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.shading import (
    AbstractShading,
    FlatShading,
    GouraudShading,
    PhongShading,
)
from phongfit.geometry.surfaces import AbstractSurface, NormalMap, Sphere
from phongfit.lights import (
    AbstractLight,
    DirectionalLight,
    HarmonicLight,
    PointLight,
    SpotLight,
)
from phongfit.material import Material
from phongfit.microfacets import GGX, Ward
from phongfit.reflectance import AbstractSpecular, BlinnPhong, Phong
from phongfit.rendering.film import Film
from phongfit.scene import Scene
from phongfit.textures import AbstractTexture, Texture, VertexColours

SCENE_FORMAT = "phongfit scene"
TRUTH_FORMAT = "phongfit truth"


# Kinds.


class CameraArguments(Arguments):
    """Arguments of a camera, with `target` and `up` as alternatives to `rotation`."""

    target: Vector | None = None
    up: Vector | None = None

    def given(self) -> dict[str, Any]:
        given = Arguments.given(self)
        if self.target is None and self.up is None:
            return given
        if given["rotation"] is not None:
            raise ValueError("rotation: expected it or target and up, got both")
        target, up = self.target or (0.0, 0.0, 0.0), self.up or (0.0, 1.0, 0.0)
        return given | {"rotation": look_at(given["position"], target, up)}


class MeshFile(AbstractPart):
    """A mesh in a common format: see [`load_mesh`][]."""

    makes: ClassVar[type] = AbstractSurface

    kind: Literal["mesh_file"] = "mesh_file"
    file: FileBeside
    two_sided: bool = False

    def build(self) -> AbstractSurface:
        # Imported here, since SciPy takes long to import.
        from phongfit.files.meshes import load_mesh

        return load_mesh(self.file, two_sided=self.two_sided).mesh


# Names of kinds are unique within each family.
FAMILIES = (
    AbstractSurface,
    AbstractCamera,
    AbstractLight,
    AbstractSpecular,
    AbstractShading,
    AbstractDistortion,
    AbstractTexture,
)


@checked
def register(made: type, kind: str, /, **keys: str) -> None:
    """Register a class for scene files, for [`load_scene`][] and [`save_scene`][].

    ```python
    phongfit.register(Candle, "candle")
    ```

    Fields and defaults are those of its constructor, shapes those of its annotations:
    `Float[Array, ""]` is a number, `"3"` three, `"rgb=3"` a colour (three, or one for
    all), `"3 3"` three rows, `"9 3"` nine colours. An array of another shape goes into
    a file beside the scene's. The class must keep each argument in a field of the same
    name, as a value that its constructor accepts.

    **Arguments:**

    - `made`: a light, surface, camera, distortion, texture, specular model or shading
        method. It may be registered again, as happens in a notebook.
    - `kind`: its name in files.
    - `keys`: keys of arguments in files, where they differ from the arguments' names.

    **Raises:** `ValueError` for a kind that is taken, and for a class that files
    cannot hold.
    """
    families = [base for base in FAMILIES if base in getattr(made, "__mro__", ())]
    if not families or inspect.isabstract(made):
        wanted = ", ".join(base.__name__ for base in FAMILIES)
        raise ValueError(f"made: expected a final class of {wanted}, got {made!r}")
    for name, record in kinds_of(families[0]).items():
        same = _full_name(record.makes) == _full_name(made)
        if name == kind and not same:
            raise ValueError(f"kind: {kind!r} is taken by {record.makes.__name__}")
        if name != kind and same:
            raise ValueError(f"kind: {made.__name__} is registered as {name!r}")
    turned = (
        issubclass(made, AbstractCamera)
        and "rotation" in inspect.signature(made).parameters
    )
    base = CameraArguments if turned else Arguments
    arguments_of(made, keys, kind=kind)(base)


def _full_name(made: type) -> tuple[str, str]:
    return made.__module__, made.__qualname__


RECORDS[AbstractSurface] = MeshFile
# Default for older scene files, written before textures had a kind.
UNSAID[AbstractTexture] = "image"
register(Texture, "image")
register(VertexColours, "vertices")
register(Sphere, "sphere")
register(NormalMap, "normal_map")
register(Mesh, "mesh")
register(OrthographicCamera, "orthographic")
register(PerspectiveCamera, "perspective", fov_y="fov_y_degrees")
register(PinholeCamera, "pinhole")
register(BrownDistortion, "brown")
register(FisheyeDistortion, "fisheye")
register(DirectionalLight, "directional")
register(PointLight, "point")
register(SpotLight, "spot", cutoff="cutoff_degrees")
register(HarmonicLight, "harmonic")
register(Phong, "phong")
register(BlinnPhong, "blinn-phong")
register(GGX, "ggx")
register(Ward, "ward")
register(FlatShading, "flat")
register(GouraudShading, "gouraud")
register(PhongShading, "phong")


# Whole files.

CameraRecord = Annotated[AbstractPart, PlainValidator(one_of(AbstractCamera))]
SpecularRecord = Annotated[AbstractPart, PlainValidator(one_of(AbstractSpecular))]


class ImageRecord(AbstractRecord):
    """One photograph; `lights` counts from 0 and defaults to all, `camera` defaults to
    the scene's."""

    file: FileName
    lights: Many[int] | None = None
    mask: FileName | None = None
    camera: CameraRecord | None = None


@arguments_of(Scene, {"specular_model": "specular"})
class SceneRecord(Arguments):
    """`scene.json`: a scene and, for a data set, its images."""

    format: Literal["phongfit scene"]
    version: Literal[1]
    encoding: EncodingField | None = None
    bits: Annotated[int, Field(ge=1, le=16)] | None = None
    clamped: bool = True
    white: Annotated[int, Field(ge=1, le=65535)] | None = None
    images: Many[ImageRecord] = []

    def film(self) -> Film:
        """Clamp, encoding and rounding of the images."""
        if not self.clamped:
            return Film(clamp=False)
        return Film(encoding=self.encoding or "linear", bits=self.bits)


# Reflectances are required in files, since a missing one is most likely a mistake.
@arguments_of(Material, required=("diffuse", "specular", "shininess", "ambient"))
class MaterialRecord(Arguments):
    """A material: each parameter is one number for all channels, or RGB."""

    def given(self) -> dict[str, Any]:
        leaves = Arguments.given(self)
        return {
            name: leaf[0] if isinstance(leaf, tuple) and len(leaf) == 1 else leaf
            for name, leaf in leaves.items()
        }


def describe_material(material: Material) -> dict[str, Any]:
    """The content of a material's record: each parameter one number, or RGB.

    **Raises:** `ValueError` for a parameter of another shape.
    """
    described = describe(material)
    for name in described:
        shape = getattr(material, name).shape
        if shape not in ((), (3,)):
            raise ValueError(f"{name}: expected shape () or (3,), got {shape}")
    return described


class TruthRecord(AbstractRecord):
    """`truth.json`: the true material and the noise of a data set's images."""

    format: Literal["phongfit truth"]
    version: Literal[1]
    material: MaterialRecord
    noise: Annotated[float, Field(ge=0)] | None = None
    seed: int | None = None
