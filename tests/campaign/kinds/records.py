"""JSON files of ours with a value that is wrong, missing, or too much."""

import copy
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.encodings import read_response
from phongfit.files.fits import read_fit_record
from phongfit.files.images import write_image
from phongfit.files.materials import read_material
from phongfit.files.scenes import load_scene, load_truth, load_views
from tests.campaign.cases import Case, Kind, Wrong, blaming, put
from tests.campaign.damage import damaged

RECORDS = Path(__file__).parents[2] / "data" / "records"
LIGHT = {"kind": "point", "position": [1, 2, 3], "intensity": [0.5, 0.6, 0.7]}
SCENE = {
    "format": "phongfit scene",
    "version": 1,
    "surface": {"kind": "sphere", "radius": 1.0},
    "camera": {
        "kind": "perspective",
        "width": 8,
        "height": 6,
        "fov_y_degrees": 40,
        "position": [0, 0, 5],
        "target": [0, 0, 0],
    },
    "lights": [LIGHT, {"kind": "directional", "direction": [0, 1, 1]}],
    "ambient": 0.2,
    "specular": {"kind": "phong"},
    "shading": {"kind": "phong"},
    "encoding": "srgb",
    "bits": 8,
    "images": [
        {"file": "001.png", "lights": [0]},
        {"file": "001.png", "mask": "m.png"},
    ],
}
TRUTH = {
    "format": "phongfit truth",
    "version": 1,
    "material": {
        "ambient": 0.1,
        "diffuse": [0.5, 0.4, 0.3],
        "specular": 0.3,
        "shininess": 40,
    },
    "noise": 0.01,
    "seed": 3,
}
RESPONSE = {
    "format": "phongfit response",
    "version": 1,
    "light": [0, 0.2, 0.6, 1],
    "light_error": [0, 0.01, 0.01, 0],
    "numbers_seen": [0.1, 0.9],
    "checks": {"srgb": {"sigmas": 12.5, "off": 0.1}},
    "warnings": ["a word"],
}

# As text, since some of them are no values of Python's.
VALUES = [
    "null", "true", "0", "-1", "1e999", "-1e999", "NaN", "Infinity", "1e308", "1e-320",
    "9" * 400, "-" + "9" * 30, "2147483648", "4294967296", "0.5", '""', '"a"', "[]",
    "{}", "[[]]", "[1, 2]", "[0, 0, 0]", "[1e999, 0, 0]", '["a", "b", "c"]',
    '"../../etc/passwd"', '"/dev/zero"', '"\\u001b[31m"', '"' + "x" * 5000 + '"',
    "[" + "1, " * 2000 + "1]", "[" * 60 + "]" * 60, '{"kind": "sphere"}',
    '{"kind": "mesh_file", "file": "scene.json"}', '"\\ud800"',
]  # fmt: skip


def _places(value: Any, path: tuple = ()) -> list[tuple]:
    """The path of every value in a record."""
    found = [path] if path else []
    if isinstance(value, dict):
        for key, item in value.items():
            found += _places(item, (*path, key))
    if isinstance(value, list):
        for at, item in enumerate(value[:4]):
            found += _places(item, (*path, at))
    return found


MARK = "a mark to be replaced"


def changed(random: np.random.Generator, record: Any) -> tuple[str, bytes]:
    """A record with one value changed, gone, or of another name."""
    record = copy.deepcopy(record)
    places = _places(record)
    *path, last = places[int(random.integers(len(places)))]
    holder = record
    for step in path:
        holder = holder[step]
    how = int(random.integers(6))
    if how == 0:
        del holder[last]
        return f"{last} is missing", json.dumps(record).encode()
    if how == 1 and isinstance(holder, dict):
        holder[f"{last}x"] = holder.pop(last)
        return f"{last} misspelt", json.dumps(record).encode()
    value = VALUES[int(random.integers(len(VALUES)))]
    holder[last] = MARK
    text = json.dumps(record).replace(json.dumps(MARK), value)
    return f"{last} is {value[:40]}", text.encode()


@functools.cache
def fits() -> dict[str, Any]:
    """Records of fits that this and older versions wrote."""
    return {
        path.name: json.loads(path.read_text())
        for path in sorted(RECORDS.glob("fit_*.json"))
        if json.loads(path.read_text()).get("format") == "phongfit fit"
    }


def make(random: np.random.Generator, stock: Path) -> Case:
    picture = (stock / "001.png").read_bytes()
    ours = {"scene.json": SCENE, "truth.json": TRUTH, "response.json": RESPONSE}
    sources = ours | fits()
    name = str(random.choice(["scene.json", "scene.json", *sources]))
    if random.random() < 0.2:
        what, data = damaged(random, json.dumps(sources[name]).encode())
    else:
        what, data = changed(random, sources[name])

    def act(folder: Path) -> None:
        path = folder / name
        with blaming(name):
            if name == "scene.json":
                scene = load_scene(path)
                load_views(path)
                if scene.camera.width * scene.camera.height > 2**25:
                    raise Wrong("a camera of too many pixels")
            elif name == "truth.json":
                material = load_truth(path)
                if not np.isfinite(material.diffuse).all():
                    raise Wrong("a material that is not finite")
                read_material(str(path))
            elif name == "response.json":
                light = read_response(path).decode(np.linspace(0, 1, 9))
                if not np.isfinite(light).all():
                    raise Wrong("a curve that is not finite")
            else:
                read_fit_record(path)
                read_material(str(path))

    files = {"001.png": picture, "m.png": picture, name: data}
    return Case(f"{name}: {what}", put(files), act)


def prepare(stock: Path) -> None:
    write_image(stock / "001.png", np.full((6, 8, 3), 0.5), "srgb", 8)


KIND = Kind(make, prepare)
