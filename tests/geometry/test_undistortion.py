import numpy as np
import pytest

import phongfit as pf
from tests.helpers import floats, near

WIDTH, HEIGHT = 24, 16
CAMERA = pf.PinholeCamera(
    WIDTH, HEIGHT, fx=20, cx=11, distortion=pf.geometry.BrownDistortion(-0.3, 0.1, 0.01)
)


def ramp(camera):
    """What a plane at distance 1 looks like whose colours are x, y and 1 there."""
    rays = np.asarray(camera.rays().direction)
    place = rays[..., :2] / -rays[..., 2:]
    return np.concatenate([place, np.ones((*place.shape[:2], 1))], axis=-1)


@pytest.mark.parametrize("k1, all_known", [(-0.3, True), (0.3, False)])
def test_straight_lines_become_straight(k1, all_known):
    """A barrel keeps what is in its middle, a pincushion leaves corners open."""
    lens = pf.geometry.BrownDistortion(k1, 0.1, 0.01)
    bent = pf.PinholeCamera(WIDTH, HEIGHT, fx=20, cx=11, distortion=lens)
    image, mask, camera = pf.geometry.undistort(ramp(bent), bent)
    assert camera.distortion is None and image.shape == (HEIGHT, WIDTH, 3)
    assert mask.all() == all_known and mask[2:-2, 2:-2].all()
    # Bilinear: exact for straight ramps, and these are bent a little.
    assert np.abs(image - ramp(camera))[mask].max() < 1e-3
    near(image[mask][:, 2], 1, 1e-5)
    assert not image[~mask].any()


def test_as_opencv_does():
    """One pixel in 255, where it is black elsewhere: cv2.undistort's own answer.

    K = [[20, 0, 10.5], [0, 20, 7.5], [0, 0, 1]] with k1 = −0.3, k2 = 0.1, p1 = 0.01,
    made by `cv2.undistort(image, K, np.array([-0.3, 0.1, 0.01, 0]))` of OpenCV 5.0.0,
    which interpolates in 32 steps between pixels.
    """
    image = np.zeros((HEIGHT, WIDTH))
    image[3, 4] = 1
    found = pf.geometry.undistort(image, CAMERA).image
    expected = np.zeros((4, 4))
    expected[1:3, 1:3] = [[0.2031, 0.2148], [0.3008, 0.5156]]
    assert np.abs(found[1:5, 2:6] - expected).max() < 1 / 32
    assert found.sum() - found[1:5, 2:6].sum() == 0


def test_pixels_that_are_masked_spread():
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[8, 11] = False
    image = ramp(CAMERA)
    image[8, 11] = np.inf
    found = pf.geometry.undistort(image, CAMERA, mask=mask)
    plain = pf.geometry.undistort(ramp(CAMERA), CAMERA)
    lost = plain.mask & ~found.mask
    assert 1 <= lost.sum() <= 9 and lost[7:10, 10:13].sum() == lost.sum()
    near(found.image[found.mask], plain.image[found.mask])


def test_past_the_fold_nothing_is_known():
    lens = pf.geometry.BrownDistortion(-1 / 3)
    camera = pf.PinholeCamera(64, 4, fx=8, distortion=lens)
    mask = pf.geometry.undistort(np.ones((4, 64)), camera).mask
    # Two thirds from the centre is the image of what lies 1 from it, and the last.
    x = np.abs(np.arange(64) + 0.5 - 32) / 8
    near(mask[2], x < 1)


def test_without_a_lens_nothing_happens():
    camera = pf.PinholeCamera(WIDTH, HEIGHT, fx=20)
    image = np.random.default_rng(0).uniform(size=(HEIGHT, WIDTH, 3))
    found = pf.geometry.undistort(image, camera)
    near(found.image, floats(image))
    assert found.mask.all()


@pytest.mark.parametrize(
    "call, words",
    [
        (
            lambda: pf.geometry.undistort(np.ones((3, 4)), CAMERA),
            "image: expected shape",
        ),
        (
            lambda: pf.geometry.undistort(
                np.ones((HEIGHT, WIDTH)), CAMERA, mask=np.ones(3)
            ),
            "mask: expected shape",
        ),
        (
            lambda: pf.geometry.undistort(np.ones((4, 4)), pf.PerspectiveCamera(4, 4)),  # pyright: ignore
            "camera: expected",
        ),
    ],
)
def test_what_is_wrong_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
