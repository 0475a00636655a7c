"""README and CONTRIBUTING: their code runs, and what they point to is there.

The rest of the documentation is held by `test_documentation`.
"""

import contextlib
import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from tests.helpers import check_light, check_specular, check_surface

ROOT = Path(__file__).parents[1]
EXTENDING = "docs/how-to/extending.md"
DOCUMENTS = {name: ROOT / name for name in ("README.md", "CONTRIBUTING.md", EXTENDING)}


def blocks(name: str, language: str) -> list[str]:
    """The code in a document, block after block."""
    text = DOCUMENTS[name].read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def run(name: str, *, fits: bool = True) -> dict[str, Any]:
    """What the Python blocks of a document define, run from top to bottom.

    `fits`: also the blocks that make a fit.
    """
    names: dict[str, Any] = {}
    for block in blocks(name, "python"):
        if fits or "pf.fit(" not in block:
            exec(compile(block, name, "exec"), names)
    return names


@pytest.fixture(scope="module")
def extending(tmp_path_factory) -> dict[str, Any]:
    with contextlib.chdir(tmp_path_factory.mktemp("extending")):
        return run(EXTENDING, fits=False)


@pytest.fixture(scope="module")
def extending_with_fits(tmp_path_factory) -> dict[str, Any]:
    with contextlib.chdir(tmp_path_factory.mktemp("extending_with_fits")):
        return run(EXTENDING)


def test_the_first_fit(capsys):
    (block,) = blocks("README.md", "python")
    assert len(block.splitlines()) <= 10
    found = run("README.md")
    fit, truth = found["fit"], found["truth"]
    assert "shininess" in capsys.readouterr().out
    assert fit.converged
    np.testing.assert_allclose(fit.material.shininess, truth.shininess, rtol=1e-3)
    np.testing.assert_allclose(fit.material.diffuse, truth.diffuse, atol=1e-4)


def test_a_light(extending):
    check_light(extending["Candle"]((1.0, 2.0, 3.0), (1.0, 0.5, 0.2), 2.0))
    image = np.asarray(pf.render(extending["scene"], pf.Material()))
    assert image.max() > 2 * np.median(image[image > 0])
    with pytest.raises(ValueError, match="position"):
        extending["Candle"](1.0)


def test_a_surface(extending):
    camera = extending["above"]
    small = pf.PerspectiveCamera(
        4, 3, position=camera.position, rotation=camera.rotation
    )
    check_surface(extending["Floor"](), small)
    image = np.asarray(pf.render(extending["floor"], pf.Material()))
    # Lightest under the candle, which is in the middle.
    middle = image[8, 12].mean()
    assert middle > 2 * image[0].mean() and middle > 2 * image[-1].mean()


def test_a_specular_model(extending):
    check_specular(extending["SphericalGaussian"]())


@pytest.mark.extended
def test_a_specular_model_with_a_number_of_its_own(extending_with_fits):
    rim = extending_with_fits["found"]["scene.specular_model.rim"]
    assert rim.error > 0 and abs(rim.value - 10) < 0.5
    scene = extending_with_fits["coated"]
    assert float(scene.specular_model.rim) == 10


@pytest.mark.extended
def test_a_loss(extending_with_fits):
    fit, truth = extending_with_fits["fit"], extending_with_fits["truth"]
    assert fit.converged and fit.loss == "Geman"
    # Least squares would be 0.01 off.
    np.testing.assert_allclose(fit.material.diffuse, truth.diffuse, atol=0.002)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_what_they_point_to_is_there(name):
    text = DOCUMENTS[name].read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("https://") or (ROOT / target).exists(), target
    for module in re.findall(r"python -m ([\w.]+)", text):
        if module != "venv":
            assert importlib.util.find_spec(module) is not None, module
    for path in re.findall(
        r"`((?:phongfit|tests|experiments|data_synth)/[^`]*)`", text
    ):
        assert (ROOT / path).exists(), path
    references = set(re.findall(r"\[([^\]\n]+)\](?!\(|:|\[)", text))
    defined = set(re.findall(r"^\[([^\]]+)\]: https://", text, re.MULTILINE))
    assert defined <= references


def test_two_commands():
    lines = DOCUMENTS["README.md"].read_text(encoding="utf-8").splitlines()
    commands = [line for line in lines if line.startswith("python3 -m venv")]
    assert len(commands) == 2
    assert commands[0].endswith(".venv/bin/python -m experiments.recover_material")
    assert commands[1].endswith(".venv/bin/pytest")


def test_one_version_everywhere():
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {pf.__version__}\n" in cited
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\n## {pf.__version__}\n" in changes
