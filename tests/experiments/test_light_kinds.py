import dataclasses

import numpy as np
import pytest

from experiments.light_kinds import EXPERIMENT, Result, fog_contrast


@pytest.mark.extended
def test_rendered_light_is_that_of_the_formulas(found):
    finding = found(EXPERIMENT)
    assert not finding.failed_checks
    differences = finding.numbers["off"]
    assert set(differences) == {"directional", "point", "spot", "fog", "shadow"}
    assert all(
        differences[name] < 1e-4 for name in ("directional", "point", "spot", "fog")
    )
    assert differences["shadow"] < 0.05
    fall = finding.numbers["falloff"]
    assert np.all(fall["directional"] == 1) and fall["spot"].min() == 0
    assert np.all(fall["spot"] <= fall["point"] + 1e-6)


def test_fog_takes_more_from_further_away():
    depth, contrast = fog_contrast(32)
    order = np.argsort(depth)
    assert np.all(np.diff(contrast[order]) < 0) and contrast.max() < 1


@pytest.mark.extended
def test_a_wrong_picture_is_seen(found):
    numbers = found(EXPERIMENT).numbers
    fields = {field.name: numbers[field.name] for field in dataclasses.fields(Result)}
    right = Result(**fields)
    dimmer = {**right.falloff, "point": 0.9 * right.falloff["point"]}
    assert dataclasses.replace(right, falloff=dimmer).differences["point"] > 0.05
    assert (
        dataclasses.replace(right, shadow=2 * right.shadow).differences["shadow"] > 0.9
    )
    assert right.differences == pytest.approx(numbers["off"])
