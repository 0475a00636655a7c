"""`phongfit scene`: files that are written so that nobody writes JSON by hand."""

import dataclasses

import imagecodecs
import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import main
from phongfit.commands.data import DataOptions, read_data
from phongfit.files.scenes import save_truth
from tests.calibration.studio import directions

SIZE = (48, 36)
CIRCLE = ("27", "16", "12")
TRUTH = pf.Material((0.5, 0.3, 0.2), 0.3, 20.0, 0.1)
LAMPS = directions(3)


def towards(light):
    """A distant light's direction."""
    assert isinstance(light, pf.DirectionalLight)
    return np.asarray(light.direction)


def made(capsys, *words):
    """What the command says; it must succeed."""
    assert main(["scene", *map(str, words)]) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_a_ball_from_its_circle_is_rendered_and_read(tmp_path, capsys):
    first, second = tmp_path / "made.json", tmp_path / "photo.json"
    image = tmp_path / "ball.png"
    ball = ["--sphere", *CIRCLE, "--light", "-1", "1", "2"]
    made(capsys, "--size", *SIZE, *ball, "--ambient", 0.5, "-o", first)
    scene = pf.load_scene(first)
    assert (scene.camera.width, scene.camera.height) == SIZE
    # The ball where the circle is: its centre is seen by the pixel at 27, 16.
    seen = np.asarray(scene.trace().normal)[15:17, 26:28].mean(axis=(0, 1))
    assert seen == pytest.approx([0, 0, 1], abs=0.01)
    truth = tmp_path / "truth.json"
    save_truth(truth, TRUTH)
    assert main(["render", f"{first}", "--material", f"{truth}", "-o", f"{image}"]) == 0
    made(capsys, image, "--encoding", "srgb", *ball, "-o", second)
    data, _ = read_data(DataOptions(image, scene=second))
    assert data.film == pf.Film(encoding="srgb", bits=8)
    # Its ambient light is not that of the first: nobody said what it was.
    bright = dataclasses.replace(TRUTH, ambient=0.5 * np.asarray(TRUTH.ambient))
    shown = np.asarray(pf.render(data.scenes[0], bright))
    assert shown.std() > 0.1 and np.abs(shown - data.images[0]).max() < 0.005


def test_a_pinhole_sees_the_ball_where_its_circle_is(tmp_path, capsys):
    out = tmp_path / "a.json"
    made(capsys, "--size", *SIZE, "--sphere", *CIRCLE, "--fov", 20, "-o", out)
    scene = pf.load_scene(out)
    assert isinstance(scene.camera, pf.PerspectiveCamera)
    rows, columns = np.nonzero(np.asarray(scene.trace().mask))
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((27, 16), abs=0.2)
    assert np.sqrt(len(rows) / np.pi) == pytest.approx(12, abs=0.1)


