"""`phongfit scene --cameras`: photographs from several places, from files of others."""

import numpy as np
import pytest
import trimesh
from PIL import Image

import phongfit as pf
from phongfit.cli import main
from tests.commands.test_scene import made
from tests.files.test_cameras import quaternion

SIZE = (40, 30)
TRUTH = pf.Material((0.5, 0.4, 0.3), 0.3, 20.0, 0.2)
LAMP = (1, 2, 2)
PLACES = ((0.5, 0.3, 4.0), (2.8, 0.4, 2.9), (-1.5, 1.8, 3.2))
LENS = "45.0 44.0 21.0 14.5 -0.2 0.05 0.001 -0.002"


@pytest.fixture
def project(tmp_path):
    """A mesh, its photographs, and what COLMAP would have found of them."""
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "ball.ply")
    mesh = pf.load_mesh(tmp_path / "ball.ply").mesh
    model, photographs = tmp_path / "sparse" / "0", tmp_path / "photos"
    model.mkdir(parents=True)
    photographs.mkdir()
    model.joinpath("cameras.txt").write_text(f"1 OPENCV {SIZE[0]} {SIZE[1]} {LENS}\n")
    fx, fy, cx, cy, *lens = map(float, LENS.split())
    lines = []
    for at, place in enumerate(PLACES, 1):
        axes = np.asarray(pf.geometry.look_at(place, (0, 0, 0)))
        turn = (axes * [1, -1, -1]).T
        pose = [*quaternion(turn), *(-turn @ np.array(place))]
        lines += [f"{at} {' '.join(map(str, pose))} 1 images/{at}.png", ""]
        camera = pf.PinholeCamera(
            *SIZE,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion=pf.geometry.BrownDistortion(*lens),
            position=place,
            rotation=axes,
        )
        scene = pf.Scene(mesh, camera, pf.DirectionalLight(LAMP), ambient=0.5)
        pf.write_image(photographs / f"{at}.png", pf.render(scene, TRUTH), "srgb")
    model.joinpath("images.txt").write_text("\n".join(lines))
    return tmp_path


def words(project, *more):
    folder = project / "photos"
    given = ["--mesh", project / "ball.ply", "--cameras", project, "--encoding", "srgb"]
    return list(map(str, [folder, *given, *more]))


def test_from_colmap_to_a_data_set(project, capsys):
    """Three views of one material, which is rendered as the photographs show it."""
    folder = project / "photos"
    pf.write_image(folder / "other.png", np.zeros((3, 3, 3)), "srgb")
    lamp = ["--light", *map(str, LAMP), "--ambient", "0.5"]
    said = made(capsys, *words(project, *lamp))
    assert "3 photographs" in said and "no camera of other.png: left out" in said
    data = pf.read_dataset(folder)
    assert [tuple(np.round(s.camera.position, 4)) for s in data.scenes] == [
        pytest.approx(place, abs=1e-4) for place in PLACES
    ]
    for scene, image in zip(data.scenes, data.images, strict=True):
        shown = np.asarray(pf.render(scene, TRUTH))
        assert shown.std() > 0.1 and np.median(np.abs(shown - image)) < 0.003
        # A vertex on an outline may fall on either side of a pixel's centre.
        assert np.mean(np.abs(shown - image) > 0.02) < 0.01


@pytest.mark.parametrize(
    "more, said",
    [
        (["--fov", "30"], "fov: "),
        (["--sphere", "1", "1", "1"], "sphere: "),
        (["--lights", "a.json"], "lights: expected an .lp with --cameras"),
        (["--lights", "a.lp"], "a.lp: cannot be read"),
        (["--mask", "a.png"], "mask: is of photographs from one place"),
        (["--cameras", "none"], "none: there is no such file"),
    ],
)
def test_what_does_not_go_together_is_one_line(more, said, project, refused):
    assert said in refused("scene", *words(project, *more))
    assert not (project / "photos" / "scene.json").exists()


def test_names_of_photographs_on_another_machine(project, capsys):
    """COLMAP's names with folders of Windows before them."""
    path = project / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("images/", "C:\\photos\\"))
    assert "3 photographs" in made(capsys, *words(project))


@pytest.mark.parametrize("orientation", [3, 6])
def test_photographs_that_are_turned(project, capsys, orientation):
    """COLMAP passes EXIF's orientation over, so that no camera would fit."""
    path = project / "photos" / "2.png"
    exif = Image.Exif()
    exif[274] = orientation
    with Image.open(path) as image:
        image.save(path, exif=exif)
    assert main(["scene", *words(project)]) == 2
    expected = "2.png: expected an upright image, got one that its EXIF orientation tur"
    assert expected in capsys.readouterr().err


def test_photographs_that_do_not_fit_their_cameras(project, refused):
    pf.write_image(project / "photos" / "2.png", np.zeros((3, 4, 3)), "srgb")
    assert "2.png: expected 40 × 30 pixels, as its camera" in refused(
        "scene", *words(project)
    )
    for at in (1, 2, 3):
        (project / "photos" / f"{at}.png").unlink()
    assert "expected cameras of photographs in" in refused("scene", *words(project))
