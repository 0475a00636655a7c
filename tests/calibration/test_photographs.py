"""Real spheres, where the photographs are."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import main
from phongfit.files.capture_data import open_captured
from phongfit.files.images import read_mask
from tests.calibration.studio import degrees
from tests.helpers import photographs

ROOT = Path(__file__).parents[2]


@pytest.mark.extended
def test_two_chrome_spheres_agree():
    """Lamps of one capture by either sphere, which stand apart in the room."""
    folder = photographs("psbox")
    found = []
    for probe in ("LightProbe-1", "LightProbe-2"):
        capture = pf.open_capture(folder / probe)
        x, up, radius = np.loadtxt(folder / probe / "circle_data.txt")
        # Counted from the lower left corner.
        circle = (x, capture[0].shape[0] - up, radius)
        lamps = pf.calibrate(capture, chrome=[circle]).lamps
        found.append([lamp.direction for lamp in lamps])
    apart = degrees(*found)
    assert len(apart) == 12
    assert apart.mean() < 1.0


@pytest.mark.extended
def test_a_chrome_sphere_is_found():
    """And nothing else: noise and the tripod have circles as well."""
    folder = photographs("psbox") / "LightProbe-1"
    x, up, radius = np.loadtxt(folder / "circle_data.txt")
    capture = pf.open_capture(folder)
    (sphere,) = pf.calibrate(capture).spheres
    given = (x, capture[0].shape[0] - up, radius)
    assert sphere.kind == "chrome"
    np.testing.assert_allclose(sphere.outline, given, atol=4)


@pytest.mark.extended
def test_a_sphere_with_half_an_outline_is_suggested():
    folder = photographs("uw_spheres")
    capture = pf.open_capture(folder / "chrome", "linear")
    with pytest.raises(ValueError, match="no sphere is seen .* perhaps ") as refused:
        pf.calibrate(capture)
    words = str(refused.value).partition("perhaps ")[2].partition(" or ")[0]
    suggested = [float(number) for number in words.split()]
    np.testing.assert_allclose(suggested, outline(folder, "chrome"), atol=2)


@pytest.mark.slow
def test_strengths_of_lamps_from_the_object_itself(tmp_path, monkeypatch):
    """As the guide finds them, by either half of the pixels."""
    page = (ROOT / "docs/how-to/capture.md").read_text(encoding="utf-8")
    code = re.search(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert code is not None
    shutil.copytree(ROOT / "docs/how-to/psbox", tmp_path / "psbox")
    monkeypatch.chdir(tmp_path)
    command = "calibrate psbox/chrome -o out/lights --encoding srgb --sphere"
    assert main([*command.split(), "114", "119", "105"]) == 0
    whole = "mask = images.max(axis=(0, 3)) > 0.1\n"
    assert whole in code[1]
    found = []
    for half in (0, 1):
        # Tiles, as neighbours err alike.
        tiles = "sum(np.indices(mask.shape) // 16) % 2"
        some = f"{whole}mask &= {tiles} == {half}\n"
        names: dict[str, Any] = {}
        exec(code[1].replace(whole, some), names)
        found.append(names["maps"].strengths.values)
    assert len(found[0]) == 12 and np.ptp(found[0]) > 0.5
    assert np.abs(found[0] / found[1] - 1).max() < 0.015


def outline(folder, name):
    """A sphere's circle, by its mask."""
    mask = read_mask(folder / name / f"{name}.mask.png")
    rows, columns = np.nonzero(mask)
    radius = float((mask.sum() / np.pi) ** 0.5)
    return float(columns.mean()) + 0.5, float(rows.mean()) + 0.5, radius


@pytest.mark.extended
def test_a_matte_sphere_has_no_highlight_under_the_lamps_of_a_chrome_one(tmp_path):
    folder = photographs("uw_spheres")
    capture = pf.open_capture(folder / "chrome", "linear")
    found = pf.calibrate(
        capture,
        chrome=[outline(folder, "chrome")],
        names=[name.replace("chrome", "gray") for name in capture.names],
    )
    pf.save_calibration(tmp_path / "lights.json", found)
    data = open_captured(
        folder / "gray",
        "linear",
        sphere=outline(folder, "gray"),
        lights=tmp_path,
        room_light=0.0,
    ).load()
    some = np.zeros(data.images[0].shape[:2], bool)
    some[::12, ::12] = True
    fit = pf.fit(
        data.scenes,
        data.images,
        mask=[mask & some for mask in data.masks],
        film=data.film,
        unknowns=("diffuse", "specular", "shininess", "exposure"),
        per_channel=("diffuse",),
        fixed={"exposure[0]": 1.0},
        uncertain=data.uncertain,
    )
    value, error = (
        dict(zip(fit.labels, numbers, strict=True))["specular"]
        for numbers in (fit.values, fit.errors)
    )
    assert value < 1.5 * error and error < 0.5


@pytest.mark.extended
def test_a_chrome_and_a_matte_sphere_agree():
    folder = photographs("uw_spheres")
    found = []
    for name in ("chrome", "gray"):
        capture = pf.open_capture(folder / name, "linear")
        circle = outline(folder, name)
        if name == "chrome":
            lamps = pf.calibrate(capture, chrome=[circle]).lamps
        else:
            lamps = pf.calibrate(capture, matte=circle).lamps
        found.append([lamp.direction for lamp in lamps])
    assert degrees(*found).mean() < 2.2


@pytest.mark.parametrize(
    "name, lamps, given",
    [
        ("capture00", "distant", True),
        ("capture01", "near", True),
        ("capture01", "near", False),
    ],
)
def test_captures_rendered_by_another_program(name, lamps, given):
    """Twelve lamps, two chrome spheres and a matte one; sRGB in JPEG of quality 95."""
    folder = photographs(f"../reference/capture/{name}")
    truth = json.loads((folder / "truth.json").read_text())
    circles = [
        (kind["pixels"]["x"], kind["pixels"]["y"], kind["pixels"]["radius"])
        for kind in truth["spheres"]
    ]
    options = {"chrome": circles[:2], "matte": circles[2]} if given else {}
    capture = pf.open_capture(folder)
    found = pf.calibrate(capture, fov=14, sphere_radius=0.6, lamps=lamps, **options)
    apart = degrees(
        [lamp.direction for lamp in found.lamps],
        [lamp["direction"] for lamp in truth["lamps"]],
    )
    stated = np.array([lamp.direction_error for lamp in found.lamps])
    # What the guide to captures says of them.
    assert apart.max() < 0.5 and np.mean(apart) < 0.1
    assert np.sqrt(np.mean((apart / stated) ** 2)) < 1.3
    ratio = np.array([lamp.intensity.mean() for lamp in found.lamps]) / [
        lamp["intensity"] for lamp in truth["lamps"]
    ]
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.003
    if lamps == "near":
        # The camera stands at (0, 0, 20) of the truth's axes.
        places = np.array([lamp["position"] for lamp in truth["lamps"]])
        seen = np.array([lamp.position for lamp in found.lamps]) + [0, 0, 20]
        far = np.linalg.norm(places, axis=1)
        assert (np.linalg.norm(seen - places, axis=1) / far).max() < 0.007
        # Its light falls off as 2 / (1 + d²), not as 1 / d².
        assert found.falloff == pytest.approx(0.5, abs=0.05)
    for sphere in found.spheres:
        nearest = min(np.abs(np.subtract(sphere.outline, one)).max() for one in circles)
        assert nearest < 1
