"""A specular model's own numbers as unknowns: found, bounded, predicted, refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.layout import make_unknowns
from phongfit.fitting.problem.shapes import moves_cosine, own_names, takes_exponent
from phongfit.fitting.problem.specification import Specification
from phongfit.reflectance import AbstractSpecular, halfway
from phongfit.vectors import Scalar, dot
from tests.fitting.scenes import ball

ROUGHNESS, F0 = "scene.specular_model.roughness", "scene.specular_model.f0"
ALPHA = "scene.specular_model.alpha"
OWN = ("ambient", "diffuse", ROUGHNESS, F0)
MIRROR = pf.Material(0.0, 1.0, 32.0, 0.0)
NOISE = 0.005


class Turned(AbstractSpecular):
    """A highlight beside its place: its own number moves the cosine."""

    turn: Scalar

    def cosine(self, normal, to_light, to_viewer):
        aside = jnp.stack([self.turn, 0 * self.turn, 0 * self.turn])
        return dot(halfway(to_light, to_viewer), normal) + dot(aside, normal)

    def lobe(self, cosine, shininess):
        return pf.Phong().lobe(cosine, shininess)

    def diffuse_scale(self):
        return 1.0


def photograph(scene, material, rng):
    """What a camera with a clamp shows of it."""
    clean = np.asarray(pf.render(scene, material, film=pf.Film(clamp=False)))
    noisy = clean + NOISE * rng.normal(size=clean.shape)
    return np.clip(noisy, 0, 1).astype(clean.dtype)


def ggx_pulls(count):
    """How far roughness and F0 come out from the truth, in standard errors."""
    rng, pulls = np.random.default_rng(3), []
    for _ in range(count):
        roughness, f0 = rng.uniform(0.3, 0.8), rng.uniform(0.05, 0.9)
        truth = pf.Material(rng.uniform(0.1, 0.7, 3), 1.0, 32.0, rng.uniform(0.2, 0.6))
        image = photograph(ball(specular_model=pf.GGX(roughness, f0)), truth, rng)
        begun = ball(specular_model=pf.GGX(0.5, 0.2))
        fit = pf.fit(begun, image, unknowns=OWN, known=MIRROR)
        assert fit.converged and fit.identified.all(), fit
        estimates = fit[ROUGHNESS], fit[F0]
        pulls.append(
            [
                (one.value - true) / one.error
                for one, true in zip(estimates, (roughness, f0), strict=True)
            ]
        )
    return np.array(pulls)


@pytest.mark.extended
def test_ggx_is_found():
    assert np.abs(ggx_pulls(3)).max() < 4


@pytest.mark.slow
def test_ggx_is_found_a_hundred_times():
    pulls = ggx_pulls(100)
    assert np.abs(pulls).max() < 4
    rms = np.sqrt(np.mean(pulls**2, axis=0))
    assert np.all((rms > 0.8) & (rms < 1.2)), rms


@pytest.mark.extended
def test_its_errors_are_predicted():
    rng = np.random.default_rng(1)
    scene, truth = ball(specular_model=pf.GGX(0.5, 0.2)), pf.Material(0.4, 1.0)
    fit = pf.fit(scene, photograph(scene, truth, rng), unknowns=OWN, known=MIRROR)
    foreseen = pf.predict_errors(scene, truth, NOISE, unknowns=OWN)
    assert foreseen.labels == fit.labels
    np.testing.assert_allclose(foreseen.errors, fit.errors, rtol=0.1)


@pytest.mark.extended
def test_ward_is_found_from_images_of_several_lights():
    """Images of two lights and of one, whose lobes are padded, share one α."""
    rng = np.random.default_rng(2)
    truth = pf.Material((0.4, 0.3, 0.2), (0.1, 0.06, 0.14), 32.0, 0.5)

    def views(alpha):
        two = ball(specular_model=pf.Ward(alpha))
        one = pf.Scene(
            two.surface, two.camera, two.lights[:1], 0.3, specular_model=pf.Ward(alpha)
        )
        return [two, one]

    images = [photograph(view, truth, rng) for view in views(0.25)]
    unknowns = ("ambient", "diffuse", "specular", ALPHA)
    fit = pf.fit(views(0.5), images, unknowns=unknowns)
    assert abs(fit[ALPHA].value - 0.25) < 4 * fit[ALPHA].error
    off = (fit["specular"].value - truth.specular) / fit["specular"].error
    assert np.abs(off).max() < 4
    assert isinstance(fit.scene, tuple)
    again = fit.scene[1].specular_model
    assert isinstance(again, pf.Ward) and again.alpha is not None
    assert float(again.alpha) == pytest.approx(float(fit[ALPHA].value), rel=1e-6)
    assert fit.bounds[fit.labels.index(ALPHA)] == pytest.approx((0.01, 1))


@pytest.mark.extended
def test_a_highlight_that_is_not_there_has_no_width():
    """Neither of none, nor of one that noise hides, is an α claimed to be known."""
    rng = np.random.default_rng(5)
    scene, unknowns = ball(specular_model=pf.Ward(0.3)), ("diffuse", "specular", ALPHA)
    known = pf.Material(0.0, 0.0, 32.0, 0.5)
    for specular in (0.0, 0.0002):
        truth = pf.Material((0.4, 0.3, 0.2), specular, 32.0, 0.5)
        fit = pf.fit(
            scene, photograph(scene, truth, rng), unknowns=unknowns, known=known
        )
        assert fit[ALPHA].unidentified and not np.isfinite(fit[ALPHA].error), fit
        low, high = fit.intervals()[fit.labels.index(ALPHA)]
        assert low == pytest.approx(0.01) and high == pytest.approx(1)
        off = fit["diffuse"].value - np.asarray(truth.diffuse)
        assert np.all(np.abs(off) < 4 * fit["diffuse"].error)


def test_lobes_are_shaped_without_lighting_points_anew():
    """Unless what is unknown moves the cosine, or belongs to something else."""
    for model, names, relights in (
        (pf.GGX(0.5), (F0,), False),
        (pf.GGX(0.5), (F0, "scene.lights[0].intensity"), True),
        (Turned(jnp.zeros(())), ("scene.specular_model.turn",), True),
        (pf.GGX(0.5), (), False),
    ):
        scenes = [ball(specular_model=model)]
        asked = Specification(unknowns=("diffuse", *names))
        assert make_unknowns(asked, 1, scenes).relights == relights, names


def test_what_a_model_depends_on():
    ggx, turned = pf.GGX(0.5), Turned(jnp.zeros(()))
    assert own_names(ggx) == [ROUGHNESS, F0] and own_names(pf.Phong()) == []
    assert moves_cosine(turned) and not moves_cosine(ggx)
    assert [takes_exponent(m) for m in (ggx, pf.GGX(), pf.Ward(), turned)] == [
        False,
        True,
        True,
        True,
    ]


@pytest.mark.parametrize(
    "options, words",
    [
        ({}, "unknowns: shininess shapes no highlight of this GGX; expected scene"),
        (
            {"unknowns": (F0,), "per_image": (F0,)},
            "per_image: expected an array of the scenes",
        ),
        (
            {"unknowns": (F0,), "bounds": {F0: (0.5, 0.1)}},
            "bounds: .*f0: 0.5 < 0.1 does not hold",
        ),
    ],
)
def test_what_is_refused(options, words):
    scene = ball(specular_model=pf.GGX(0.5))
    with pytest.raises(ValueError, match=words):
        pf.fit(scene, np.zeros((32, 32, 3)), **options)
