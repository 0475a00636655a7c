"""What tests of the commands share: data sets that a command made, and no cache."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import main
from tests.maps.normals.scenes import hide


@pytest.fixture(autouse=True)
def _no_cache(monkeypatch):
    """Tests leave nothing in the cache of whoever runs them."""
    monkeypatch.setenv("PHONGFIT_CACHE", "off")


@pytest.fixture(scope="session")
def brass(tmp_path_factory) -> Path:
    """Three photographs of brass, 24 × 24 pixels, which nothing may change."""
    folder = tmp_path_factory.mktemp("data") / "brass"
    options = ["--material", "preset:brass", "--resolution", "24", "--lights", "3"]
    assert main(["synth", str(folder), *options, "--noise", "0.01"]) == 0
    return folder


@pytest.fixture(scope="session")
def fitted(brass, tmp_path_factory) -> Path:
    """The folder of a fit of them, which nothing may change."""
    folder = tmp_path_factory.mktemp("fits") / "fit"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHONGFIT_CACHE", "off")
        assert main(["fit", str(brass), "-o", str(folder), "--report", "none"]) == 0
    return folder


@pytest.fixture
def copy(brass, tmp_path) -> Path:
    """A copy of the data set that a test may break."""
    return Path(shutil.copytree(brass, tmp_path / "copy"))


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """Photographs of something, and their list of lights; what it is, too."""
    folder = tmp_path_factory.mktemp("capture")
    hidden = hide(surface="dome")
    names = [f"{k:02d}.png" for k in range(24)]
    directions = []
    for name, image, scene in zip(names, hidden.images, hidden.scenes, strict=True):
        # As bright as the strongest channel of the lamps: a list knows no strengths.
        pf.write_image(folder / name, image / [1.0, 0.9, 0.8], "linear", 16)
        (lamp,) = scene.lights
        assert isinstance(lamp, pf.DirectionalLight)
        directions.append(np.asarray(lamp.direction))
    pf.write_lp(folder / "dome.lp", names, np.array(directions))
    return folder, hidden
