"""Fit the Phong illumination model to images, with honest error bars."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from phongfit import testing as testing
    from phongfit.environment import Fog as Fog
    from phongfit.files.datasets import (
        Dataset as Dataset,
        open_dataset as open_dataset,
        read_dataset as read_dataset,
    )
    from phongfit.files.images import (
        read_film as read_film,
        read_image as read_image,
        write_image as write_image,
    )
    from phongfit.files.meshes import load_mesh as load_mesh
    from phongfit.files.mtl import read_mtl as read_mtl, write_mtl as write_mtl
    from phongfit.files.saved import load_fit as load_fit, save_fit as save_fit
    from phongfit.files.scenes import (
        load_scene as load_scene,
        save_scene as save_scene,
    )
    from phongfit.files.schema import register as register
    from phongfit.fitting.fit import fit as fit
    from phongfit.fitting.implicit import refit as refit
    from phongfit.fitting.predict import (
        Prediction as Prediction,
        predict_errors as predict_errors,
    )
    from phongfit.fitting.problem.losses import (
        AbstractLoss as AbstractLoss,
        Cauchy as Cauchy,
        Huber as Huber,
        Linear as Linear,
        SoftL1 as SoftL1,
        Tukey as Tukey,
    )
    from phongfit.fitting.problem.posing import make_problem as make_problem
    from phongfit.fitting.problem.problem import Problem as Problem
    from phongfit.fitting.problem.specification import Specification as Specification
    from phongfit.fitting.result import Estimate as Estimate, Fit as Fit
    from phongfit.fitting.solve.solver import (
        BoundedLevenbergMarquardt as BoundedLevenbergMarquardt,
    )
    from phongfit.fitting.uncertainty.profile import (
        Profile as Profile,
        ProfilePair as ProfilePair,
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
    from phongfit.maps.pixel.flags import Flag as Flag
    from phongfit.maps.result import Maps as Maps, load_maps as load_maps
    from phongfit.maps.run import fit_maps as fit_maps
    from phongfit.maps.stacks import (
        AbstractStack as AbstractStack,
        DatasetStack as DatasetStack,
        PhotographStack as PhotographStack,
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
    from phongfit.rendering.jpeg import JpegCompression as JpegCompression
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
    from phongfit.report.page import write_page as write_page
    from phongfit.report.pictures import show as show
    from phongfit.scene import Scene as Scene

# What a name needs is imported when it is first asked for: JAX and decoders take long,
# and a command that only shows its help needs none of them.
_ORIGINS = {
    "AbstractCamera": "phongfit.geometry.cameras",
    "AbstractLight": "phongfit.lights",
    "AbstractLoss": "phongfit.fitting.problem.losses",
    "AbstractShading": "phongfit.geometry.shading",
    "AbstractSpecular": "phongfit.reflectance",
    "AbstractStack": "phongfit.maps.stacks",
    "AbstractSurface": "phongfit.geometry.surfaces",
    "BlinnPhong": "phongfit.reflectance",
    "BoundedLevenbergMarquardt": "phongfit.fitting.solve.solver",
    "Cauchy": "phongfit.fitting.problem.losses",
    "Dataset": "phongfit.files.datasets",
    "DatasetStack": "phongfit.maps.stacks",
    "DirectionalLight": "phongfit.lights",
    "Estimate": "phongfit.fitting.result",
    "Film": "phongfit.rendering.film",
    "Fit": "phongfit.fitting.result",
    "Flag": "phongfit.maps.pixel.flags",
    "FlatShading": "phongfit.geometry.shading",
    "Fog": "phongfit.environment",
    "GBuffer": "phongfit.geometry.surfaces",
    "GouraudShading": "phongfit.geometry.shading",
    "Huber": "phongfit.fitting.problem.losses",
    "ImplicitSurface": "phongfit.geometry.implicit",
    "JpegCompression": "phongfit.rendering.jpeg",
    "Linear": "phongfit.fitting.problem.losses",
    "Maps": "phongfit.maps.result",
    "Material": "phongfit.material",
    "Mesh": "phongfit.geometry.meshes",
    "NormalMap": "phongfit.geometry.surfaces",
    "OrthographicCamera": "phongfit.geometry.cameras",
    "PRESETS": "phongfit.material",
    "PerspectiveCamera": "phongfit.geometry.cameras",
    "Phong": "phongfit.reflectance",
    "PhongShading": "phongfit.geometry.shading",
    "PhotographStack": "phongfit.maps.stacks",
    "PixelTerms": "phongfit.rendering.pixels",
    "PointLight": "phongfit.lights",
    "Prediction": "phongfit.fitting.predict",
    "Problem": "phongfit.fitting.problem.problem",
    "Profile": "phongfit.fitting.uncertainty.profile",
    "ProfilePair": "phongfit.fitting.uncertainty.profile",
    "Scene": "phongfit.scene",
    "ShadingTerms": "phongfit.rendering.terms",
    "SoftL1": "phongfit.fitting.problem.losses",
    "Specification": "phongfit.fitting.problem.specification",
    "Sphere": "phongfit.geometry.surfaces",
    "SpotLight": "phongfit.lights",
    "Tukey": "phongfit.fitting.problem.losses",
    "blinn_from_phong": "phongfit.reflectance",
    "combine": "phongfit.rendering.terms",
    "fit": "phongfit.fitting.fit",
    "fit_maps": "phongfit.maps.run",
    "join": "phongfit.geometry.meshes",
    "load_fit": "phongfit.files.saved",
    "load_maps": "phongfit.maps.result",
    "load_mesh": "phongfit.files.meshes",
    "load_scene": "phongfit.files.scenes",
    "look_at": "phongfit.geometry.cameras",
    "make_problem": "phongfit.fitting.problem.posing",
    "open_dataset": "phongfit.files.datasets",
    "phong_from_blinn": "phongfit.reflectance",
    "pixel_terms": "phongfit.rendering.pixels",
    "predict_errors": "phongfit.fitting.predict",
    "preset": "phongfit.material",
    "read_dataset": "phongfit.files.datasets",
    "read_film": "phongfit.files.images",
    "read_image": "phongfit.files.images",
    "read_mtl": "phongfit.files.mtl",
    "refit": "phongfit.fitting.implicit",
    "register": "phongfit.files.schema",
    "render": "phongfit.rendering.render",
    "save_fit": "phongfit.files.saved",
    "save_scene": "phongfit.files.scenes",
    "stack_materials": "phongfit.material",
    "terms": "phongfit.rendering.terms",
    "tessellate": "phongfit.geometry.parametric",
    "trace": "phongfit.geometry.tracing",
    "unstack_materials": "phongfit.material",
    "show": "phongfit.report.pictures",
    "write_image": "phongfit.files.images",
    "write_page": "phongfit.report.page",
    "write_mtl": "phongfit.files.mtl",
}
_MODULES = {
    "shapes": "phongfit.geometry.shapes",
    "testing": "phongfit.testing",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value = importlib.import_module(_MODULES[name])
    elif name in _ORIGINS:
        value = getattr(importlib.import_module(_ORIGINS[name]), name)
    else:
        raise AttributeError(f"module 'phongfit' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_ORIGINS, *_MODULES})
