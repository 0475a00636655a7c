"""Fits of meshes: every shading method, fog, shadows, several materials."""

import numpy as np
import pytest

import phongfit as pf
from experiments.references import REFERENCES, read_reference

TRUTH = pf.Material((0.4, 0.3, 0.2), 0.5, 40.0, 0.3)
BALL = pf.shapes.Ball().mesh(48, 24)


def noisy(image, seed=0, sigma=0.01):
    noise = np.random.default_rng(seed).normal(size=image.shape)
    return np.clip(np.asarray(image) + sigma * noise, 0, 1).astype(image.dtype)


def true_values(material, labels):
    """The true material in the order of a fit's labels, whatever their shape."""
    channels = ("red", "green", "blue")
    values = []
    for label in labels:
        name, _, channel = label.partition(".")
        leaf, _, row = name.rstrip("]").partition("[")
        value = np.asarray(getattr(material, leaf), float)
        value = value[int(row)] if row and value.ndim == 2 else value
        value = np.broadcast_to(value, (3,))
        values.append(value[channels.index(channel)] if channel else value[0])
    return np.array(values)


@pytest.mark.parametrize(
    "shading",
    [
        pf.FlatShading(),
        pf.GouraudShading(),
        pf.GouraudShading(clamp=True),
        pf.PhongShading(),
    ],
    ids=["flat", "gouraud", "gouraud-clamped", "phong"],
)
def test_every_shading_method_gives_the_material_back(shading):
    scene = pf.Scene(
        BALL,
        pf.PerspectiveCamera(64, 64, position=(0, 0, 5)),
        (pf.DirectionalLight((1, 1, 2), 0.7), pf.PointLight((-2, 1, 2), 0.5)),
        ambient=0.3,
        shading=shading,
        fog=pf.Fog((0.5, 0.6, 0.7), "exp", density=0.1),
    )
    fit = pf.fit(scene, noisy(pf.render(scene, TRUTH)))
    assert fit.converged
    off = (fit.values - true_values(TRUTH, fit.labels)) / fit.errors
    assert np.all(np.abs(off) < 4.5)
    assert fit.misfit.over_repeatability == pytest.approx(1, abs=0.05)


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
    images = [noisy(pf.render(s, TRUTH), seed) for seed, s in enumerate(scenes)]
    fit = pf.fit(scenes, images)
    assert fit.converged
    off = (fit.values - true_values(TRUTH, fit.labels)) / fit.errors
    assert np.all(np.abs(off) < 4.5)


@pytest.mark.parametrize(
    "name, loss",
    [
        ("scene00", "linear"),
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
    truth = true_values(reference.material, fit.labels)
    dark = np.array(
        [
            label.startswith(("specular", "shininess"))
            and not true_values(
                reference.material, [f"specular[{label.split('[')[1][0]}].red"]
            ).any()
            for label in fit.labels
        ]
    )
    # Where a highlight is there to be seen, all is found; where none is, that is said.
    np.testing.assert_allclose(fit.values[~dark], truth[~dark], rtol=0.02)
    assert np.all(np.isfinite(fit.errors[~dark]))
    shininess = np.array([label.startswith("shininess") for label in fit.labels])
    assert dark.any()
    assert np.all(np.isinf(fit.errors[dark & shininess]))


def triangle(shading):
    """One large triangle with the highlight in its middle, far from all its corners."""
    return pf.Scene(
        pf.Mesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]]),
        pf.PerspectiveCamera(48, 48, position=(0, 0, 4), fov_y=32),
        pf.PointLight((0, -0.3, 2.0)),
        ambient=0.3,
        shading=shading,
    )


def test_wrong_shading_is_told_and_not_fitted_away():
    target = pf.render(triangle(pf.PhongShading()), TRUTH)
    missed = pf.render(triangle(pf.GouraudShading()), TRUTH)
    assert target.max() > 2 * missed.max()

    image = noisy(target)
    wrong = pf.fit(triangle(pf.GouraudShading()), image)
    assert any("residuals are not noise" in warning for warning in wrong.warnings)
    identified = np.isfinite(wrong.errors)
    truth = true_values(TRUTH, wrong.labels)
    assert np.all(
        np.abs(wrong.values - truth)[identified] < 4 * wrong.errors[identified]
    )
    given = pf.fit(triangle(pf.GouraudShading()), image, noise=0.01)
    assert given.reduced_chi_squared > 10
    assert any("noise that was given" in warning for warning in given.warnings)

    right = pf.fit(triangle(pf.PhongShading()), image)
    assert not right.warnings
    assert np.all(np.abs(right.values - truth) < 4.5 * right.errors)


def test_scenes_must_compute_light_alike():
    scenes = [triangle(pf.PhongShading()), triangle(pf.GouraudShading())]
    images = [np.zeros((48, 48, 3))] * 2
    with pytest.raises(ValueError, match="scene: .* same shading"):
        pf.fit(scenes, images)


def test_a_mesh_outside_the_view():
    scene = pf.Scene(
        BALL,
        pf.PerspectiveCamera(32, 32, position=(0, 0, -5)),
        pf.DirectionalLight((0, 0, 1)),
    )
    with pytest.warns(UserWarning, match="view"):
        image = pf.render(scene, TRUTH)
    with (
        pytest.warns(UserWarning, match="view"),
        pytest.raises(ValueError, match="mask: it leaves no pixel"),
    ):
        pf.fit(scene, np.asarray(image))
