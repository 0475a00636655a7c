"""`phongfit fit`: what it writes, and that it can be repeated from that."""

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.calibration.outlines import View
from phongfit.calibration.result import Lamp
from phongfit.cli import main
from phongfit.files.fits import read_fit_record
from phongfit.files.images import read_image, write_image
from phongfit.files.materials import read_material, write_material
from tests.helpers import said


def _change(path, **changes):
    record = json.loads(path.read_text())
    for place, value in changes.items():
        *above, last = place.split("__")
        part = record
        for step in above:
            part = part[step]
        part[last] = value
    path.write_text(json.dumps(record))


def test_all_numbers_are_written(brass, fitted):
    record = read_fit_record(fitted / "fit.json")
    data = pf.read_dataset(brass)
    fit = pf.fit(data.scenes, data.images, mask=data.masks, film=data.film)
    values, errors = record.numbers()
    assert tuple(record.labels) == fit.labels
    np.testing.assert_allclose(values, fit.values, rtol=1e-6)
    np.testing.assert_allclose(errors, fit.errors, rtol=1e-6)
    np.testing.assert_allclose(
        np.array(record.covariance, float), fit.covariance, rtol=1e-6
    )
    assert [list(row) for row in record.bounds] == fit.bounds.tolist()
    np.testing.assert_allclose(
        np.array(record.intervals, float), fit.intervals(), rtol=1e-6
    )
    assert record.n_samples == fit.n_samples and record.converged
    assert set(record.data.inputs) == {"001.png", "002.png", "003.png", "scene.json"}
    assert record.made_with["precision"] == fit.material.diffuse.dtype.name
    near = pf.preset("brass").diffuse
    np.testing.assert_allclose(record.build().diffuse, near, atol=0.02)
    read = read_material(str(fitted / "fit.json"))
    assert isinstance(read.model, pf.BlinnPhong)
    assert np.array_equal(read.material.diffuse, record.build().diffuse)


def test_a_file_from_before_there_were_intervals(fitted, tmp_path):
    content = json.loads((fitted / "fit.json").read_text())
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({**content, "intervals": content["intervals"][1:]}))
    with pytest.raises(ValueError, match="intervals: expected 10"):
        read_fit_record(path)
    del content["intervals"]
    path.write_text(json.dumps(content))
    assert read_fit_record(path).intervals is None


OLD = Path(__file__).parents[1] / "data" / "records" / "fit_version_1.json"


def test_a_file_of_version_1(tmp_path):
    """Its fields had other names."""
    record = read_fit_record(OLD)
    assert record.labels == ["diffuse", "shininess", "scene.lights[0].intensity"]
    assert record.unidentified == [True, False, False]
    assert (record.version, record.n_samples, record.n_images) == (2, 492, 1)
    assert np.isinf(record.numbers()[1]).tolist() == record.unidentified
    assert read_material(str(OLD)).material.shininess == record.values[1]
    path = tmp_path / "fit.json"
    path.write_text(OLD.read_text().replace("[true, false, false]", "[true, false, 1]"))
    with pytest.raises(
        ValueError, match=r"unidentified\[2\]: expected a valid boolean, got 1"
    ):
        read_fit_record(path)


def test_names_of_version_1_are_no_names_of_version_2(fitted, tmp_path):
    path = tmp_path / "fit.json"
    path.write_text((fitted / "fit.json").read_text().replace("n_samples", "samples"))
    with pytest.raises(ValueError, match="did you mean 'n_samples'"):
        read_fit_record(path)


def test_the_report_says_how_to_repeat_it_in_python(brass, tmp_path):
    args = ["fit", str(brass), "-o", str(tmp_path / "fit"), "--report", "quick"]
    assert main(args) == 0
    page = (tmp_path / "fit" / "report.html").read_text(encoding="utf-8")
    program = html.unescape(page.split("<pre")[-1].split(">", 1)[1].split("</pre>")[0])
    assert "mask=masks" in program
    place: dict[str, Any] = {}
    exec(program, place)
    values, errors = read_fit_record(tmp_path / "fit" / "fit.json").numbers()
    np.testing.assert_allclose(place["fit"].values, values, rtol=1e-6)
    np.testing.assert_allclose(place["fit"].errors, errors, rtol=1e-6)


