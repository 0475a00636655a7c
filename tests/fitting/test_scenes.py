"""Numbers of the scenes as unknowns: found, or named as unidentified."""

import equinox as eqx
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.parameters import scene_arrays
from tests.fitting import canonical
from tests.fitting.scenes import (
    PARAMETERS,
    as_vector,
    ball,
    photograph,
    truth,
    two_lights,
)
from tests.helpers import floats, near, only

TRUTH = truth()

NOISE = 0.01
COLOURS = ("red", "green", "blue")
PARTS = (*COLOURS, "x", "y", "z")
SCENE = ball()
ONE_LIGHT = pf.Scene(
    pf.Sphere(), SCENE.camera, pf.DirectionalLight((1, 1, 2), 0.5), 0.3
)


def changed(scene: pf.Scene, arrays: dict) -> pf.Scene:
    """The scene with other numbers in some places."""
    for name, value in arrays.items():

        def where(scene: pf.Scene, name: str = name):
            return eval(name, {"scene": scene})

        scene = eqx.tree_at(where, scene, floats(value))
    return scene


def true_values(fit: pf.Fit, scene: pf.Scene) -> np.ndarray:
    """The truth in the order of a fit's labels; directions of length 1."""
    arrays = scene_arrays(scene)
    truth = {f"{name}.": getattr(TRUTH, name) for name in PARAMETERS}
    for name, array in arrays.items():
        long = name.endswith("direction")
        truth[f"{name}."] = array / np.linalg.norm(array) if long else array
    values = []
    for label in fit.labels:
        name, _, part = label.rpartition(".")
        if part in PARTS:
            values.append(np.asarray(truth[f"{name}."])[PARTS.index(part) % 3])
        else:
            values.append(np.mean(truth[f"{label}."]))
    return np.array(values)


LIGHTS = (
    pf.DirectionalLight((1, 1, 2), (0.35, 0.3, 0.25)),
    pf.PointLight((-2, 0.5, 2), 0.3, attenuation=(1, 0.05, 0.02)),
    pf.SpotLight((0, -3, 2), (0, 3, -2), 0.5, cutoff=60, exponent=6),
)
MIXED = pf.Scene(
    pf.Sphere(),
    SCENE.camera,
    LIGHTS,
    ambient=0.3,
    fog=pf.Fog((0.3, 0.3, 0.4), "exp", density=0.1),
)
START = {
    "scene.lights[0].direction": (2, 0.5, 2),
    "scene.lights[0].intensity": (0.2, 0.5, 0.3),
    "scene.lights[1].position": (-1.5, 1, 3),
    "scene.lights[2].exponent": 3,
    "scene.fog.density": 0.2,
    "scene.ambient": (0.5, 0.5, 0.5),
}


@pytest.mark.extended
def test_a_direction_is_found():
    solved = canonical.unknown_direction()
    fit = solved.fit
    assert fit.converged and not fit.warnings
    off = fit.values - true_values(fit, solved.scene)
    assert np.all(np.abs(off) < 4 * fit.errors), fit
    assert 0.9 < fit.noise / NOISE < 1.1
    check_direction(fit)
    # The result's scene is lit from there.
    arrays = scene_arrays(only(fit.scene))
    near(arrays["scene.lights[0].direction"], fit["scene.lights[0].direction"].value)


def check_direction(fit: pf.Fit) -> None:
    """It stays on the sphere: three components that know two numbers."""
    direction = fit["scene.lights[0].direction"]
    near(np.linalg.norm(direction.value), 1, 1e-6)
    at = [fit.labels.index(f"scene.lights[0].direction.{axis}") for axis in "xyz"]
    covariance = fit.covariance[np.ix_(at, at)]
    near(np.diag(covariance), direction.error**2, 1e-6)
    spread = np.linalg.eigvalsh(covariance)
    assert abs(spread[0]) < 1e-5 * spread[1]


@pytest.mark.extended
@pytest.mark.parametrize("noise", [NOISE, 0.0])
def test_numbers_of_a_scene_are_found(noise):
    """Lights, ambient light and fog at once, from a wrong start."""
    wrong = changed(MIXED, START)
    fit = pf.fit(
        wrong,
        photograph(MIXED, TRUTH, noise=noise),
        unknowns=("diffuse", "shininess", *START),
        per_channel=("diffuse", "scene.lights[0].intensity"),
        known=TRUTH,
    )
    assert fit.converged and not fit.unidentified.any(), fit
    off = fit.values - true_values(fit, MIXED)
    if noise:
        assert np.all(np.abs(off) < 4 * fit.errors), fit
        assert 0.9 < fit.noise / noise < 1.1
    else:
        assert np.all(np.abs(off) < 1e-4 * np.maximum(np.abs(fit.values), 1)), fit

    check_direction(fit)
    # What was fitted is what comes back, and the rest is as it was.
    scene = only(fit.scene)
    arrays, before = scene_arrays(scene), scene_arrays(wrong)
    for name in before:
        if name not in START:
            assert np.array_equal(arrays[name], before[name]), name
    near(
        arrays["scene.lights[1].position"], fit["scene.lights[1].position"].value, 1e-6
    )
    near(arrays["scene.fog.density"], fit["scene.fog.density"].value, 1e-6)
    near(arrays["scene.ambient"], np.full(3, fit["scene.ambient"].value), 1e-6)
    shown = np.asarray(pf.render(scene, fit.material))
    near(shown, fit.fitted, 1e-5)
    near(fit.exposure, [1])


