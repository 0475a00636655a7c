"""Fit the Phong illumination model to images, with honest error bars."""

from phongfit.environment import Fog as Fog
from phongfit.files.meshes import load_mesh as load_mesh
from phongfit.files.mtl import read_mtl as read_mtl, write_mtl as write_mtl
from phongfit.fitting.fit import fit as fit
from phongfit.fitting.result import Fit as Fit
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
