"""The problem in the open: what a sampler or another solver asks of it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import phongfit as pf
from tests.fitting import canonical
from tests.fitting.canonical import FREE, NOISE
from tests.fitting.scenes import ball, photograph, truth

SCENE = ball()
IMAGE = photograph(SCENE, truth(), noise=NOISE, film=FREE)


@pytest.fixture(scope="module")
def problem():
    return pf.make_problem(SCENE, IMAGE, NOISE, film=FREE)


def test_the_likelihood_is_that_of_normal_noise(problem):
    y = problem.unknowns.start
    light = np.asarray(pf.render(SCENE, problem.material(y), film=FREE), float)
    seen = np.asarray(SCENE.trace().mask)
    expected = norm.logpdf(IMAGE[seen], light[seen], NOISE).sum()
    np.testing.assert_allclose(problem.log_likelihood(y), expected, rtol=1e-4)
    assert problem.residual(y).size >= 3 * seen.sum()


def test_the_fit_is_where_it_is_largest():
    solved = canonical.two_directional()
    fit = solved.fit
    problem = pf.make_problem(SCENE, solved.image, fit.noise)
    y = jnp.asarray(fit.position)
    value = problem.log_likelihood
    both = jax.jit(lambda y: (jax.grad(value)(y), jax.hessian(value)(y)))
    slope, curvature = (np.asarray(found, float) for found in both(y))
    errors = np.sqrt(np.diag(np.linalg.inv(-curvature)))
    # In standard errors the gradient is nothing.
    assert np.max(np.abs(slope * errors)) < 0.02
    exponent = fit.labels.index("shininess")
    np.testing.assert_allclose(
        errors[exponent] * fit.values[exponent], fit.errors[exponent], rtol=0.05
    )


def test_its_functions_go_through_jax(problem):
    ys = jnp.stack([problem.unknowns.start, problem.unknowns.start * 0.9])
    together = jax.jit(jax.vmap(problem.log_likelihood))(ys)
    alone = [problem.log_likelihood(y) for y in ys]
    np.testing.assert_allclose(together, np.array(alone), rtol=1e-5)
    # The problem itself is an argument, too.
    slope = jax.jit(jax.grad(lambda problem, y: problem.log_likelihood(y), 1))
    assert np.isfinite(slope(problem, ys[0])).all()


def test_an_exponent_is_called_a_logarithm(problem):
    labels = problem.unknowns.y_labels
    assert labels[:1] == problem.unknowns.labels[:1]
    assert labels[-1] == "log_shininess" and problem.unknowns.labels[-1] == "shininess"


def test_priors_are_normal():
    priors = {"shininess": (30.0, 3.0)}
    problem = pf.make_problem(SCENE, IMAGE, NOISE, priors=priors)
    at = {label: k for k, label in enumerate(problem.unknowns.y_labels)}
    at = at["log_shininess"]
    y = problem.unknowns.start.at[at].set(jnp.log(36.0))
    np.testing.assert_allclose(problem.log_prior(y), -(2.0**2) / 2, rtol=1e-4)


def test_it_asks_for_the_noise_and_for_options_that_there_are():
    with pytest.raises(ValueError, match="^noise: expected a standard deviation"):
        pf.make_problem(SCENE, IMAGE, None)
    options: dict[str, Any] = {"unknown": ["diffuse"]}
    with pytest.raises(TypeError, match="make_problem.*'unknown'"):
        pf.make_problem(SCENE, IMAGE, NOISE, **options)
