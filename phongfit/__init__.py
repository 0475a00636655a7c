"""Fit the Phong illumination model to images, with honest error bars."""

import importlib
from typing import TYPE_CHECKING, Any

from phongfit.environment import Fog as Fog
from phongfit.fitting.fit import fit as fit
from phongfit.fitting.implicit import refit as refit
from phongfit.fitting.losses import (
    AbstractLoss as AbstractLoss,
    Cauchy as Cauchy,
    Huber as Huber,
    Linear as Linear,
    SoftL1 as SoftL1,
    Tukey as Tukey,
)
from phongfit.fitting.predict import (
    Prediction as Prediction,
    predict_errors as predict_errors,
)
from phongfit.fitting.profile import Profile as Profile, ProfilePair as ProfilePair
from phongfit.fitting.result import Estimate as Estimate, Fit as Fit
from phongfit.fitting.solver import (
    BoundedLevenbergMarquardt as BoundedLevenbergMarquardt,
)
from phongfit.geometry import shapes as shapes
from phongfit.geometry.cameras import (
    AbstractCamera as AbstractCamera,
    OrthographicCamera as OrthographicCamera,
    PerspectiveCamera as PerspectiveCamera,
    look_at as look_at,
)
from phongfit.geometry.implicit import ImplicitSurface as ImplicitSurface
from phongfit.geometry.meshes import Mesh as Mesh, join as join
from phongfit.geometry.parametric import tessellate as tessellate
from phongfit.geometry.shading import (
    AbstractShading as AbstractShading,
    FlatShading as FlatShading,
    GouraudShading as GouraudShading,
    PhongShading as PhongShading,
)
from phongfit.geometry.surfaces import (
    AbstractSurface as AbstractSurface,
    GBuffer as GBuffer,
    NormalMap as NormalMap,
    Sphere as Sphere,
)
from phongfit.geometry.tracing import trace as trace
from phongfit.lights import (
    AbstractLight as AbstractLight,
    DirectionalLight as DirectionalLight,
    PointLight as PointLight,
    SpotLight as SpotLight,
)
from phongfit.material import (
    PRESETS as PRESETS,
    Material as Material,
    preset as preset,
    stack_materials as stack_materials,
    unstack_materials as unstack_materials,
)
from phongfit.reflectance import (
    AbstractSpecular as AbstractSpecular,
    BlinnPhong as BlinnPhong,
    Phong as Phong,
    blinn_from_phong as blinn_from_phong,
    phong_from_blinn as phong_from_blinn,
)
from phongfit.rendering.film import Film as Film
from phongfit.rendering.pixels import (
    PixelTerms as PixelTerms,
    pixel_terms as pixel_terms,
)
from phongfit.rendering.render import render as render
from phongfit.rendering.terms import (
    ShadingTerms as ShadingTerms,
    combine as combine,
    terms as terms,
)
from phongfit.scene import Scene as Scene

if TYPE_CHECKING:
    from phongfit import testing as testing
    from phongfit.files.datasets import (
        Dataset as Dataset,
        read_dataset as read_dataset,
    )
    from phongfit.files.images import (
        read_image as read_image,
        write_image as write_image,
    )
    from phongfit.files.meshes import load_mesh as load_mesh
    from phongfit.files.mtl import read_mtl as read_mtl, write_mtl as write_mtl
    from phongfit.files.scenes import (
        load_scene as load_scene,
        save_scene as save_scene,
    )
    from phongfit.fitting.maps.flags import Flag as Flag
    from phongfit.mapping.result import Maps as Maps, load_maps as load_maps
    from phongfit.mapping.run import fit_maps as fit_maps
    from phongfit.mapping.stacks import (
        AbstractStack as AbstractStack,
        PhotographStack as PhotographStack,
    )
    from phongfit.report.pictures import show as show

# Decoders and validators take long to import: only who reads a file waits for them.
_ON_DEMAND = {
    "AbstractStack": "phongfit.mapping.stacks",
    "Dataset": "phongfit.files.datasets",
    "Flag": "phongfit.fitting.maps.flags",
    "Maps": "phongfit.mapping.result",
    "PhotographStack": "phongfit.mapping.stacks",
    "fit_maps": "phongfit.mapping.run",
    "load_maps": "phongfit.mapping.result",
    "load_mesh": "phongfit.files.meshes",
    "load_scene": "phongfit.files.scenes",
    "read_dataset": "phongfit.files.datasets",
    "read_image": "phongfit.files.images",
    "read_mtl": "phongfit.files.mtl",
    "save_scene": "phongfit.files.scenes",
    "show": "phongfit.report.pictures",
    "write_image": "phongfit.files.images",
    "write_mtl": "phongfit.files.mtl",
}


def __getattr__(name: str) -> Any:
    if name == "testing":
        return importlib.import_module("phongfit.testing")
    if name in _ON_DEMAND:
        return getattr(importlib.import_module(_ON_DEMAND[name]), name)
    raise AttributeError(f"module 'phongfit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_ON_DEMAND, "testing"])
