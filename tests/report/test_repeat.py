"""The call that a page prints gives the same fit."""

import dataclasses
import re

import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.specification import Specification
from phongfit.report.repeat import call, names
from tests.fitting.scenes import SIZE, ball, photograph, truth
from tests.report.conftest import ARRAYS, NOISE, SETTINGS

TRUTH = truth()


def check_same(fit: pf.Fit, **given) -> None:
    """The printed lines give the same fit, from what they name."""
    place = {"pf": pf, **given}
    exec(call(fit), place)
    again = place["fit"]
    assert isinstance(again, pf.Fit) and again.labels == fit.labels
    np.testing.assert_allclose(again.values, fit.values, rtol=1e-5)
    np.testing.assert_allclose(again.errors, fit.errors, rtol=1e-3)
    np.testing.assert_array_equal(again.bounds, fit.bounds)
    assert again.film == fit.film and again.n_samples == fit.n_samples


def test_a_plain_fit_has_a_plain_call(one):
    assert call(one) == "fit = pf.fit(\n    scene, image,\n)"


@pytest.mark.extended
def test_the_call_gives_the_same_fit(held):
    check_same(held, scene=ball(), image=held.photographs, **ARRAYS)


def test_settings_are_in_the_call(one):
    fit = dataclasses.replace(
        one,
        specification=Specification(**SETTINGS),
        arrays=("mask", "weights"),
        noise_given=True,
    )
    text = call(fit)
    for name in (*SETTINGS, *ARRAYS):
        assert f"    {name}=" in text
    assert "    film=pf.Film(bits=10),\n" in text
    assert names(fit) == ["scene", "image", *ARRAYS]


@pytest.mark.parametrize(
    "film, written",
    [
        (None, None),
        (pf.Film(clamp=False), "pf.Film(clamp=False)"),
        (pf.Film(encoding="srgb", bits=16), "pf.Film(encoding='srgb', bits=16)"),
        ([pf.Film(), pf.Film(bits=8)], "(pf.Film(), pf.Film(bits=8),)"),
    ],
)
def test_a_film_that_was_given(one, film, written):
    asked = Specification(film=film)
    text = call(dataclasses.replace(one, specification=asked))
    assert ("film=" in text) == (written is not None)
    assert written is None or f"    film={written},\n" in text


@pytest.mark.slow
def test_so_does_that_of_several_images():
    camera = pf.OrthographicCamera(SIZE, SIZE)
    scenes = [
        pf.Scene(pf.Sphere(), camera, pf.DirectionalLight((x, 1, 2), 0.8), 0.3)
        for x in (-1, 1)
    ]
    images = [photograph(s, TRUTH, noise=NOISE, seed=k) for k, s in enumerate(scenes)]
    fit = pf.fit(
        scenes,
        images,
        unknowns=("diffuse", "specular", "shininess", "scene.lights[0].intensity"),
        per_image=("scene.lights[0].intensity",),
        known=pf.Material(0.0, 0.0, 32.0, (0.5, 0.4, 0.3)),
        fixed={"diffuse.red": 0.6},
    )
    assert "per_image=('scene.lights[0].intensity',)" in call(fit)
    check_same(fit, scenes=scenes, images=images)


@pytest.mark.parametrize(
    "loss, written",
    [
        (pf.Tukey(), "loss='tukey'"),
        (pf.Tukey(3.0), "loss=pf.Tukey(k=3.0)"),
        (pf.Linear(), None),
    ],
)
def test_losses_have_their_names(one, loss, written):
    fit = dataclasses.replace(one, specification=Specification(loss=loss))
    assert (written or "pf.fit") in call(fit)
    assert ("loss" in call(fit)) == (written is not None)


class Halved(pf.AbstractLoss):
    """A loss of a user's own."""

    scale: float = 2.0

    robust = True

    def ratio(self, z):
        return 1 / (1 + z / self.scale)


def test_what_is_no_public_name_comes_from_the_caller(one):
    """A camera's curve, as a file has it, and a class that is not ours."""
    curve = pf.ResponseCurve([(k / 16) ** 1.8 for k in range(17)])
    film = pf.Film(encoding=curve, bits=8)
    asked = Specification(film=film, loss=Halved())
    fit = dataclasses.replace(one, specification=asked, films=(film,))
    text = call(fit)
    assert "    film=film,\n" in text and "film" in names(fit)
    assert "    loss=Halved(scale=2.0),\n" in text
    found = re.findall(r"\bpf\.(\w+)", text)
    assert found and set(found) <= set(dir(pf))
