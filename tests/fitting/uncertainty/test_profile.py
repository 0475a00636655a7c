"""Profile likelihoods next to standard errors, and to lmfit's."""

import functools
from collections.abc import Callable
from typing import Any

import lmfit
import numpy as np
import pytest
import scipy.stats

import phongfit as pf
from phongfit.fitting.uncertainty.profile import LEVELS
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import ball, photograph, truth

TRUTH = truth()

SCENE = ball()
# Few pixels, and only the skirt of a highlight: f is poorly known.
FEW = np.zeros((32, 32), bool)
FEW[12:21:2, 10:20:2] = True
NAMES = ("diffuse", "specular", "shininess")


@functools.cache
def nearly_gaussian() -> pf.Fit:
    return pf.fit(SCENE, canonical.two_directional().image, noise=NOISE)


@functools.cache
def curved() -> tuple[pf.Fit, np.ndarray]:
    image = photograph(SCENE, TRUTH, noise=0.02, film=pf.Film(clamp=False), seed=5)
    fit = pf.fit(
        SCENE,
        image,
        unknowns=NAMES,
        per_channel=("diffuse",),
        known=TRUTH,
        mask=FEW,
        noise=0.02,
        film=pf.Film(clamp=False),
    )
    return fit, image


def residual(image: np.ndarray) -> Callable[[lmfit.Parameters], np.ndarray]:
    """The same residuals, written out in NumPy."""
    terms = pf.terms(SCENE, SCENE.trace())
    ambient, diffuse, cosine, strength = (
        np.asarray(part, float)[FEW]
        for part in (terms.ambient, terms.diffuse, terms.cosine, terms.strength)
    )
    target = image[FEW] - np.asarray(TRUTH.ambient, float) * ambient

    def of(parameters: lmfit.Parameters) -> np.ndarray:
        red, green, blue, specular, shininess = parameters.valuesdict().values()
        lobe = np.maximum(cosine, 1e-30)[..., None] ** shininess
        highlight = specular * np.sum(strength * lobe, axis=1)
        light = diffuse * [red, green, blue] + highlight
        return ((light - target) / 0.02).ravel()

    return of


def parameters(values: np.ndarray) -> lmfit.Parameters:
    made = lmfit.Parameters()
    for name, value in zip(("red", "green", "blue", *NAMES[1:]), values, strict=True):
        made.add(name, value=float(value))
    return made


@pytest.mark.parametrize("name", ["shininess", "diffuse.red"])
def test_where_the_model_hardly_bends_it_is_the_standard_error(name):
    fit = nearly_gaussian()
    profile = fit.profile(name)
    estimate = fit[name]
    for level in LEVELS:
        t = scipy.stats.t.ppf((1 + level) / 2, fit.degrees_of_freedom)
        off = (np.array(profile.intervals[level]) - estimate.value) / estimate.error
        np.testing.assert_allclose(off, [-t, t], rtol=0.06 if "." not in name else 0.02)
    assert np.all(np.diff(profile.values) > 0) and profile.label == name
    assert profile.rise.min() == 0
    nearest = np.abs(profile.values - estimate.value).argmin()
    assert profile.rise.argmin() == nearest
    assert str(profile).count("…") == 3


@pytest.mark.extended
def test_where_it_bends_it_is_lmfits():
    fit, image = curved()
    minimizer = lmfit.Minimizer(
        residual(image), parameters(fit.values), scale_covar=False
    )
    best: Any = minimizer.minimize(method="leastsq")
    found = np.array(list(best.params.valuesdict().values()))
    assert np.all(np.abs(fit.values - found) < 0.01 * fit.errors)
    # lmfit compares by Fisher's distribution, with the noise that is left over.
    chances = LEVELS[:2]
    for name in ("shininess", "specular"):
        theirs: Any = lmfit.conf_interval(
            minimizer, best, p_names=[name], sigmas=chances
        )
        ends = [value for _, value in theirs[name]]
        ours = fit.profile(name, levels=_levels(fit, chances)).intervals
        for k, (low, high) in enumerate(ours.values()):
            width = ends[-2 + k] - ends[1 - k] if k == 0 else ends[-1] - ends[0]
            expected = (ends[1], ends[3]) if k == 0 else (ends[0], ends[4])
            assert abs(low - expected[0]) < 0.02 * width
            assert abs(high - expected[1]) < 0.02 * width
    low, high = fit.profile("shininess").intervals[LEVELS[2]]
    assert high - fit.values[4] > 1.3 * (fit.values[4] - low)


def _levels(fit: pf.Fit, chances: tuple[float, ...]) -> tuple[float, ...]:
    """Chances for a known noise at which the cost rises as lmfit's does."""
    freedom = fit.degrees_of_freedom
    rises = [
        scipy.stats.f.ppf(p, 1, freedom) * fit.chi_squared / freedom for p in chances
    ]
    return tuple(
        float(2 * scipy.stats.t.cdf(np.sqrt(rise), freedom) - 1) for rise in rises
    )


