r"""From normals to heights: robust integration, for parallel rays and for a pinhole.

Two neighbours lie on a chord of the surface, which is perpendicular to the sum s of
their normals: exactly so on planes and on spheres. For parallel rays the chord is
$(\Delta x, \Delta y, \Delta h)$, so that

    $\Delta h = -(s_x \Delta x + s_y \Delta y) / s_z$

and for a pinhole, where a point is depth d times a ray r, the ratio of the depths is

    $\log d_2 - \log d_1 = \log (s \cdot r_1 / s \cdot r_2)$.

Both prescribe differences of a number u of neighbouring pixels: their height h, or the
logarithm of their depth d. Least squares over
all pairs is a sparse system, a weighted Laplacian. At a depth discontinuity no u
satisfies them, so pairs are down-weighted by their residuals, iteratively.

??? cite "Source"
    Durou, Aujol and Courteille, *Integrating the normal field of a surface in the
    presence of discontinuities*, EMMCVPR 2009 (robust weights); Cao et al., *Bilateral
    normal integration*, ECCV 2022 (one form for both cameras); Geman and McClure,
    1987, and Blake and Zisserman, *Visual reconstruction*, 1987 (weights, and that
    they sharpen step by step).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.checks import as_array
from phongfit.codes import coded
from phongfit.edge import checked
from phongfit.geometry.cameras import AbstractCamera, OrthographicCamera
from phongfit.geometry.height import HeightField, as_map

MIN_COSINE = 0.02
"""Least cosine of the angle between the normal and the direction to the camera.

