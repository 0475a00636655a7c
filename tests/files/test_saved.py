"""Fits saved and loaded again, here and in another process."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.saved import write_packed
from phongfit.lights import AbstractLight, Illumination
from phongfit.vectors import normalize
from tests.fitting.scenes import SIZE

TRUTH = pf.Material((0.6, 0.3, 0.2), 0.3, 20.0, 0.5)
CAMERA = pf.OrthographicCamera(SIZE, SIZE)
LIGHT = pf.DirectionalLight((1, 1, 2))


# Few unknowns are compiled soon, and more of a specification is kept.
FEW: dict[str, Any] = {"unknowns": ("diffuse", "specular"), "known": TRUTH}


class Beam(AbstractLight):
    """A light of one's own."""

    direction: jax.Array

    def illuminate(self, position):
        light = jax.numpy.ones_like(position)
        far = jax.numpy.array(np.inf, position.dtype)
        return Illumination(normalize(self.direction), light, light, 0 * light, far)


def fitted(*scenes, **options):
    """A fit of photographs with noise."""
    rng = np.random.default_rng(0)
    images = [np.asarray(pf.render(s, TRUTH)) for s in scenes]
    images = [image + 0.01 * rng.normal(size=image.shape) for image in images]
    if len(scenes) == 1:
        return pf.fit(scenes[0], images[0], **options)
    return pf.fit(scenes, images, **options)


@pytest.fixture(scope="module")
def fit():
    return fitted(pf.Scene(pf.Sphere(), CAMERA, LIGHT, ambient=0.3), **FEW)


def test_a_loaded_fit_says_what_it_said(fit, tmp_path):
    fit.save(tmp_path / "fit.npz")
    again = pf.load_fit(tmp_path / "fit.npz")
    assert str(again) == str(fit)
    assert again.to_dict() == fit.to_dict()
    assert again.specification == fit.specification
    np.testing.assert_array_equal(again.residuals, fit.residuals)
    np.testing.assert_array_equal(again.intervals(0.68), fit.intervals(0.68))
    assert again.plot() is not None


@pytest.mark.extended
def test_a_loaded_fit_is_worked_with(fit, tmp_path):
    fit.save(tmp_path / "fit.npz")
    again = pf.load_fit(tmp_path / "fit.npz")
    profile, then = again.profile("specular.red"), fit.profile("specular.red")
    np.testing.assert_array_equal(profile.rise, then.rise)
    material = pf.refit(again, again.scene, again.photographs)
    np.testing.assert_allclose(material.specular, fit.material.specular, rtol=1e-4)


@pytest.mark.extended
def test_in_another_process(fit, tmp_path):
    path = tmp_path / "fit.npz"
    pf.save_fit(path, fit)
    code = f"import phongfit as pf; print(pf.load_fit({str(path)!r}))"
    run = [sys.executable, "-c", code]
    root = Path(pf.__file__).parents[1]
    done = subprocess.run(run, capture_output=True, text=True, cwd=root, check=True)
    assert done.stdout.rstrip("\n") == str(fit)


@pytest.mark.extended
@pytest.mark.parametrize(
    "scenes",
    [
        (
            pf.Scene(
                pf.geometry.tessellate(
                    lambda u, v: jax.numpy.stack([2 * u - 1, 2 * v - 1, u * v]),
                    columns=5,
                    rows=5,
                ),
                CAMERA,
                (LIGHT, pf.PointLight((1, 2, 3), 3.0)),
                ambient=0.3,
                shading=pf.GouraudShading(),
                fog=pf.Fog((0.5, 0.5, 0.5), density=0.1),
            ),
        ),
        tuple(
            pf.Scene(pf.Sphere(), CAMERA, Beam(jax.numpy.array([x, 1.0, 2.0])), 0.2)
            for x in (0.0, 1.0)
        ),
    ],
    ids=["mesh, fog and lights", "lights of one's own"],
)
def test_scenes_of_many_kinds(scenes, tmp_path):
    fit = fitted(*scenes, loss="huber", **FEW)
    pf.save_fit(tmp_path / "fit.npz", fit)
    again = pf.load_fit(tmp_path / "fit.npz")
    assert str(again) == str(fit)
    assert jax.tree.structure(again.scene) == jax.tree.structure(fit.scene)
    leaves = zip(jax.tree.leaves(again.scene), jax.tree.leaves(fit.scene), strict=True)
    for one, other in leaves:
        np.testing.assert_array_equal(one, other)


def test_functions_cannot_be_saved(tmp_path):
    path = tmp_path / "fit.npz"
    with pytest.raises(ValueError, match=r"^scene\[0\]: a function cannot be saved"):
        write_packed(path, {}, _Holds([len]))
    assert not path.exists()


class _Holds(eqx.Module):
    scene: list


def test_what_it_does_not_know_is_named(fit, tmp_path):
    path = tmp_path / "fit.npz"
    path.write_bytes(b"PK no archive")
    with pytest.raises(ValueError, match="fit.npz: is no file that Fit.save"):
        pf.load_fit(path)
    np.savez(path, a=np.ones(3))
    # Of a version of the archive's format that nobody knows.
    path.write_bytes(
        path.read_bytes().replace(b"PK\1\2\x2d\3\x2d", b"PK\1\2\x2d\3\xcf")
    )
    with pytest.raises(ValueError, match="fit.npz: is no file that Fit.save"):
        pf.load_fit(path)
    np.savez(path, a=np.ones(3))
    with pytest.raises(ValueError, match="fit.npz: is no file that Fit.save"):
        pf.load_fit(path)
    double = np.result_type(pf.render(fit.scene, TRUTH).dtype) == np.float64
    here, there = ("float64", "float32") if double else ("float32", "float64")
    header = {"format": "phongfit saved fit", "version": 1, "precision": there}
    write_packed(path, header, 1)
    with pytest.raises(ValueError, match=f"expected {here}, got {there}; set JAX"):
        pf.load_fit(path)
    header["precision"] = here
    write_packed(path, header, _Holds([1.5]))
    with pytest.raises(ValueError, match="fit.npz: expected a Fit, got a _Holds"):
        pf.load_fit(path)
    write_packed(path, header | {"version": 9}, 1)
    with pytest.raises(ValueError, match="version: expected 1, got 9; read it with"):
        pf.load_fit(path)
