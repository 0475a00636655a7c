"""Public names of the geometry beside those of `phongfit` itself."""

from . import shapes as shapes
from .cameras import AbstractCamera as AbstractCamera, look_at as look_at
from .conventions import (
    AXES as AXES,
    camera_from_matrix as camera_from_matrix,
    camera_from_opencv as camera_from_opencv,
    camera_pose as camera_pose,
    camera_to_world as camera_to_world,
)
from .distortion import (
    AbstractDistortion as AbstractDistortion,
    BrownDistortion as BrownDistortion,
    FisheyeDistortion as FisheyeDistortion,
)
from .height import HeightField as HeightField, cast_shadows as cast_shadows
from .integration import integrate_normals as integrate_normals
from .meshes import join as join
from .parametric import tessellate as tessellate
from .shading import AbstractShading as AbstractShading
from .surfaces import AbstractSurface as AbstractSurface, GBuffer as GBuffer
from .tracing import trace as trace
from .undistortion import Undistorted as Undistorted, undistort as undistort
