import math

import numpy as np
import pytest

import phongfit as pf
from phongfit.testing import check_gradients
from tests.helpers import floats, near


@pytest.mark.parametrize(
    "fog, depth, expected",
    [
        (pf.Fog(mode="linear", start=2, end=6), 1, 1),
        (pf.Fog(mode="linear", start=2, end=6), 3, 0.75),
        (pf.Fog(mode="linear", start=2, end=6), 7, 0),
        # OpenGL allows fog that thins out with depth.
        (pf.Fog(mode="linear", start=6, end=2), 3, 0.25),
        (pf.Fog(mode="exp", density=0.5), 2, math.exp(-1)),
        (pf.Fog(mode="exp2", density=0.5), 4, math.exp(-4)),
        (pf.Fog(mode="exp", density=0), 100, 1),
        (pf.Fog(mode="exp", density=0.5), -1, 1),
    ],
)
def test_transmittance(fog, depth, expected):
    near(fog.transmittance(floats(depth)), expected)


@pytest.mark.parametrize("mode", ["linear", "exp", "exp2"])
def test_gradients(mode):
    fog = pf.Fog(0.3, mode, density=0.4, start=1, end=5)
    check_gradients(lambda both: both[0].transmittance(both[1]), (fog, floats(2.5)))


@pytest.mark.parametrize(
    "named, arguments",
    [
        ("color", dict(color=-1)),
        ("color", dict(color=(1, 1))),
        ("mode", dict(mode="GL_EXP")),
        ("density", dict(density=-0.1)),
        ("density", dict(density=math.nan)),
        ("start", dict(start=math.inf)),
        ("end", dict(mode="linear", start=2, end=2)),
    ],
)
def test_bad_fog(named, arguments):
    with pytest.raises(ValueError, match=f"^{named}: "):
        pf.Fog(**arguments)


def test_fog_is_mixed_in_by_depth_along_the_axis():
    # A plate across the view: all of it has the same depth, though not distance.
    camera = pf.PerspectiveCamera(9, 9, fov_y=60)
    surface = pf.shapes.plane(10, 10).mesh(1, 1)
    material = pf.Material(diffuse=0, ambient=(1, 0.5, 0))
    fog = pf.Fog((0, 0.2, 0.4), "exp", density=0.2)
    image = pf.render(pf.Scene(surface, camera, ambient=1, fog=fog), material)
    share = math.exp(-0.2 * 5)
    expected = share * np.array([1, 0.5, 0]) + (1 - share) * np.array([0, 0.2, 0.4])
    near(image, np.broadcast_to(expected, image.shape))
