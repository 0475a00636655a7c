"""Maps under other lights: what a render of the true scene shows, shadows too."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

import phongfit as pf
from tests.maps.hills import CAMERA, LIGHTS, SIZE, bumps, made


def test_height_is_that_of_the_normals():
    found = made().height()
    off = found.height - bumps()
    # The cell is 0.1 wide, and the hills are steep.
    assert np.ptp(off) < 0.06 and found.pieces.max() == 1
    # What geometry knows is not guessed again.
    known = dataclasses.replace(
        made(), depth=5 - bumps(), normals_stderr=np.zeros(SIZE)
    )
    np.testing.assert_allclose(known.height().height, bumps(), atol=1e-6)


def test_it_is_what_the_scene_shows():
    """A render of the hills as a mesh, with its shadows, is what relighting gives."""
    maps = made()
    found = maps.height()
    world = found.positions()
    surface = pf.NormalMap(maps.normals, positions=world)
    shadows = pf.geometry.cast_shadows(found.height, CAMERA, LIGHTS)
    pictures = maps.relight(LIGHTS)
    for light, shadow, picture in zip(LIGHTS, shadows, pictures, strict=True):
        scene = pf.Scene(surface, CAMERA, light, ambient=0.2)
        lit = np.asarray(pf.render(scene, maps.material, film=pf.Film(clamp=False)))
        dark = 0.2 * maps.ambient
        # Soft pixels lie between the two.
        low, high = np.minimum(lit, dark) - 1e-6, np.maximum(lit, dark) + 1e-6
        assert np.all((picture >= low) & (picture <= high))
        same = np.isclose(picture, np.where(shadow[..., None], dark, lit), atol=1e-6)
        assert same.mean() > 0.9 and 0.01 < shadow.mean() < 0.4
    flat = maps.relight(LIGHTS, shadows=False)
    assert np.all(flat >= pictures - 1e-6) and flat.mean() > pictures.mean() + 0.002
    np.testing.assert_allclose(
        maps.relight(LIGHTS[:1], ambient=0.0)[0],
        pictures[0] - 0.2 * maps.ambient,
        atol=1e-6,
    )


def test_a_mesh_traced_by_the_camera_has_the_same_shadows():
    """Not our own rays: the scene's, against the surface as a mesh."""
    maps = made()
    found = maps.height()
    scene = pf.Scene(found.mesh(), CAMERA, LIGHTS[:1], shadows=True)
    traced = scene.trace()
    assert traced.visibility is not None
    (shadow,) = pf.geometry.cast_shadows(found.height, CAMERA, LIGHTS[:1])
    # Where it is turned away from the light, a mesh has it in shadow too.
    turned = np.asarray(traced.surface_normal) @ np.array([1, 0.2, 0.8]) < 0.1
    sure = np.asarray(traced.mask) & ~turned
    assert (
        np.mean((np.asarray(traced.visibility[..., 0]) < 0.5)[sure] == shadow[sure])
        > 0.98
    )


def test_a_film_and_what_is_outside():
    maps = made()
    flags = np.zeros(SIZE, int)
    flags[:, :5] = int(pf.Flag.OUTSIDE)
    part = dataclasses.replace(maps, flags=flags)
    film = pf.Film(encoding="srgb", bits=8)
    (picture,) = part.relight(LIGHTS[:1], film=film)
    assert not picture[:, :5].any() and picture[:, 5:].min() > 0
    np.testing.assert_allclose(picture * 255, np.round(picture * 255), atol=1e-4)
    assert part.relight(()).shape == (0, *SIZE, 3)


def test_in_perspective_and_turned():
    """The same hills before a pinhole that is far away look the same."""
    far = pf.PerspectiveCamera(
        40, 32, fov_y=float(np.rad2deg(2 * np.arctan(1.6 / 300))), position=(0, 0, 300)
    )
    straight = made().relight(LIGHTS[:1])
    np.testing.assert_allclose(made(far).relight(LIGHTS[:1]), straight, atol=0.05)
    turned = pf.OrthographicCamera.look_at(
        (5, 0, 0), width=40, height=32, view_height=3.2
    )
    light = pf.DirectionalLight((0.8, 0.2, -1), (0.9, 0.8, 0.7))
    np.testing.assert_allclose(made(turned).relight([light]), straight, atol=1e-5)


def test_what_is_missing_is_said():
    old = dataclasses.replace(made(), camera=None)
    for ask in (old.height, lambda: old.relight(LIGHTS)):
        with pytest.raises(ValueError, match="camera: files of older versions"):
            ask()
    with pytest.raises(ValueError, match="lights: expected"):
        made().relight([3])  # pyright: ignore
    saved = made()
    assert eqx.tree_equal(saved.camera, CAMERA)
