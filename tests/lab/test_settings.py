"""What the page may send, and what it is built from."""

import json

import pytest

from phongfit.files.records import parse_record
from phongfit.lab.settings import (
    FitRequest,
    PictureRequest,
    Settings,
    TargetRequest,
    describe_settings,
    matters,
)
from phongfit.material import PRESETS
from tests.helpers import said


@pytest.mark.parametrize(
    "kind, sent, words",
    [
        (
            Settings,
            {"diffuse": [0.1, 0.2, 1.3]},
            "diffuse[2]: expected less than ... got 1.3",
        ),
        (Settings, {"diffuse": [0.1, 0.2]}, "diffuse"),
        (Settings, {"diffuse": "red"}, "diffuse"),
        (
            Settings,
            {"shininess": 0},
            "shininess: expected greater than or equal to 1 ... got 0",
        ),
        (
            Settings,
            {"light": "sun"},
            "light: expected 'none', 'directional' ... got \"sun\"",
        ),
        (Settings, {"lihgt": "spot"}, "did you mean 'light'?"),
        (Settings, {"surface": "x" * 1000}, "surface"),
        (PictureRequest, {}, "settings: is missing"),
        (TargetRequest, {"settings": {}, "noise": -1}, "noise: expected ... got -1"),
        (FitRequest, {"settings": {}}, "target: is missing"),
        (
            FitRequest,
            {"settings": {}, "target": "", "options": {"loss": "lad"}},
            "options.loss",
        ),
    ],
)
def test_what_is_refused(kind, sent, words):
    with pytest.raises(ValueError) as caught:
        parse_record(json.dumps(sent), kind)
    assert said(words, str(caught.value)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"settings": NaN}'])
def test_no_record_at_all(text):
    with pytest.raises(ValueError):
        parse_record(text, PictureRequest)


@pytest.mark.parametrize(
    "settings, without",
    [
        (Settings(), {"cutoff", "distance", "tilt", "radius"}),
        (Settings(light="none"), {"azimuth", "intensity", "cutoff", "turn"}),
        (Settings(light="spot", surface="mesh"), {"centre_x"}),
    ],
)
def test_what_matters(settings, without):
    assert {*matters(settings)} & without == set()
    assert {"ambient_light", "shading", "diffuse"} <= {*matters(settings)}
    assert ("tilt" in matters(settings)) == (settings.surface == "mesh")


def test_what_the_page_is_built_from():
    about = describe_settings()
    # What the page sends back when nothing was touched is what was described.
    defaults = {k: field["default"] for k, field in about["settings"].items()}
    assert parse_record(json.dumps(defaults), Settings) == Settings()
    assert tuple(about["presets"]) == PRESETS
    for preset in about["presets"].values():
        Settings.model_validate(preset)
    for name, field in about["settings"].items():
        if name == "surface":
            continue
        assert field["title"] and field["group"]
        if field["type"] == "number":
            assert field["minimum"] <= field["default"] <= field["maximum"]
            assert field["step"] > 0
        for other, values in field.get("only", {}).items():
            assert set(values) <= set(about["settings"][other]["enum"])
