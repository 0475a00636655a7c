"""`fit` as users call it: images, masks, weights, films, known values."""

import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.outputs import write_json
from phongfit.fitting.solve import search, start
from tests.fitting import canonical
from tests.fitting.canonical import NOISE, pulls
from tests.fitting.scenes import SIZE, as_vector, ball, photograph, truth
from tests.helpers import eps, near, only

TRUTH = truth()

SCENE = ball()
NOISY = photograph(SCENE, TRUTH, noise=NOISE)
MASK = np.asarray(SCENE.trace().mask)


def check_near_truth(fit: pf.Fit, truth: pf.Material = TRUTH) -> None:
    """Converged, and every parameter within 4.5 of its standard errors."""
    assert fit.converged
    for name in ("ambient", "diffuse", "specular", "shininess", "emission"):
        off = np.asarray(getattr(fit.material, name)) - getattr(truth, name)
        error = np.asarray(getattr(fit.stderr, name))
        assert np.all(np.abs(off) <= 4.5 * error + 100 * eps()), name


@pytest.mark.parametrize(
    "problem",
    [
        canonical.two_directional,
        pytest.param(canonical.one_light, marks=pytest.mark.extended),
        pytest.param(canonical.three_lights, marks=pytest.mark.extended),
        canonical.eight_bits,
        canonical.priors_and_ties,
        pytest.param(canonical.mesh, marks=pytest.mark.extended),
    ],
    ids=lambda problem: problem.__name__,
)
def test_the_truth_comes_back(problem):
    """What a fit has, whatever it is of: a solution, a report, images that agree."""
    found = problem()
    fit, mask = found.fit, found.mask
    assert fit.converged and not fit.warnings and not fit.unidentified.any()
    assert np.all(np.abs(found.pulls()) < 4.5)
    assert 0.9 * NOISE < fit.noise < 1.1 * NOISE
    assert fit.misfit.over_repeatability == pytest.approx(1, abs=0.05)
    near(fit.covariance, fit.covariance.T, 1e-12)
    assert fit.n_samples == 3 * mask.sum()
    fitted, residuals = only(fit.fitted), only(fit.residuals)
    near(fitted[mask], np.asarray(pf.render(found.scene, fit.material))[mask], 1e-5)
    near(residuals[mask], (found.image - fitted)[mask], 1e-5)
    assert np.all(residuals[~mask] == 0)
    text = str(fit)
    assert max(len(line) for line in text.splitlines()) <= 90
    assert all(f"  {label} " in text for label in fit.labels)
    assert text.count("±") == len(fit.labels)


def test_what_comes_back():
    fit = canonical.two_directional().fit
    assert fit.labels == (
        *("ambient.red", "ambient.green", "ambient.blue"),
        *("diffuse.red", "diffuse.green", "diffuse.blue"),
        *("specular.red", "specular.green", "specular.blue"),
        "shininess",
    )
    near(fit.values, as_vector(fit.material), 1e-6)
    near(fit.errors, as_vector(fit.stderr), 1e-6)
    near(fit.errors**2, np.diag(fit.covariance), 1e-5)
    assert np.all(np.linalg.eigvalsh(fit.correlation) > 0)
    assert fit.material.shininess.shape == () and fit.stderr.shininess.shape == ()
    assert fit.n_images == 1 and fit.degrees_of_freedom == fit.n_samples - 10
    assert (fit.loss, fit.model) == ("Linear", "BlinnPhong")
    assert 1 < fit.steps < 50 and "correlations" in str(fit)
    chi_squared = np.sum((only(fit.residuals) / fit.noise) ** 2)
    assert fit.chi_squared == pytest.approx(chi_squared, rel=1e-3)


def test_photographs_come_back_as_they_were_given():
    image = np.where(MASK[..., None], NOISY, np.nan)
    fit = pf.fit(SCENE, image, mask=MASK)
    photographs = only(fit.photographs)
    near(photographs[MASK], NOISY[MASK])
    assert np.isnan(photographs[~MASK]).all()
    image[MASK] = 0
    assert photographs[MASK].any(), "a copy"


