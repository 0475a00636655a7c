"""Cameras of COLMAP's and NeRF's files that were damaged, and that promise too much."""

import json
import struct
import warnings
from pathlib import Path

import numpy as np

from phongfit.files.cameras import load_cameras
from tests.campaign.cases import Case, Kind, Wrong, blaming, put
from tests.campaign.damage import damaged

CAMERAS = b"""# Camera list
1 OPENCV 8 6 5 5 4 3 -0.1 0.01 0.001 0.002
2 SIMPLE_PINHOLE 8 6 5 4 3
"""
IMAGES = b"""# Image list
1 0.9 0.1 -0.2 0.3 0.1 0.2 4 1 a photograph.jpg
1.5 2.5 -1 3.5 4.5 7
2 1 0 0 0 0 0 4 2 b.jpg

"""
TRANSFORMS = {
    "fl_x": 5.0,
    "k1": -0.1,
    "w": 8,
    "h": 6.0,
    "aabb_scale": 4,
    "frames": [
        {"file_path": "./a.png", "transform_matrix": np.eye(4).tolist()},
        {"file_path": "b.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 6},
    ],
}
POSE = (0.9, 0.1, -0.2, 0.3, 0.1, 0.2, 4.0)
LENS = (5.0, 5.0, 4.0, 3.0, -0.1, 0.01, 0.001, 0.002)
BINARY = {
    "cameras.bin": struct.pack("<QiiQQ8d", 1, 1, 4, 8, 6, *LENS),
    "images.bin": struct.pack("<Qi7di", 1, 1, *POSE, 1)
    + b"a.jpg\0"
    + struct.pack("<Qddq", 1, 1.5, 2.5, -1),
}
TEXT = {"cameras.txt": CAMERAS, "images.txt": IMAGES}
NERF = {"transforms.json": json.dumps(TRANSFORMS).encode()}


def make(random: np.random.Generator, stock: Path) -> Case:
    del stock
    sources = dict([TEXT, BINARY, NERF][int(random.integers(3))])
    hit = str(random.choice(sorted(sources)))
    what, sources[hit] = damaged(random, sources[hit])

    def act(folder: Path) -> None:
        # What is wrong in one file may show in the other, which refers to it.
        with blaming(str(folder)), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cameras = load_cameras(folder)
        for camera in cameras.values():
            numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.position)
            if not all(np.isfinite(number).all() for number in numbers):
                raise Wrong("a camera that is not finite")
            axes = np.asarray(camera.rotation)
            if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-4):
                raise Wrong("a camera that is turned by no rotation")

    return Case(f"{hit}: {what}", put(sources), act)


KIND = Kind(make)
