"""The camera's angle of view, from highlights under distant lamps."""

import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions
from phongfit.cli import main
from phongfit.maps.view_angle import _judge, _next_angle, _Noise, check_fov, seen_over
from tests.maps.synthetic import FREE, noisy, shown

SIZE, FOV = 24, 50.0
LAMPS = spread_directions(12)


def photographs(specular: float, fov: float = FOV) -> np.ndarray:
    """A ball that fills the view, with noise."""
    camera = pf.PerspectiveCamera(SIZE, SIZE, fov_y=fov, position=(0, 0, 0))
    ball = pf.Sphere((0, 0, -1 / np.sin(np.radians(fov / 2))), 1.0)
    material = pf.Material((0.5, 0.35, 0.25), specular, 25.0, 0.0)
    seen = [pf.Scene(ball, camera, pf.DirectionalLight(lamp)) for lamp in LAMPS]
    return noisy(shown(seen, material, pf.Film()), 0.004, np.random.default_rng(0))


def scenes() -> tuple[pf.Scene, ...]:
    """With parallel rays."""
    camera = pf.OrthographicCamera(SIZE, SIZE)
    lights = [pf.DirectionalLight(lamp) for lamp in LAMPS]
    return seen_over([pf.Scene(pf.Sphere(), camera, x) for x in lights], 0)


def on_the_ball() -> np.ndarray:
    rows, columns = np.indices((SIZE, SIZE)) - (SIZE - 1) / 2
    return np.hypot(rows, columns) < 0.9 * SIZE / 2


def asked(**options):
    options |= {"unknowns": ("diffuse", "specular", "shininess"), "loss": "cauchy"}
    return options | {"mask": on_the_ball(), "film": FREE}


def test_the_next_angle_is_the_vertex_of_a_parabola():
    levels = {a: np.exp([(a - 31.0) ** 2 / 1e4]) for a in (10.0, 20.0, 30.0, 40.0)}
    noise = {a: _Noise(level, np.array([5])) for a, level in levels.items()}
    assert _next_angle(noise) == pytest.approx(31, abs=0.01)
    del noise[40.0]
    assert _next_angle(noise) is None


def test_angles_without_a_common_pixel_are_not_judged():
    lost = _Noise(np.array([np.nan]), np.array([5]))
    found = _judge(dict.fromkeys((10.0, 20.0, 30.0), lost), lost, np.array([0]))
    assert not found.determined and found.stderr == np.inf


@pytest.mark.extended
def test_a_glossy_ball_shows_it():
    images = photographs(0.4)
    found = pf.fit_fov(scenes(), images, **asked())
    assert found.determined and found.noise_ratio < 0.85
    assert abs(found.degrees - FOV) < min(4 * found.stderr, 3)
    assert str(found).startswith("angle of view fitted: ")
    assert check_fov(scenes(), images, **asked()).improves
    true = seen_over(scenes(), FOV)
    assert not check_fov(true, images, **asked()).improves


@pytest.mark.extended
def test_a_matte_ball_does_not():
    found = pf.fit_fov(scenes(), photographs(0.0), **asked())
    assert not found.determined
    assert str(found) == "angle of view: not identified"


@pytest.mark.extended
def test_from_files(tmp_path, capsys):
    names = [f"{k}.png" for k in range(len(LAMPS))]
    for name, image in zip(names, photographs(0.4), strict=True):
        pf.write_image(tmp_path / name, image.clip(0, 1), "srgb")
    pf.write_lp(tmp_path / "lamps.lp", names, LAMPS)
    mask = np.repeat(on_the_ball()[..., None], 3, axis=-1).astype(float)
    pf.write_image(tmp_path / "mask.png", mask, "linear")
    given = ["maps", str(tmp_path), "--normals", "fit", "--encoding", "srgb"]
    given += ["--no-pictures", "--passes", "1"]
    assert main([*given, "-o", str(tmp_path / "flat")]) == 0
    assert "[fov-doubtful]" in capsys.readouterr().out
    assert main([*given, "-o", str(tmp_path / "deep"), "--fov", "fit"]) == 0
    told = capsys.readouterr().out
    assert "angle of view fitted: " in told and "fov-doubtful" not in told
    record = (tmp_path / "deep" / "maps.json").read_text()
    assert '"fov": 5' in record or '"fov": 49' in record
