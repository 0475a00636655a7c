import dataclasses
import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.specification import Specification, specified
from tests.fitting.scenes import ball, photograph, truth

TRUTH = truth()

OPTIONS = {
    "unknowns": ["diffuse", "shininess"],
    "known": pf.Material(0.0, 0.2, 32.0, (0.5, 0.4, 0.3)),
    "bounds": {"shininess": np.array([2.0, 90.0])},
    "fixed": {"diffuse.red": jnp.asarray(0.25)},
    "ties": {"diffuse.green": "diffuse.blue"},
    "priors": {"diffuse": (np.array([0.1, 0.2, 0.3]), 0.05)},
    "film": [pf.Film(bits=8), pf.Film()],
    "loss": "tukey",
}


def test_two_of_the_same_are_equal_however_they_were_written():
    asked = Specification(**OPTIONS)
    again = Specification(
        unknowns=("diffuse", "shininess"),
        known=pf.Material(0.0, 0.2, 32.0, (0.5, 0.4, 0.3)),
        bounds={"shininess": (2, 90)},
        fixed={"diffuse.red": 0.25},
        ties={"diffuse.green": (1, "diffuse.blue")},
        priors={"diffuse": ([0.1, 0.2, 0.3], 0.05)},
        film=(pf.Film(bits=8), pf.Film()),
        loss=pf.Tukey(),
    )
    assert asked == again
    assert asked.changed.keys() == OPTIONS.keys()
    # What was changed says it all.
    assert Specification(**asked.changed) == asked


MORE = {
    "per_image": ["scene.lights[0].intensity"],
    "unknowns": ["diffuse", "scene.lights[0].intensity"],
    "bounds": {"diffuse": (0, np.inf)},
    "uncertain": {
        "scene.lights[0].direction": 0.01,
        ("scene.lights[1].position", "scene.lights[1].attenuation"): np.eye(6) / 8,
    },
    "film": pf.Film(
        encoding=pf.ResponseCurve((0, 0.2, 1)),
        jpeg=pf.rendering.JpegCompression.at_quality(80),
    ),
    "loss": pf.Huber(),
    "max_steps": 7,
    "tolerance": 1e-5,
}


NESTED = {
    "priors": {
        "diffuse": (((0.5, 0.4, 0.3), (0.1, 0.2, 0.3)), 0.05),
        "specular": ((0.1, 0.2, 0.3), np.array([0.01, 0.02, 0.03])),
    }
}


@pytest.mark.parametrize("options", [{}, OPTIONS, MORE, NESTED])
def test_it_is_written_and_read_as_json(options):
    asked = Specification(**options)
    assert Specification.from_dict(json.loads(json.dumps(asked.to_dict()))) == asked


@pytest.mark.parametrize(
    "data, words",
    [
        ({"unknown": []}, "\"unknown\" is no key of it; did you mean 'unknowns'"),
        ({"max_steps": "x"}, 'max_steps: expected a valid integer, got "x"'),
        ({"film": {"bits": 99}}, "film: bits: expected None or 1 … 16, got 99"),
        ({"loss": "square"}, "loss: expected 'linear', .*, got \"square\""),
        ({"noise": 0.1}, "noise: expected none"),
        (3, "the file: expected"),
    ],
)
def test_json_that_it_is_not(data, words):
    with pytest.raises(ValueError, match=words):
        Specification.from_dict(data)


def test_what_json_cannot_hold():
    with pytest.raises(ValueError, match="loss: expected one of .*, got Huber"):
        Specification(loss=pf.Huber(3.0)).to_dict()
    with pytest.raises(ValueError, match="known: diffuse: expected shape"):
        Specification(known=pf.Material(np.ones((2, 3)))).to_dict()


@pytest.mark.parametrize("name", OPTIONS)
def test_each_of_them_counts(name):
    options = {name: OPTIONS[name]}
    if name in ("fixed", "ties", "priors"):
        options["unknowns"] = OPTIONS["unknowns"]
    asked = Specification(**options)
    assert asked != Specification()
    assert asked.asks_as_usual == (name in ("film", "loss"))


