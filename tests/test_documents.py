"""README and CONTRIBUTING: their code runs, and what they point to is there.

The rest of the documentation is held by `test_documentation`.
"""

import contextlib
import importlib.util
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from tests.helpers import check_light, check_specular, check_surface

as_users_run_it = pytest.mark.skipif(
    jnp.result_type(float) == jnp.float64, reason="runs in float32 alone"
)
ROOT = Path(__file__).parents[1]
EXTENDING = "docs/how-to/extending.md"
DOCUMENTS = {name: ROOT / name for name in ("README.md", "CONTRIBUTING.md", EXTENDING)}


def blocks(name: str, language: str) -> list[str]:
    """The code in a document, block after block."""
    text = DOCUMENTS[name].read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def run(name: str) -> dict[str, Any]:
    """What the Python blocks of a document define, run from top to bottom."""
    names: dict[str, Any] = {}
    for block in blocks(name, "python"):
        exec(compile(block, name, "exec"), names)
    return names


@pytest.fixture(scope="module")
def extending(tmp_path_factory) -> dict[str, Any]:
    with contextlib.chdir(tmp_path_factory.mktemp("extending")):
        return run(EXTENDING)


@as_users_run_it
def test_the_first_fit(capsys):
    (block,) = blocks("README.md", "python")
    assert len(block.splitlines()) <= 10
    found = run("README.md")
    fit, truth = found["fit"], found["truth"]
    assert "shininess" in capsys.readouterr().out
    assert fit.converged
    np.testing.assert_allclose(fit.material.shininess, truth.shininess, rtol=1e-3)
    np.testing.assert_allclose(fit.material.diffuse, truth.diffuse, atol=1e-4)


@as_users_run_it
def test_a_light(extending):
    check_light(extending["Candle"]((1.0, 2.0, 3.0), (1.0, 0.5, 0.2), 2.0))
    image = np.asarray(pf.render(extending["scene"], pf.Material()))
    assert image.max() > 2 * np.median(image[image > 0])
    with pytest.raises(ValueError, match="position"):
        extending["Candle"](1.0)


@as_users_run_it
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


@as_users_run_it
def test_a_specular_model(extending):
    check_specular(extending["SphericalGaussian"]())


@as_users_run_it
def test_a_specular_model_with_a_number_of_its_own(extending):
    rim = extending["found"]["scene.specular_model.rim"]
    assert rim.error > 0 and abs(rim.value - 10) < 0.5
    scene = extending["coated"]
    assert float(scene.specular_model.rim) == 10


@as_users_run_it
def test_a_loss(extending):
    fit, truth = extending["fit"], extending["truth"]
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
    assert commands[1].endswith(".venv/bin/python -m tests")


def test_one_version_everywhere():
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {pf.__version__}\n" in cited
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\n## {pf.__version__}\n" in changes