@pytest.mark.parametrize("camera", [(), ("--fov", "30")])
def test_all_of_a_mesh_is_in_view(tmp_path, capsys, camera):
    mesh = tmp_path / "box.obj"
    corners = [(x, y, z) for x in (3, 5) for y in (0, 1) for z in (0, 1)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["f 2 6 8", "f 2 8 4", "f 1 3 7", "f 1 7 5"]
    mesh.write_text("\n".join(lines))
    out = tmp_path / "a.json"
    made(capsys, "--size", *SIZE, "--mesh", mesh, *camera, "-o", out)
    scene = pf.load_scene(out)
    assert not scene.shadows
    made(capsys, "--size", *SIZE, "--mesh", mesh, "--shadows", "-o", f"{out}.json")
    assert pf.load_scene(f"{out}.json").shadows
    seen = np.asarray(scene.trace().mask)
    assert seen.any() and not seen[[0, -1]].any() and not seen[:, [0, -1]].any()


@pytest.fixture
def capture(tmp_path):
    """Photographs of a ball, without anything beside them."""
    folder = tmp_path / "photos"
    folder.mkdir()
    camera = pf.OrthographicCamera(*SIZE, view_height=36 / 12)
    surface = pf.Sphere(((27 - 24) / 12, (18 - 16) / 12, 0), 1.0)
    for number, lamp in enumerate(LAMPS, 1):
        scene = pf.Scene(surface, camera, pf.DirectionalLight(lamp), ambient=1.0)
        pf.write_image(folder / f"{number}.png", pf.render(scene, TRUTH), "srgb")
    return folder


def test_a_folder_becomes_a_data_set(capture, tmp_path, capsys, refused):
    lights = tmp_path / "lights.lp"
    pf.write_lp(lights, ["3.png", "1.png", "2.png"], LAMPS[[2, 0, 1]])
    words = [capture, "--encoding", "srgb", "--sphere", *CIRCLE, "--lights", lights]
    said = made(capsys, *words)
    assert "3 photographs" in said and "--unknowns" in said and "exposure" in said
    data = pf.read_dataset(capture)
    assert data.names == ("3.png", "1.png", "2.png")
    found = [towards(scene.lights[0]) for scene in data.scenes]
    assert np.array(found) == pytest.approx(LAMPS[[2, 0, 1]], abs=1e-6)
    expected = np.asarray(pf.render(data.scenes[1], TRUTH))
    assert np.abs(data.images[1] - expected).max() < 0.01
    # What was edited since is not lost.
    assert "--overwrite" in refused("scene", *words)
    made(capsys, *words, "--overwrite")


def test_one_photograph_takes_its_own_light(capture, tmp_path, capsys):
    lights = tmp_path / "lights.lp"
    pf.write_lp(lights, ["1.png", "2.png", "3.png"], LAMPS)
    out = tmp_path / "two.json"
    ball = ["--encoding", "srgb", "--sphere", *CIRCLE, "--lights", lights, "-o", out]
    made(capsys, capture / "2.png", *ball)
    (light,) = pf.load_scene(out).lights
    assert towards(light) == pytest.approx(LAMPS[1], abs=1e-6)


def test_white_is_kept_with_the_scene(capture, tmp_path, capsys):
    """Of 12 bits in 16: in a data set, and for one of its photographs."""
    for path in capture.glob("*.png"):
        light = np.asarray(pf.read_image(path, "srgb"))
        levels = np.round(4095 * light).astype(np.uint16)
        path.write_bytes(imagecodecs.png_encode(levels))
    pf.write_lp(capture / "lights.lp", ["1.png", "2.png", "3.png"], LAMPS)
    light = imagecodecs.imread(capture / "2.png") / 4095
    how = ["--encoding", "linear", "--sphere", *CIRCLE]
    made(capsys, capture, *how, "--white", 4095)
    data = pf.read_dataset(capture)
    assert data.images[1] == pytest.approx(light, abs=1e-5)
    assert data.film == pf.Film(bits=12)
    one = DataOptions(capture / "2.png", scene=capture / "scene.json")
    for options in (one, DataOptions(one.dataset, sphere=(27, 16, 12), white=4095)):
        options = dataclasses.replace(options, encoding="linear")
        data, record = read_data(options)
        assert data.images[0].max() > 0.2 and data.film == pf.Film(bits=12)
        assert options.like(record.reading).white == options.white
    with pytest.raises(ValueError, match="white: .* which says this itself"):
        read_data(DataOptions(capture, white=4095))


def test_normals_are_a_surface(tmp_path, capsys):
    normals = np.zeros((6, 8, 3))
    normals[1:5, 2:6] = (0, 0, 1)
    np.save(tmp_path / "n.npy", normals)
    out = tmp_path / "a.json"
    made(capsys, "--size", 8, 6, "--normals", tmp_path / "n.npy", "-o", out)
    assert np.asarray(pf.load_scene(out).trace().mask).sum() == 16


@pytest.mark.parametrize(
    "words, said",
    [
        ([], "out: expected the name"),
        (["-o", "a.json"], "size: expected it, or a photograph"),
        (["-o", "a.png"], "out: expected a .json"),
        (["no.png", "-o", "a.json"], "no.png: there is no such file"),
        (["--size", "8", "6", "-o", "a.json"], "sphere: expected one of"),
        (
            ["--size", "8", "6", "--sphere", "80", "3", "2", "-o", "a.json"],
            "sphere: expected a sphere that lies wholly in the 8 × 6 pixels",
        ),
        (
            ["--size", "8", "6", "--sphere", "4", "3", "2", "--light", "0", "0", "0"]
            + ["-o", "a.json"],
            "light: expected",
        ),
        (
            ["--size", "8", "6", "--sphere", "4", "3", "2", "--camera", "perspective"]
            + ["-o", "a.json"],
            "fov: expected the angle of view",
        ),
        (
            ["--size", "8", "6", "--sphere", "4", "3", "2", "--intensity", "1", "2"]
            + ["-o", "a.json"],
            "intensity: expected one number or three, got 2",
        ),
        (
            ["--size", "90000", "90000", "--sphere", "4", "3", "2", "-o", "a.json"],
            "90000 × 90000 pixels",
        ),
    ],
)
def test_what_is_missing_is_one_line(words, said, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    assert said in refused("scene", *words)
    assert not list(tmp_path.iterdir())


def test_a_folder_without_lights_says_what_to_do(capture, refused):
    ball = ["--encoding", "srgb", "--sphere", *CIRCLE]
    assert "lights: expected lights.json or an .lp for the 3 photographs" in refused(
        "scene", capture, *ball
    )
    assert sorted(path.name for path in capture.iterdir()) == [
        "1.png",
        "2.png",
        "3.png",
    ]
