"""Fog that is known: maps look through it."""

from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.job import make_job
from phongfit.maps.stacks import ArrayStack
from tests.maps.synthetic import FREE, dtype, shown

pytestmark = pytest.mark.extended

SIZE = 20
QUICK: dict[str, Any] = {
    "unknowns": ("diffuse",),
    "film": FREE,
    "tile_pixels": 512,
}


def make(*fogs: pf.Fog | None) -> tuple[list[pf.Scene], np.ndarray, pf.Material]:
    """A ball behind one fog after the other, each under its own light."""
    rng = np.random.default_rng(0)
    camera = pf.PerspectiveCamera(SIZE, SIZE)
    truth = pf.Material(rng.uniform(0.2, 0.6, (SIZE, SIZE, 3)), 0.2, 12.0, 0.5)
    scenes = [
        pf.Scene(pf.Sphere(), camera, pf.PointLight(place), ambient=0.2, fog=fog)
        for place, fog in zip(rng.uniform(2, 4, (len(fogs), 3)), fogs, strict=True)
    ]
    return scenes, shown(scenes, truth).astype(dtype()), truth


def test_what_lies_behind_the_fog():
    """Of every mode, and none, in scenes of one map."""
    fogs = (
        pf.Fog((0.5, 0.6, 0.7), density=0.2),
        pf.Fog(0.8, "linear", start=3, end=9),
        None,
        pf.Fog(0.3, "exp2", density=0.1),
    )
    scenes, foggy, truth = make(*fogs)
    known = pf.Material(0.0, truth.specular, truth.shininess, truth.ambient)
    maps = pf.fit_maps(scenes, foggy, known=known, noise=0.01, **QUICK)
    assert maps.identified.sum() > 80
    # The search ends at a small fraction of the errors.
    true = np.asarray(truth.diffuse)
    off = np.abs(maps.diffuse - true)[maps.identified]
    assert np.all(off < 0.05 * maps.stderr.diffuse[maps.identified])
    # The thicker the fog, the less is identified.
    bare = [pf.Scene(s.surface, s.camera, s.lights, s.ambient) for s in scenes]
    clear = pf.fit_maps(bare, shown(bare, truth), known=known, noise=0.01, **QUICK)
    assert np.all(
        maps.stderr.diffuse[maps.identified] > clear.stderr.diffuse[maps.identified]
    )
    ignored = pf.fit_maps(bare, foggy, known=known, noise=0.01, **QUICK)
    assert np.median(np.abs(ignored.diffuse - true)[maps.identified]) > 0.05


def test_another_fog_is_another_job():
    fogs = (pf.Fog(0.5, mode, density=0.2) for mode in ("exp", "exp2"))
    one, other = (
        make_job(scenes, ArrayStack(images)).identify()
        for scenes, images, _ in (make(*[fog] * 5) for fog in fogs)
    )
    assert {name for name in one if one[name] != other[name]} == {"lights"}
