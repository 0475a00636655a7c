"""Warnings of maps, and what their files keep."""

import dataclasses
import sys
import types

import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.result import BasisMaterials, Maps, ParameterMaps

SIZE = 3, 4


def basis(shininess: float, at_bound: bool) -> BasisMaterials:
    one = np.ones((1, 3))
    return BasisMaterials(
        specular=0.3 * one,
        shininess=np.array([float(shininess)]),
        stderr_specular=0.01 * one,
        stderr_shininess=np.array([2.0]),
        at_bound=np.array([at_bound]),
        weights=np.ones((*SIZE, 1)),
        criterion=np.array([10.0]),
        sample=12,
    )


def maps(**fields) -> Maps:
    """Flat maps of normals that were sought, with errors of 0.5°."""
    colour, one = np.full((*SIZE, 3), 0.3), np.full(SIZE, 0.01)
    normals = np.broadcast_to([0.0, 0, 1], (*SIZE, 3))
    return Maps(
        ambient=0 * colour,
        diffuse=colour,
        specular=colour,
        shininess=np.full((*SIZE, 1), 40.0),
        stderr=ParameterMaps(colour, colour, colour, np.ones((*SIZE, 1))),
        noise=one,
        samples=np.full(SIZE, 30),
        flags=np.zeros(SIZE, np.uint16),
        unknowns=("diffuse", "specular", "shininess"),
        noise_given=None,
        normals=normals,
        normals_stderr=np.full(SIZE, 0.5),
        depth=np.full(SIZE, np.nan),
        **fields,
    )


@pytest.mark.parametrize(
    "shininess, at_bound, code",
    [
        (40, False, None),
        (1, True, "broad-highlights"),
        (2.9, False, "broad-highlights"),
        (1000, True, "at-bound"),
    ],
)
def test_shared_highlights(shininess, at_bound, code):
    found = maps(materials=basis(shininess, at_bound)).warnings
    assert [pf.warning_code(one) for one in found] == ([] if code is None else [code])


def test_a_shared_highlight_that_is_not_seen():
    unseen = dataclasses.replace(basis(1, True), stderr_shininess=np.array([np.inf]))
    (warning,) = maps(materials=unseen).warnings
    assert pf.warning_code(warning) == "no-highlight"


@pytest.mark.parametrize(
    "strength_error, misplacement, code",
    [
        (0.2, 0.0, "strengths-doubtful"),
        # Wrong positions look like wrong strengths.
        (0.2, 1.6, "pixels-misplaced"),
    ],
)
def test_strengths_that_the_images_contradict(strength_error, misplacement, code):
    fields = {"strength_error": strength_error, "misplacement": misplacement}
    (warning,) = maps(**fields).warnings
    assert pf.warning_code(warning) == code


@pytest.mark.parametrize("angle, warned", [(0, False), (1.4, False), (1.6, True)])
def test_misplaced_pixels(angle, warned):
    found = maps(misplacement=float(angle)).warnings
    assert [pf.warning_code(one) for one in found] == ["pixels-misplaced"] * warned


def test_arrays_by_name(monkeypatch):
    found = maps()
    assert found["stderr_diffuse"] is found.stderr.diffuse
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match="to_xarray: .*pip install xarray"):
        found.to_xarray()
    table = types.SimpleNamespace(Dataset=dict)
    monkeypatch.setitem(sys.modules, "xarray", table)
    made = found.to_xarray()
    dimensions = {name: made[name][0] for name in ("diffuse", "normals", "shininess")}
    assert dimensions == {
        "diffuse": ("y", "x", "channel"),
        "normals": ("y", "x", "axis"),
        "shininess": ("y", "x"),
    }


def test_a_file_keeps_both(tmp_path):
    path = tmp_path / "maps.npz"
    saved = maps(materials=basis(1000, True), misplacement=1.6)
    saved.save(path)
    found = pf.load_maps(path)
    assert found.warnings == saved.warnings and len(found.warnings) == 2
    # Files before version 0.2 have neither.
    arrays = dict(np.load(path))
    del arrays["misplacement"], arrays["materials_at_bound"]
    np.savez(path, **arrays)
    assert pf.load_maps(path).warnings == ()


def test_wrong_numbers_of_a_file_are_named(tmp_path):
    path = tmp_path / "maps.npz"
    dataclasses.replace(maps(), misplacement=-1.0).save(path)
    with pytest.raises(ValueError, match="misplacement: expected a number ≥ 0"):
        pf.load_maps(path)
