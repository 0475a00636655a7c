"""Normals with the material: the truth within the errors, and no error that is none."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.pixel.errors import Profile, _widened, _Widths
from phongfit.maps.pixel.settings import Point, Unknowns
from phongfit.maps.pixel.step import Edges
from tests.maps.pixel.scenes import NOISE, Hidden, hide
from tests.maps.synthetic import FREE, pulls, shown, spread


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    return hide()


@pytest.fixture(scope="module")
def maps(hidden: Hidden) -> pf.Maps:
    return found(hidden)


def found(hidden: Hidden, images: np.ndarray | None = None, **options) -> pf.Maps:
    images = hidden.images if images is None else images
    options = {"film": FREE, "normals": "fit", "passes": 1} | options
    return pf.fit_maps(hidden.scenes, images, **options)


def test_a_profile_that_is_nan_leaves_no_finite_error():
    one, yes = jnp.ones(1), jnp.ones(1, bool)
    point = Point(jnp.ones((3, 1)), one, *(jnp.ones((1, 1)) for _ in range(3)))
    beside = Point(*(jnp.stack([leaf, leaf]) for leaf in point))
    profile = Profile(beside, jnp.array([[jnp.nan], [4.0]]), yes)
    widths = _Widths(one, (jnp.ones((1, 1)),), one, one, ~yes)
    edges = Edges(((0.0, 1.0),), (0.0, 1.0), (0.0, 5.0))
    which = Unknowns(("diffuse",), True, False)
    for vague, lost in ((yes, True), (~yes, False)):
        wide = _widened(point, profile, widths, one, vague, vague, which, edges)
        for error in (wide.normal, wide.own[0], wide.exponent):
            assert bool(jnp.isnan(error).all()) == lost


def check_truth(hidden: Hidden, maps: pf.Maps, least: float = 0.95) -> None:
    """Errors that hold: of normals and of the material."""
    assert maps.identified.mean() > least
    pull = np.sort(hidden.pulls(maps) ** 2)
    # One in two hundred may be another basin's.
    assert 0.85 < np.sqrt(pull[: int(0.995 * pull.size)].mean()) < 1.12
    for name in ("diffuse", "specular", "shininess"):
        assert 0.7 < spread(pulls(maps, hidden.truth, name)) < 1.15, name
    level = maps.noise[maps.identified] / NOISE
    assert np.median(level**2) == pytest.approx(1, abs=0.1)


@pytest.mark.extended
def test_truth_lies_within_the_errors(hidden, maps):
    check_truth(hidden, maps)
    assert hidden.angles(maps).mean() < 1
    np.testing.assert_allclose(np.linalg.norm(maps.normals, axis=-1), 1, rtol=1e-5)


@pytest.mark.extended
def test_shadows_disturb_little(hidden, maps):
    """Cast shadows, light that bounced, what no lamp reaches but noise."""
    images = hidden.images.copy()
    images[:4, 4:8] *= 0.1
    images[7, 8:10] += 0.3
    images[:, 2, 5] = NOISE * np.random.default_rng(5).normal(size=(24, 3))
    seen = found(hidden, images)
    assert np.isinf(seen.normals_stderr[2, 5]) and not seen.identified[2, 5]
    assert np.isinf(seen.stderr.diffuse[2, 5]).all()
    assert np.median(hidden.angles(seen)[4:10]) < 1
    calm = np.ones((16, 24), bool)
    calm[4:10] = calm[2, 5] = False
    # Pixels disturb none beside them.
    assert np.median(np.abs(seen.diffuse - maps.diffuse)[calm]) < 1e-4
    assert hidden.angles(seen)[calm].mean() < 1


@pytest.mark.extended
def test_lamps_in_one_plane_tell_no_normal(hidden):
    angle = np.linspace(-1.2, 1.2, 24)
    plane = np.stack([np.sin(angle), 0.3 * np.cos(angle), np.cos(angle)], axis=-1)
    row = hide(directions=plane / np.linalg.norm(plane, axis=-1, keepdims=True))
    seen = found(row)
    assert seen.flagged(pf.Flag.IN_A_PLANE).all()
    assert np.isinf(seen.normals_stderr).all() and not seen.identified.any()
    assert np.isinf(seen.stderr.diffuse).all() and np.isinf(seen.stderr.shininess).all()
    assert "in a plane" in str(seen)


@pytest.mark.parametrize(
    "count, options, words",
    [
        (4, {}, "images: expected at least 5 .*unknowns=\\('diffuse',\\)"),
        (2, {"unknowns": ("diffuse",)}, "images: expected at least 3 .*got 2"),
        (24, {"unknowns": ("specular",)}, "unknowns: expected diffuse"),
        (24, {"per_channel": ("diffuse", "shininess")}, "no shininess"),
        (24, {"min_cosine": 0.1}, "min_cosine: expected 0"),
        (24, {"normals": "found"}, "normals: expected"),
    ],
)
def test_wrong_arguments_are_named(count, options, words):
    hidden = hide((4, 6))
    given = {"normals": "fit", **options}
    with pytest.raises(ValueError, match=words):
        pf.fit_maps(hidden.scenes[:count], hidden.images[:count], **given)


@pytest.mark.extended
def test_a_matte_surface_needs_three_lamps():
    """Lambert's photometric stereo, from the fewest lamps there can be."""
    hidden = hide((16, 24), 3)
    matte = pf.Material(hidden.truth.diffuse, 0.0, 1.0, 0.0)
    surface = pf.NormalMap(hidden.normals)
    camera = pf.OrthographicCamera(24, 16)
    scenes = [pf.Scene(surface, camera, s.lights) for s in hidden.scenes]
    images = shown(scenes, matte)
    asked = {"film": FREE, "normals": "fit", "passes": 1, "unknowns": ["diffuse"]}
    seen = pf.fit_maps(scenes, images, **asked)
    lit = np.min(images, axis=(0, 3)) > 0
    assert hidden.angles(seen)[lit].max() < 0.1
    np.testing.assert_allclose(
        seen.diffuse[lit], np.asarray(hidden.truth.diffuse)[lit], rtol=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("lights", [12, 96])
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("model", [pf.Phong(), pf.BlinnPhong()], ids=["phong", "blinn"])
def test_errors_hold_for_all_kinds(lights, near, model):
    exponents = (6, 12) if isinstance(model, pf.Phong) else (8, 30)
    hidden = hide(
        (24, 24),
        lights,
        near=near,
        perspective=near,
        model=model,
        exponents=exponents,
        seed=lights,
    )
    check_truth(hidden, found(hidden), least=0.9)


@pytest.mark.extended
def test_lights_mirrored_in_y_are_hinted_at():
    """A dome, and its list of lights with y of the wrong sign."""
    dome = hide(surface="dome")
    assert not found(dome).warnings
    mirrored = []
    for scene in dome.scenes:
        (lamp,) = scene.lights
        assert isinstance(lamp, pf.DirectionalLight)
        x, y, z = np.asarray(lamp.direction)
        light = pf.DirectionalLight((x, -y, z), lamp.intensity)
        mirrored.append(dataclasses.replace(scene, lights=(light,)))
    seen = found(dome._replace(scenes=mirrored))
    assert "bulge the wrong way" in str(seen)