def test_a_fit_repeats_and_a_difference_is_told(brass, fitted, tmp_path, capsys):
    before = (fitted / "fit.json").read_text()
    like = tmp_path / "fit.json"
    like.write_text(before)
    again = ["fit", str(brass), "--like", str(like), "--report", "none"]
    assert main([*again, "-o", str(tmp_path / "a")]) == 0
    assert "\nagrees with the recorded fit: " in capsys.readouterr().out
    assert json.loads((tmp_path / "a/fit.json").read_text()) == json.loads(before)
    # An answer that is two standard errors off.
    record = json.loads(before)
    record["values"][3] += 2 * record["errors"][3]
    like.write_text(json.dumps(record))
    assert main([*again, "-o", str(tmp_path / "b")]) == 1
    out = capsys.readouterr().out
    assert re.search(r"DIFFERS from the recorded fit: .* 2 .*diffuse\.red", out)
    # Other data are fitted in the same way, but not compared.
    record["data"]["inputs"]["001.png"] = 64 * "0"
    like.write_text(json.dumps(record))
    assert main([*again, "-o", str(tmp_path / "c")]) == 0
    assert "other data than in the recorded fit (001.png)" in capsys.readouterr().out


def test_every_setting_arrives_and_is_kept(brass, tmp_path, capsys):
    args = [
        "fit",
        f"{brass}/002.png",
        "--scene",
        f"{brass}/scene.json",
        "--report",
        "none",
    ]
    args += ["--unknowns", "diffuse", "specular", "emission"]
    args += ["--per-channel", "diffuse", "specular", "--known", "preset:brass"]
    args += ["--bounds", "diffuse.red=0:2", "emission=0:inf"]
    args += ["--fixed", "diffuse.blue=0.1"]
    args += ["--ties", "specular.green=specular.red", "specular.blue=0.8*specular.red"]
    args += ["--priors", "specular.red=0.9:0.2", "--loss", "huber", "--noise", "0.01"]
    assert main([*args, "-o", str(tmp_path / "out"), "--max-steps", "50"]) == 0
    record = read_fit_record(tmp_path / "out" / "fit.json")
    options = record.settings.specification().options
    assert options["unknowns"] == ("diffuse", "specular", "emission")
    assert options["bounds"] == {"diffuse.red": (0, 2), "emission": (0, np.inf)}
    assert options["fixed"] == {"diffuse.blue": 0.1}
    ties = {
        "specular.green": (1, "specular.red"),
        "specular.blue": (0.8, "specular.red"),
    }
    assert options["ties"] == ties
    assert options["priors"] == {"specular.red": (0.9, 0.2)}
    assert (options["loss"], options["max_steps"]) == (pf.Huber(), 50)
    assert record.settings.noise == 0.01
    values = dict(zip(record.labels, record.values, strict=True))
    assert values["specular.blue"] == pytest.approx(0.8 * values["specular.red"])
    assert record.build().shininess == pytest.approx(27.897436)
    assert set(record.data.inputs) == {"002.png", "scene.json"}
    assert record.noise_given and record.n_images == 1


def test_pictures_and_report(brass, tmp_path, capsys):
    out = tmp_path / "out"
    args = ["fit", str(brass), "-o", str(out), "--report", "quick"]
    assert main(args) == 0
    names = {path.name for path in out.iterdir()}
    assert names == {"fit.json", "comparison.png", "report.html"}
    page = (out / "report.html").read_text()
    assert page.startswith("<!doctype html>") and f"--like {out}/fit.json" in page
    assert pf.read_image(out / "comparison.png", "srgb").std() > 0.1
    capsys.readouterr()
    # What is there stays, unless told otherwise, and nothing else goes.
    assert main(args) == 2
    assert "the folder is not empty" in capsys.readouterr().err
    (out / "notes.txt").write_text("mine")
    assert main([*args, "--overwrite"]) == 2
    assert "it holds notes.txt" in capsys.readouterr().err
    (out / "notes.txt").unlink()
    assert main([*args[:-1], "none", "--overwrite"]) == 0
    assert [path.name for path in out.iterdir()] == ["fit.json"]


