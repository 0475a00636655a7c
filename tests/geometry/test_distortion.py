import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.testing import check_gradients
from tests.helpers import floats, near

LENSES = [
    pf.geometry.BrownDistortion(),
    pf.geometry.BrownDistortion(-0.3, 0.1, 0.001, -0.002),
    pf.geometry.BrownDistortion(0.4, 0.1, 0.01, -0.02, 0.02),
    # Folds at a radius of 1.3: well beyond what is asked for.
    pf.geometry.BrownDistortion(0.5, -0.2),
    pf.geometry.BrownDistortion(0.3, 0.1, 0, 0, 0.02, 0.1, 0.05, 0.01),
    pf.geometry.FisheyeDistortion(),
    pf.geometry.FisheyeDistortion(0.05, -0.01, 0.002, 0.001),
]


@eqx.filter_jit
def there_and_back(lens, directions):
    return jax.vmap(lambda to: lens.direction(lens.place(to)))(directions)


@pytest.mark.parametrize("lens", LENSES)
def test_a_place_shows_the_direction_whose_image_it_is(lens):
    grid = np.linspace(-0.8, 0.8, 9)
    x, y = (values.ravel() for values in np.meshgrid(grid, grid))
    directions = np.stack([x, y, np.ones_like(x)], axis=-1)
    found, some = there_and_back(lens, floats(3 * directions))
    assert np.all(some)
    length = np.linalg.norm(directions, axis=-1, keepdims=True)
    near(found / np.linalg.norm(found, axis=-1, keepdims=True), directions / length)


# By hand: x, y, z, then the place.
@pytest.mark.parametrize(
    "lens, direction, place",
    [
        (pf.geometry.BrownDistortion(), (1, 2, 4), (0.25, 0.5)),
        (pf.geometry.BrownDistortion(0.1), (1, 0, 1), (1.1, 0)),
        (pf.geometry.BrownDistortion(0, 0.1), (0, 2, 1), (0, 5.2)),
        (pf.geometry.BrownDistortion(k3=0.1), (0, 2, 1), (0, 2 * 7.4)),
        (pf.geometry.BrownDistortion(p1=0.1), (1, 1, 1), (1.2, 1.4)),
        (pf.geometry.BrownDistortion(p2=0.1), (1, 1, 1), (1.4, 1.2)),
        (pf.geometry.BrownDistortion(k4=1.0), (1, 0, 2), (0.4, 0)),
        (pf.geometry.FisheyeDistortion(), (1, 0, 1), (np.pi / 4, 0)),
        (pf.geometry.FisheyeDistortion(), (0, 3, 0), (0, np.pi / 2)),
        (pf.geometry.FisheyeDistortion(), (0, -1, -1), (0, -3 * np.pi / 4)),
        (pf.geometry.FisheyeDistortion(1.0), (1, 0, 0), (np.pi / 2 + np.pi**3 / 8, 0)),
        (pf.geometry.FisheyeDistortion(1.0), (0, 0, 2), (0, 0)),
    ],
)
def test_places(lens, direction, place):
    near(lens.place(floats(direction)), place, 1e-6)


def test_beside_and_behind_a_fisheye():
    directions = np.array([(1, 0, 0), (0.3, 0.4, -1), (0, 0, 1)], float)
    found, some = there_and_back(
        pf.geometry.FisheyeDistortion(0.05, 0.01), floats(directions)
    )
    assert np.all(some)
    near(found, directions / np.linalg.norm(directions, axis=1, keepdims=True), 1e-5)


@pytest.mark.parametrize(
    "lens, order",
    [
        (LENSES[6], 1),
        pytest.param(LENSES[2], 2, marks=pytest.mark.extended),
        pytest.param(LENSES[6], 2, marks=pytest.mark.extended),
    ],
)
def test_derivatives(lens, order):
    """Of the inverse, which Newton's method finds."""

    def seen(both):
        lens, places = both
        return jax.vmap(lambda place: lens.direction(place)[0])(places)

    places = floats([(0.3, -0.2), (0.05, 0.4)])
    check_gradients(seen, (lens, places), order=order)


@pytest.mark.parametrize("lens", [LENSES[2], LENSES[6]])
def test_in_the_middle_nothing_is_bent(lens):
    slope = jax.jit(jax.jacfwd(lambda place: lens.direction(place)[0]))
    near(slope(jnp.zeros(2)), np.eye(3)[:, :2])


def test_past_the_fold_there_is_no_direction():
    lens = pf.geometry.BrownDistortion(-1 / 3)
    places = floats([(0.66, 0), (0.67, 0), (5, 5)])
    _, some = jax.jit(jax.vmap(lambda place: lens.direction(place)))(places)
    assert some.tolist() == [True, False, False]


def test_past_the_fold_there_is_no_image():
    """Also where it is folded twice, and back into the picture."""
    lens = pf.geometry.BrownDistortion(-0.9)
    x = [0.3, 0.6, 0.62, 1.0, 1.5]
    places = jax.vmap(lens.place)(floats([(each, 0, 1) for each in x]))
    assert np.isfinite(places).all(axis=1).tolist() == [True] * 2 + [False] * 3
    matrix = np.array([[820.0, 0, 331], [0, 790, 219], [0, 0, 1]])
    camera = pf.geometry.camera_from_opencv(
        matrix, width=640, height=480, distortion=(-0.9, 0, 0, 0)
    )
    assert np.isnan(camera.project(floats((1.0, 0, 1)))).all()
    near(camera.project(floats((0.3, 0, 1))), (331.5 + 820 * 0.2757, 219.5), 1e-5)