@pytest.mark.extended
def test_each_image_has_its_light_and_exposure():
    """Per image an intensity and an exposure, which one known light tells apart."""
    strengths, exposures = (0.5, 0.2), (1.0, 1.4)
    main, other = two_lights("directional")
    scenes = [
        pf.Scene(
            pf.Sphere(), SCENE.camera, (pf.DirectionalLight((1, 1, 2), s), other), 0.3
        )
        for s in strengths
    ]
    images = []
    for k, (scene, exposure) in enumerate(zip(scenes, exposures, strict=True)):
        light = photograph(scene, TRUTH, film=pf.Film(clamp=False)) * exposure
        noise = NOISE * np.random.default_rng(k).normal(size=light.shape)
        images.append(np.clip(light + noise, 0, 1))
    start = pf.Scene(pf.Sphere(), SCENE.camera, (main, other), 0.3)
    name = "scene.lights[0].intensity"
    fit = pf.fit(
        [start, start],
        images,
        unknowns=(*PARAMETERS, name, "exposure"),
        per_image=(name,),
        fixed={"exposure[0]": 1.0},
    )
    assert fit.converged and not fit.unidentified.any(), fit
    expected = (*strengths, exposures[1])
    labels = ("scenes[0].lights[0].intensity", "scenes[1].lights[0].intensity")
    for label, value in zip((*labels, "exposure[1]"), expected, strict=True):
        found = fit[label]
        assert abs(found.value - value) < 4 * found.error, label
    off = fit.values[:10] - as_vector(TRUTH)
    assert np.all(np.abs(off) < 4 * fit.errors[:10])
    near(fit.exposure, [1, fit["exposure[1]"].value], 1e-6)
    assert isinstance(fit.scene, tuple)
    for label, scene in zip(labels, fit.scene, strict=True):
        intensity = scene_arrays(scene)["scene.lights[0].intensity"]
        near(intensity, np.full(3, fit[label].value), 1e-6)
        near(scene_arrays(scene)[BOTH[1]], scene_arrays(start)[BOTH[1]])
    for left in fit.residuals:
        assert np.std(left[left != 0]) < 1.1 * NOISE


@pytest.mark.slow
def test_a_surface_that_is_traced_again():
    """The radius of the ball: whether a ray hits changes with the guess."""
    fit = pf.fit(
        changed(SCENE, {"scene.surface.radius": 0.95}),
        photograph(SCENE, TRUTH, noise=NOISE),
        unknowns=("scene.surface.radius",),
        known=TRUTH,
    )
    assert fit.converged and not fit.unidentified.any(), fit
    assert np.all(np.abs(fit.values - 1) < 4 * fit.errors)
    radius = scene_arrays(only(fit.scene))["scene.surface.radius"]
    near(radius, fit["scene.surface.radius"].value, 1e-6)


TWINS = pf.Scene(
    pf.Sphere(),
    SCENE.camera,
    [pf.DirectionalLight((1, 1, 2), 0.2), pf.DirectionalLight((1, 1, 2), 0.3)],
    0.3,
)
BOTH = ("scene.lights[0].intensity", "scene.lights[1].intensity")


@pytest.mark.parametrize(
    "scene, names, unidentified",
    [
        pytest.param(
            ONE_LIGHT,
            (*PARAMETERS, BOTH[0]),
            ("diffuse", "specular", BOTH[0]),
            marks=pytest.mark.extended,
        ),
        (
            ONE_LIGHT,
            (*PARAMETERS, "exposure"),
            ("ambient", "diffuse", "specular", "exposure"),
        ),
        pytest.param(
            SCENE,
            (*PARAMETERS, "scene.ambient"),
            ("ambient", "scene.ambient"),
            marks=pytest.mark.extended,
        ),
        (TWINS, BOTH, BOTH),
        # The other light is known, and so is the scale.
        pytest.param(SCENE, (*PARAMETERS, BOTH[0]), (), marks=pytest.mark.extended),
    ],
)
def test_what_nobody_could_tell_is_named(scene, names, unidentified):
    predicted = pf.predict_errors(scene, TRUTH, NOISE, unknowns=names)
    leaves = {
        label.removesuffix(f".{colour}")
        for label in np.array(predicted.labels)[predicted.unidentified]
        for colour in COLOURS
        if label.endswith(colour) or not label.endswith(COLOURS)
    }
    assert leaves == set(unidentified)
    assert np.array_equal(np.isinf(predicted.errors), predicted.unidentified)
    assert len(predicted.warnings) == bool(unidentified)
    for warning in predicted.warnings:
        assert pf.warning_code(warning) == "degenerate"
        assert all(name in warning for name in unidentified)


@pytest.mark.extended
@pytest.mark.parametrize("noise", [NOISE, 0.0])
def test_one_image_does_not_tell_its_exposure(noise):
    image = photograph(ONE_LIGHT, TRUTH, noise=noise)
    fit = pf.fit(ONE_LIGHT, image, unknowns=(*PARAMETERS, "exposure"))
    assert fit.converged
    (warning,) = fit.warnings
    assert pf.warning_code(warning) == "degenerate" and "exposure" in warning
    # The exponent does not depend on the scale.
    assert np.flatnonzero(~fit.unidentified).tolist() == [9]
    assert abs(fit.values[9] - 20) < max(4 * fit.errors[9], 2e-3)
    assert np.array_equal(np.isinf(fit.errors), fit.unidentified)
    ratio = fit.values[:9] * fit.exposure / as_vector(TRUTH)[:9]
    assert np.all(np.abs(ratio - 1) < 0.1)