@pytest.mark.parametrize(
    "args, words",
    [
        (["--bounds", "diffuse"], "bounds: expected NAME=VALUE"),
        (
            ["--bounds", "diffuse=1"],
            "bounds: expected two numbers ... for diffuse, got '1'",
        ),
        (["--fixed", "diffuse=x"], "fixed: expected a number for diffuse, got 'x'"),
        (
            ["--ties", "a=2*"],
            "ties: expected a label, or FACTOR*LABEL, for a, got '2*'",
        ),
        (["--ties", "a=b", "a=c"], "ties: expected ... got 'a=c'"),
        (["--known", "gold"], "known: material: expected preset:NAME ... got 'gold'"),
        (["--noise", "0"], "noise: expected a number > 0"),
        (["--noise", "nan"], "noise: expected ... got nan"),
        (["--max-steps", "0"], "max_steps: expected ... got 0"),
        (["--unknowns", "colour"], "unknowns: expected one of ambient"),
        (["--scene", "scene.json"], "is a folder, which says this itself"),
        (["--loss", "l2"], "--loss"),
        (["--like", "no.json"], "no.json: cannot be read"),
    ],
)
def test_bad_options(brass, tmp_path, capsys, args, words):
    assert main(["fit", str(brass), "-o", str(tmp_path / "out"), *args]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("error: ") and said(words, output.err), output.err
    assert output.err.count("\n") == 1 and output.out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "changes, words",
    [
        (
            {"format": "phongfit truth"},
            "format: expected 'phongfit fit' ... got \"phongfit truth\"",
        ),
        ({"version": 3}, "version: expected ... got 3"),
        ({"values": [0.5]}, "values: expected 10, one a label, got 1"),
        ({"covariance": [[1.0]]}, "covariance: expected 10 rows of 10 numbers"),
        ({"settings__loss": "l2"}, 'settings.loss: expected ... got "l2"'),
        ({"settings__lost": 1}, "\"lost\" is no key of it; did you mean 'loss'?"),
        ({"settings__noise": -1}, "settings.noise: expected ... got -1"),
        ({"settings__bounds": {"diffuse": [1]}}, "settings.bounds.diffuse"),
        ({"data__inputs": {"a.png": "zz"}}, "data.inputs"),
        ({"material__diffuse": [[0.1], [0.1, 0.2]]}, "rows of one length"),
        (
            {"material__diffuse": -1.0},
            "material: diffuse: expected finite numbers ≥ 0, got -1",
        ),
        ({"labels": []}, "labels: expected ... got []"),
    ],
)
def test_a_wrong_record_names_the_field(fitted, tmp_path, changes, words):
    path = tmp_path / "fit.json"
    path.write_text((fitted / "fit.json").read_text())
    _change(path, **changes)
    with pytest.raises(ValueError) as caught:
        read_fit_record(path)
    assert str(caught.value).startswith(f"{path}: ") and said(words, str(caught.value))


def test_like_and_other_settings_do_not_mix(brass, fitted, tmp_path, capsys):
    args = ["--like", str(fitted / "fit.json"), "--loss", "huber"]
    assert main(["fit", str(brass), "-o", str(tmp_path / "out"), *args]) == 2
    assert "loss: expected this option or --like" in capsys.readouterr().err


def test_jpeg_files_say_what_they_round(copy, tmp_path):
    record = json.loads((copy / "scene.json").read_text())
    for image in record["images"]:
        light = read_image(copy / image["file"], record["encoding"])
        image["file"] = image["file"].replace(".png", ".jpg")
        write_image(copy / image["file"], light, record["encoding"])
    (copy / "scene.json").write_text(json.dumps(record))
    film = pf.read_film(copy / record["images"][0]["file"], record["encoding"])
    data = pf.read_dataset(copy)
    assert data.film == film and film.jpeg is not None
    out = tmp_path / "fit"
    assert main(["fit", str(copy), "-o", str(out), "--report", "none"]) == 0
    assert read_fit_record(out / "fit.json").film.endswith("JPEG 4:4:4")
    again = ["fit", str(copy), "-o", str(tmp_path / "again"), "--report", "none"]
    assert main([*again, "--like", str(out / "fit.json")]) == 0


