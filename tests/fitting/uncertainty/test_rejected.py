"""A highlight that a robust loss rejects is named; a highlight that is found is not."""

import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.uncertainty.rejected import rejected_highlights
from tests.fitting import canonical
from tests.fitting.scenes import ball, photograph, truth
from tests.helpers import photographs

TRUTH = truth()

SCENE = ball()
GLOSSY = pf.Material(TRUTH.diffuse, TRUTH.specular, 200.0, TRUTH.ambient)
REJECTED = "took the highlight for outliers"


def test_a_rejected_highlight_is_not_identified():
    """Nothing sharper than f = 4 is allowed, so the highlight fits nowhere."""
    image = photograph(SCENE, GLOSSY, noise=0.01)
    fit = pf.fit(SCENE, image, loss="tukey", bounds={"shininess": (1.0, 4.0)})
    lost = [words for words in fit.warnings if REJECTED in words]
    assert len(lost) == 1 and 'loss="linear"' in lost[0]
    lobe = np.array([name.startswith(("specular", "shininess")) for name in fit.labels])
    np.testing.assert_array_equal(fit.unidentified, lobe)
    assert np.all(np.isinf(fit.errors[lobe])) and np.all(np.isfinite(fit.errors[~lobe]))
    assert rejected_highlights(fit.solution.problem, fit.solution.y).min() > 0


@pytest.mark.parametrize(
    "loss", ["tukey", pytest.param("huber", marks=pytest.mark.extended)]
)
def test_garbage_is_no_highlight(loss):
    image = photograph(SCENE, GLOSSY, noise=0.01)
    fit = pf.fit(SCENE, canonical.with_garbage(image), loss=loss)
    assert not any(REJECTED in words for words in fit.warnings)
    exponent = fit["shininess"]
    # With a fifth of garbage the estimate and the error of Huber's loss are larger.
    most, widest = (4, 25) if loss == "tukey" else (6, 50)
    assert abs(exponent.value - 200) < most * exponent.error < most * widest


def test_a_rejected_patch_elsewhere_does_not_widen_errors():
    """What the loss rejects says nothing of how the others correlate."""
    clean = photograph(SCENE, TRUTH, noise=0.01)
    image = clean.copy()
    image[22:26, 10:15] = 1.0
    fit, plain = (pf.fit(SCENE, one, loss="tukey") for one in (image, clean))
    assert not fit.warnings
    np.testing.assert_allclose(fit.errors, plain.errors, rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy", "tukey"])
def test_real_photographs(loss):
    """Each fit finds what least squares find, or says that it lost the highlight."""
    from phongfit.commands.data import DataOptions, read_data

    data, _ = read_data(DataOptions(photographs("diligent_ball")))
    for k in (0, 50):
        options = {"mask": data.masks[k], "film": data.film}
        fit = pf.fit(data.scenes[k], data.images[k], loss=loss, **options)
        lost = any(REJECTED in words for words in fit.warnings)
        assert lost or 600 < fit["shininess"].value < 2100
