"""A material from photographs alone: lamps by their spheres, the rest by a fit.

Errors that are stated are to hold, whatever they come from: noise, JPEG, the lamps.
"""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import phongfit as pf
from phongfit.files.capture_data import open_captured
from tests.calibration.studio import Studio, calibrated, directions
from tests.helpers import known, photographs

LAMPS = 6
COLOUR = np.array([1, 0.9, 0.8])
"""Of the studio's lamps."""
FILM = pf.Film(encoding="srgb", bits=8)
CENTRE, RADIUS = np.array([0, -0.45, -10.0]), 0.58
SLOW = list(itertools.product((0.0, 0.003, 0.01), (75, 90, 95), ("distant", "near")))
"""Noise, JPEG's quality, lamps: with two more, twenty captures."""


def vase(camera, random):
    """A ball whose normals are bent: relief, of which no pixel hides another."""
    light = pf.DirectionalLight((0, 0, 1))
    seen = pf.Scene(pf.Sphere(CENTRE, RADIUS), camera, light).trace()
    mask = np.asarray(seen.mask)[..., None]
    normal, place = np.asarray(seen.normal), np.asarray(seen.position)
    at, phase = (place - CENTRE) / RADIUS, random.uniform(0, 6, 2)
    bend = 0.25 * np.sin(np.array([7, 5]) * at[..., :2] + phase)
    normal = normal + np.concatenate([bend, 0 * bend[..., :1]], axis=-1)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return pf.NormalMap(np.where(mask, normal, 0), positions=np.where(mask, place, 0))


def photograph(folder, seed, noise, quality, lamps):
    """Write a capture; give the material, as the calibration's lamps would have it."""
    random = np.random.default_rng(seed)
    studio = Studio(200, 150)
    camera = pf.PerspectiveCamera(200, 150, fov_y=20, position=(0, 0, 0))
    surface = vase(camera, random)
    diffuse, specular = random.uniform(0.2, 0.55, 3), random.uniform(0.1, 0.3)
    shininess = random.uniform(15, 60)
    material = pf.Material(diffuse, specular, shininess)
    turn = random.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    aim = directions(LAMPS) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    strength, places = random.uniform(0.7, 1.3, LAMPS), np.array(aim)
    for k in range(LAMPS):
        place, light = aim[k], pf.DirectionalLight(aim[k], strength[k] * COLOUR)
        if lamps == "near":
            distance = random.uniform(5, 8)
            place = places[k] = np.array([0, 0, -10]) + distance * aim[k]
            attenuation = (0, 0, 1 / distance**2)
            light = pf.PointLight(place, strength[k] * COLOUR, attenuation=attenuation)
        around = studio.photograph(place, strength[k], near=lamps == "near", noise=0)
        scene = pf.Scene(surface, camera, light)
        shown = np.asarray(pf.render(scene, material))
        image = np.where(np.asarray(surface.mask)[..., None], shown, around)
        image = np.clip(image + noise * random.normal(size=image.shape), 0, 1)
        stored = np.asarray(FILM.expose(image))
        levels = np.round(255 * stored).astype(np.uint8)
        # Of no quality: without loss.
        options = {} if quality is None else {"quality": quality}
        suffix = "png" if quality is None else "jpg"
        Image.fromarray(levels).save(folder / f"{k + 1}.{suffix}", **options)
    seen = known(surface.positions)
    np.savez(folder / "n.npz", normals=surface.normals, positions=seen)
    found = calibrated(studio, folder, "srgb", lamps)
    if lamps == "near":
        # They are those at the calibration's reference point.
        centre = np.linalg.norm(places - [0, 0, -10], axis=1)
        strength *= (centre / np.linalg.norm(places - found.reference, axis=1)) ** 2
    # Strengths are over their mean, as nothing tells how bright the matte sphere is.
    kept = [int(Path(lamp.photograph).stem) - 1 for lamp in found.lamps]
    unit = strength[kept].mean() * COLOUR.mean()
    return np.array([*(unit * diffuse), unit * specular, shininess])


