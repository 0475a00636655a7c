"""Real photographs, where they are: left-out ones are predicted from maps."""

import numpy as np
import pytest

import phongfit as pf
from experiments.fit_photographs import (
    ALL_PARAMETERS,
    every_second,
    fit,
    predict,
    read,
    rmse_over_mean,
)
from tests.helpers import photographs


@pytest.mark.slow
def test_left_out_photographs_are_predicted_better_than_by_one_material():
    """One highlight for the whole ball, seen by one light in a pixel at most."""
    data = read(photographs("diligent_ball"))
    seen, unseen = every_second(data, 0), every_second(data, 1)
    one = fit(seen, ALL_PARAMETERS, ())
    maps = pf.fit_maps(
        seen.scenes,
        seen.images,
        mask=seen.masks,
        film=data.film,
        unknowns=("ambient", "diffuse"),
        known=one.material,
        per_channel=ALL_PARAMETERS,
    )
    single, each = (
        rmse_over_mean(unseen, predict(unseen, material))
        for material in (one.material, maps.material)
    )
    assert np.all(each < single)
    assert np.all(each < 0.97 * np.array([0.0942, 0.0806, 0.1213]))