def test_the_background_is_shown_and_not_fitted():
    grey = pf.Scene(
        SCENE.surface, SCENE.camera, SCENE.lights, 0.3, background=(0.1, 0.2, 0.3)
    )
    image = np.where(MASK[..., None], NOISY, np.random.default_rng(0).random(3))
    fit = pf.fit(grey, image)
    near(only(fit.fitted)[0, 0], [0.1, 0.2, 0.3])
    near(fit.values, canonical.two_directional().fit.values, 1e-5)


def test_the_least_cost():
    """No material near by explains the image better."""
    fit = canonical.two_directional().fit
    rng = np.random.default_rng(0)
    for _ in range(40):
        step = 0.02 * fit.errors * rng.normal(size=10)
        values = fit.values + step
        other = pf.Material(values[3:6], values[6:9], values[9], values[:3])
        off = np.asarray(pf.render(SCENE, other), float) - NOISY
        cost = np.sum(off[MASK] ** 2) / fit.noise**2
        assert cost >= fit.chi_squared * (1 - 1e-5)


@pytest.mark.extended
def test_of_many_samples_a_few_come_first(monkeypatch):
    """And lead to where all lead that are solved for at once."""
    passes, settle = [], search._settle

    def counted(*args, **kwargs):
        passes.append(len(args[0].samples.image))
        return settle(*args, **kwargs)

    monkeypatch.setattr(search, "_settle", counted)
    at_once = pf.fit(SCENE, NOISY)
    assert len(passes) == 1
    monkeypatch.setattr(start, "SUBSET", 512)
    monkeypatch.setattr(search, "MANY", 512)
    after_a_few = pf.fit(SCENE, NOISY)
    assert passes == [passes[0], 512, passes[0]] and passes[0] > 512
    assert np.all(np.abs(after_a_few.values - at_once.values) < 0.01 * at_once.errors)
    near(after_a_few.errors, at_once.errors, 1e-3)


def test_known_shared_and_per_channel():
    truth = pf.Material(TRUTH.diffuse, 0.3, (10.0, 20.0, 40.0), 0.4, (0.1, 0.05, 0.02))
    image = photograph(SCENE, truth, noise=NOISE)
    colours = ("diffuse", "shininess", "emission")
    fit = pf.fit(
        SCENE,
        image,
        unknowns=("diffuse", "specular", "shininess", "emission"),
        per_channel=colours,
        known=truth,
    )
    check_near_truth(fit, truth)
    assert fit.labels == (
        *("diffuse.red", "diffuse.green", "diffuse.blue"),
        "specular",
        *("shininess.red", "shininess.green", "shininess.blue"),
        *("emission.red", "emission.green", "emission.blue"),
    )
    assert fit.material.specular.shape == () and fit.material.shininess.shape == (3,)
    # What is known stays.
    assert np.array_equal(fit.material.ambient, truth.ambient)
    assert np.all(np.asarray(fit.stderr.ambient) == 0)
    # Three channels tell of what they share.
    apart = pf.fit(SCENE, image)
    assert fit.stderr.specular < 0.75 * np.min(np.asarray(apart.stderr.specular))
    # And one exponent for all does not explain these channels.
    assert apart.chi_squared * apart.noise**2 > 1.1 * fit.chi_squared * fit.noise**2


def test_bounds():
    bounds = {"diffuse": (0.0, 0.5), "shininess": (25.0, 80.0)}
    fit = pf.fit(SCENE, NOISY, bounds=bounds)
    assert fit.converged
    # The solver holds the logarithm of an exponent to its bound.
    assert fit.values[3] == 0.5 and fit.values[9] == pytest.approx(25, rel=4 * eps())
    assert fit.at_bound[[3, 9]].all()
    assert np.array_equal(fit.bounds[3], [0, 0.5])
    assert np.array_equal(fit.bounds[9], [25, 80])
    assert np.all((fit.bounds[:, 0] <= fit.values) & (fit.values <= fit.bounds[:, 1]))


