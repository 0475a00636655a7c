"""`phongfit fit`: what it writes, and that it can be repeated from that."""

import contextlib
import html
import io
import json
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.calibration.outlines import View
from phongfit.calibration.result import Lamp
from phongfit.cli import main
from phongfit.commands.data import DataOptions
from phongfit.files.fits import read_fit_record
from phongfit.files.images import read_image, write_image
from phongfit.files.materials import read_material, write_material
from phongfit.files.outputs import WORK
from phongfit.fitting.problem.specification import Specification
from tests.commands.conftest import ENDS, SIDE
from tests.commands.test_loading import check_public
from tests.helpers import said

FIT = "phongfit.commands.fit.fit"
MADE = {"fit.json", "comparison.png", "report.html"}


@pytest.fixture(scope="module")
def fitted(brass, tmp_path_factory) -> Path:
    """The folder of a fit, with what it printed, which nothing may change."""
    folder, printed = tmp_path_factory.mktemp("fits") / "fit", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["fit", f"{brass}", "-o", f"{folder}", "--report", "quick"]) == 0
    assert "diffuse.red" in printed.getvalue()
    assert f"\n{folder}: comparison.png, fit.json" in printed.getvalue()
    return folder


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


def test_the_report_says_how_to_repeat_it_in_python(fitted):
    page = (fitted / "report.html").read_text(encoding="utf-8")
    program = html.unescape(page.split("<pre")[-1].split(">", 1)[1].split("</pre>")[0])
    assert "mask=masks" in program
    check_public(program)
    place: dict[str, Any] = {}
    exec(program, place)
    values, errors = read_fit_record(fitted / "fit.json").numbers()
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


def test_every_setting_arrives_and_is_kept(brass, asked_of):
    words = ["fit", brass / "002.png", "--scene", brass / "scene.json", "-o", "out"]
    words += ["--unknowns", "diffuse", "specular", "emission"]
    words += ["--per-channel", "diffuse", "specular", "--known", "preset:brass"]
    words += ["--bounds", "diffuse.red=0:2", "emission=0:inf"]
    words += ["--fixed", "diffuse.blue=0.1"]
    words += ["--ties", "specular.green=specular.red", "specular.blue=0.8*specular.red"]
    words += ["--priors", "specular.red=0.9:0.2", "--loss", "huber", "--noise", "0.01"]
    (scene, image), options = asked_of(FIT, *words, "--max-steps", "50")
    assert len(scene.lights) == 1 and image.shape == (SIDE, SIDE, 3)
    assert options.pop("mask").all() and options.pop("noise") == 0.01
    wanted = {
        "unknowns": ("diffuse", "specular", "emission"),
        "per_channel": ("diffuse", "specular"),
        "bounds": {"diffuse.red": (0, 2), "emission": (0, np.inf)},
        "fixed": {"diffuse.blue": 0.1},
        "ties": {
            "specular.green": (1, "specular.red"),
            "specular.blue": (0.8, "specular.red"),
        },
        "priors": {"specular.red": (0.9, 0.2)},
        "loss": pf.Huber(),
        "max_steps": 50,
    }
    assert wanted.items() <= options.items()
    assert options["known"].shininess == pytest.approx(27.897436)
    # And so it stands in the record, from which --like takes it.
    kept = json.loads(json.dumps(Specification(**options).to_dict()))
    again = Specification.from_dict(kept)
    assert wanted.items() <= again.options.items()
    assert again.options["known"].shininess == pytest.approx(27.897436)


def test_data_are_read_again_as_a_record_has_it():
    given = DataOptions(
        Path("ball"),
        sphere=(24, 18, 12),
        lights=Path("a.lp"),
        fov=20.0,
        encoding="srgb",
        min_cosine=0.2,
        room_light=0.5,
    )
    assert DataOptions(Path("ball")).like(given.settings()) == given


def test_pictures_and_report(brass, fitted, tmp_path, refused):
    out = Path(shutil.copytree(fitted, tmp_path / "out"))
    assert {path.name for path in out.iterdir()} == MADE
    page = (out / "report.html").read_text()
    assert page.startswith("<!doctype html>") and f"--like {fitted}/fit.json" in page
    assert pf.read_image(out / "comparison.png", "srgb").std() > 0.1
    # What is there stays, unless told otherwise, and nothing else goes.
    args = ["fit", str(brass), "-o", str(out), "--report"]
    assert "the folder is not empty" in refused(*args, "quick")
    (out / "notes.txt").write_text("mine")
    assert "it holds notes.txt" in refused(*args, "quick", "--overwrite")
    (out / "notes.txt").unlink()
    assert main([*args, "none", "--overwrite"]) == 0
    assert [path.name for path in out.iterdir()] == ["fit.json"]


