"""`phongfit relight`: pictures named as in the list, as the photographs are encoded."""

import json
import shutil

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import main
from phongfit.commands.data import DataOptions, stack_data
from phongfit.files.fits import DataSettings
from phongfit.maps.folder import load_folder
from tests.maps.hills import write_hills


@pytest.fixture(scope="module")
def hills(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hills") / "maps"
    folder.mkdir()
    write_hills(folder)
    return folder


def test_a_picture_for_each_lamp(hills, tmp_path, capsys, refused):
    names = ["C:\\dome\\a 1.png", "two.tif", "three.CR2"]
    vectors = np.array([[1.0, 0.2, 0.8], [0, 0, 1], [-1, 1, 1]])
    pf.write_lp(tmp_path / "dome.lp", names, vectors)
    out = tmp_path / "relit"
    args = ["relight", str(hills), "--lights", f"{tmp_path}/dome.lp", "-o", str(out)]
    assert main(args) == 0
    told = capsys.readouterr().out
    assert "3 pictures, srgb; 1 of them as .png" in told and "in 1 piece" in told
    written = sorted(path.name for path in out.iterdir())
    assert written == ["a 1.png", "three.CR2.png", "two.tif"]
    maps, _, _ = load_folder(hills)
    expected = maps.relight([pf.DirectionalLight(vector) for vector in vectors])
    for name, light in zip(
        ["a 1.png", "two.tif", "three.CR2.png"], expected, strict=True
    ):
        shown = np.clip(light, 0, 1)
        np.testing.assert_allclose(pf.read_image(out / name, "srgb"), shown, atol=0.005)
    # Older pictures stay, unless told otherwise; without shadows it is brighter.
    before = pf.read_image(out / "a 1.png", "srgb").mean()
    assert "is not replaced, since it holds" in refused(*args)
    assert main([*args, "--overwrite", "--no-shadows", "--ambient", "0.5"]) == 0
    assert pf.read_image(out / "a 1.png", "srgb").mean() > before + 0.02


def test_near_lamps_of_a_calibration(hills, tmp_path):
    record = {
        "format": "phongfit lights",
        "version": 1,
        "camera": {"width": 40, "height": 32, "view_height": 3.2},
        "reference": [0, 0, 0],
        "falloff": 1.0,
        "lights": [
            {
                "photograph": "p.tiff",
                "position": [-1.5, 1.0, 2.0],
                "intensity": [0.8, 0.8, 0.8],
                "intensity_error": [0, 0, 0],
                "direction_error_degrees": 0.1,
                "covariance": [[0, 0, 0]] * 3,
            }
        ],
    }
    (tmp_path / "lights.json").write_text(json.dumps(record))
    args = ["relight", str(hills), "--lights", f"{tmp_path}/lights.json"]
    assert main([*args, "-o", f"{tmp_path}/out", "--encoding", "linear"]) == 0
    maps, _, _ = load_folder(hills)
    (light,) = pf.load_calibration(tmp_path / "lights.json").lights
    (expected,) = maps.relight([light])
    shown = pf.read_image(tmp_path / "out" / "p.tiff", "linear")
    np.testing.assert_allclose(shown, np.clip(expected, 0, 1), atol=0.0021)


@pytest.mark.parametrize(
    "lines, options, words",
    [
        ("1\na.png 0 0 0\n", [], "expected a vector to the lamp"),
        ("2\na.jpg 0 0 1\nb.png 0 0 1\n", ["--ambient", "-1"], "ambient: expected"),
    ],
)
def test_bad_input(hills, tmp_path, refused, lines, options, words):
    (tmp_path / "a.lp").write_text(lines)
    args = ["relight", str(hills), "--lights", f"{tmp_path}/a.lp", *options]
    assert words in refused(*args, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_maps_of_before_want_an_encoding(hills, tmp_path, refused):
    record = json.loads((hills / "maps.json").read_text()) | {"encoding": None}
    for path in hills.glob("*.np*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "maps.json").write_text(json.dumps(record))
    pf.write_lp(tmp_path / "a.lp", ["a.png"], np.array([[0, 0, 1.0]]))
    args = ["relight", str(tmp_path), "--lights", f"{tmp_path}/a.lp"]
    assert "expected --encoding linear or srgb" in refused(
        *args, "-o", tmp_path / "out"
    )


READ = {"normals": "fit", "encoding": "linear", "fov": 30.0}


@pytest.mark.extended
def test_with_what_maps_leave_of_their_photographs(capture, tmp_path, capsys):
    """Under its own lamp each photograph comes back."""
    photographs, _ = capture
    maps = tmp_path / "maps"
    words = [word for name, value in READ.items() for word in (f"--{name}", f"{value}")]
    words += ["--passes", "1", "--no-pictures"]
    assert main(["maps", str(photographs), "-o", str(maps), *words]) == 0
    args = ["relight", str(maps), "--lights", f"{photographs}/dome.lp"]
    given = [*args, "--photographs", str(photographs), "-o", str(tmp_path / "seen")]
    assert main(given) == 0
    assert main([*args, "-o", str(tmp_path / "alone")]) == 0
    off = {}
    for name in ("seen", "alone"):
        shown, taken = (
            np.stack([pf.read_image(at / f"{k:02d}.png", "linear") for k in range(24)])
            for at in (tmp_path / name, photographs)
        )
        off[name] = np.abs(shown - taken).max()
    # 8 bits as they are written, of 16 that were read.
    assert off["seen"] < 0.0025 < 0.02 < off["alone"]


def test_other_photographs_are_refused(capture, tmp_path, refused):
    photographs, _ = capture
    _, record = stack_data(DataOptions(photographs).like(DataSettings(**READ)))
    (maps := tmp_path / "maps").mkdir()
    write_hills(maps)
    content = json.loads((maps / "maps.json").read_text())
    content["data"] = record.model_dump(mode="json")
    (maps / "maps.json").write_text(json.dumps(content))
    other, out = tmp_path / "other", tmp_path / "out"
    args = ["relight", str(maps), "--lights", f"{photographs}/dome.lp"]
    args += ["-o", str(out), "--photographs"]

    def told(*words) -> str:
        err = refused(*args, *words)
        assert not out.exists()
        return err

    assert "photographs: " in told(other)
    shutil.copytree(photographs, other)
    pf.write_image(other / "07.png", np.full((16, 24, 3), 0.5), "linear")
    assert "photographs: expected those of the maps" in told(other)
    words = told(photographs, "--no-shadows")
    assert "shadows: photographs have theirs" in words
