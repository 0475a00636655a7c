"""Fits of meshes: every shading method, fog, shadows, several materials."""

import numpy as np
import pytest

import phongfit as pf
from experiments.references import REFERENCES, read_reference
from phongfit.material import stack_materials
from tests.fitting import canonical
from tests.fitting.scenes import SIZE, photograph, truth

TRUTH = stack_materials([truth(), canonical.plastic()])


# Gouraud's is `canonical.mesh`, which `test_fit` holds.
@pytest.mark.extended
@pytest.mark.parametrize(
    "shading",
    [pf.FlatShading(), pf.GouraudShading(clamp=True), pf.PhongShading()],
    ids=["flat", "gouraud-clamped", "phong"],
)
def test_every_shading_method_gives_the_material_back(shading):
    found = canonical.solved(canonical.mesh_scene(shading), TRUTH)
    assert found.fit.converged
    assert np.all(np.abs(found.pulls()) < 4.5)
    assert found.fit.misfit.over_repeatability == pytest.approx(1, abs=0.05)


@pytest.mark.extended
def test_two_views_of_one_mesh_in_different_light():
    mesh = pf.shapes.Torus().mesh(48, 24)
    scenes = [
        pf.Scene(
            mesh,
            pf.OrthographicCamera.look_at(place, width=48, height=48, view_height=3.2),
            lights,
            ambient=0.2,
            shading=pf.GouraudShading(),
        )
        for place, lights in (
            ((0, 2, 4), [pf.DirectionalLight((1, 1, 2), 0.8)]),
            ((3, 2, 3), [pf.PointLight((2, 3, 2), 0.5), pf.PointLight((0, 3, 4), 0.5)]),
        )
    ]
    material = canonical.plastic()
    images = [
        photograph(scene, material, noise=0.01, seed=k)
        for k, scene in enumerate(scenes)
    ]
    fit = pf.fit(scenes, images)
    assert fit.converged
    assert np.all(np.abs(canonical.pulls(fit, material)) < 4.5)


@pytest.mark.parametrize(
    "name, loss",
    [
        pytest.param("scene00", "linear", marks=pytest.mark.extended),
        pytest.param("scene01", "linear", marks=pytest.mark.slow),
        pytest.param("scene00", "tukey", marks=pytest.mark.slow),
        pytest.param("scene01", "tukey", marks=pytest.mark.slow),
    ],
)
def test_materials_of_a_ray_traced_scene(name, loss):
    reference = read_reference(REFERENCES / "povray" / f"{name}.json")
    image = reference.image.astype(np.asarray(reference.material.diffuse).dtype)
    fit = pf.fit(
        reference.scene, image, mask=reference.covered, film=reference.film, loss=loss
    )
    assert fit.converged
    highlight = np.asarray(reference.material.specular).max(axis=-1) > 0
    dark = np.array(
        [
            label.startswith(("specular", "shininess"))
            and not highlight[int(label.split("[")[1][0])]
            for label in fit.labels
        ]
    )
    truth = canonical.true_values(fit.labels, reference.material)
    # Where a highlight is there to be seen, all is found; where none is, that is said.
    np.testing.assert_allclose(fit.values[~dark], truth[~dark], rtol=0.02)
    assert np.all(np.isfinite(fit.errors[~dark]))
    shininess = np.array([label.startswith("shininess") for label in fit.labels])
    assert dark.any()
    assert np.all(np.isinf(fit.errors[dark & shininess]))


@pytest.mark.extended
def test_wrong_shading_is_told_and_not_fitted_away():
    """A highlight between the corners of a coarse mesh, which Gouraud's misses."""
    scene, right = canonical.mesh().scene, canonical.mesh_scene(pf.PhongShading())
    image = photograph(right, TRUTH, noise=0.01)
    wrong = pf.fit(scene, image)
    assert any("residuals are not noise" in warning for warning in wrong.warnings)
    off = canonical.pulls(wrong, TRUTH)
    assert np.all(np.abs(off[np.isfinite(wrong.errors)]) < 4)


def test_scenes_must_compute_light_alike():
    scenes = [
        canonical.mesh_scene(shading)
        for shading in (pf.PhongShading(), pf.GouraudShading())
    ]
    with pytest.raises(ValueError, match="scene: .* same shading"):
        pf.fit(scenes, [np.zeros((SIZE, SIZE, 3))] * 2)


def test_a_mesh_outside_the_view():
    scene = pf.Scene(
        pf.shapes.Ball().mesh(16, 8),
        pf.PerspectiveCamera(32, 32, position=(0, 0, -5)),
        pf.DirectionalLight((0, 0, 1)),
    )
    with pytest.warns(UserWarning, match="view"):
        image = pf.render(scene, canonical.plastic())
    with (
        pytest.warns(UserWarning, match="view"),
        pytest.raises(ValueError, match="mask: it leaves no pixel"),
    ):
        pf.fit(scene, np.asarray(image))
