"""Derivatives of a fit against finite differences of whole fits."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.testing import check_gradients
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import ball, photograph, truth
from tests.helpers import floats, near

TRUTH = truth()

SCENE = ball()
IMAGE = photograph(SCENE, TRUTH, noise=NOISE)
OTHER = photograph(SCENE, TRUTH, noise=NOISE, seed=1)


def fitted() -> pf.Fit:
    return canonical.two_directional().fit


def vector(material: pf.Material) -> jax.Array:
    leaves = (material.ambient, material.diffuse, material.specular)
    return jnp.concatenate([*leaves, material.shininess[None]])


def of_light(scene: Any) -> tuple[jax.Array, jax.Array]:
    return scene.lights[0].intensity, scene.lights[0].direction


def shone(*numbers: jax.Array) -> pf.Scene:
    return eqx.tree_at(of_light, SCENE, numbers)


@pytest.mark.extended
@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_derivatives_are_those_of_whole_fits(loss):
    """In the image, a light's intensity and its direction."""
    fit = pf.fit(SCENE, IMAGE, loss=loss)
    image, other = floats(IMAGE), floats(OTHER)

    def refitted(point):
        share, intensity, direction = point
        mixed = (1 - share) * image + share * other
        return vector(pf.refit(fit, shone(intensity, direction), mixed))

    point = (floats(0.1), *of_light(SCENE))
    check_gradients(refitted, point, order=1, rtol=1e-4)


@pytest.mark.extended
def test_at_a_bound_there_is_no_derivative():
    fit = pf.fit(SCENE, IMAGE, bounds={"diffuse": (0, 0.5)})
    assert np.flatnonzero(fit.at_bound).tolist() == [3]
    image, other = floats(IMAGE), floats(OTHER)

    def refitted(share):
        return vector(pf.refit(fit, SCENE, (1 - share) * image + share * other))

    slope = np.asarray(jax.jit(jax.jacfwd(refitted))(floats(0.0)))
    assert slope[3] == 0 and np.all(np.delete(slope, 3) != 0)
    check_gradients(refitted, floats(0.0), order=1, rtol=1e-4)


@pytest.mark.extended
def test_jit_and_vmap():
    fit = fitted()
    images = floats(np.stack([IMAGE, OTHER]))
    found = jax.jit(jax.vmap(lambda image: vector(pf.refit(fit, SCENE, image))))(images)
    near(found[0], fit.values, 1e-3)
    other = pf.fit(SCENE, OTHER)
    # The noise level stays that of the fit, and where it matters is the clamp alone.
    assert np.all(np.abs(np.asarray(found[1]) - other.values) < 0.05 * other.errors)


def test_a_list_of_images():
    fit = pf.fit([SCENE], [IMAGE])
    near(vector(pf.refit(fit, [SCENE], [floats(IMAGE)])), fit.values, 1e-3)


@pytest.mark.parametrize(
    "scene, image, words",
    [
        (
            SCENE,
            IMAGE[:8],
            "image: expected shape .32, 32, 3. for scene 0, got .8, 32, 3.",
        ),
        (SCENE, IMAGE[..., 0], "image: expected .*, got .32, 32."),
        (SCENE, object(), "image: .* is not an array of numbers"),
        ([SCENE], 3, "image: expected a sequence, one a scene, got int"),
        ([SCENE, SCENE], [IMAGE, IMAGE], "scene: expected 1 .*, got 2 and 2"),
        ([SCENE], [IMAGE, IMAGE], "scene: expected 1 .*, got 1 and 2"),
        (
            ball(size=16),
            IMAGE,
            "scene: expected .32, 32. pixels of scene 0, got .16, 16.",
        ),
    ],
)
def test_wrong_shapes(scene, image, words):
    with pytest.raises(ValueError, match=words):
        pf.refit(fitted(), scene, image)


REFIT = (
    "expected known numbers, got a traced array "
    r".*differentiate refit\(fit, scene, image\)"
)
TRACED = [
    ("image", floats(IMAGE), lambda x: pf.fit(SCENE, x)),
    ("image", floats(np.stack([IMAGE, OTHER])), lambda x: pf.fit([SCENE, SCENE], x)),
    ("scene", SCENE, lambda x: pf.fit(x, IMAGE)),
    ("scene", SCENE, lambda x: pf.fit([SCENE, x], [IMAGE, OTHER])),
    ("known", TRUTH, lambda x: pf.fit(SCENE, IMAGE, known=x)),
    ("noise", floats(0.01), lambda x: pf.fit(SCENE, IMAGE, noise=x)),
    ("weights", floats(IMAGE), lambda x: pf.fit(SCENE, IMAGE, weights=x)),
    ("fixed", floats(0.3), lambda x: pf.fit(SCENE, IMAGE, fixed={"specular": x})),
    (
        "priors",
        floats(0.3),
        lambda x: pf.fit(SCENE, IMAGE, priors={"specular": (x, 1)}),
    ),
]


@pytest.mark.parametrize("name, point, fit", TRACED)
def test_a_fit_is_not_traced_itself(name, point, fit):
    def matte(point):
        return jnp.sum(fit(point).material.diffuse)

    with pytest.raises(ValueError, match=f"^{name}: {REFIT}"):
        eqx.filter_grad(matte)(point)
    with pytest.raises(ValueError, match=f"^{name}: {REFIT}"):
        eqx.filter_jit(matte)(point)


def test_nor_are_predictions_and_maps():
    both = floats(np.stack([IMAGE, OTHER]))
    for name, point, function in (
        ("material", TRUTH, lambda x: pf.predict_errors(SCENE, x, 0.01).errors),
        ("scene", SCENE, lambda x: pf.predict_errors(x, TRUTH, 0.01).errors),
        ("mask", both, lambda x: pf.predict_errors(SCENE, TRUTH, 1, mask=x).errors),
        ("images", both, lambda x: pf.fit_maps([SCENE, SCENE], x).material.diffuse),
        ("scenes", SCENE, lambda x: pf.fit_maps([x, x], both).material.diffuse),
    ):
        with pytest.raises(
            ValueError, match=f"^{name}: expected known numbers, got a traced array"
        ):
            eqx.filter_grad(lambda x, f=function: jnp.sum(jnp.asarray(f(x))))(point)
