import numpy as np
import pytest

from phongfit.maps.handedness import is_mirrored


def bumps(size: int = 96) -> np.ndarray:
    """Unit normals of a dome with a wave on it, x right and y up."""
    x, y = np.meshgrid(np.linspace(-1, 1, size), np.linspace(1, -1, size))
    slopes = [
        -0.8 * x + 0.5 * np.cos(5 * x + 2 * y),
        -0.8 * y + 0.2 * np.cos(5 * x + 2 * y),
    ]
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(x)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_normals_of_a_mirrored_list_of_lights(noise):
    rng = np.random.default_rng(0)
    normals = bumps() + noise * rng.normal(size=(96, 96, 3))
    known = np.ones((96, 96), bool)
    known[:, 40:45] = False
    assert not is_mirrored(normals, known)
    for mirror in ([1, -1, 1], [-1, 1, 1]):
        assert is_mirrored(normals * mirror, known)
    # Turned by half a circle they are those of another surface: a hollow.
    assert not is_mirrored(normals * [-1, -1, 1], known)


def test_what_is_no_surface_is_not_mirrored():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(40, 40, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    everywhere = np.ones((40, 40), bool)
    assert not is_mirrored(normals, everywhere)
    assert not is_mirrored(np.zeros((40, 40, 3)), everywhere)
    assert not is_mirrored(bumps(40) * [1, -1, 1], ~everywhere)
