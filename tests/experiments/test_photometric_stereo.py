import json

import numpy as np
import pytest

from experiments.photometric_stereo import least_squares, main
from tests.maps.synthetic import make_stack, write_diligent


def test_a_matte_surface_by_least_squares():
    rng = np.random.default_rng(0)
    normals = np.concatenate(
        [rng.uniform(-0.3, 0.3, (4, 5, 2)), np.ones((4, 5, 1))], -1
    )
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    lights = np.array([[0.3, 0, 1], [-0.3, 0.2, 1], [0, -0.4, 1], [0.1, 0.1, 1]])
    light = np.einsum("kd,hwd->khw", lights, normals)[..., None] * [0.4, 0.5, 0.2]
    np.testing.assert_allclose(least_squares(light, lights), normals, atol=1e-12)


@pytest.mark.extended
def test_normals_are_nearer_than_those_of_least_squares(tmp_path, capsys):
    folder, numbers = tmp_path / "ball", tmp_path / "numbers.json"
    folder.mkdir()
    write_diligent(folder, make_stack(lights=24, ambient=0.0), brightness=0.8)
    picture = tmp_path / "picture.png"
    assert main(folder, picture=picture, json=numbers) == 0
    found = json.loads(numbers.read_text())
    assert found["photographs"] == 24 and picture.stat().st_size > 1000
    assert found["mean_angular_error"] < 1
    assert found["mean_angular_error"] < 0.3 * found["least_squares"]
    assert found["identified"] > 0.95 and found["lamps_in_a_plane"] == 0
    assert "mean angular error" in capsys.readouterr().out
    assert main(tmp_path / "nowhere") == 0
    assert "there is no folder" in capsys.readouterr().out
    with pytest.raises(ValueError, match="expected true normals"):
        main(tmp_path, picture=picture)
