"""Intervals in a box against a general optimiser, and against what really happens."""

import numpy as np
import pytest
from scipy.optimize import minimize

import phongfit as pf
from phongfit.fitting.uncertainty.intervals import Quadratic
from phongfit.fitting.uncertainty.region import Part, Region
from tests.fitting.scenes import SIZE, as_vector, ball, photograph, truth
from tests.helpers import near

TRUTH = truth()

LEVEL = 3.84


def quadratic(seed: int) -> Quadratic:
    """A random one: some bounds bind, some numbers trade, one may not be at best."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    jacobian = rng.normal(size=(n + 2, n)) * 10 ** rng.uniform(-1, 1, n)
    if seed % 3 == 0:
        jacobian[:, 1] = jacobian[:, 0] + 0.01 * rng.normal(size=n + 2)
    precision = jacobian.T @ jacobian
    lower, upper = -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
    slope, root = np.zeros(n), np.sqrt(np.diag(precision))
    for i, kind in enumerate(rng.integers(5, size=n)):
        if kind == 0:
            lower[i], slope[i] = 0, rng.exponential() * root[i]
        elif kind == 1:
            # Held by a bound that it has no wish to cross.
            upper[i] = 0
        elif kind == 2:
            lower[i] = -np.inf
    rise = 0.0
    if seed % 4 == 0:
        lower[0], upper[0], slope[0] = -0.1, 0.1, 0.3 * rng.normal() * root[0]
        rise = 0.3
    return Quadratic(precision, slope, lower, upper, rise, np.zeros(n))


def rise(one: Quadratic, p: np.ndarray) -> float:
    return float(one.rise + 2 * one.slope @ p + p @ one.precision @ p)


def farthest(one: Quadratic, place: int, sign: float) -> float:
    """The same by a method for any smooth problem."""
    along = sign * np.eye(len(one.slope))[place]
    ends = []
    for trial in range(4):
        step = 0.05 * trial * np.random.default_rng(trial).normal(size=len(along))
        found = minimize(
            lambda p: -along @ p,
            np.clip(step, one.lower, one.upper),
            jac=lambda p: -along,
            bounds=list(zip(one.lower, one.upper, strict=True)),
            constraints={
                "type": "ineq",
                "fun": lambda p: LEVEL - rise(one, p),
                "jac": lambda p: -2 * (one.slope + one.precision @ p),
            },
            method="SLSQP",
            options={"maxiter": 1000, "ftol": 1e-14},
        )
        if rise(one, found.x) <= LEVEL + 1e-7:
            ends.append(along @ found.x)
    return float(sign * max(ends))


def test_ends_are_the_farthest_points():
    for one in map(quadratic, range(24)):
        places = np.eye(len(one.slope))
        expected = [[farthest(one, k, s) for s in (-1, 1)] for k in range(len(places))]
        near(one.ends(places, LEVEL), expected, 1e-4)


def test_where_the_level_is_nowhere_kept():
    one = Quadratic(np.eye(2), np.zeros(2), -np.ones(2), np.ones(2), 5.0, np.zeros(2))
    assert np.isnan(one.ends(np.eye(2), LEVEL)).all()
    near(one.ends(np.eye(2), 5.25), [[-0.5, 0.5]] * 2, 1e-12)
    none = np.zeros(0)
    empty = Quadratic(np.zeros((0, 0)), none, none, none, 0.0, none)
    assert empty.ends(np.zeros((0, 0)), LEVEL).shape == (0, 2)


def test_a_bound_makes_the_other_one_sided():
    """Two that nearly trade, one at 0: the other can only go down, by all it has."""
    precision = np.array([[1.0, 0.999999], [0.999999, 1.0]]) * 1e8
    lower, upper = np.array([-0.7, 0.0]), np.full(2, np.inf)
    one = Quadratic(precision, np.zeros(2), lower, upper, 0.0, np.zeros(2))
    first, second = one.ends(np.eye(2), 1.0)
    assert first[0] < -0.06 and 0 < first[1] < 2e-4
    assert second[0] == 0 and second[1] > 0.06


def coverage(scene: pf.Scene, truth: pf.Material, noise: float, draws: int, **options):
    """Share of 95 % intervals that hold the truth, entry by entry, and the fits."""
    fits = [
        pf.fit(scene, photograph(scene, truth, noise=noise, seed=seed), **options)
        for seed in range(draws)
    ]
    low, high = np.moveaxis(np.array([fit.intervals() for fit in fits]), -1, 0)
    return low, high, fits


@pytest.mark.extended
def test_two_lamps_almost_at_one_place():
    """One of them often comes out as 0, and then the other has it all."""
    lamps = [
        pf.DirectionalLight((1, 1, 2), 0.4),
        pf.DirectionalLight((1.004, 1, 2), 0.3),
    ]
    scene = pf.Scene(pf.Sphere(), ball().camera, lamps, ambient=0.3)
    names = tuple(f"scene.lights[{k}].intensity" for k in range(2))
    options = {"unknowns": names, "per_channel": (), "known": TRUTH}
    low, high, fits = coverage(scene, TRUTH, 0.02, 24, **options)
    held = np.array([fit.at_bound.any() for fit in fits])
    assert 6 < held.sum()
    inside = (low <= [0.4, 0.3]) & (high >= [0.4, 0.3])
    assert inside.mean() > 0.9 and inside[held].mean() > 0.9
    # Its error is the whole trade, to the side where there is room.
    first = next(fit for fit in fits if fit.at_bound.any())
    other = int(np.flatnonzero(~first.at_bound)[0])
    assert first.errors[other] > 0.2 and np.isnan(first.covariance[other]).all()
    down, up = first.sides[other]
    assert down > 10 * up
    assert f"+{up:.2g} −{down:.2g}" in str(first)


# Light from the viewer: near f = 1 a highlight is what Lambert's light is.
FRONT = pf.Scene(
    pf.Sphere(),
    pf.OrthographicCamera(SIZE, SIZE),
    pf.DirectionalLight((0, 0, 1), 0.6),
    ambient=0.3,
)


@pytest.mark.extended
@pytest.mark.parametrize(
    "scene, specular, shininess", [(FRONT, 0.1, 2.0), (ball(), 0.03, 300.0)]
)
def test_specular_where_the_exponent_is_not_identified(scene, specular, shininess):
    truth = pf.Material(TRUTH.diffuse, specular, shininess, TRUTH.ambient)
    low, high, fits = coverage(scene, truth, 0.05, 16)
    assert np.mean([fit.unidentified[9] for fit in fits]) > 0.8
    expected = as_vector(
        pf.Material(truth.diffuse, np.full(3, specular), shininess, truth.ambient)
    )
    identified = ~np.array([fit.unidentified for fit in fits])
    inside = (low <= expected) & (expected <= high)
    assert inside[identified].mean() > 0.94
    off = np.array([fit.values for fit in fits]) - expected
    errors = np.array([fit.errors for fit in fits])
    assert np.mean(np.abs(off)[identified] < 2 * errors[identified]) > 0.94


def test_an_interval_follows_the_exponent():
    """It holds what other exponents near the best would make of it, and no more."""
    truth = pf.Material(TRUTH.diffuse, 0.1, 20.0, TRUTH.ambient)
    image = photograph(ball(), truth, noise=0.03, seed=1)
    fit = pf.fit(ball(), image, noise=0.03)
    level = 0.95
    low, high = fit.intervals(level)[9]
    assert high - fit.values[9] > 1.2 * (fit.values[9] - low)
    profile = fit.profile("shininess", levels=(level,)).intervals[level]
    near([low, high], profile, 0.05)


def test_ends_lie_on_their_bounds():
    """An end that single precision leaves a digit short of one is on it."""
    low, high = (np.log([end / 2]) for end in (1.0000001, 999.9999))
    flat = Quadratic(np.array([[1e-6]]), np.zeros(1), low, high, 0.0, np.zeros(1))
    region = Region(
        values=np.array([2.0]),
        slope=np.array([[2.0]]),
        logarithmic=np.array([True]),
        bounds=np.array([[1.0, 1000.0]]),
        open_ended=np.array([False]),
        make=lambda: (Part(np.array([0]), (flat,)),),
    )
    assert region.ends(LEVEL).tolist() == [[1.0, 1000.0]]
