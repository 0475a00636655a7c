"""What tests of the commands share: data sets that a command made, and no cache."""

import shutil
from pathlib import Path

import pytest

from phongfit.cli import main


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
