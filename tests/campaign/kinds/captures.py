"""Photographs with what is known of their lamps and their camera, damaged."""

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import phongfit as pf
from phongfit.calibration.outlines import View
from phongfit.calibration.result import CalibratedSphere, Calibration, Lamp
from phongfit.files.calibrations import LIGHTS_FILE, load_calibration, save_calibration
from phongfit.files.capture_data import open_captured
from phongfit.files.captures import open_capture
from phongfit.files.encodings import read_response
from phongfit.files.images import to_levels
from phongfit.files.lp import read_lp
from phongfit.files.materials import read_material
from tests.campaign.cases import Case, Kind, Wrong, blaming, command, files
from tests.campaign.damage import damaged
from tests.campaign.kinds.records import RESPONSE, changed

STOCK = "captures"
LIST_FILE = "lights.lp"
NEAR_FILE = "near.json"
SIZE = (24, 32)
BALL = (16.0, 12.0, 10.0)
NAMES = ("001.jpg", "002.jpg", "003.jpg")
LIST = b"3\n001.jpg 0.1 0.2 1\nphotos/002.jpg -1 0.5 2\nC:\\x\\003.jpg 0,5 0,5 1\n"
WORDS = [
    b"nan", b"inf", b"1e999", b"-1e308", b"1e-320", b"0", b"", b"x", b"0,1", b"1,000.5",
    b"\xd9\xa3", b"\xff", b"\0", b"1_0", b"0x1", b"99999999999999999999", b"-1", b"2",
    b"a b c", b"\x1b[31m", b"x" * 3000, b"../../1.jpg", b"001.jpg", b"\r", b"\n", b"\t",
]  # fmt: skip


def _calibration(near: bool) -> Calibration:
    """What might have been found, of near lamps or of distant ones."""
    lamps = []
    for number, name in enumerate(NAMES):
        direction = np.array([0.6, 0.0, 0.8]) if number else np.array([0.0, 0, 1])
        position = 5 * direction - [0, 0, 5] if near else None
        known = np.array([1.1, 1.0, 0.9])
        spot = np.array([[3.5, 4.5]])
        covariance = 1e-4 * np.eye(3)
        lamps.append(
            Lamp(name, direction, position, covariance, 0.2, known, known / 99, spot)
        )
    ball = CalibratedSphere("chrome", np.array(BALL), np.eye(3))
    view, zeros = View(SIZE[1], SIZE[0], 20.0), np.zeros(3)
    place, left_out = np.array([0, 0, -5.0]), {"4.jpg": "no highlight"}
    own = 0.5, place, float(near), zeros, left_out, ("look",)
    return Calibration(view, tuple(lamps), (ball,), *own, None, 1e-4 * np.eye(9), 0.1)


@functools.cache
def _lights(stock: Path, name: str) -> dict:
    return json.loads((stock / STOCK / name).read_text())


def _of_lights(random: np.random.Generator, stock: Path) -> Case:
    """A calibration: refused, or lamps of which all is finite."""
    record = _lights(stock, str(random.choice([LIGHTS_FILE, NEAR_FILE])))
    if random.random() < 0.2:
        what, data = damaged(random, json.dumps(record).encode())
    else:
        what, data = changed(random, record)

    def act(folder: Path) -> None:
        with blaming(LIGHTS_FILE):
            found = load_calibration(folder)
            camera, lights = found.camera, found.lights
        _ = camera.width, str(found), found.to_dict()
        for light, lamp in zip(lights, found.lamps, strict=True):
            _check_light(light)
            _check_covariance(lamp.covariance)
        for sphere in found.spheres:
            _check_covariance(sphere.covariance)
        if found.covariance is not None:
            _check_covariance(found.covariance)

    return Case(f"{LIGHTS_FILE}: {what}", files(lights__json=data), act)


def _check_light(light: pf.AbstractLight) -> None:
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(light)):
        raise Wrong("a light that is not finite")


def _check_covariance(matrix: np.ndarray) -> None:
    with np.errstate(all="ignore"):
        least = np.linalg.eigvalsh(matrix).min()
        if (
            not np.allclose(matrix, matrix.T)
            or not least >= -1e-6 * np.abs(matrix).max()
        ):
            raise Wrong(f"a covariance that is none: {matrix.tolist()}")


def _of_list(random: np.random.Generator, stock: Path) -> Case:
    """A list of lights with another word in it, or damaged."""
    del stock
    if random.random() < 0.5:
        what, data = damaged(random, LIST)
    else:
        words = LIST.replace(b"\n", b" \n ").split(b" ")
        at, by = int(random.integers(len(words))), int(random.integers(len(WORDS)))
        what = f"{WORDS[by][:20]!r} for {words[at]!r}"
        words[at] = WORDS[by]
        data = b" ".join(words)

    def act(folder: Path) -> None:
        with blaming(LIST_FILE):
            found = read_lp(folder / LIST_FILE)
        if not np.isfinite(found.vectors).all() or not found.vectors.any(axis=1).all():
            raise Wrong("a vector to nowhere")
        if len(set(found.base_names)) != len(found.vectors):
            raise Wrong("names that are no names of lights")

    return Case(f"{LIST_FILE}: {what}", files(lights__lp=data), act)


