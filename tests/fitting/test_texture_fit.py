"""Texels from photographs: against the truth, and against dense least squares."""

import dataclasses
import functools
import weakref
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from experiments.honesty.situations import captures
from phongfit.fitting import texture_fit
from phongfit.fitting.texels import equations, steps
from phongfit.fitting.texels.job import RIDGE
from phongfit.fitting.texels.lit import Photographs
from phongfit.fitting.texels.result import TextureFit
from phongfit.textures import texels
from tests.fitting.texels.scenes import (
    NOISE,
    SIZE,
    TRUE,
    camera_at,
    matte,
    painted,
    photographs,
    plate,
    scenes,
    shiny,
)
from tests.helpers import near

DIFFUSE = ("diffuse.texture",)


def fitted(images, **options):
    given = {"per_channel": (), "known": pf.Material(ambient=0.0, shininess=20.0)}
    return pf.fit_texture(scenes(), images, size=SIZE, **(given | options))


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """Photographs of a plate with a highlight."""
    return photographs(painted(diffuse=TRUE), shiny())


@pytest.fixture(scope="module")
def kept(images) -> TextureFit:
    return fitted(images)


@pytest.mark.usefixtures("precision")
def test_texels_and_a_shared_highlight():
    fit = fitted(photographs(painted(diffuse=TRUE), shiny()))
    assert fit.converged and not fit.warnings, fit
    errors = fit.stderr["diffuse"][0]
    known = np.isfinite(errors)
    assert known.mean() > 0.9
    pulls = ((fit.values["diffuse"][0] - TRUE) / errors)[known]
    assert 0.85 < np.sqrt(np.mean(pulls**2)) < 1.15
    for one, true in zip(fit.shared, (0.3, 20.0), strict=True):
        assert abs(one.value - true) < 4 * one.stderr < 0.2 * true
    assert [one.label for one in fit.shared] == ["specular", "shininess"]
    assert abs(fit.noise / NOISE - 1) < 0.05
    near(fit.material.diffuse, np.ones((1, 3)))
    assert "texels identified" in str(fit)
    # What was found is a scene again.
    again = pf.render(fit.scene(scenes()[0]), fit.material)
    near(
        np.asarray(again),
        np.asarray(pf.render(painted(diffuse=TRUE)[0], shiny())),
        0.03,
    )


def test_jpeg_files_are_said_to_err_alike():
    images = photographs(painted(diffuse=TRUE), matte())
    film = pf.Film(jpeg=pf.rendering.JpegCompression.at_quality(90))
    fit = fitted(images, unknowns=DIFFUSE, film=film)
    assert [pf.warning_code(words) for words in fit.warnings] == ["jpeg-texels"]


@pytest.mark.parametrize("texel", [(), ("specular",), ("shininess",)])
def test_a_matte_surface_has_no_exponent(texel):
    images = photographs(painted(diffuse=TRUE), matte())
    shared = tuple(name for name in ("specular", "shininess") if name not in texel)
    textures = [f"{name}.texture" for name in ("diffuse", *texel)]
    fit = fitted(images, unknowns=(*textures, *shared))
    assert "no-highlight" in map(pf.warning_code, fit.warnings)
    hidden = [one.label for one in fit.shared if not np.isfinite(one.stderr)]
    assert hidden == (["specular"] if "shininess" in texel else ["shininess"])
    if "shininess" in texel:
        assert np.isinf(fit.stderr["shininess"]).all()


def test_steps_of_an_exponent_do_not_alternate():
    """Two matte plates of which steps of log f went to and fro without end."""
    answers = captures.texture([np.random.default_rng(seed) for seed in (1, 6)])
    for sentences in answers.warnings:
        assert {pf.warning_code(words) for words in sentences} == {"no-highlight"}


def test_an_exponent_of_0_is_no_numerical_failure(images):
    known = pf.Material(0.0, 0.3, 0.0, 0.0)
    assert fitted(images, unknowns=DIFFUSE, known=known).converged


