"""What scenes know with an error: a prior, whatever is asked for."""

from typing import Any

import numpy as np
import pytest

import phongfit as pf

CAMERA = pf.OrthographicCamera(24, 24)
TRUTH = pf.Material((0.6, 0.3, 0.2), 0.3, 20.0, 0.0)
AIM = np.array([[0.5, 0.4, 0.77], [-0.4, 0.1, 0.91]])
DIRECTION, INTENSITY = "scene.lights[0].direction", "scene.lights[0].intensity"
UNKNOWNS = ("diffuse", "specular", "shininess")


def scenes(aim=AIM, strength=(1.0, 1.0)):
    lamps = [pf.DirectionalLight(a, s) for a, s in zip(aim, strength, strict=True)]
    return [pf.Scene(pf.Sphere(), CAMERA, lamp) for lamp in lamps]


def photographs(noise=0.002):
    random = np.random.default_rng(3)
    light = [np.asarray(pf.render(scene, TRUTH)) for scene in scenes()]
    return [image + noise * random.normal(size=image.shape) for image in light]


IMAGES = photographs()
AIM_UNIT = AIM / np.linalg.norm(AIM, axis=1, keepdims=True)


def fitted(aim=AIM, strength=(1.0, 1.0), **options):
    options = {"unknowns": UNKNOWNS, "noise": 0.002} | options
    return pf.fit(scenes(aim, strength), IMAGES, film=pf.Film(clamp=False), **options)


def turned(k, angle):
    """The directions with one of them turned by so many radians about y."""
    c, s = np.cos(angle), np.sin(angle)
    aim = AIM.copy()
    aim[k] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ aim[k]
    return aim / np.linalg.norm(aim, axis=1, keepdims=True)


def lamps(found):
    """Their directions in the scenes of a fit."""
    return np.array([np.asarray(s.lights[0].direction) for s in tuple(found.scene)])


@pytest.mark.extended
def test_what_images_leave_open_of_a_lamp_is_in_the_errors():
    plain, share = fitted(turned(0, 0)), 0.01
    # Lamps that are all stronger by the same share look like a darker material.
    alike = {INTENSITY: np.full((6, 6), share**2)}
    found = fitted(turned(0, 0), uncertain=alike)
    assert found.values == pytest.approx(plain.values, rel=1e-4)
    stronger = np.append(share * plain.values[:-1], 0)
    expected = plain.covariance + np.outer(stronger, stronger)
    assert found.errors == pytest.approx(np.sqrt(np.diag(expected)), rel=0.05)
    assert found.errors[0] > 5 * plain.errors[0]


@pytest.mark.extended
def test_a_lamp_is_brought_to_what_the_images_say():
    plain, angle = fitted(turned(0, 0)), 0.01
    to_side = (turned(0, angle) - turned(0, -angle))[0] / (2 * angle)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.outer(to_side, to_side) * angle**2
    held = fitted(turned(0, angle))
    found = fitted(turned(0, angle), uncertain={DIRECTION: covariance})
    assert np.abs((held.values - plain.values) / plain.errors).max() > 3
    assert np.abs((found.values - plain.values) / found.errors).max() < 1.5
    assert np.abs(lamps(found) - AIM_UNIT).max() < 0.1 * angle
    # Images that know the lamp better than anybody lose little by its error.
    assert (found.errors < 1.3 * plain.errors).all()
    assert (found.errors > 0.95 * plain.errors).all()
    assert found.misfit.significance < 4.5 < held.misfit.significance


@pytest.mark.extended
def test_a_lamp_far_from_where_it_was_said_to_be():
    """Over two of its errors away, where light is far from linear in its place."""
    random = np.random.default_rng(1057)
    spread = np.random.default_rng(8).normal(size=(3, 3)) * 0.06
    place = np.array([0.8, 0.9, 2.2])
    said = place + spread @ random.normal(size=3)
    camera = pf.OrthographicCamera(32, 32, view_height=2.2)
    true, start = (
        pf.Scene(
            pf.Sphere(),
            camera,
            pf.PointLight(at, attenuation=(0.5, 0.0, 0.3)),
            ambient=0.3,
        )
        for at in (place, said)
    )
    material, free = (
        pf.Material((0.6, 0.3, 0.2), 0.3, 30.0, 1 / 3),
        pf.Film(clamp=False),
    )
    image = np.asarray(pf.render(true, material, film=free))
    image = image + 0.03 * random.normal(size=image.shape)
    uncertain = {"scene.lights[0].position": spread @ spread.T}
    found = pf.fit(start, image, film=free, uncertain=uncertain)
    assert found.converged and not found.warnings
    scene: Any = found.scene
    off = np.asarray(scene.lights[0].position) - place
    assert off @ np.linalg.solve(spread @ spread.T, off) < 9
    for label, value in (("shininess", 30.0), ("diffuse.red", 0.6)):
        assert abs(found[label].value - value) < 4 * found[label].error < 0.4 * value


