import dataclasses

import numpy as np
import pytest

from experiments.how_well import (
    EXPERIMENT,
    PARAMETERS,
    SIZE,
    Spread,
    Sweep,
    failures,
    measure_setting,
    relative,
    resolutions,
    root_mean_square,
)


@pytest.mark.extended
def test_fits_reach_the_bound(found):
    """Forty fits a setting: a spread is known to 11 %, three of which are 34 %."""
    finding = found(EXPERIMENT)
    assert not finding.failed_checks
    settings = [one for group in finding.numbers.values() for one in group]
    ratios = np.array([
        observed / bound
        for one in settings
        for observed, bound, identified in zip(
            one["observed"], one["bound"], one["identified"], strict=True
        )
        if identified
    ])  # fmt: skip
    assert len(ratios) >= 34 and np.all(np.abs(ratios - 1) < 0.34)
    # All together they are known to 2 %.
    assert np.sqrt(np.mean(ratios**2)) == pytest.approx(1, abs=0.06)


@pytest.mark.extended
def test_what_makes_errors_larger(found):
    numbers = found(EXPERIMENT).numbers
    bound = {
        name: np.array([one["bound"] for one in group])
        for name, group in numbers.items()
    }
    np.testing.assert_allclose(bound["noise"][1], 3 * bound["noise"][0], rtol=1e-3)
    assert np.all(bound["lamps"][1] < 0.6 * bound["lamps"][0])
    np.testing.assert_allclose(
        bound["resolution"][1] / bound["resolution"][0], 2 / 3, 0.1
    )
    specular, f = PARAMETERS.index("specular"), PARAMETERS.index("shininess")
    for name in ("clipping", "highlight"):
        first, last = numbers[name]
        assert first["identified"].all()
        lost = ~last["identified"] | (last["bound"] > 5 * first["bound"])
        assert lost[specular] and lost[f]


@pytest.mark.extended
def test_a_highlight_out_of_view_is_not_identifiable(found):
    *_, last = found(EXPERIMENT).numbers["highlight"]
    identified = dict(zip(PARAMETERS, last["identified"], strict=True))
    assert last["x"] < 1 and not identified["specular"] and not identified["shininess"]
    # What the fits themselves state of the others covers any exponent.
    assert (
        identified["diffuse"] and 0.3 < last["pull"][PARAMETERS.index("diffuse")] < 1.2
    )


def test_a_spread_off_the_bound_is_seen():
    ones = np.ones(4)
    right = Spread(0.01, ones, ones, ones, ones > 0, 200)
    sweep = Sweep("noise", "", ())
    assert right.tolerance == pytest.approx(0.15)
    assert failures([(sweep, [right])]) == ()
    wide = dataclasses.replace(right, observed=np.array([1.0, 1.0, 1.2, 1.0]))
    (words,) = failures([(sweep, [wide])])
    assert words == "noise 0.01: shininess scatters 1.20 times the prediction"
    # What is not identifiable is not judged; of the others the fits' own errors are,
    # too.
    open_ = dataclasses.replace(
        wide,
        identified=np.array([True, True, False, True]),
        pull=np.array([1, 1, 9, 1.3]),
    )
    (words,) = failures([(sweep, [open_])])
    assert words == "noise 0.01: ambient scatters 1.30 times the errors that fits state"


def test_relative_errors():
    truth = np.array([0.5, 0.3, 20.0, 0.5])
    off = relative(np.array([0.55, 0.3, 40.0, 0.25]), truth)
    np.testing.assert_allclose(off, [0.1, 0, np.log(2), -0.5], atol=1e-12)
    columns = np.array([[3.0, np.nan], [4.0, np.nan], [np.nan, 1.0]])
    np.testing.assert_allclose(root_mean_square(columns), [np.sqrt(12.5), np.nan])


@pytest.mark.slow
def test_fits_reach_the_bound_closely():
    (setting,) = resolutions([SIZE]).settings
    ratio = measure_setting(setting, 1000, 1).ratio
    assert np.all(np.abs(ratio - 1) < 3 / np.sqrt(2000))
