"""`phongfit fit` with textures among the unknowns: files in, files out."""

import dataclasses
import json
import warnings

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import main
from phongfit.files.schema import ImageRecord
from tests.fitting.texels import ball, checkers
from tests.fitting.texels.scenes import NOISE, SIZE, TRUE, painted, scenes, shiny
from tests.helpers import known as present, near

ASKED = ["--unknowns", "diffuse.texture", "specular", "shininess"]
SIZED = ["--texture-size", *map(str, SIZE), "--per-channel", "diffuse"]


def write(folder, views, material, bare, encoding, seed):
    """Photographs of these views, and a scene file with all but their textures."""
    noise = np.random.default_rng(seed)
    for at, scene in enumerate(views):
        light = np.asarray(pf.render(scene, material))
        light = np.clip(light + NOISE * noise.normal(size=light.shape), 0, 1)
        pf.write_image(folder / f"{at}.png", light, encoding, bits=16)
    images = [ImageRecord(file=f"{at}.png", lights=[at]) for at in range(len(views))]
    lights = [light for scene in views for light in scene.lights]
    bare = dataclasses.replace(bare, lights=lights)
    film = pf.Film(encoding=encoding, bits=16)
    cameras = [scene.camera for scene in views]
    pf.save_scene(folder, bare, film=film, images=images, cameras=cameras)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A folder with the photographs of a plate, as `phongfit scene` lists them."""
    folder = tmp_path_factory.mktemp("texels") / "photographs"
    folder.mkdir()
    write(folder, painted(diffuse=TRUE), shiny(), scenes()[0], "srgb", seed=3)
    return folder


def test_from_photographs_to_a_mesh_for_others(photographs, tmp_path, capsys, refused):
    out = tmp_path / "fit"
    assert main(["fit", str(photographs), "-o", str(out), *ASKED, *SIZED]) == 0
    said = capsys.readouterr().out
    assert "texels identified" in said and "mesh.glb" in said
    arrays = np.load(out / "textures.npz")
    values, errors = arrays["diffuse"][0], arrays["stderr_diffuse"][0]
    known = np.isfinite(errors)
    pulls = ((values - TRUE) / errors)[known]
    assert known.mean() > 0.9 and 0.8 < np.sqrt(np.mean(pulls**2)) < 1.2
    # What nothing sees is marked, and filled in the mesh alone.
    assert np.isinf(errors[arrays["seen"][0] == 0]).all()
    record = json.loads((out / "textures.json").read_text())
    assert record["converged"] and not record["warnings"]
    numbers = zip(record["values"], record["errors"], (0.3, 20.0), strict=True)
    for value, error, true in numbers:
        assert abs(value - true) < 4 * error < 0.2 * true
    assert record["labels"] == ["specular", "shininess"]
    # The mesh is the scene again, and so it is in other formats.
    seen = np.asarray(scenes()[0].trace().mask)
    expected = np.asarray(pf.render(painted(diffuse=TRUE)[0], shiny()))
    again = tmp_path / "again.obj"
    assert main(["export", str(out), "-o", str(again)]) == 0
    for file in (out / "mesh.glb", again):
        mesh, material, names = pf.load_mesh(file)
        assert len(names) == 1
        near(material.shininess, record["values"][1], 1e-3)
        near(material.specular, record["values"][0], 1e-3)
        texture = present(present(mesh.textures)[0].diffuse)
        read = np.asarray(material.diffuse) * np.asarray(texture.values)
        # To the rounding of pictures.
        near(read[known.all(axis=-1)], values[known.all(axis=-1)], 2e-4)
        scene = pf.Scene(mesh, scenes()[0].camera, scenes()[0].lights, ambient=0.2)
        left = (np.asarray(pf.render(scene, material)) - expected)[seen]
        assert np.sqrt(np.mean(left**2)) < 2 * NOISE
    page = (out / "report.html").read_text()
    for words in ("Textures", "12 × 12 texels", "specular", "--texture-size 12 12"):
        assert words in page, words
    # Again, in its place.
    words = ["fit", str(photographs), "-o", str(out), *ASKED, *SIZED]
    assert "is not empty" in refused(*words)


@pytest.mark.extended
def test_from_photographs_to_numbers_at_vertices(tmp_path, capsys):
    folder, out = tmp_path / "ball", tmp_path / "fit"
    folder.mkdir()
    views = ball.painted(diffuse=ball.TRUE)
    for at, light in enumerate(ball.images()):
        pf.write_image(folder / f"{at}.png", np.clip(light, 0, 1), "srgb", bits=16)
    images = [ImageRecord(file=f"{at}.png", lights=[at]) for at in range(len(views))]
    lights = [light for scene in views for light in scene.lights]
    bare = dataclasses.replace(ball.scenes()[0], lights=lights)
    film = pf.Film(encoding="srgb", bits=16)
    cameras = [scene.camera for scene in views]
    pf.save_scene(folder, bare, film=film, images=images, cameras=cameras)
    asked = [*ASKED, "--texture-size", "vertices", "--per-channel", "diffuse"]
    assert main(["fit", str(folder), "-o", str(out), *asked]) == 0
    assert "162 vertices identified" in capsys.readouterr().out
    arrays = np.load(out / "textures.npz")
    values, errors = arrays["diffuse"][0], arrays["stderr_diffuse"][0]
    told = np.isfinite(errors) & (arrays["seen"][0] >= 3)[:, None]
    pulls = ((values - ball.TRUE) / errors)[told]
    assert told.mean() > 0.85 and 0.9 < np.sqrt(np.mean(pulls**2)) < 1.1
    record = json.loads((out / "textures.json").read_text())
    assert record["settings"]["size"] == "vertices" and record["texels"] == 162
    # The mesh of the folder has them, and an .obj of it.
    again = tmp_path / "again.obj"
    assert main(["export", str(out), "-o", str(again)]) == 0
    for file in (out / "mesh.glb", again):
        mesh, material, _ = pf.load_mesh(file)
        rows = present(present(mesh.textures)[0].diffuse)
        read = np.asarray(material.diffuse) * np.asarray(rows.values)
        whole = np.isfinite(errors).all(axis=-1)
        near(read[whole], values[whole], 1e-5)
    page = (out / "report.html").read_text()
    for words in (
        "a number for each of 162 vertices",
        "at vertices, linear over each triangle",
        "--texture-size vertices",
        "Vertices as they look",
    ):
        assert words in page, words


@pytest.mark.extended
def test_ambient_has_no_place_in_gltf(photographs, tmp_path, capsys):
    out = tmp_path / "fit"
    asked = ["--unknowns", "ambient.texture", "--known", "preset:brass"]
    words = ["fit", str(photographs), "-o", str(out), *asked, *SIZED]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main([*words, "--report", "none", "--smoothness", "0.1"]) == 0
    told = capsys.readouterr().err
    assert "warning: ambient: glTF has no texture of it; the nearest is taken" in told
    assert "ambient" in np.load(out / "textures.npz")


@pytest.mark.parametrize(
    "more, said",
    [
        (ASKED, "texture_size: expected columns and rows of the textures, or vertices"),
        ([*ASKED, "--texture-size", "faces"], "texture-size"),
        (["--separate"], "separate: is of textures, expected one among the unknowns"),
        ([*ASKED, *SIZED, "--fixed", "shininess=3"], "fixed: expected its default in"),
        ([*ASKED, *SIZED, "--loss", "huber"], "loss: expected its default in"),
        ([*ASKED, *SIZED, "--refine-lights"], "refine_lights: expected none with"),
        (["--unknowns", "gloss.texture", *SIZED], "unknowns: expected some of ambient"),
        (
            ["--unknowns", "shininess.texture", "shininess", *SIZED],
            "unknowns: expected shininess or",
        ),
    ],
)
def test_what_does_not_go_with_textures(more, said, photographs, tmp_path, refused):
    assert said in refused("fit", photographs, "-o", tmp_path / "out", *more)
    assert not (tmp_path / "out").exists()


def test_fit_says_who_finds_texels():
    image = np.zeros((32, 32, 3))
    with pytest.raises(ValueError, match="by fit_texture, got 'diffuse.texture'"):
        pf.fit(scenes()[0], image, unknowns=("diffuse.texture", "specular"))


@pytest.mark.extended
@pytest.mark.parametrize(
    "model, names, scale",
    [
        (pf.BlinnPhong(), ("diffuse", "specular", "shininess"), 1.0),
        # Of which ρ_s is multiplied by what depends on f.
        (pf.BlinnPhong(normalized=True), ("diffuse", "shininess"), 0.1),
    ],
)
def test_exponents_of_texels_by_way_of_files(model, names, scale, tmp_path, capsys):
    folder, out = tmp_path / "photographs", tmp_path / "fit"
    folder.mkdir()
    plain = np.full((*SIZE, 3), 0.4)
    painted = {
        "diffuse": checkers.DIFFUSE,
        "specular": scale * plain,
        "shininess": checkers.EXPONENT,
    }
    views = [
        dataclasses.replace(one, specular_model=model)
        for one in checkers.painted(6, **painted)
    ]
    bare = dataclasses.replace(checkers.scenes()[0], specular_model=model)
    write(folder, views, checkers.unit(), bare, "linear", seed=5)
    asked = [f"{name}.texture" if name in names else name for name in painted]
    words = ["fit", str(folder), "-o", str(out), "--unknowns", *asked]
    report = "full" if scale == 1 else "none"
    assert main([*words, *SIZED, "--report", report]) == 0
    assert "shininess: " in capsys.readouterr().out
    arrays = np.load(out / "textures.npz")
    f, errors = arrays["shininess"], arrays["stderr_shininess"]
    assert f.shape == errors.shape == (1, *SIZE, 1)
    known = np.isfinite(errors)
    pulls = ((np.log(f) - np.log(checkers.EXPONENT)) * f / errors)[known]
    assert known.mean() > 0.95 and 0.85 < np.sqrt(np.mean(pulls**2)) < 1.15
    record = json.loads((out / "textures.json").read_text())
    assert record["identified"]["shininess"] == known[..., 0].sum()
    assert record["converged"] and not record["warnings"]
    # Un-normalised Blinn-Phong looks the same, in either file.
    again = tmp_path / "again.obj"
    assert main(["export", str(out), "-o", str(again)]) == 0
    for file in (out / "mesh.glb", again):
        mesh, material, _ = pf.load_mesh(file)
        texture = present(present(mesh.textures)[0].shininess)
        read = float(material.shininess) * np.asarray(texture.values)
        # To the rounding of pictures of 16 bits.
        near(read[known[0]], f[0][known[0]], 2e-3)
        for view in views[:3]:
            scene = pf.Scene(mesh, view.camera, view.lights)
            seen = np.asarray(scene.trace().mask)
            left = np.asarray(
                pf.render(scene, material) - pf.render(view, checkers.unit())
            )
            assert np.sqrt(np.mean(left[seen] ** 2)) < 2 * NOISE
    if report == "full":
        assert (out / "shininess.png").is_file()
        page = (out / "report.html").read_text()
        assert "shininess are identified" in page