def _of_response(random: np.random.Generator, stock: Path) -> Case:
    """A response curve, and light as it decodes it."""
    del stock
    what, data = changed(random, RESPONSE)
    if random.random() < 0.3:
        what, data = damaged(random, json.dumps(RESPONSE).encode())

    def act(folder: Path) -> None:
        with blaming("response.json"):
            curve = read_response(folder / "response.json")
        numbers = np.linspace(0, 1, 33)
        back = curve.encode(curve.decode(numbers))
        if not np.abs(back - numbers).max() < 1e-6:
            raise Wrong("a curve that has no inverse")

    return Case(f"response.json: {what}", files(response__json=data), act)


def _of_folder(random: np.random.Generator, stock: Path) -> Case:
    """A folder of photographs, one file of which was damaged."""
    whole = stock / STOCK
    name = str(random.choice([*NAMES, LIST_FILE, LIGHTS_FILE, "mask.png"]))
    what, data = damaged(random, (whole / name).read_bytes())
    # With the one or the other list of lights, or none.
    gone = {LIST_FILE: LIGHTS_FILE, LIGHTS_FILE: LIST_FILE}.get(name)
    gone = gone or str(random.choice([LIST_FILE, LIGHTS_FILE]))
    readers: list[Callable[[Path], object]] = [_captured, _sphere, _calibrated, _fitted]
    reader = readers[int(random.choice(4, p=[0.3, 0.45, 0.23, 0.02]))]

    def arrange(folder: Path) -> None:
        shutil.copytree(whole, folder / "photos")
        (folder / "photos" / gone).unlink()
        (folder / "photos" / name).write_bytes(data)

    def act(folder: Path) -> None:
        reader(folder)

    return Case(f"{reader.__name__}, {name}: {what}", arrange, act, ("out",))


def _captured(folder: Path) -> None:
    with blaming("photos"):
        for image in open_capture(folder / "photos"):
            _check_image(image)


def _sphere(folder: Path) -> None:
    with blaming("photos"):
        photos = folder / "photos"
        found = open_captured(photos, sphere=BALL, mask=photos / "mask.png")
        for number in range(len(found.scenes)):
            photograph = found.read(number)
            _check_image(photograph.image)
            mask = photograph.mask
            if mask.shape[:2] != photograph.image.shape[:2]:
                raise Wrong(f"a mask of shape {mask.shape}")


def _check_image(image: np.ndarray) -> None:
    if image.shape != (*SIZE, 3) or not np.isfinite(image).all() or (image < 0).any():
        raise Wrong(f"an image of shape {image.shape}, or not finite")


def _calibrated(folder: Path) -> None:
    ball = ["--sphere", *BALL, "--orthographic"]
    command("calibrate", folder / "photos", *ball, "-o", folder / "out")
    for light in load_calibration(folder / "out").lights:
        _check_light(light)


def _fitted(folder: Path) -> None:
    own = ["--sphere", *BALL, "--report", "none", "--mask", folder / "photos/mask.png"]
    command("fit", folder / "photos", *own, "-o", folder / "out")
    material = read_material(f"{folder}/out/fit.json").material
    if not np.isfinite(material.diffuse).all():
        raise Wrong("a material that is not finite")


def make(random: np.random.Generator, stock: Path) -> Case:
    makers = [_of_lights, _of_list, _of_response, _of_folder]
    return makers[int(random.choice(4, p=[0.35, 0.25, 0.1, 0.3]))](random, stock)


def prepare(stock: Path) -> None:
    """Three photographs of a mirroring ball with EXIF, and both lists of lamps."""
    folder = stock / STOCK
    folder.mkdir()
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] + 0.5
    away = np.hypot(x - BALL[0], y - BALL[1])
    shade = 0.3 * np.sqrt(np.clip(1 - (away / BALL[2]) ** 2, 0, 1))
    for number, name in enumerate(NAMES):
        spot = np.exp(-(np.hypot(x - 14 - 2 * number, y - 10) ** 2) / 2)
        light = np.clip(shade + 0.8 * spot, 0, 1)[..., None] * [1, 0.9, 0.8]
        levels = to_levels(light.astype(np.float32), "srgb", 8)
        tags = Image.Exif()
        tags[0x0112], tags[0x829A], tags[0x829D], tags[0x8827] = 1, 0.01, 8.0, 100
        Image.fromarray(levels).save(folder / name, quality=95, exif=tags)
    white = np.full(SIZE, 255, np.uint8)
    Image.fromarray(white).save(folder / "mask.png")
    (folder / LIST_FILE).write_bytes(LIST)
    save_calibration(folder / LIGHTS_FILE, _calibration(near=False))
    save_calibration(folder / NEAR_FILE, _calibration(near=True))


KIND = Kind(make, prepare, seconds=180.0, megabytes=2500.0, share=0.5)