def test_several_images():
    """Two lights, one at a time: each image alone tells less."""
    # The other light is off, not away: so the images share one compilation.
    off = pf.DirectionalLight((0, 0, 1), 0.0)
    scenes = [
        pf.Scene(SCENE.surface, SCENE.camera, (light, off), SCENE.ambient)
        for light in SCENE.lights
    ]
    images = [photograph(s, TRUTH, noise=NOISE, seed=k) for k, s in enumerate(scenes)]
    fit = pf.fit(scenes, (image for image in images))
    check_near_truth(fit)
    assert fit.n_images == 2 and fit.n_samples == 6 * MASK.sum()
    for several in (fit.fitted, fit.residuals, fit.photographs):
        assert isinstance(several, tuple) and len(several) == 2
    for shown, left, image in zip(fit.fitted, fit.residuals, images, strict=True):
        near(left[MASK], (image - shown)[MASK], 1e-5)
    # The same answer in another order, and less certainty from one.
    turned = pf.fit(scenes[::-1], images[::-1])
    near(turned.values, fit.values, 1e-4)
    alone = pf.fit(scenes[0], images[0])
    assert np.all(fit.errors < alone.errors)
    # A list of one is one, but comes back as a list.
    listed = pf.fit(scenes[:1], images[:1])
    near(listed.values, alone.values, 1e-6)
    assert isinstance(listed.fitted, tuple) and len(listed.fitted) == 1


def test_each_image_has_its_mask_and_noise():
    broken = photograph(SCENE, TRUTH, noise=0.03, seed=1)
    broken[:16] = 0.9
    lower = np.zeros((SIZE, SIZE), bool)
    lower[16:] = True
    fit = pf.fit(
        [SCENE, SCENE], [NOISY, broken], mask=[MASK, lower], noise=[NOISE, 0.03]
    )
    check_near_truth(fit)
    assert 0.9 < fit.reduced_chi_squared < 1.1
    assert fit.n_samples == 3 * (MASK.sum() + (MASK & lower).sum())
    assert np.all(fit.residuals[1][:16] == 0)


def test_masked_pixels_do_not_matter():
    mask = MASK.copy()
    mask[15, 10:20] = False
    image = NOISY.copy()
    image[~mask] = np.nan
    fit = pf.fit(SCENE, image, mask=mask)
    other = pf.fit(SCENE, np.where(mask[..., None], NOISY, 0.77), mask=mask)
    assert np.array_equal(fit.values, other.values)
    weighted = pf.fit(SCENE, image, weights=mask.astype(float))
    assert np.array_equal(fit.values, weighted.values)
    assert fit.n_samples == weighted.n_samples == 3 * mask.sum()
    check_near_truth(fit)


def test_one_channel_may_be_masked():
    mask = np.repeat(MASK[..., None], 3, axis=-1)
    mask[:, :16, 0] = False
    image = np.where(mask, NOISY, 5.0)
    fit = pf.fit(SCENE, image, mask=mask)
    check_near_truth(fit)
    whole = canonical.two_directional().fit
    assert fit.errors[3] > 1.05 * whole.errors[3]
    assert fit.errors[4] == pytest.approx(whole.errors[4], rel=0.05)


def test_weights_are_relative():
    weights = np.random.default_rng(1).uniform(0.5, 2, MASK.shape)
    fit = pf.fit(SCENE, NOISY, weights=weights)
    check_near_truth(fit)
    scaled = pf.fit(SCENE, NOISY, weights=100 * weights)
    near(scaled.values, fit.values, 1e-4)
    near(scaled.errors / fit.errors, 1, 1e-3)
    equal = canonical.two_directional().fit
    assert not np.allclose(fit.values, equal.values, rtol=1e-5)


def test_weight_two_is_seeing_twice():
    # So large that neither finds the residuals larger than what was given; and a draw
    # in which noise looks equal everywhere, since chance that is seen twice does not.
    image = photograph(SCENE, TRUTH, noise=NOISE, seed=6)
    ours = pf.fit(SCENE, image, weights=np.full(MASK.shape, 2.0), noise=1.5 * NOISE)
    twice = pf.fit([SCENE, SCENE], [image, image], noise=1.5 * NOISE)
    near(ours.values, twice.values, 1e-4)
    near(ours.errors / twice.errors, 1, 1e-3)


