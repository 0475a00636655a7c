"""Cameras from NeRF's `transforms.json`, with extensions of instant-ngp and nerfstudio.

??? cite "Source"
    Mildenhall et al., *NeRF*, ECCV 2020, the synthetic scenes; instant-ngp's
    `colmap2nerf.py`; nerfstudio's documentation, *Data conventions*.
"""

import math
from collections.abc import Mapping
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from phongfit.codes import warn
from phongfit.files.budget import afford
from phongfit.files.colmap import CAMERA
from phongfit.files.images import SUFFIXES, read_head
from phongfit.files.inputs import beside, inside, listed, naming, read_text
from phongfit.files.strict_json import parse_json, shorten, unexpected
from phongfit.geometry.cameras import PinholeCamera
from phongfit.geometry.conventions import camera_pose
from phongfit.geometry.distortion import (
    AbstractDistortion,
    BrownDistortion,
    FisheyeDistortion,
)

MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "OPENCV_FISHEYE")
FEW, MOST = 8, 10_000
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
NUMBERS = (
    *("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h"),
    *DISTORTION,
)
COMMON = {*NUMBERS, "is_fisheye", "camera_model"}
"""Keys given once for all frames or in each frame; `null` is the same as absent."""
OF_FRAME = {*COMMON, "file_path", "transform_matrix"}

Frame = dict[str, Any]


def load_transforms(path: Path) -> dict[str, PinholeCamera]:
    """The camera of every frame, by its `file_path`, in the file's order.

    If the file lacks the size of a frame, it is read from the frame's image. Unused
    keys are named in a warning.

    **Raises:** `ValueError` that names the file and the key.
    """
    text = read_text(path)
    with naming(str(path)):
        top = parse_json(text)
        frames = top.pop("frames", None) if isinstance(top, dict) else None
        if not isinstance(frames, list) or not 0 < len(frames) <= MOST:
            raise ValueError(f"frames: expected at least one and at most {MOST}")
        afford(CAMERA * len(frames), f"{len(frames)} cameras")
        common = {key: value for key, value in top.items() if key in COMMON}
        made: dict[str, PinholeCamera] = {}
        for at, frame in enumerate(frames):
            with naming(f"frames[{at}]"):
                merged = _checked(common, frame)
                name = PureWindowsPath(merged["file_path"]).as_posix()
                if name in made:
                    raise ValueError(f"file_path: {shorten(name)} comes twice")
                made[name] = _camera(path.parent, name, merged)
    keys = [key for key in top if key not in COMMON]
    keys += [key for frame in frames for key in frame if key not in OF_FRAME]
    if unused := list(dict.fromkeys(keys)):
        named = listed([shorten(key) for key in unused], FEW, "more")
        remedy = "Check that none of these changes what a camera sees"
        warn("part-unused", f"{path}: not used: {named}", remedy, stacklevel=3)
    return made


def _checked(common: Frame, frame: Any) -> Frame:
    """A frame with the keys that are common to all, of the right types."""
    if not isinstance(frame, dict):
        raise ValueError(f"expected an object {{…}}, got {shorten(frame)}")
    both = common | frame
    merged = {key: value for key, value in both.items() if value is not None}
    for key in NUMBERS:
        value = merged.get(key, 0)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise unexpected(key, "a number", value)
    if not isinstance(fisheye := merged.get("is_fisheye", False), bool):
        raise unexpected("is_fisheye", "true or false", fisheye)
    name = merged.get("file_path")
    if not isinstance(name, str) or not PureWindowsPath(name).name:
        raise ValueError("file_path: expected a file's name")
    rows = merged.get("transform_matrix")
    matrix = np.array(rows if isinstance(rows, list) else 0, dtype=object)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise unexpected("transform_matrix", "four rows of four numbers", rows)
    return merged


def _camera(folder: Path, name: str, frame: Frame) -> PinholeCamera:
    width, height = _size(folder, name, frame)
    pose = camera_pose(frame["transform_matrix"], "nerf")
    return PinholeCamera(
        width,
        height,
        **_focal(frame, width, height),
        # Measured from the corner of the first pixel, as in COLMAP, their source.
        cx=frame.get("cx"),
        cy=frame.get("cy"),
        distortion=_distortion(frame),
        position=pose.position,
        rotation=pose.rotation,
    )


def _size(folder: Path, name: str, frame: Frame) -> tuple[int, int]:
    if "w" not in frame or "h" not in frame:
        with naming("file_path"):
            return read_head(image_of(folder, name)).size
    for key in ("w", "h"):
        if frame[key] != int(frame[key]) or not 0 < frame[key] < 2**31:
            got = f"{frame[key]:g}"
            raise ValueError(f"{key}: expected a whole number of pixels, got {got}")
    return int(frame["w"]), int(frame["h"])


def image_of(folder: Path, name: str) -> Path:
    """The image file of a frame, in the folder or below it.

    Its name may lack the suffix .png, as in the original NeRF data. If it has folders
    of another machine, the longest end of the name that exists here is used.

    **Raises:** `ValueError` for a file outside the folder.
    """
    known = Path(name).suffix.lower() in SUFFIXES
    name = name if known else f"{name}.png"
    return beside(folder, name) or inside(folder, name)


def _focal(frame: Frame, width: int, height: int) -> Mapping[str, float]:
    found = {}
    for axis, side in (("x", width), ("y", height)):
        if (length := frame.get(f"fl_{axis}")) is None:
            angle = frame.get(f"camera_angle_{axis}")
            if angle is None:
                continue
            if not 0 < angle < math.pi:
                raise ValueError(f"camera_angle_{axis}: expected 0 to π, got {angle:g}")
            length = side / 2 / math.tan(angle / 2)
        found[f"f{axis}"] = length
    if not found:
        raise ValueError("fl_x: expected it or camera_angle_x, got neither")
    one = next(iter(found.values()))
    return {"fx": one, "fy": one} | found


def _distortion(frame: Frame) -> AbstractDistortion | None:
    model = frame.get("camera_model")
    if model is not None and model not in MODELS:
        raise unexpected("camera_model", f"one of {', '.join(MODELS)}", model)
    k1, k2, k3, k4, p1, p2 = (float(frame.get(key, 0)) for key in DISTORTION)
    if frame.get("is_fisheye") or model == "OPENCV_FISHEYE":
        if p1 or p2:
            raise ValueError("p1: expected 0 of a fisheye, which has k1 … k4")
        return FisheyeDistortion(k1, k2, k3, k4)
    if k4:
        raise ValueError(
            "k4: expected 0 unless is_fisheye is true, got an eighth power of the "
            "radius, which is not modelled"
        )
    known = any((k1, k2, k3, p1, p2))
    if known and model in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise ValueError(f"k1: expected no distortion of a {model} camera")
    return BrownDistortion(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2) if known else None