@pytest.mark.parametrize("failing, status", ENDS)
def test_a_result_outlives_its_pictures(
    brass, tmp_path, monkeypatch, capfd, failing, status
):
    monkeypatch.setattr("phongfit.commands.fit._draw", failing)
    # The test's own output stays where it is.
    monkeypatch.setattr(os, "dup2", lambda *args: None)
    out = tmp_path / "out"
    assert main(["fit", str(brass), "-o", str(out), "--report", "quick"]) == status
    assert os.listdir(out) == ["fit.json"] and WORK not in os.listdir(out)
    assert f"\n{out}: fit.json" in capfd.readouterr().out


@pytest.mark.extended
def test_names_of_all_kinds(brass, tmp_path, monkeypatch):
    """Formulas of matplotlib, bytes that are no UTF-8, a terminal of ASCII."""
    data = Path(os.fsdecode(os.fsencode(tmp_path) + b"/$x_$ caf\xe9"))
    shutil.copytree(brass, data)
    os.rename(data / "001.png", data / "$a_$.png")
    scene = (data / "scene.json").read_text()
    (data / "scene.json").write_text(scene.replace("001.png", "$a_$.png"))
    little = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stdout", little)
    out = tmp_path / "out"
    assert main(["fit", str(data), "-o", str(out), "--report", "quick"]) == 0
    assert set(os.listdir(out)) == MADE
    little.flush()
    assert b"diffuse" in little.buffer.getvalue()
    record = read_fit_record(out / "fit.json")
    assert record.data.name == r"$x_$ caf\udce9"
    assert "$a_$.png" in record.data.inputs


def test_a_fit_goes_to_other_programs(fitted, tmp_path):
    """The folder of a fit is the name of its material."""
    path = tmp_path / "a.gltf"
    assert main(["export", str(fitted), "--to", "gltf", "-o", str(path)]) == 0
    fit = read_material(str(fitted / "fit.json"))
    assert fit.name == "brass"
    (written,) = json.loads(path.read_text())["materials"]
    phong = written["extras"]["phong"]
    np.testing.assert_allclose(phong["ambient"], fit.material.ambient, rtol=1e-6)


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
        (["--scene", "scene.json"], "is a data set, which says this itself"),
        (["--loss", "l2"], "--loss"),
        (["--like", "no.json"], "no.json: cannot be read"),
    ],
)
def test_bad_options(brass, tmp_path, refused, args, words):
    output = refused("fit", brass, "-o", tmp_path / "out", *args)
    assert said(words, output), output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "changes, words",
    [
        (
            {"format": "phongfit truth"},
            "format: expected 'phongfit fit' ... got \"phongfit truth\"",
        ),
        ({"values": [0.5]}, "values: expected 10, one a label, got 1"),
        ({"covariance": [[1.0]]}, "covariance: expected 10 rows of 10 numbers"),
        ({"settings__lost": 1}, "\"lost\" is no key of it; did you mean 'loss'?"),
        ({"material__diffuse": [[0.1], [0.1, 0.2]]}, "rows of one length"),
    ],
)
def test_a_wrong_record_names_the_field(fitted, tmp_path, changes, words):
    path = tmp_path / "fit.json"
    path.write_text((fitted / "fit.json").read_text())
    _change(path, **changes)
    with pytest.raises(ValueError) as caught:
        read_fit_record(path)
    assert str(caught.value).startswith(f"{path}: ") and said(words, str(caught.value))


def test_like_and_other_settings_do_not_mix(brass, fitted, tmp_path, refused):
    args = ["--like", str(fitted / "fit.json"), "--loss", "huber"]
    assert "loss: expected this option or --like" in refused(
        "fit", brass, "-o", tmp_path / "out", *args
    )


def test_jpeg_files_say_what_they_round(copy, asked_of):
    record = json.loads((copy / "scene.json").read_text())
    for image in record["images"]:
        light = read_image(copy / image["file"], record["encoding"])
        image["file"] = image["file"].replace(".png", ".jpg")
        write_image(copy / image["file"], light, record["encoding"])
    (copy / "scene.json").write_text(json.dumps(record))
    film = pf.read_film(copy / record["images"][0]["file"], record["encoding"])
    assert film.jpeg is not None and film.jpeg.subsampling == "4:4:4"
    assert pf.read_dataset(copy).film == film
    _, options = asked_of(FIT, "fit", copy, "-o", copy / "out")
    assert options["film"] == film


LAMPS = np.array([(0.5, 0.3, 0.8), (-0.4, 0.2, 0.9)])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)
BALL = pf.Material((0.5, 0.3, 0.2), 0.3, 20.0, 0.1)
CIRCLE = ("--sphere", "24", "18", "12")


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    """Two photographs of a ball, each under its own lamp, and a JPEG beside them."""
    folder = tmp_path_factory.mktemp("ball")
    camera = pf.OrthographicCamera(48, 36, view_height=3.0)
    for name, lamp in zip("ab", LAMPS, strict=True):
        light = pf.DirectionalLight(lamp)
        scene = pf.Scene(pf.Sphere(), camera, light, ambient=1.0)
        image = np.asarray(pf.render(scene, BALL))
        pf.write_image(folder / f"{name}.png", image, "linear", 16)
        if name == "a":
            pf.write_image(folder.parent / "photo.jpg", image, "srgb")
    return folder