@pytest.mark.parametrize(
    "film, words",
    [
        (pf.Film(bits=8), "clamped, 8-bit linear"),
        (pf.Film(encoding="srgb", bits=8), "clamped, 8-bit srgb"),
        (pf.Film(encoding="srgb", bits=16), "clamped, 16-bit srgb"),
        (pf.Film(), "clamped, not rounded"),
    ],
)
def test_film_found_or_given(film, words):
    image = photograph(SCENE, TRUTH, noise=NOISE, film=film)
    found, given = pf.fit(SCENE, image), pf.fit(SCENE, image, film=film)
    assert found.film == given.film == words
    near(found.values, given.values, 1e-6)
    check_near_truth(found)


def test_a_film_that_was_never_clamped():
    lights = [pf.DirectionalLight((1, 1, 2), 3.0), pf.DirectionalLight((-1, 0, 1), 0.2)]
    bright = pf.Scene(SCENE.surface, SCENE.camera, lights, ambient=0.3)
    free = pf.Film(clamp=False)
    image = photograph(bright, TRUTH, noise=NOISE, film=free)
    assert image.max() > 1.5 and image.min() < 0
    found = pf.fit(bright, image)
    assert found.film == "not clamped, not rounded"
    check_near_truth(found)
    # Clipped, the same scene tells less.
    clipped = pf.fit(bright, np.clip(image, 0, 1))
    above = pf.fit(bright, np.minimum(image, 1))
    assert above.film == clipped.film == "clamped, not rounded"
    near(above.values, clipped.values, 1e-6)
    assert only(above.photographs).min() < 0
    check_near_truth(clipped)
    assert np.all(clipped.errors > found.errors)
    assert np.all(clipped.errors[6:] > 3 * found.errors[6:])


def test_the_wrong_model_is_told():
    """Blinn's highlight for Phong's, under a light from the side."""
    lights = (pf.DirectionalLight((4, 1, 1), 0.5), SCENE.lights[1])
    scenes = [
        pf.Scene(SCENE.surface, SCENE.camera, lights, 0.3, specular_model=model)
        for model in (pf.Phong(), pf.BlinnPhong())
    ]
    fit = pf.fit(scenes[1], photograph(scenes[0], TRUTH, noise=0.002))
    assert fit.converged and fit.neighbour_correlation > 0.1
    assert fit.misfit.significant
    (warning,) = fit.warnings
    assert warning.startswith("residuals are not noise")
    widened = np.sqrt(fit.misfit.inflation)
    assert f"errors are widened {widened:.1f} times" in warning


def test_too_few_steps_are_told():
    fit = pf.fit(SCENE, NOISY, max_steps=1)
    assert not fit.converged
    assert any("did not converge" in warning for warning in fit.warnings)
    assert "NOT CONVERGED" in str(fit)
    assert np.all(np.isfinite(fit.values))


def test_a_result_becomes_json(tmp_path):
    fit = canonical.no_highlight().fit
    assert fit.unidentified[9]
    path = tmp_path / "fit.json"
    write_json(path, fit.to_dict())
    assert '"stderr"' in path.read_text() and "Infinity" not in path.read_text()


def test_both_precisions_of_image():
    single, double = (pf.fit(SCENE, NOISY.astype(kind)) for kind in ("f4", "f8"))
    near(single.values, double.values, 1e-5)


@pytest.mark.parametrize(
    "loss", ["linear", pytest.param("cauchy", marks=pytest.mark.extended)]
)
def test_the_same_answer_in_both_precisions(loss):
    """Whatever the film cuts off and rounds."""
    film = pf.Film(bits=8)
    image = photograph(SCENE, TRUTH, noise=NOISE, film=film)
    double = pf.fit(SCENE, image, loss=loss)
    with jax.enable_x64(False):
        single = pf.fit(ball(), image.astype(np.float32), loss=loss)
    assert single.material.diffuse.dtype == np.float32
    assert np.all(np.abs(pulls(single, TRUTH)) < 4.5)
    near((single.values - double.values) / double.errors, 0, 0.02)
    near(single.errors / double.errors, 1, 0.02)