@pytest.mark.slow
def test_a_pair_is_lmfits():
    fit, image = curved()
    pair = fit.profile("specular", "shininess")
    assert pair.labels == ("specular", "shininess")
    assert pair.rise.shape == (len(pair.values[0]), len(pair.values[1]))
    solve = residual(image)
    # At some points of the grid, all others fitted again by SciPy.
    for i, j in ((2, 7), (7, 2), (10, 11), (12, 4), (7, 7)):
        held = parameters(fit.values)
        held["specular"].set(value=pair.values[0][i], vary=False)
        held["shininess"].set(value=pair.values[1][j], vary=False)
        best = lmfit.minimize(solve, held)
        expected = best.chisqr - fit.chi_squared
        assert pair.rise[i, j] == pytest.approx(expected, rel=0.02, abs=0.02)
    for level, threshold in pair.thresholds.items():
        expected = 2 * scipy.stats.f.ppf(level, 2, fit.degrees_of_freedom)
        assert threshold == pytest.approx(expected)
    assert pair.rise.max() > max(pair.thresholds.values())


def test_an_end_at_a_bound():
    truth = pf.Material((0.6, 0.3, 0.0), TRUTH.specular, 20.0, TRUTH.ambient)
    fits = [
        pf.fit(SCENE, photograph(SCENE, truth, noise=NOISE, seed=seed), noise=NOISE)
        for seed in range(3)
    ]
    assert {bool(fit.at_bound[5]) for fit in fits} == {False, True}
    for fit in fits:
        estimate = fit["diffuse.blue"]
        profile = fit.profile("diffuse.blue")
        for sigmas, (low, high) in enumerate(profile.intervals.values(), 1):
            assert low == 0
            if not estimate.at_bound:
                reach = (high - estimate.value) / estimate.error
                assert reach == pytest.approx(sigmas, rel=0.03)
        low, high = profile.intervals[LEVELS[0]]
        if estimate.at_bound:
            assert high == pytest.approx(estimate.error, rel=0.03)
        with_other = fit.profile("diffuse.red").intervals[LEVELS[0]]
        t = np.subtract(with_other, fit.values[3]) / fit.errors[3]
        np.testing.assert_allclose(t, [-1, 1], rtol=0.03)


def test_what_is_not_identifiable_has_its_box():
    fit = pf.fit(SCENE, canonical.no_highlight().image, noise=NOISE)
    assert fit["shininess"].unidentified
    profile = fit.profile("shininess", levels=(0.99, 0.999))
    assert profile.intervals == {0.99: (1, 1000), 0.999: (1, 1000)}


def test_what_is_not_identifiable_does_not_scale_a_pair():
    image = canonical.no_highlight().image
    matte = pf.Material(0.5, 0.0, 20.0, 0.5)
    unknowns = ("ambient", "diffuse", "shininess")
    fit = pf.fit(SCENE, image, noise=NOISE, unknowns=unknowns, known=matte)
    alone = fit.profile("diffuse.red")
    pair = fit.profile("diffuse.red", "shininess")
    # Any exponent will do, so the least over exponents is the profile of the other.
    least = np.interp(pair.values[0], alone.values, alone.rise)
    inner = (pair.values[0] > alone.values[0]) & (pair.values[0] < alone.values[-1])
    inner &= least > 0.5
    ratio = pair.rise.min(axis=1)[inner] / least[inner]
    assert np.median(ratio) == pytest.approx(1, rel=0.1)


@pytest.mark.slow
def test_robust_losses_have_the_errors_that_they_state():
    image = photograph(SCENE, TRUTH, noise=NOISE)
    fit = pf.fit(SCENE, image, noise=NOISE, loss="tukey")
    for name in ("shininess", "specular.green"):
        low, high = fit.profile(name).intervals[LEVELS[0]]
        estimate = fit[name]
        assert (high - low) / (2 * estimate.error) == pytest.approx(1, rel=0.05)


def test_tied_unknowns_follow():
    fit = canonical.priors_and_ties().fit
    estimate = fit["diffuse.red"]
    for part in ("value", "error"):
        followed = 0.5 * getattr(fit["diffuse"], part)
        np.testing.assert_allclose(getattr(fit["specular"], part), followed, rtol=1e-5)
    assert fit.correlation[3, 6] == pytest.approx(1, abs=1e-5)
    low, high = fit.profile("diffuse.red").intervals[LEVELS[0]]
    np.testing.assert_allclose(
        [low, high], estimate.value + estimate.error * np.array([-1, 1]), rtol=1e-3
    )
    with pytest.raises(
        ValueError, match="name: expected one of ambient.*got 'specular.red'"
    ):
        fit.profile("specular.red")


def test_wrong_arguments():
    fit = nearly_gaussian()
    with pytest.raises(
        ValueError, match="name: expected one of ambient.red.*got 'gloss'"
    ):
        fit.profile("gloss")
    with pytest.raises(ValueError, match="other: expected .*, got 'diffuse'"):
        fit.profile("shininess", "diffuse")
    with pytest.raises(
        ValueError, match="other: expected two unknowns, got 'shininess' twice"
    ):
        fit.profile("shininess", "shininess")
    for level in (0.0, 1.0, -0.5, 95):
        with pytest.raises(ValueError, match="levels: "):
            fit.profile("shininess", levels=(0.5, level))
