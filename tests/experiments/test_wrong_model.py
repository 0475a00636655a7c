import numpy as np
import pytest

from experiments.wrong_model import DIAGNOSTICS, EXPERIMENT, PARAMETERS, TRUTH

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module")
def outcomes(found):
    return found(EXPERIMENT).numbers


def bias(outcome, leaf):
    return outcome["bias"][PARAMETERS.index(leaf)]


def test_the_right_model_is_fine(found, outcomes):
    assert not found(EXPERIMENT).failed_checks
    right = outcomes["none"]
    assert right["flags"] == () and not right["misled"]
    assert right["chi_squared"] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    "mistake",
    [
        "the same, lamps far apart",
        "Gouraud for Phong",
        "lamp missing",
        "lamp 4° off",
        "sRGB read as linear",
        "linear read as sRGB",
        "shadow left out",
        "clamp left out",
    ],
)
def test_mistakes_that_mislead_and_are_given_away(outcomes, mistake):
    outcome = outcomes[mistake]
    # A shadow is so plain a misfit that the errors, widened by it, cover the bias.
    assert outcome["misled"] == (mistake != "shadow left out")
    assert {"χ²", "neighbours"} <= set(outcome["flags"]) <= set(DIAGNOSTICS)
    assert outcome["chi_squared"] > 1.15 and outcome["correlation"] > 0.1


def test_what_the_mistakes_do(outcomes):
    f = float(TRUTH.shininess)
    # Phong's exponent is about a quarter of Blinn's.
    assert 0.2 * f < f + bias(outcomes["Phong for Blinn"], "shininess") < 0.35 * f
    # A wrong encoding drags the exponent away, and ρ_a to its bound.
    assert bias(outcomes["sRGB read as linear"], "shininess") < -0.5 * f
    assert {"bound", "warning"} <= set(outcomes["sRGB read as linear"]["flags"])
    # Light of a lamp that is not in the model looks like ambient light.
    assert bias(outcomes["lamp missing"], "ambient") > 0.1
    assert bias(outcomes["shadow left out"], "diffuse") < -0.02
    assert bias(outcomes["clamp left out"], "specular") < -0.02


def test_what_no_diagnostic_shows(found, outcomes):
    """The experiment says so."""
    brighter = outcomes["lamp 10 % too bright"]
    assert brighter["flags"] == () and brighter["misled"]
    for leaf in ("diffuse", "specular"):
        expected = float(np.asarray(getattr(TRUTH, leaf))) * (1 / 1.1 - 1)
        assert bias(brighter, leaf) == pytest.approx(expected, abs=0.01)
    answer = found(EXPERIMENT).answer
    for name, outcome in outcomes.items():
        hidden = outcome["misled"] and not outcome["flags"]
        assert (f"Nothing shows {name!r}" in answer) == hidden
