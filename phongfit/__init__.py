"""Fit the Phong illumination model to images, with honest error bars."""

import importlib
from typing import TYPE_CHECKING, Any

from phongfit.fitting.fit import fit as fit
from phongfit.fitting.losses import (
    AbstractLoss as AbstractLoss,
    Cauchy as Cauchy,
    Huber as Huber,
    Linear as Linear,
    SoftL1 as SoftL1,
    Tukey as Tukey,
)
from phongfit.fitting.result import Fit as Fit
from phongfit.fitting.solver import (
    BoundedLevenbergMarquardt as BoundedLevenbergMarquardt,
)
from phongfit.geometry.cameras import (
    AbstractCamera as AbstractCamera,
    OrthographicCamera as OrthographicCamera,
    PerspectiveCamera as PerspectiveCamera,
    look_at as look_at,
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
from phongfit.material import PRESETS as PRESETS, Material as Material, preset as preset
from phongfit.reflectance import (
    AbstractSpecular as AbstractSpecular,
    BlinnPhong as BlinnPhong,
    Phong as Phong,
    blinn_from_phong as blinn_from_phong,
    phong_from_blinn as phong_from_blinn,
)
from phongfit.rendering.film import Film as Film
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
    from phongfit.files.scenes import (
        load_scene as load_scene,
        save_scene as save_scene,
    )

# Decoders and validators take long to import: only who reads a file waits for them.
_ON_DEMAND = {
    "Dataset": "phongfit.files.datasets",
    "load_scene": "phongfit.files.scenes",
    "read_dataset": "phongfit.files.datasets",
    "read_image": "phongfit.files.images",
    "save_scene": "phongfit.files.scenes",
    "write_image": "phongfit.files.images",
}


def __getattr__(name: str) -> Any:
    if name == "testing":
        return importlib.import_module("phongfit.testing")
    if name in _ON_DEMAND:
        return getattr(importlib.import_module(_ON_DEMAND[name]), name)
    raise AttributeError(f"module 'phongfit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_ON_DEMAND, "testing"])