def test_images_without_noise():
    fit = fitted(photographs(painted(diffuse=TRUE), shiny(), 0.0))
    assert fit.converged and fit.steps < 15, fit
    errors = fit.stderr["diffuse"][0]
    known = np.isfinite(errors)
    # Known to the rounding of the arithmetic, and no better.
    assert 1e-16 < errors.min() and errors[known].max() < 0.1
    assert abs(fit.values["diffuse"][0] - TRUE)[known].max() < 1e-3
    near([one.value for one in fit.shared], [0.3, 20.0], 1e-3)


def test_texels_are_those_of_dense_least_squares():
    images = photographs(painted(diffuse=TRUE), matte())
    fit = fitted(images, unknowns=DIFFUSE, noise=NOISE)
    rows, light = [], []
    for scene, image in zip(scenes(), images, strict=True):
        buffer = scene.trace()
        assert buffer.uv is not None
        mask = np.asarray(buffer.mask)
        basis = np.asarray(
            pf.rendering.pixel_terms(scene, buffer).basis(matte().shininess)
        )
        index, weight = map(np.asarray, texels(buffer.uv, SIZE, "bilinear", "repeat"))
        seen = np.zeros((mask.sum(), SIZE[0] * SIZE[1]))
        for k in range(4):
            seen[np.arange(len(seen)), index[mask][:, k]] += weight[mask][:, k]
        rows.append(seen * basis[mask][:, 0, 1][:, None])
        light.append(image[mask])
    matrix, target = np.concatenate(rows), np.concatenate(light)
    # Nothing draws texels; errors know that each step holds them a little.
    expected = np.linalg.lstsq(matrix, target)[0].reshape(*SIZE, 3)
    whole = matrix.T @ matrix / NOISE**2 + RIDGE * np.eye(matrix.shape[1])
    error = np.sqrt(np.diag(np.linalg.inv(whole))).reshape(SIZE)
    known = np.isfinite(fit.stderr["diffuse"][0]).all(axis=-1)
    assert known.mean() > 0.9
    inside = (expected > 0) & (expected < 1) & known[..., None]
    difference = fit.values["diffuse"][0] - expected
    assert abs(difference / error[..., None])[inside].max() < 0.05
    widened = fit.stderr["diffuse"][0][known] / error[known][:, None]
    near(widened, np.full(widened.shape, widened[0, 0]), 1e-2)
    assert 0.98 < widened[0, 0] < 1.3


def test_two_textures_and_a_smoothness():
    smooth = 0.3 + 0.2 * np.sin(np.arange(12) / 12 * 2 * np.pi)
    strong = np.broadcast_to(smooth[:, None, None], (*SIZE, 1))
    truth = painted(diffuse=TRUE, specular=strong)
    images = photographs(truth, pf.Material(1.0, 1.0, 20.0, 0.0), 0.002)
    options = {"unknowns": ("diffuse.texture", "specular.texture", "shininess")}
    fit = fitted(images, **options)
    errors = fit.stderr["specular"][0]
    known = np.isfinite(errors)
    pulls = ((fit.values["specular"][0] - strong) / errors)[known]
    assert np.sqrt(np.mean(pulls**2)) < 1.2
    drawn = fitted(images, **options, smoothness=0.1)
    less = drawn.stderr["specular"][0][known] <= 1.01 * errors[known]
    assert less.all()


def test_texels_that_nothing_sees():
    half = np.zeros((32, 32), bool)
    half[:, :16] = True
    images = photographs(painted(diffuse=TRUE), matte())[:1]
    fit = pf.fit_texture(
        scenes()[0],
        images[0],
        size=SIZE,
        unknowns=DIFFUSE,
        known=matte(),
        mask=half,
    )
    errors, seen = fit.stderr["diffuse"][0], fit.seen[0]
    assert np.all(np.isinf(errors[seen == 0])) and np.any(seen == 0)
    assert np.isinf(errors[:, 9]).all() and np.isfinite(errors[4:8, 2:4]).all()
    # Filled from the nearest that is known, and only where nothing is.
    filled, known = fit.filled("diffuse")[0], np.isfinite(errors)
    near(filled[known], fit.values["diffuse"][0][known])
    assert np.isin(
        filled[:, 9, 0], fit.values["diffuse"][0][..., 0][known[..., 0]]
    ).all()