Below it the slope is too uncertain."""

HALF_WEIGHT_ERROR = 1.0
"""Standard error at which a normal has half the weight of an exact one, degrees."""

UNIDENTIFIED_WEIGHT = 1e-4
"""Weight of a pixel whose normal is not identified: it follows its neighbours."""

FIRST_SCALE, LAST_SCALE, MAX_ITERATIONS = 2.0, 0.1, 20
"""First and last scale of the robust weights, pixels, and the number of iterations."""

FACTORED_PIXELS = 2_000_000
"""Most pixels whose system is factored, which takes some 1.2 GB for a million."""


class _Pairs(NamedTuple):
    """Pairs of neighbouring pixels.

    - `first`, `second`: indices of the two pixels.
    - `step`: prescribed difference u(second) − u(first).
    - `cosine`: of the angle between the normal and the direction to the camera.
    - `pixel`: distance between the two pixels, in the unit of u.
    """

    first: Int[np.ndarray, " pairs"]
    second: Int[np.ndarray, " pairs"]
    step: Float[np.ndarray, " pairs"]
    cosine: Float[np.ndarray, " pairs"]
    pixel: Float[np.ndarray, " pairs"]


@checked
def integrate_normals(
    normals: Any,
    camera: AbstractCamera | None = None,
    mask: Any = None,
    *,
    stderr: Any = None,
    depth: Any = None,
    distance: float | None = None,
) -> HeightField:
    """Heights of a surface from its normals.

    Discontinuities are kept where the surrounding normals show them. Normals determine
    neither the distance of a surface nor the relative depth of separate pieces of a
    mask.

    **Arguments:**

    - `normals`: (H, W, 3) in the camera's axes (x right, y up, z to the camera), of any
        length. A pixel of the mask whose normal is 0 or points away from the camera
        follows its neighbours.
    - `camera`: default an orthographic one with a view of one world unit for each
        pixel, so that heights are in pixels.
    - `mask`: (H, W), true inside; default where normals are not 0. Outside of it
        normals may be NaN.
    - `stderr`: (H, W), standard errors ≥ 0 of the normals in degrees; pairs of
        neighbours are weighted by them. A pixel with an infinite one follows its
        neighbours.
    - `depth`: (H, W), known distances along the camera's axis, world units, NaN where
        they are unknown. Each piece is moved so that the medians agree.
    - `distance`: median distance along the camera's axis of a piece without known
        distances, > 0, world units; default that of the world's origin.

    **Returns:** a [`HeightField`][]; its `warnings` count pieces whose relative depth
    is unknown, and pixels without a usable normal.

    **Raises:** `ValueError` that names the argument.
    """
    field = _as_normals(normals)
    size = field.shape[:2]
    inside = np.any(field != 0, axis=-1)
    if mask is not None:
        inside = as_map("mask", mask, size).astype(bool)
    if not np.isfinite(field[inside]).all():
        raise ValueError("normals: expected finite numbers")
    field = np.where(inside[..., None], field, 0)
    if camera is None:
        camera = OrthographicCamera(size[1], size[0], view_height=float(size[0]))
    if size != (camera.height, camera.width):
        raise ValueError(
            f"normals: expected shape {(camera.height, camera.width, 3)}, as the "
            f"camera has pixels, got {field.shape}"
        )
    length = np.linalg.norm(field, axis=-1)
    if not inside.any():
        raise ValueError("mask: expected at least one pixel with a normal, got none")
    weight = np.ones(size)
    if stderr is not None:
        errors = as_map("stderr", stderr, size).astype(float)
        if not np.all(errors[inside] >= 0):
            raise ValueError("stderr: expected degrees ≥ 0")
        weight = 1 / (1 + (np.minimum(errors, 1e6) / HALF_WEIGHT_ERROR) ** 2)
    default_depth = _default_depth(distance, camera)
    rays = camera_rays(camera)
    facing = -np.sum(field * rays.direction, axis=-1) > MIN_COSINE * length
    valid = inside & facing & (weight > UNIDENTIFIED_WEIGHT)
    field = _fill_invalid(field / np.maximum(length, 1e-30)[..., None], valid)
    weight = np.where(valid, weight, UNIDENTIFIED_WEIGHT)
    pieces = label_pieces(inside)
    u = np.full(size, np.nan)
    u[inside] = _solve(_pairs(field, inside, rays), weight[inside], int(inside.sum()))
    known_depth = np.full(size, np.nan)
    if depth is not None:
        known_depth = as_map("depth", depth, size).astype(float)
    depths = _depths(u, pieces, rays.parallel, known_depth, default_depth)
    # The camera's own height above the world's origin, along its z axis.
    top = float(np.dot(camera.position, camera.rotation[:, 2]))
    height = top - depths
    warnings = _warnings(inside, valid, pieces, known_depth)
    return HeightField(height, pieces, camera, warnings)


class CameraRays(NamedTuple):
    """Rays of all pixels in the camera's axes; directions have z = −1.

    `parallel` is true if all directions are the same.
    """

    origin: Float[np.ndarray, "height width 3"]
    direction: Float[np.ndarray, "height width 3"]
    parallel: bool


def camera_rays(camera: AbstractCamera) -> CameraRays:
    """A camera's rays in its own axes, world units from its position."""
    rays, axes = camera.rays(), np.asarray(camera.rotation, float)
    origin = (np.asarray(rays.origin, float) - np.asarray(camera.position)) @ axes
    direction = np.asarray(rays.direction, float) @ axes
    direction = direction / -direction[..., 2:]
    parallel = bool(np.ptp(direction, axis=(0, 1)).max() < 1e-9)
    return CameraRays(origin, direction, parallel)