@pytest.mark.extended
def test_errors_that_hang_together():
    near = [
        pf.PointLight(5 * a / np.linalg.norm(a), attenuation=(0, 0, 1 / 25))
        for a in AIM
    ]
    rooms = [pf.Scene(pf.Sphere(), CAMERA, lamp) for lamp in near]
    light = [np.asarray(pf.render(room, TRUTH)) for room in rooms]
    arrays = "scene.lights[0].position", "scene.lights[0].attenuation"
    # Further away by a share, and as bright at the origin.
    share, joint = 0.05, np.zeros((12, 12))
    for k, lamp in enumerate(near):
        place = np.asarray(lamp.position, float)
        moved = np.zeros(12)
        moved[3 * k : 3 * k + 3] = share * place
        moved[6 + 3 * k + 2] = -2 * share / 25
        joint += np.outer(moved, moved)
    apart = {arrays[0]: joint[:6, :6], arrays[1]: joint[6:, 6:]}
    options = {"unknowns": UNKNOWNS, "noise": 0.002, "film": pf.Film(clamp=False)}
    together, separate = (
        pf.fit(rooms, light, **options, uncertain=one)
        for one in ({arrays: joint}, apart)
    )
    assert together.errors[0] < 0.5 * separate.errors[0]
    with pytest.raises(ValueError, match="expected all of them to be unknown, or none"):
        pf.fit(
            rooms,
            light,
            unknowns=(*UNKNOWNS, arrays[0]),
            per_image=(arrays[0],),
            uncertain={arrays: joint},
        )
    with pytest.raises(ValueError, match="uncertain: expected a name, or several"):
        pf.fit(rooms, light, uncertain={3: 0.1})
    with pytest.raises(ValueError, match="uncertain: expected each name once"):
        pf.fit(rooms, light, uncertain={arrays: joint, arrays[0]: 0.1})


@pytest.mark.extended
def test_what_is_unknown_too_has_a_prior_about_what_the_scenes_have():
    aim = turned(0, 0.01)
    across = np.eye(6) * 0.02**2
    across[:3, :3] -= 0.02**2 * np.outer(aim[0], aim[0])
    across[3:, 3:] -= 0.02**2 * np.outer(aim[1], aim[1])
    options = {"unknowns": (*UNKNOWNS, DIRECTION), "per_image": (DIRECTION,)}
    free = fitted(aim, **options)
    loose = fitted(aim, **options, uncertain={DIRECTION: across})
    assert loose.values == pytest.approx(free.values, abs=1e-3)
    # A lamp that is known better than the images could tell stays where it is.
    tight = fitted(aim, **options, uncertain={DIRECTION: 1e-7 * across})
    assert np.abs(lamps(tight) - aim).max() < 5e-4
    assert np.abs(lamps(loose) - turned(0, 0)).max() < 2e-3
    # Two measurements: neither is worse than the better one alone.
    assert (loose.errors <= 1.01 * free.errors).all()
    with pytest.raises(ValueError, match="expected a covariance of full rank"):
        shared = {INTENSITY: np.full((6, 6), 1e-4)}
        options = {"unknowns": (*UNKNOWNS, INTENSITY), "per_image": (INTENSITY,)}
        colours = ("diffuse", "specular", INTENSITY)
        fitted(**options, per_channel=colours, uncertain=shared)


def test_errors_that_are_predicted_know_it_too():
    scale = {INTENSITY: np.full((6, 6), 0.05**2)}
    options = {"unknowns": UNKNOWNS, "noise": 0.002, "film": pf.Film(clamp=False)}
    found = pf.predict_errors(scenes(), TRUTH, **options, uncertain=scale)
    # All lamps 5 % stronger are a material 5 % darker.
    errors = dict(zip(found.labels, found.errors, strict=True))
    assert errors["diffuse.red"] == pytest.approx(0.05 * 0.6, rel=0.02)


@pytest.mark.parametrize(
    "uncertain, message",
    [
        ({"scene.lights[0].colour": 1.0}, "unknowns: expected one of"),
        ({DIRECTION: np.eye(5)}, r"uncertain: .*direction: expected a covariance \(6"),
        ({DIRECTION: "x"}, "uncertain: .*direction: expected a covariance"),
        ({DIRECTION: np.triu(np.ones((6, 6)))}, "uncertain: .* symmetric"),
        ({DIRECTION: -np.eye(6)}, "uncertain: .* a negative variance"),
        ([1], "uncertain: expected a mapping of names"),
    ],
)
def test_what_is_wrong_is_said(uncertain, message):
    with pytest.raises(ValueError, match=message):
        fitted(uncertain=uncertain)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"bounds": {INTENSITY: (0.9, 0.95)}}, "bounds: expected one of diffuse"),
        ({"fixed": {INTENSITY: 1.0}}, "fixed: expected one of diffuse"),
        ({"ties": {"shininess": INTENSITY}}, "ties: expected one of diffuse"),
        ({"fixed": dict.fromkeys(UNKNOWNS, 0.5)}, "fixed: nothing unknown is left"),
    ],
)
def test_uncertain_arrays_are_no_unknowns_of_other_options(options, message):
    with pytest.raises(ValueError, match=message):
        fitted(uncertain={INTENSITY: 0.01}, **options)


@pytest.mark.extended
def test_residuals_have_the_shadows_of_the_solution():
    """Shadows stay where the scene's lamp casts them, though the lamp is refined."""
    camera = pf.OrthographicCamera(32, 32)
    surface = pf.shapes.Torus().mesh(32, 16)

    def scene(x: float) -> pf.Scene:
        lamp = pf.DirectionalLight((x, 0.4, 0.5))
        return pf.Scene(surface, camera, lamp, shadows=True)

    image = np.asarray(pf.render(scene(1.05), pf.Material(0.5, 0.0, 10.0)))
    found = pf.fit(
        scene(1.0),
        image,
        unknowns=["diffuse"],
        uncertain={DIRECTION: 0.05},
        noise=0.01,
        film=pf.Film(clamp=False),
    )
    of_samples = np.sum((np.asarray(found.residuals) / 0.01) ** 2)
    # The rest is the lamp's prior.
    assert 0 < found.chi_squared - of_samples < 5
