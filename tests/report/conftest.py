"""Fits that all tests of the report look at."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from tests.fitting.scenes import SIZE, ball, photograph, truth

TRUTH = truth()

NOISE = 0.01
# Of everything that can be asked of one image, something.
SETTINGS: dict[str, Any] = {
    "unknowns": ("diffuse", "specular", "shininess"),
    "per_channel": ("diffuse", "specular", "shininess"),
    "known": pf.Material(0.0, 0.0, 32.0, (0.5, 0.4, 0.3)),
    "bounds": {"diffuse.red": (0.1, 0.9)},
    "fixed": {"diffuse.blue": 0.2},
    "ties": {"specular.blue": (1.1, "specular.red")},
    "priors": {"diffuse.green": (0.3, 0.05)},
    "loss": pf.Huber(2.0),
    "film": pf.Film(bits=10),
}
# Of which the values themselves tell nothing.
ARRAYS = {
    "mask": np.repeat([True, False], SIZE // 2)[:, None].repeat(SIZE, axis=1),
    "weights": np.linspace(0.5, 2, SIZE**2).reshape(SIZE, SIZE),
    "noise": np.float64(NOISE),
}


@pytest.fixture(scope="session")
def one() -> pf.Fit:
    """One image, everything identified."""
    scene = ball()
    return pf.fit(scene, photograph(scene, TRUTH, noise=NOISE))


MATTE = pf.Material((0.6, 0.3, 0.2), 0.0, 30.0, 0.0)
DARK = (
    pf.DirectionalLight((1, 1, 2), 0.12),
    pf.DirectionalLight((-1, 0.3, 1), (0.08, 0.07, 0.06)),
)


@pytest.fixture(scope="session")
def open_fit() -> pf.Fit:
    """A dark photograph of a matte ball: f not identifiable, ρ_a lies at a bound.

    The same program solves it as `one`.
    """
    scene = dataclasses.replace(ball(), lights=DARK)
    film = pf.Film(clamp=False)
    return pf.fit(scene, photograph(scene, MATTE, noise=NOISE, film=film))


@pytest.fixture(scope="session")
def six() -> pf.Fit:
    """Six such photographs, each under a lamp of its own."""
    camera = pf.OrthographicCamera(SIZE, SIZE // 2)
    scenes = [
        pf.Scene(pf.Sphere(), camera, pf.DirectionalLight((x, 1, 2), 0.2), 0.2)
        for x in np.linspace(-1, 1, 6)
    ]
    images = [
        photograph(s, MATTE, noise=NOISE, film=pf.Film(clamp=False), seed=k)
        for k, s in enumerate(scenes)
    ]
    return pf.fit(scenes, images)


@pytest.fixture(scope="session")
def held() -> pf.Fit:
    """One image and much that was known: see [`SETTINGS`][]."""
    scene = ball()
    image = photograph(scene, TRUTH, noise=NOISE)
    return pf.fit(scene, image, **SETTINGS, **ARRAYS)
