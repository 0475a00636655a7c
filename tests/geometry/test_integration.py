"""Heights from normals: exact where the theory says so, and jumps are kept."""

import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry import integration

PARALLEL = pf.OrthographicCamera(40, 32)
PINHOLE = pf.PerspectiveCamera.look_at((3, 2, 4), width=40, height=32, fov_y=35.0)


def seen(
    camera: pf.geometry.AbstractCamera,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals in the camera's axes, depth and points of a sphere of radius 1."""
    gbuffer = pf.geometry.trace(pf.Sphere(), camera)
    mask, points = np.asarray(gbuffer.mask), np.asarray(gbuffer.position, float)
    normals = np.asarray(gbuffer.normal, float) @ np.asarray(camera.rotation, float)
    offset = np.asarray(camera.position, float) - points
    depth = offset @ np.asarray(camera.rotation, float)[:, 2]
    outside = ~mask
    normals[outside], depth[outside] = 0, np.nan
    return normals, depth, points


@pytest.mark.parametrize("camera", [PARALLEL, PINHOLE])
def test_a_sphere_is_exact(camera):
    """A chord is perpendicular to the sum of its ends' normals: no error of method.

    For a pinhole as well: its rays' ratio is that of the ends' depths.
    """
    normals, depth, points = seen(camera)
    found = pf.geometry.integrate_normals(normals, camera, depth=depth)
    inside = found.mask
    np.testing.assert_array_equal(inside, np.isfinite(depth))
    np.testing.assert_allclose(found.positions()[inside], points[inside], atol=2e-5)
    assert found.warnings == () and found.pieces.max() == 1


def test_a_plane_in_perspective():
    normal = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    found = pf.geometry.integrate_normals(
        np.tile(normal, (32, 40, 1)), PINHOLE, distance=5.0
    )
    points = found.positions()
    world = normal @ np.asarray(PINHOLE.rotation).T
    assert np.ptp(points @ world) < 2e-5
    along = (np.asarray(PINHOLE.position) - points) @ np.asarray(PINHOLE.rotation)
    assert np.median(along[..., 2]) == pytest.approx(5, rel=1e-5)


def flap(slope: float, size: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A sheet with a slit: right of it, its upper half bends up. Normals, heights.

    The two sides meet in the lower half; above, they are up to slope × size / 2 apart.
    """
    y, x = np.mgrid[:size, :size] + 0.5
    bent = (x > size / 2) & (y < size / 2)
    height = np.where(bent, slope * (size / 2 - y), 0)
    normals = np.where(bent[..., None], [0, -slope, 1], [0, 0, 1])
    return normals, height


@pytest.mark.parametrize("slope", [0.2, 0.5])
@pytest.mark.parametrize("noise", [0, 0.02])
@pytest.mark.parametrize("most", [integration.FACTORED_PIXELS, 0])
def test_a_step_is_kept(slope, noise, most, monkeypatch):
    """Least squares alone smears it: by 0.5 and 1.2 pixels on average.

    By a factorization, and as the largest images by conjugate gradients.
    """
    monkeypatch.setattr(integration, "FACTORED_PIXELS", most)
    normals, height = flap(slope)
    rng = np.random.default_rng(0)
    found = pf.geometry.integrate_normals(
        normals + noise * rng.normal(size=normals.shape)
    )
    off = found.height - height
    off = np.abs(off - np.median(off))
    assert off.mean() < 0.05
    jump = found.height[2, 22] - found.height[2, 17]
    assert jump == pytest.approx(height[2, 20], rel=0.03)


def test_errors_weigh():
    """Normals that are known badly follow those that are known well."""
    normals, depth, points = seen(PARALLEL)
    bad = np.zeros(depth.shape, bool)
    bad[12:20, 14:26] = True
    wrong = normals + np.where(bad[..., None], [0.05, 0, 0], 0)
    errors = {
        error: np.abs(
            pf.geometry.integrate_normals(
                wrong, PARALLEL, stderr=np.where(bad, error, 0.0), depth=depth
            ).positions()
            - points
        )[~bad & np.isfinite(depth)].mean()
        for error in (0.0, 3.0, 30.0, np.inf)
    }
    assert errors[0.0] > 2 * errors[3.0] > 10 * errors[30.0] > 10 * errors[np.inf]


def test_normals_that_are_not_identified():
    """The surface goes on smoothly below them, and it is said."""
    normals, depth, points = seen(PARALLEL)
    wrong = normals.copy()
    wrong[15:18, 18:22] = [0, 0, -1]
    found = pf.geometry.integrate_normals(wrong, PARALLEL, depth=depth)
    off = np.abs(found.positions() - points)[np.isfinite(depth)]
    assert off.max() < 0.1 and found.height[16, 20] > 0.9
    (words,) = found.warnings
    assert pf.warning_code(words) == "vague-normals"
    assert words.startswith("normals: 12 of ")


def test_pieces_are_named_and_placed():
    normals, depth, points = seen(PARALLEL)
    mask = np.isfinite(depth)
    mask[:, 19:21] = False
    found = pf.geometry.integrate_normals(normals, PARALLEL, mask)
    assert found.pieces.max() == 2 and "2 pieces" in found.warnings[0]
    assert "2 of them are put at the same depth" in found.warnings[0]
    assert str(found).splitlines()[0].endswith("in 2 pieces")
    for piece in (1, 2):
        own = found.pieces == piece
        assert np.median(found.height[own]) == pytest.approx(0, abs=1e-6)
        # Each is right in itself.
        off = found.height[own] - points[own][:, 2]
        assert np.ptp(off) < 2e-5
    # One pixel of each that is known moves it.
    few = np.full(depth.shape, np.nan)
    few[16, [10, 30]] = depth[16, [10, 30]]
    placed = pf.geometry.integrate_normals(normals, PARALLEL, mask, depth=few)
    np.testing.assert_allclose(placed.positions()[mask], points[mask], atol=2e-5)
    assert placed.warnings == ()


def test_a_single_pixel():
    mask = np.zeros((32, 40), bool)
    mask[3, 4] = True
    found = pf.geometry.integrate_normals(
        np.tile([0.0, 0, 1], (32, 40, 1)), PARALLEL, mask
    )
    assert found.height[3, 4] == 0 and np.isnan(found.height).sum() == 32 * 40 - 1
    with pytest.raises(ValueError, match="neighbouring pixels"):
        found.mesh()
    outside = np.where(mask[..., None], [0.0, 0, 1], np.nan)
    again = pf.geometry.integrate_normals(outside, PARALLEL, mask)
    np.testing.assert_array_equal(again.height, found.height)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"normals": np.ones((4, 5))}, r"normals: expected shape \(height"),
        ({"normals": np.full((32, 40, 3), np.nan)}, "normals: expected finite"),
        ({"normals": np.ones((4, 5, 3))}, "normals: expected shape .*as the camera"),
        ({"normals": np.zeros((32, 40, 3))}, "mask: expected at least one pixel"),
        ({"mask": np.ones((3, 3))}, "mask: expected numbers of shape"),
        ({"stderr": np.full((32, 40), -1.0)}, "stderr: expected degrees"),
        ({"distance": -1.0}, "distance: expected a number > 0"),
    ],
)
def test_bad_arguments(arguments, words):
    arguments = {"normals": np.tile([0.0, 0, 1], (32, 40, 1))} | arguments
    with pytest.raises(ValueError, match=words):
        pf.geometry.integrate_normals(camera=PARALLEL, **arguments)


def test_a_pinhole_wants_a_distance():
    at_origin = pf.PerspectiveCamera(40, 32, position=(0, 0, 0))
    with pytest.raises(ValueError, match="distance: expected the distance from"):
        pf.geometry.integrate_normals(np.tile([0.0, 0, 1], (32, 40, 1)), at_origin)
