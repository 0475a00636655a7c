"""Relighting compared: bases of the field, folders as they come, and the stand-in."""

import json
from pathlib import Path

import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions
from experiments import relighting
from experiments.relighting import LitPhotographs, Split, harmonics, polynomials, psnr
from phongfit.cli import run


def test_harmonics_are_orthonormal_over_the_hemisphere():
    rng = np.random.default_rng(0)
    turn, z = rng.uniform(0, 2 * np.pi, 200_000), rng.uniform(0, 1, 200_000)
    flat = np.sqrt(1 - z * z)
    values = harmonics(np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1), 3)
    assert values.shape[1] == 16
    product = 2 * np.pi * values.T @ values / len(z)
    np.testing.assert_allclose(product, np.eye(16), atol=0.03)


@pytest.mark.parametrize(
    "basis", [polynomials, lambda directions: harmonics(directions, 2)]
)
def test_what_a_basis_holds_is_predicted_exactly(basis):
    rng = np.random.default_rng(0)
    directions = np.asarray(spread_directions(40), float)
    values = basis(directions)
    images = (values @ rng.normal(size=(values.shape[1], 5 * 4 * 3))).reshape(
        -1, 5, 4, 3
    )
    data = Split(
        "exact",
        LitPhotographs(directions[:30], images[:30]),
        LitPhotographs(directions[30:], images[30:]),
        "linear",
    )
    np.testing.assert_allclose(
        relighting.predict_by_regression(basis, data), images[30:], atol=1e-9
    )


def test_ratio():
    assert psnr(np.full((2, 2, 3), 0.6), np.full((2, 2, 3), 0.5)) == pytest.approx(20)


def write(folder: Path, count: int, listed: int) -> None:
    folder.mkdir()
    for at in range(count):
        pf.write_image(folder / f"{at:02d}.png", np.full((4, 5, 3), at / 50), "linear")
    lines = [f"{folder.parent}/{at:02d}.png 0 {at + 1} 9" for at in range(listed)]
    (folder / "dirs.lp").write_text("\n".join([str(count), *lines]))


def test_folders_as_they_come(tmp_path):
    """A list that names more photographs than there are; every sixth is left out."""
    write(tmp_path / "coin", 20, 21)
    data = relighting.read(tmp_path / "coin")
    assert len(data.fitted.images) == 17 and len(data.left_out.images) == 3
    levels = np.round(50 * data.left_out.images[:, 0, 0, 0])
    np.testing.assert_array_equal(levels, [3, 9, 15])
    np.testing.assert_allclose(np.linalg.norm(data.fitted.directions, axis=1), 1)
    (tmp_path / "domed").mkdir()
    write(tmp_path / "domed" / "Dome", 8, 8)
    write(tmp_path / "domed" / "Test", 3, 3)
    domed = relighting.read(tmp_path / "domed")
    assert len(domed.fitted.images) == 8 and len(domed.left_out.images) == 3
    with pytest.raises(ValueError, match="expected an .lp file"):
        relighting.read_photographs(tmp_path)


@pytest.mark.extended
def test_maps_are_best_on_what_they_describe(tmp_path, capsys):
    out = tmp_path / "a.json"
    args = ["--small", "--picture", f"{tmp_path}/a.png", "--json", str(out)]
    assert run(relighting.main, args) == 0
    (found,) = json.loads(out.read_text()).values()
    assert set(found) == {"PTM", "HSH 2", "HSH 3", "maps", "maps, photographs"}
    assert found["PTM"] < found["HSH 2"] < found["HSH 3"] < found["maps"] - 3
    assert found["HSH 3"] < found["maps, photographs"] - 3
    assert "Mean PSNR" in capsys.readouterr().out
    assert (tmp_path / "a.png").stat().st_size > 10_000