def _pairs(
    normals: Float[np.ndarray, "height width 3"],
    inside: Bool[np.ndarray, "height width"],
    rays: CameraRays,
) -> _Pairs:
    """All pairs of neighbours inside: those in rows, then those in columns.

    **Arguments:** `normals`: unit vectors in the camera's axes.
    """
    # Index of each pixel among those inside.
    number = np.cumsum(inside).reshape(inside.shape) - 1
    parts = []
    for first, second in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
    ):
        both = inside[first] & inside[second]
        mean = (normals[first][both] + normals[second][both]) / 2
        start, end = (
            rays.origin[at][both] if rays.parallel else rays.direction[at][both]
            for at in (first, second)
        )
        # Both formulas for `step` are derived in the module's docstring.
        if rays.parallel:
            cosine = np.maximum(mean[:, 2], MIN_COSINE)
            step = -np.sum(mean * (end - start), axis=1) / cosine
        else:
            near, far = (
                np.maximum(-np.sum(mean * ray, axis=1), MIN_COSINE)
                for ray in (start, end)
            )
            step, cosine = np.log(near / far), (near + far) / 2
        pixel = np.linalg.norm(end - start, axis=1)
        parts.append(
            _Pairs(number[first][both], number[second][both], step, cosine, pixel)
        )
    return _Pairs(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _solve(
    pairs: _Pairs, weight: Float[np.ndarray, " pixels"], count: int
) -> Float[np.ndarray, " pixels"]:
    """The numbers u of the pixels: see the module's docstring for u and the method.

    **Arguments:** `weight`: of each pixel's normal, in (0, 1]; `count`: of pixels.
    """
    # A pair's weight is the harmonic mean of its pixels' weights, and its residual is
    # measured perpendicular to the surface, in pixels.
    ends = weight[pairs.first], weight[pairs.second]
    base = pairs.cosine**2 * 2 / (1 / ends[0] + 1 / ends[1]) / pairs.pixel**2
    heights = _least_squares(pairs, base, np.zeros(count))
    scale = FIRST_SCALE
    for _ in range(MAX_ITERATIONS):
        residual = heights[pairs.second] - heights[pairs.first] - pairs.step
        gap = np.abs(pairs.cosine * residual / pairs.pixel)
        if gap.max(initial=0) < LAST_SCALE:
            break
        heights = _least_squares(pairs, base / (1 + (gap / scale) ** 2) ** 2, heights)
        scale = max(0.7 * scale, LAST_SCALE)
    return heights


def _least_squares(
    pairs: _Pairs,
    weight: Float[np.ndarray, " pairs"],
    start: Float[np.ndarray, " pixels"],
) -> Float[np.ndarray, " pixels"]:
    """The numbers u that fit the pairs' steps best in weighted least squares.

    By a sparse LU factorization. For the largest images it would take too much memory.
    They are solved by conjugate gradients with algebraic multigrid, which takes 4 to 30
    times as long, since the weights of neighbouring pairs differ by orders of
    magnitude. `start` determines what the pairs do not: the mean of each piece.
    """
    # Imported here, since they take long to import.
    from scipy.sparse import csc_array, csr_array, eye_array
    from scipy.sparse.linalg import cg, splu

    if not len(weight):
        return start
    weight = weight / weight.max()
    ones, rows = np.ones(len(weight)), np.arange(len(weight))
    shape = (len(weight), len(start))
    second = csr_array((ones, (rows, pairs.second)), shape)
    difference = second - csr_array((ones, (rows, pairs.first)), shape)
    system = csr_array(difference.T @ (difference * weight[:, None]))
    # Neighbours do not determine the mean of u in a piece. A tiny weight on `start`
    # makes the system regular.
    regularisation = 1e-10 * system.diagonal().max()
    system = csr_array(system + regularisation * eye_array(len(start), format="csr"))
    right = difference.T @ (weight * pairs.step) + regularisation * start
    if len(start) <= FACTORED_PIXELS:
        # SuperLU's options for symmetric systems.
        factors = splu(
            csc_array(system),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0,
            options={"SymmetricMode": True},
        )
        return factors.solve(right)
    import pyamg

    levels = pyamg.ruge_stuben_solver(system, coarse_solver="splu")
    preconditioner = levels.aspreconditioner()
    solution, _ = cg(system, right, start, rtol=1e-8, maxiter=200, M=preconditioner)
    return solution


def label_pieces(
    inside: Bool[np.ndarray, "height width"],
) -> Int[np.ndarray, "height width"]:
    """Number of each pixel's connected piece, from 1 on; 0 outside.

    Pixels are connected by their sides, not by their corners.
    """
    from scipy.ndimage import label

    pieces, _ = label(inside)  # pyright: ignore
    return pieces


def _fill_invalid(
    normals: Float[np.ndarray, "height width 3"],
    valid: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width 3"]:
    """Replace each normal that is not `valid` by that of the nearest valid pixel.

    If no pixel is valid, all normals face the camera.
    """
    from scipy.ndimage import distance_transform_edt

    if valid.all():
        return normals
    if not valid.any():
        return np.broadcast_to([0.0, 0.0, 1.0], normals.shape)
    nearest = distance_transform_edt(
        ~valid, return_distances=False, return_indices=True
    )
    return normals[tuple(nearest)]  # pyright: ignore


def _depths(
    u: Float[np.ndarray, "height width"],
    pieces: Int[np.ndarray, "height width"],
    parallel: bool,
    known_depth: Float[np.ndarray, "height width"],
    default_depth: float,
) -> Float[np.ndarray, "height width"]:
    """Depth of every pixel along the camera's axis, world units; NaN outside.

    `u` is a height (parallel rays) or a log depth (pinhole), up to a constant for each
    piece. The constant makes the median depth of pixels with a `known_depth` (not
    NaN) that of `known_depth`. A piece without any gets the median `default_depth`.

    **Raises:** `ValueError` if the median depth from a pinhole is not positive.
    """
    from scipy.ndimage import median

    index = np.arange(1, int(pieces.max()) + 1)
    median_depth = np.full(len(index), default_depth)
    has_depth = np.isfinite(known_depth) & (pieces > 0)
    median_u = np.asarray(median(u, pieces, index))
    if has_depth.any():
        marked = np.where(has_depth, pieces, 0)
        is_known = np.isin(index, marked)
        numbers = index[is_known]
        median_depth[is_known] = np.asarray(median(known_depth, marked, numbers))
        median_u[is_known] = np.asarray(median(u, marked, numbers))
    if not parallel and not np.all(median_depth > 0):
        raise ValueError(
            "distance: expected the distance from the pinhole to the surface, > 0 "
            f"world units, got {median_depth.min():g}"
        )
    # Pixels outside (0) use the first piece: their `u` is NaN, and so is the result.
    piece = np.maximum(pieces - 1, 0)
    if parallel:
        # A height grows towards the camera, a depth away from it.
        return median_depth[piece] - (u - median_u[piece])
    return median_depth[piece] * np.exp(u - median_u[piece])


def _default_depth(distance: float | None, camera: AbstractCamera) -> float:
    """The given distance; for `None` that of the world's origin along the axis.

    **Raises:** `ValueError` if the given distance is not finite and positive.
    """
    if distance is None:
        return float(np.dot(camera.position, camera.rotation[:, 2]))
    if not np.isfinite(distance) or not distance > 0:
        raise ValueError(f"distance: expected a number > 0, got {distance!r}")
    return float(distance)


def _warnings(
    inside: np.ndarray,
    valid: np.ndarray,
    pieces: np.ndarray,
    known_depth: np.ndarray,
) -> tuple[str, ...]:
    """Warnings of pieces without `known_depth`, and of pixels that are not `valid`."""
    warnings = []
    count = int(pieces.max())
    placed = {*pieces[np.isfinite(known_depth)].tolist()} - {0}
    if count > 1 and len(placed) < count:
        problem = (
            f"mask: it consists of {count} pieces, whose relative depth normals do not "
            f"determine: {count - len(placed)} of them are put at the same depth"
        )
        warnings.append(coded("separate-pieces", problem))
    invalid = int((inside & ~valid).sum())
    if invalid:
        problem = (
            f"normals: {invalid:,} of {int(inside.sum()):,} pixels do not identify "
            "their normal, or it points away from the camera: there the surface is "
            "interpolated"
        )
        warnings.append(coded("vague-normals", problem))
    return tuple(warnings)


def _as_normals(normals: Any) -> Float[np.ndarray, "height width 3"]:
    """`normals` in double precision, of shape (H, W, 3) and not empty.

    **Raises:** `ValueError` for another shape or type.
    """
    field = as_array("normals", normals)
    if field.ndim != 3 or field.shape[-1] != 3 or 0 in field.shape:
        raise ValueError(
            f"normals: expected shape (height, width, 3), got {field.shape}"
        )
    if field.dtype.kind not in "fiu":
        raise ValueError(f"normals: expected numbers, got {field.dtype}")
    return field.astype(float)
