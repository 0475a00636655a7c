"""Files of every version that ever was are read: one of each is kept.

Who adds a version to a record keeps a file of it in `tests/data/records`.
"""

import json
import re
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.commands.predict import PREDICTION_FORMAT
from phongfit.files.calibrations import LightsRecord
from phongfit.files.encodings import ResponseRecord, read_response
from phongfit.files.fits import FitRecord, read_fit_record
from phongfit.files.materials import MaterialFile, read_material
from phongfit.files.records import read_record
from phongfit.files.schema import SceneRecord, TruthRecord
from phongfit.maps.folder import MapsRecord, load_folder
from phongfit.maps.result import MAPS_VERSION

KEPT = Path(__file__).parents[1] / "data" / "records"
KINDS: dict[str, type[Any]] = {
    "fit": FitRecord,
    "lights": LightsRecord,
    "maps": MapsRecord,
    "material": MaterialFile,
    "response": ResponseRecord,
    "scene": SceneRecord,
    "truth": TruthRecord,
}
# What a record turns into the newest version while it reads.
UPGRADED = {"fit": (1,)}
WRITTEN = [
    (kind, version)
    for kind, record in KINDS.items()
    for version in sorted(
        {*typing.get_args(record.model_fields["version"].annotation)}
        | {*UPGRADED.get(kind, ())}
    )
]


def kept(kind: str, version: int, suffix: str = ".json") -> Path:
    return KEPT / f"{kind}_version_{version}{suffix}"


@pytest.mark.parametrize("kind, version", WRITTEN)
def test_every_version_is_read(kind, version):
    path, record = kept(kind, version), KINDS[kind]
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["version"] == version
    assert content["format"] in typing.get_args(
        record.model_fields["format"].annotation
    )
    assert read_record(path, record).version >= version


@pytest.mark.parametrize("kind", KINDS)
def test_a_version_of_the_future_is_refused(kind, tmp_path):
    newest = max(version for name, version in WRITTEN if name == kind)
    content = json.loads(kept(kind, newest).read_text(encoding="utf-8"))
    path = tmp_path / "future.json"
    path.write_text(json.dumps({**content, "version": newest + 1}))
    with pytest.raises(ValueError, match=f"version: expected .*{newest}.*got"):
        read_record(path, KINDS[kind])


def test_what_is_in_them():
    assert read_material(str(kept("material", 1))).name == "brass"
    truth = read_material(str(kept("truth", 1))).material
    np.testing.assert_allclose(truth.diffuse, pf.preset("brass").diffuse)
    assert len(pf.load_scene(kept("scene", 1)).lights) == 6
    lamps = pf.load_calibration(kept("lights", 1)).lamps
    assert [lamp.photograph for lamp in lamps] == ["01.png", "02.png", "03.png"]
    assert len(read_response(kept("response", 1)).light) == 9
    for version in (1, 2):
        fitted = read_fit_record(kept("fit", version))
        assert fitted.labels[1] == "shininess" and fitted.build().shininess >= 1


@pytest.mark.parametrize("version", range(1, MAPS_VERSION + 1))
def test_maps_of_every_version(version, tmp_path):
    path = kept("maps", version, ".npz")
    maps, normals = pf.load_maps(path), tmp_path / "normals.npy"
    assert maps.identified.sum() > 5 and maps.diffuse.shape == (8, 8, 3)
    assert ("version" in np.load(path)) == (version > 1)
    assert (maps.camera is None) == (version == 1)
    assert (maps.specular_model is None) == (version == 1)
    if version == 1:
        assert not maps.normals.any() and np.isinf(maps.normals_stderr).all()
    (tmp_path / "maps.npz").write_bytes(path.read_bytes())
    (tmp_path / "maps.json").write_bytes(kept("maps", version).read_bytes())
    np.save(normals, np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3)))
    whole, record, given = load_folder(tmp_path)
    assert whole.specular_model == record.model.build() == pf.BlinnPhong()
    if version == 1:
        # Normals and the model stood beside the maps, and no camera or encoding.
        np.testing.assert_array_equal(whole.normals, given)
        assert not whole.normals_stderr[maps.identified].any()
        assert whole.camera is None and record.encoding is None


@pytest.mark.parametrize("version", [0, MAPS_VERSION + 1, [2, 2], "two"])
def test_maps_of_the_future(version, tmp_path):
    arrays = dict(np.load(kept("maps", MAPS_VERSION, ".npz")))
    path = tmp_path / "maps.npz"
    np.savez(path, allow_pickle=False, **arrays | {"version": np.array(version)})
    with pytest.raises(ValueError, match=f"version: expected 1 to {MAPS_VERSION}, got"):
        pf.load_maps(path)


def test_the_documentation_has_all_of_them():
    page = Path(__file__).parents[2] / "docs/reference/formats.md"
    rows = re.findall(
        r"^\| .* \| `(phongfit \w+)` \| (\d) \| ([\d, ]+) \|$",
        page.read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    found = {
        (name.removeprefix("phongfit "), int(version))
        for name, newest, read in rows
        for version in read.split(", ")
        if int(version) <= int(newest)
    }
    assert found == set(WRITTEN)


def test_a_prediction_states_its_version():
    content = json.loads(kept("prediction", 1).read_text(encoding="utf-8"))
    assert (content["format"], content["version"]) == (PREDICTION_FORMAT, 1)