def test_each_material_has_its_own_texture():
    other = 1 - TRUE
    textures = [pf.Textures(diffuse=pf.Texture(one)) for one in (TRUE, other)]
    mesh = plate(textures, material_index=[0, 1])
    images = photographs(scenes(mesh), matte(), 0.0005)
    bare = scenes(mesh)
    fit = pf.fit_texture(
        bare, images, size=SIZE, unknowns=DIFFUSE, known=matte(), separate=True
    )
    for layer, true in enumerate((TRUE, other)):
        known = np.isfinite(fit.stderr["diffuse"][layer])
        assert 0.2 < known.mean() < 0.9
        off = abs(fit.values["diffuse"][layer] - true) / fit.stderr["diffuse"][layer]
        assert off[known].max() < 6
    image = pf.render(fit.scene(bare[0]), fit.material)
    near(np.asarray(image), np.asarray(pf.render(bare[0], matte())), 0.02)


def test_each_material_has_its_own_highlight():
    glossy = pf.Material(1.0, [[0.3], [0.15]], [[20.0], [6.0]], 0.0)
    textures = pf.Textures(diffuse=pf.Texture(TRUE))
    of = {"material_index": [0, 1]}
    images = photographs(scenes(plate(textures, **of)), glossy, 0.002)
    fit = pf.fit_texture(
        scenes(plate(**of)), images, size=SIZE, per_channel=(), known=matte()
    )
    labels = ["specular[0]", "specular[1]", "shininess[0]", "shininess[1]"]
    assert [one.label for one in fit.shared] == labels
    for one, true in zip(fit.shared, (0.3, 0.15, 20.0, 6.0), strict=True):
        assert abs(one.value - true) < 4 * one.stderr < true, one


class Counted(Photographs):
    """Photographs of which few are kept."""

    traced = 0

    def at(self, k):
        Counted.traced += k not in self.kept
        assert sum(one.bytes for one in self.kept.values()) <= self.room
        return super().at(k)


def test_photographs_that_are_not_kept_are_traced_again(images, kept, monkeypatch):
    # Some 750 pixels of each see the plate, which take 80 kB.
    made = functools.partial(Counted, room=120_000)
    monkeypatch.setattr(texture_fit, "Photographs", made)
    again = fitted(images)
    # One is kept, and the others are seen anew in each step.
    assert Counted.traced > 2 * again.steps
    near(again.values["diffuse"], kept.values["diffuse"], 0)
    near(again.stderr["diffuse"], kept.stderr["diffuse"], 0)


def test_one_matrix_is_there_at_a_time(images, monkeypatch):
    make, made = steps.make_matrix, []

    def alone(*args):
        assert all(one() is None for one in made)
        matrix = make(*args)
        made.append(weakref.ref(matrix))
        return matrix

    monkeypatch.setattr(steps, "make_matrix", alone)
    # As of lamps that differ in colour.
    monkeypatch.setattr(steps, "is_like_last", lambda *args: False)
    fitted(images)
    assert len(made) > 3


def test_many_texels_are_found_as_few_are(images, monkeypatch):
    few = fitted(images, smoothness=0.2)
    monkeypatch.setattr(equations, "DIRECT", 0)
    many = fitted(images, smoothness=0.2)
    errors = few.stderr["diffuse"]
    away = abs(many.values["diffuse"] - few.values["diffuse"]) / errors
    assert away[np.isfinite(errors)].max() < 0.05
    near(many.stderr["diffuse"] / errors, np.ones_like(errors), 0.1)
    for one, other in zip(many.shared, few.shared, strict=True):
        assert abs(one.value - other.value) < 0.01 * other.stderr
        near(one.stderr, other.stderr, 0.01 * other.stderr)


@pytest.mark.extended
def test_a_fit_starts_from_some_of_many_pixels(images, kept, monkeypatch):
    monkeypatch.setattr(steps, "START", 32 * 32)
    fit = fitted(images)
    assert fit.converged
    for one, other in zip(fit.shared, kept.shared, strict=True):
        assert abs(one.value - other.value) < 0.1 * one.stderr