def fitted(folder, *of):
    """Shares that reflectances and exponent are off by the calibration, and errors."""
    truth = photograph(folder, *of)
    data = open_captured(folder, "srgb", normals=folder / "n.npz").load()
    fit = pf.fit(
        data.scenes,
        data.images,
        mask=data.masks,
        film=data.film,
        uncertain=data.uncertain,
        unknowns=("ambient", "diffuse", "specular", "shininess"),
        per_channel=("ambient", "diffuse"),
        bounds={"diffuse": (0, 3), "specular": (0, 3)},
    )
    assert fit.misfit.inflation < 4
    first = list(fit.labels).index("diffuse.red")
    assert fit.labels[first:] == (
        *("diffuse.red", "diffuse.green", "diffuse.blue"),
        *("specular", "shininess"),
    )
    return (fit.values[first:] - truth) / truth, fit.errors[first:] / truth


def pulls(folder, *of):
    """(found − true) / error of the same."""
    off, errors = fitted(folder, *of)
    return off / errors


@pytest.mark.extended
def test_errors_contain_those_of_the_lamps(tmp_path):
    off, errors = fitted(tmp_path, 25, 0.003, None, "near")
    assert np.sqrt(np.mean((off / errors) ** 2)) < 1.8
    # How far away all is moves strengths that are over their mean by next to nothing.
    assert (0.0003 < errors[:-1]).all() and (errors[:-1] < 0.005).all()
    assert errors[-1] < 0.01


@pytest.fixture(scope="module")
def over_captures(tmp_path_factory) -> np.ndarray:
    """Pulls of twenty captures."""
    captures = [*SLOW, (0.003, 95, "distant"), (0.003, 95, "near")]
    found = [
        pulls(tmp_path_factory.mktemp("capture"), 40 + seed, *capture)
        for seed, capture in enumerate(captures)
    ]
    return np.array(found)


@pytest.mark.slow
def test_errors_hold_over_captures(over_captures):
    assert np.sqrt(np.mean(over_captures**2)) < 1.3
    # What is said of single channels holds too, not only on average.
    assert (np.sqrt(np.mean(over_captures**2, axis=0)) < 1.6).all()


@pytest.mark.slow
@pytest.mark.xfail(reason="JPEG: see `_Stage._doubts`", strict=True)
def test_errors_are_not_too_large_over_captures(over_captures):
    assert np.sqrt(np.mean(over_captures**2)) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, lamps", [("capture00", "distant"), ("capture01", "near")]
)
def test_captures_rendered_by_another_program(tmp_path, name, lamps):
    """A vase that shades itself, so that some samples are in a shadow."""
    folder = photographs(f"../reference/capture/{name}")
    truth = json.loads((folder / "truth.json").read_text())
    circles = [
        (kind["pixels"]["x"], kind["pixels"]["y"], kind["pixels"]["radius"])
        for kind in truth["spheres"]
    ]
    capture = pf.open_capture(folder)
    found = pf.calibrate(
        capture,
        chrome=circles[:2],
        matte=circles[2],
        fov=14,
        sphere_radius=0.6,
        lamps=lamps,
        names=capture.names,
    )
    pf.save_calibration(tmp_path / "lights.json", found)
    seen = np.load(folder / "normals.npz")
    # The file's camera stands at (0, 0, 20).
    places = seen["positions"] - np.array([0, 0, 20], np.float32)
    there = np.any(seen["normals"] != 0, axis=-1)
    np.savez(tmp_path / "n.npz", normals=seen["normals"], mask=there, positions=places)
    data = open_captured(folder, normals=tmp_path / "n.npz", lights=tmp_path).load()
    # Some blocks of the file, for speed.
    rows, columns = np.mgrid[:720, :960] // 16
    some = (rows % 3 == 0) & (columns % 3 == 0)
    fit = pf.fit(
        data.scenes,
        data.images,
        mask=[mask & some for mask in data.masks],
        film=data.film,
        uncertain=data.uncertain,
        unknowns=("ambient", "diffuse", "specular", "shininess"),
        per_channel=("ambient", "diffuse"),
        loss="tukey",
    )
    unit = np.mean([lamp["intensity"] for lamp in truth["lamps"]])
    material = truth["material"]
    expected = [*(unit * np.array(material["diffuse"])), unit * material["specular"]]
    off = fit.values[-5:] - [*expected, material["shininess"]]
    assert np.sqrt(np.mean((off / fit.errors[-5:]) ** 2)) < 1.5
    assert (fit.errors[-5:-2] < 0.02 * np.array(expected[:3])).all()