def test_nothing_was_asked():
    assert Specification().changed == {} and Specification().asks_as_usual


def test_a_loss_of_none_is_the_default():
    assert Specification(loss=None) == Specification()
    asked = Specification(loss="tukey")
    assert specified(asked, {"loss": None, "film": None}, "") == asked


def test_a_functions_own_defaults_stay_beside_a_specification():
    own = Specification(loss="cauchy", max_steps=20)
    asked = Specification(unknowns=("diffuse",), film=pf.Film())
    found = specified(asked, {"film": None}, "", own)
    assert found == Specification(unknowns=("diffuse",), loss="cauchy", max_steps=20)
    assert specified(Specification(loss="tukey"), {}, "", own).loss == pf.Tukey()


def test_a_tolerance_that_is_an_array_becomes_a_number():
    asked = Specification(tolerance=jnp.asarray(0.25))  # pyright: ignore
    assert type(asked.tolerance) is float and asked.tolerance == 0.25


def test_it_stays_as_it_is():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Specification().loss = pf.Tukey()  # pyright: ignore


@pytest.mark.parametrize(
    "options, words",
    [
        (
            {"unknowns": "diffuse"},
            "unknowns: expected a list of names or None, got 'diffuse'",
        ),
        ({"unknowns": ()}, "unknowns: expected .*, got none"),
        ({"unknowns": None}, "unknowns: expected .*, got none"),
        ({"unknowns": (3,)}, r"unknowns: expected a list of names .*, got \(3,\)"),
        (
            {"unknowns": ("diffuse", "diffuse")},
            "unknowns: expected each name once, got diffuse",
        ),
        (
            {"per_channel": ("gloss",)},
            "per_channel: expected one of ambient.*got 'gloss'",
        ),
        ({"per_image": ("diffuse",)}, "per_image: expected an array of.*got 'diffuse'"),
        ({"loss": "square"}, "loss: expected .*, got 'square'"),
        ({"tolerance": 0.0}, "tolerance: expected a number in .*, got 0.0"),
        ({"tolerance": "x"}, "tolerance: expected a number or None, got 'x'"),
    ],
)
def test_errors_name_the_argument(options, words):
    with pytest.raises(ValueError, match=words):
        Specification(**options)


def test_a_fit_knows_what_it_was_asked():
    scene = ball()
    image = photograph(scene, TRUTH)
    asked = Specification(bounds={"shininess": (2, 90)}, known=TRUTH, loss="linear")
    fit = pf.fit(scene, image, **asked.changed)
    assert fit.specification == asked
    again = pf.fit(scene, image, asked)
    assert again.specification == asked and again.labels == fit.labels
    np.testing.assert_array_equal(again.values, fit.values)
    # A coarser solution takes fewer steps, and is within the errors.
    coarse = pf.fit(scene, image, asked, tolerance=0.01)
    assert coarse.converged and coarse.steps < fit.steps
    assert coarse.problem.tolerance == 0.01
    # An option beside it replaces its own.
    fewer = pf.fit(scene, image, asked, unknowns=("diffuse",))
    assert fewer.specification == dataclasses.replace(asked, unknowns=("diffuse",))
    # And is itself, whatever it is compared with.
    assert fit == fit and fit != asked and len({fit}) == 1
    assert fit.films == (pf.Film(),) and fit.loss == "Linear"


def test_a_misspelt_option_is_named():
    wrong: dict[str, Any] = {"unknown": ()}
    with pytest.raises(TypeError, match="predict_errors.*'unknown', expected one of"):
        pf.predict_errors(ball(), TRUTH, 0.01, **wrong)
    with pytest.raises(TypeError, match="'unknown'"):
        pf.fit(ball(), np.zeros((32, 32, 3)), unknown=())  # pyright: ignore
    words = r"^Specification\(\) got .*'unknown', expected one of unknowns, per_ch"
    with pytest.raises(TypeError, match=words):
        Specification(unknown=())  # pyright: ignore
    with pytest.raises(ValueError, match="specification: expected a Specification"):
        pf.fit(ball(), np.zeros((32, 32, 3)), {"unknowns": ()})  # pyright: ignore