def test_a_wrong_model_is_said_to_be_wrong(images):
    fit = fitted(images, unknowns=DIFFUSE)
    assert any("residuals are not noise" in words for words in fit.warnings)
    # Without light from elsewhere the ambient reflectance means nothing.
    dark = [dataclasses.replace(scene, ambient=0.0) for scene in scenes()]
    images = photographs(
        [dataclasses.replace(scene, ambient=0.0) for scene in painted(diffuse=TRUE)],
        matte(),
    )
    fit = pf.fit_texture(
        dark, images, size=SIZE, unknowns=(*DIFFUSE, "ambient"), known=matte()
    )
    assert all(np.isinf(one.stderr) for one in fit.shared)
    assert any("ambient.red, ambient.green" in words for words in fit.warnings)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"unknowns": ("gloss.texture",)}, "unknowns: expected some of ambient"),
        ({"unknowns": (*DIFFUSE, "gloss")}, "unknowns: expected some of ambient"),
        (
            {"unknowns": (*DIFFUSE, "diffuse")},
            "unknowns: expected diffuse or diffuse.t",
        ),
        ({"unknowns": (*DIFFUSE, *DIFFUSE)}, "unknowns: expected each name once"),
        (
            {"specification": pf.Specification(unknowns=("diffuse",))},
            "unknowns: expected a texture",
        ),
        ({"fixed": {"specular": 0.3}}, "fixed: expected its default in fit_texture"),
        ({"loss": "tukey"}, "loss: expected its default in fit_texture"),
        ({"size": (0, 3)}, "size: expected rows and columns"),
        ({"smoothness": -1.0}, "smoothness: expected a number > 0"),
        ({"image": np.zeros((3, 3, 3))}, "image: expected shape"),
        ({"known": pf.Material(np.zeros((5, 3)))}, "known: diffuse has shape"),
    ],
)
def test_wrong_arguments_are_named(options, words):
    given = {"image": np.zeros((32, 32, 3)), "size": SIZE} | options
    with pytest.raises(ValueError, match=words):
        pf.fit_texture(scenes()[0], given.pop("image"), **given)


def test_a_surface_without_uv_is_refused():
    with pytest.raises(ValueError, match="scene: expected a Mesh with uv"):
        scene = pf.Scene(pf.Sphere(), camera_at(0, 0, 4))
        pf.fit_texture(scene, np.zeros((32, 32, 3)), size=SIZE)


@pytest.mark.parametrize(
    "older, unknowns",
    [
        ({"unknowns": ("specular",)}, (*DIFFUSE, "specular")),
        ({"unknowns": ()}, DIFFUSE),
        ({"textures": ("specular",), "unknowns": ()}, ("specular.texture",)),
        ({"textures": ("specular",)}, ("specular.texture", "specular", "shininess")),
    ],
)
def test_names_of_textures_without_the_suffix_are_deprecated(older, unknowns, images):
    def outcome(**options) -> Any:
        try:
            return fitted(images, **options).values
        except ValueError as error:
            return str(error)

    with pytest.warns(DeprecationWarning, match=r"textures: write unknowns=\('diff"):
        before = outcome(**older)
    now = outcome(unknowns=unknowns)
    assert before == now if isinstance(now, str) else before.keys() == now.keys()


def test_a_specification_and_a_change(images, kept):
    asked = pf.Specification(
        unknowns=("diffuse.texture", "specular", "shininess"),
        per_channel=(),
        known=pf.Material(ambient=0.0, shininess=20.0),
        max_steps=1,
    )
    assert not pf.fit_texture(scenes(), images, asked, size=SIZE).converged
    again = pf.fit_texture(scenes(), images, asked, size=SIZE, max_steps=20)
    near(again.values["diffuse"], kept.values["diffuse"], 0)
    with pytest.raises(ValueError, match="textures: expected none beside a spec"):
        pf.fit_texture(scenes(), images, asked, size=SIZE, textures=("diffuse",))
