"""Names that moved from `phongfit` into its modules in 0.3; the old ones go in 0.4."""

import warnings

MOVED = {
    "calibration.response": "Response",
    "files.captures": "Capture",
    "files.datasets": "Dataset",
    "files.photographs": "list_photographs open_photographs",
    "fitting.predict": "Prediction",
    "fitting.problem.problem": "Problem",
    "fitting.result": "Estimate",
    "fitting.solve.solver": "BoundedLevenbergMarquardt",
    "fitting.texels.result": "TextureFit",
    "fitting.uncertainty.profile": "Profile ProfilePair",
    "geometry": "AXES AbstractCamera AbstractDistortion AbstractShading "
    "AbstractSurface BrownDistortion FisheyeDistortion GBuffer "
    "HeightField Undistorted camera_from_matrix camera_from_opencv "
    "camera_pose camera_to_world cast_shadows integrate_normals "
    "join look_at tessellate trace undistort",
    "maps.result": "BasisMaterials Strengths",
    "maps.stacks": "AbstractStack",
    "maps.view_angle": "FovFit seen_over",
    "material": "PRESETS stack_materials unstack_materials",
    "microfacets": "roughness_from_shininess shininess_from_roughness",
    "reflectance": "blinn_from_phong phong_from_blinn",
    "rendering": "JpegCompression PixelTerms ShadingTerms combine pixel_terms",
    "textures": "AbstractTexture",
}
"""Names by the module, relative to `phongfit`, in which they are public now."""


def warn_deprecated(words: str, deeper: int = 0) -> None:
    """Warn that a name or an argument will be removed.

    The warning shows the line that called the caller of this function, or one that is
    so many calls `deeper`.
    """
    warnings.warn(words, DeprecationWarning, stacklevel=3 + deeper)