def test_a_photograph_of_a_ball_with_nothing_else(tmp_path, capsys):
    camera = pf.OrthographicCamera(48, 36, view_height=3.0)
    light = pf.DirectionalLight((0.5, 0.3, 0.8))
    scene = pf.Scene(pf.Sphere(), camera, light, ambient=1.0)
    truth = pf.Material((0.5, 0.3, 0.2), 0.3, 20.0, 0.1)
    pf.write_image(tmp_path / "photo.jpg", pf.render(scene, truth), "srgb")
    call = ["fit", str(tmp_path / "photo.jpg"), "--report", "none"]
    out = tmp_path / "out"
    assert main([*call, "--sphere", "24", "18", "12", "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "scene.lights[0].direction.x" in said and "shininess" in said
    assert (
        main([*call, "--like", str(out / "fit.json"), "-o", str(tmp_path / "b")]) == 0
    )
    assert main([*call, "-o", str(tmp_path / "c")]) == 2
    assert "--sphere or --normals" in capsys.readouterr().err


def only_diffuse(folder: Path, material: pf.Material) -> list[str]:
    """Options for the rest of a material to be known, which is compiled sooner."""
    path = folder / "known.json"
    write_material(path, "known", material, pf.BlinnPhong())
    return ["--unknowns", "diffuse", "--known", str(path)]


def test_lamps_of_unknown_strength_are_next_to_the_first(tmp_path):
    folder, out = tmp_path / "ball", tmp_path / "out"
    folder.mkdir()
    lamps, truth = [(0.5, 0.3, 0.8), (-0.4, 0.2, 0.9)], pf.Material(0.4, 0.2, 20.0, 0.1)
    camera = pf.OrthographicCamera(48, 36, view_height=3.0)
    for name, lamp, strength in zip("ab", lamps, (1.0, 0.7), strict=True):
        light = pf.DirectionalLight(lamp)
        scene = pf.Scene(pf.Sphere(), camera, light, ambient=1.0)
        image = strength * np.asarray(pf.render(scene, truth))
        pf.write_image(folder / f"{name}.png", image, "linear", 16)
    pf.write_lp(folder / "lamps.lp", ["a.png", "b.png"], np.array(lamps))
    call = ["fit", str(folder), "--sphere", "24", "18", "12", "--encoding", "linear"]
    call += only_diffuse(tmp_path, truth)
    assert main([*call, "-o", str(out), "--report", "none"]) == 0
    found = json.loads((out / "fit.json").read_text())
    values = dict(zip(found["labels"], found["values"], strict=True))
    assert values["exposure[1]"] == pytest.approx(0.7, rel=0.01)
    assert values["diffuse.red"] == pytest.approx(0.4, rel=0.01)


def test_lights_of_a_calibration_err_or_are_unknown(tmp_path):
    folder, lamps = tmp_path / "ball", np.array([(0.5, 0.3, 0.8), (-0.4, 0.2, 0.9)])
    truth = pf.Material(0.4, 0.2, 20.0, 0.1)
    folder.mkdir()
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    camera = pf.OrthographicCamera(48, 36, view_height=3.0)
    for name, lamp in zip("ab", lamps, strict=True):
        scene = pf.Scene(pf.Sphere(), camera, pf.DirectionalLight(lamp), ambient=1.0)
        image = pf.render(scene, truth)
        pf.write_image(folder / f"{name}.png", image, "linear", 16)
    found = [
        Lamp(
            f"{name}.png",
            lamp,
            None,
            1e-4 * (np.eye(3) - np.outer(lamp, lamp)),
            0.8,
            np.ones(3),
            np.full(3, 0.02),
            np.zeros((0, 2)),
        )
        for name, lamp in zip("ab", lamps, strict=True)
    ]
    calibration = pf.Calibration(
        View(48, 36), tuple(found), (), 1.0, np.zeros(3), 0.0, np.zeros(3), {}, (), 3.0
    )
    pf.save_calibration(folder / "lights.json", calibration)
    call = ["fit", str(folder), "--sphere", "24", "18", "12", "--encoding", "linear"]
    call += only_diffuse(tmp_path, truth)
    # A known highlight would tell how strong the lamps are.
    call.insert(call.index("diffuse"), "specular")
    call += ["--report", "none", "-o"]
    errors = {}
    for name, options in {"known": [], "refined": ["--refine-lights"]}.items():
        assert main([*call, str(tmp_path / name), *options]) == 0
        fit = json.loads((tmp_path / name / "fit.json").read_text())
        errors[name] = dict(zip(fit["labels"], fit["errors"], strict=True))
    # Each strength is off by 2 %: both together by less, and directions add to it.
    assert 0.005 < errors["known"]["diffuse.red"] < 0.02
    assert errors["refined"]["scenes[1].lights[0].direction.x"] < 0.003
    (folder / "lights.json").unlink()
    assert main([*call, str(tmp_path / "c"), "--refine-lights"]) == 2
