"""The public names of `phongfit`, each imported at its first use.

Names for experts are in `phongfit.geometry` and `phongfit.rendering`, or in the modules
that define them.
"""

from . import geometry as geometry, rendering as rendering, testing as testing
from .cache import cache_programs as cache_programs
from .calibration.calibrate import calibrate as calibrate
from .calibration.response import fit_response as fit_response
from .calibration.result import Calibration as Calibration
from .codes import warning_code as warning_code
from .environment import Fog as Fog
from .files.calibrations import (
    load_calibration as load_calibration,
    save_calibration as save_calibration,
)
from .files.cameras import load_cameras as load_cameras
from .files.capture_data import open_captured as open_captured
from .files.captures import open_capture as open_capture
from .files.datasets import (
    open_dataset as open_dataset,
    read_dataset as read_dataset,
)
from .files.images import (
    read_film as read_film,
    read_image as read_image,
    read_mask as read_mask,
    write_image as write_image,
)
from .files.lp import read_lp as read_lp, write_lp as write_lp
from .files.mesh_saving import save_mesh as save_mesh
from .files.meshes import load_mesh as load_mesh
from .files.mtl import read_mtl as read_mtl, write_mtl as write_mtl
from .files.opening import open_data as open_data
from .files.photographs import read_photograph as read_photograph
from .files.saved import load_fit as load_fit, save_fit as save_fit
from .files.scenes import load_scene as load_scene, save_scene as save_scene
from .files.schema import register as register
from .fitting.fit import fit as fit
from .fitting.implicit import refit as refit
from .fitting.predict import predict_errors as predict_errors
from .fitting.problem.losses import (
    AbstractLoss as AbstractLoss,
    Cauchy as Cauchy,
    Huber as Huber,
    Linear as Linear,
    SoftL1 as SoftL1,
    Tukey as Tukey,
)
from .fitting.problem.posing import make_problem as make_problem
from .fitting.problem.specification import Specification as Specification
from .fitting.result import Fit as Fit
from .fitting.texture_fit import fit_texture as fit_texture
from .geometry import shapes as shapes
from .geometry.cameras import (
    OrthographicCamera as OrthographicCamera,
    PerspectiveCamera as PerspectiveCamera,
    PinholeCamera as PinholeCamera,
)
from .geometry.implicit import ImplicitSurface as ImplicitSurface
from .geometry.meshes import Mesh as Mesh
from .geometry.shading import (
    FlatShading as FlatShading,
    GouraudShading as GouraudShading,
    PhongShading as PhongShading,
)
from .geometry.surfaces import (
    NormalMap as NormalMap,
    Sphere as Sphere,
)
from .lights import (
    AbstractLight as AbstractLight,
    DirectionalLight as DirectionalLight,
    HarmonicLight as HarmonicLight,
    PointLight as PointLight,
    SpotLight as SpotLight,
)
from .maps.pixel.settings import Flag as Flag
from .maps.result import (
    Maps as Maps,
    load_maps as load_maps,
)
from .maps.run import fit_maps as fit_maps, fit_stored_maps as fit_stored_maps
from .maps.stacks import (
    DatasetStack as DatasetStack,
    PhotographStack as PhotographStack,
    ZarrStack as ZarrStack,
)
from .maps.stored import StoredMaps as StoredMaps
from .maps.view_angle import fit_fov as fit_fov
from .material import (
    Material as Material,
    preset as preset,
)
from .microfacets import (
    GGX as GGX,
    Ward as Ward,
)
from .reflectance import (
    AbstractSpecular as AbstractSpecular,
    BlinnPhong as BlinnPhong,
    Phong as Phong,
)
from .rendering.film import Film as Film
from .rendering.render import render as render
from .rendering.response import ResponseCurve as ResponseCurve
from .rendering.terms import terms as terms
from .report.page import write_page as write_page
from .report.pictures import show as show
from .report.viewer import write_view as write_view
from .scene import Scene as Scene
from .textures import (
    Texture as Texture,
    Textures as Textures,
    VertexColours as VertexColours,
)

__version__: str
