"""What reports print to read photographs again: public names, and the same data."""

import ast
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.commands.data import DataOptions, read_data
from phongfit.commands.fit import loading_lines
from tests.calibration.studio import directions

LAMPS = directions(2)
CIRCLE = (27.0, 20.0, 15.0)
ONE, SEVERAL = ("scene", "image", "mask"), ("scenes", "images", "masks")
GAMMA = [(k / 16) ** 1.8 for k in range(17)]


def check_public(program: str) -> None:
    """Every name of ours that a program uses is one of `phongfit`'s public names."""
    for node in ast.walk(ast.parse(program)):
        if isinstance(node, ast.ImportFrom):
            assert node.module is not None and not node.module.startswith("phongfit")
        if isinstance(node, ast.Import):
            assert not any(one.name.startswith("phongfit.") for one in node.names)
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "pf":
            assert node.attr in dir(pf), node.attr


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two photographs of a ball, a mask, a response, and a scene file that lists them.

    DiLiGenT's layout has the same photographs.
    """
    folder = tmp_path_factory.mktemp("ball")
    camera = pf.OrthographicCamera(48, 40, view_height=40 / 15)
    surface = pf.Sphere(((27 - 24) / 15, 0, 0), 1.0)
    lights = [pf.DirectionalLight(lamp) for lamp in LAMPS]
    scenes = [pf.Scene(surface, camera, light, ambient=1.0) for light in lights]
    images = [pf.render(scene, pf.preset("ruby")) for scene in scenes]
    for number, image in enumerate(images, 1):
        for suffix in ("png", "jpg"):
            pf.write_image(folder / f"{number}.{suffix}", image, "srgb")
    half = np.zeros((40, 48))
    half[:, :24] = 1
    pf.write_image(folder / "half.mask.png", half, "linear")
    everything = dataclasses.replace(scenes[0], lights=tuple(lights))
    pf.save_scene(folder / "both.json", everything, film=pf.Film(encoding="srgb"))
    scene = json.loads((folder / "both.json").read_text())
    listed = [{"file": "1.png", "lights": [0]}, {"file": "2.png", "lights": [1]}]
    (folder / "listed.json").write_text(json.dumps(scene | {"images": listed}))
    (folder / "set").mkdir()
    for name in ("1.png", "2.png"):
        (folder / "set" / name).write_bytes((folder / name).read_bytes())
    (folder / "set" / "scene.json").write_text((folder / "listed.json").read_text())
    listed[0] |= {"camera": scene["camera"]}
    (folder / "own").mkdir()
    (folder / "own" / "1.png").write_bytes((folder / "1.png").read_bytes())
    own = json.dumps(scene | {"images": listed[:1]})
    (folder / "own" / "scene.json").write_text(own)
    response = {"format": "phongfit response", "version": 1, "light": GAMMA}
    (folder / "response.json").write_text(json.dumps(response))
    pf.write_lp(folder / "two.lp", ["1.png", "2.png"], LAMPS)
    (folder / "photos").mkdir()
    for name in ("1.png", "2.png", "two.lp"):
        (folder / "photos" / name).write_bytes((folder / name).read_bytes())
    return folder


@pytest.mark.parametrize(
    "dataset, options",
    [
        ("1.png", {"sphere": CIRCLE, "encoding": "srgb"}),
        ("1.jpg", {"sphere": CIRCLE, "mask": "half.mask.png", "min_facing": 0.3}),
        ("1.png", {"sphere": CIRCLE, "encoding": "response.json", "white": 250}),
        ("photos", {"sphere": CIRCLE, "encoding": "srgb", "room_light": 0.5}),
        ("1.png", {"sphere": CIRCLE, "encoding": "srgb", "lights": "two.lp"}),
        ("1.png", {"scene": "both.json", "mask": "half.mask.png"}),
        ("2.png", {"scene": "listed.json", "white": 250}),
        ("set/2.png", {"scene": "set/scene.json"}),
        ("1.jpg", {"scene": "both.json", "encoding": "response.json"}),
        ("own/1.png", {"scene": "own/scene.json"}),
        ("set", {}),
    ],
)
def test_the_lines_read_the_same_data(folder, dataset, options):
    for name in ("mask", "scene", "lights"):
        if name in options:
            options = options | {name: folder / options[name]}
    if "encoding" in options and options["encoding"] != "srgb":
        options = options | {"encoding": str(folder / options["encoding"])}
    asked = DataOptions(folder / dataset, **options)
    data, _ = read_data(asked)
    names = [*(ONE if len(data.images) == 1 else SEVERAL), "film"]
    program = f"import phongfit as pf\n{loading_lines(asked, names)}"
    check_public(program)
    place: dict[str, Any] = {}
    exec(program, place)
    got = [place[n] if names[0] == "scenes" else (place[n],) for n in names[:3]]
    for mine, theirs in zip((data.scenes, data.images, data.masks), got, strict=True):
        assert len(mine) == len(theirs)
    for mine, theirs in zip(data.scenes, got[0], strict=True):
        assert len(mine.lights) == len(theirs.lights)
        for a, b in zip(mine.lights, theirs.lights, strict=True):
            np.testing.assert_array_equal(a.direction, b.direction)  # pyright: ignore
        np.testing.assert_array_equal(mine.ambient, theirs.ambient)
    np.testing.assert_array_equal(data.images, got[1])
    np.testing.assert_array_equal(data.masks, got[2])
    if data.films[0].jpeg is not None:
        assert place["film"] == data.film