def test_what_photographs_leave_open_is_found(ball, tmp_path, asked_of, refused):
    photo = ball.parent / "photo.jpg"
    (scene, image), options = asked_of(FIT, "fit", photo, *CIRCLE, "-o", tmp_path / "a")
    assert image.shape == (36, 48, 3) and isinstance(scene.surface, pf.Sphere)
    assert options["unknowns"][-1] == "scene.lights[0].direction"
    assert options["film"].jpeg is not None
    assert "--sphere or --normals" in refused("fit", photo, "-o", tmp_path / "a")
    # Lamps of a list are of unknown strength, next to the first.
    pf.write_lp(tmp_path / "a.lp", ["a.png", "b.png"], LAMPS)
    words = ["fit", ball, *CIRCLE, "--encoding", "linear", "-o", tmp_path / "a"]
    _, options = asked_of(FIT, *words, "--lights", tmp_path / "a.lp")
    assert options["unknowns"][-1] == "exposure"
    assert options["fixed"] == {"exposure[0]": 1} and not options["uncertain"]
    _, options = asked_of(FIT, *words)
    assert options["unknowns"][-2:] == ("scene.lights[0].direction", "exposure")
    assert options["per_image"] == ("scene.lights[0].direction",)


@pytest.fixture(scope="module")
def calibrated(ball) -> Path:
    """A calibration of the ball's lamps: 2 % of their strength, 0.01 of direction."""
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
        for name, lamp in zip("ab", LAMPS, strict=True)
    ]
    calibration = pf.Calibration(
        View(48, 36), tuple(found), (), 1.0, np.zeros(3), 0.0, np.zeros(3), {}, (), 3.0
    )
    path = ball.parent / "lights.json"
    pf.save_calibration(path, calibration)
    return path


def test_lights_of_a_calibration_err_or_are_unknown(
    ball, calibrated, tmp_path, asked_of, refused
):
    words = ["fit", ball, *CIRCLE, "--encoding", "linear", "-o", tmp_path / "a"]
    given = [*words, "--lights", calibrated]
    direction, intensity = "scene.lights[0].direction", "scene.lights[0].intensity"
    _, known = asked_of(FIT, *given)
    assert list(known["uncertain"]) == [(direction, intensity)]
    assert direction not in known["unknowns"] and known["per_image"] == ()
    _, refined = asked_of(FIT, *given, "--refine-lights")
    for name in (direction, intensity):
        assert all(name in refined[each] for each in ("unknowns", "per_image"))
        assert name in refined["per_channel"]
    assert refined["uncertain"].keys() == known["uncertain"].keys()
    assert "refine_lights: expected lights of a" in refused(*words, "--refine-lights")


@pytest.mark.extended
def test_a_photograph_of_a_ball_with_nothing_else(ball, tmp_path, capsys):
    call = ["fit", str(ball.parent / "photo.jpg"), "--report", "none", "-o"]
    out = tmp_path / "out"
    assert main([*call, str(out), *CIRCLE]) == 0
    said = capsys.readouterr().out
    assert "scene.lights[0].direction.x" in said and "shininess" in said
    record = read_fit_record(out / "fit.json")
    assert record.film.endswith("JPEG 4:4:4")
    assert record.build().diffuse == pytest.approx(np.asarray(BALL.diffuse), abs=0.02)
    assert record.build().shininess == pytest.approx(20, rel=0.1)
    assert main([*call, str(tmp_path / "b"), "--like", str(out / "fit.json")]) == 0
    assert "\nagrees with the recorded fit: " in capsys.readouterr().out


@pytest.mark.extended
def test_errors_of_a_calibration_are_those_of_the_material(ball, calibrated, tmp_path):
    write_material(tmp_path / "known.json", "known", BALL, pf.BlinnPhong())
    call = ["fit", str(ball), *CIRCLE, "--encoding", "linear", "--report", "none"]
    # A known highlight would tell how strong the lamps are.
    call += ["--unknowns", "specular", "diffuse", "--known", f"{tmp_path}/known.json"]
    call += ["--lights", str(calibrated), "-o"]
    errors = {}
    for name, options in {"known": [], "refined": ["--refine-lights"]}.items():
        assert main([*call, str(tmp_path / name), *options]) == 0
        fit = json.loads((tmp_path / name / "fit.json").read_text())
        errors[name] = dict(zip(fit["labels"], fit["errors"], strict=True))
    # Each strength is off by 2 %: both together by less, and directions add to it.
    assert 0.005 < errors["known"]["diffuse.red"] < 0.02
    assert errors["refined"]["scenes[1].lights[0].direction.x"] < 0.003
