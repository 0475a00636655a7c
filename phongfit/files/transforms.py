"""Cameras from NeRF's `transforms.json`, with extensions of instant-ngp and nerfstudio.

??? cite "Source"
    Mildenhall et al., *NeRF*, ECCV 2020, the synthetic scenes; instant-ngp's
    `colmap2nerf.py`; nerfstudio's documentation, *Data conventions*.
"""

import math
from collections.abc import Mapping
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from phongfit.codes import warn
from phongfit.files.budget import afford
from phongfit.files.colmap import CAMERA
from phongfit.files.images import SUFFIXES, read_head
from phongfit.files.inputs import beside, inside, listed, naming, read_text
from phongfit.files.records import Many, validated
from phongfit.files.strict_json import parse_json, shorten
from phongfit.geometry.cameras import PinholeCamera
from phongfit.geometry.conventions import camera_pose
from phongfit.geometry.distortion import (
    AbstractDistortion,
    BrownDistortion,
    FisheyeDistortion,
)

MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "OPENCV_FISHEYE")
FEW = 8

Positive = Annotated[float, Field(gt=0)]
Angle = Annotated[float, Field(gt=0, lt=math.pi)]


class _Intrinsics(BaseModel):
    """Camera parameters, given once for all frames or in each frame."""

    model_config = ConfigDict(
        extra="allow", strict=True, frozen=True, allow_inf_nan=False, defer_build=True
    )

    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    fl_x: Positive | None = None
    fl_y: Positive | None = None
    cx: float | None = None
    cy: float | None = None
    w: Positive | None = None
    h: Positive | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    is_fisheye: bool = False
    camera_model: str | None = None


class _Frame(_Intrinsics):
    file_path: Annotated[str, Field(min_length=1, max_length=1000)]
    transform_matrix: Annotated[
        list[Annotated[list[float], Field(max_length=4)]], Field(max_length=4)
    ]


class _Transforms(_Intrinsics):
    frames: Many[_Frame]


def load_transforms(path: Path) -> dict[str, PinholeCamera]:
    """The camera of every frame, by its `file_path`, in the file's order.

    If the file lacks the size of a frame, it is read from the frame's image. Unused
    keys are named in a warning.

    **Raises:** `ValueError` that names the file and the key.
    """
    text = read_text(path)
    with naming(str(path)):
        data = validated(parse_json(text), _Transforms)
        afford(CAMERA * len(data.frames), f"{len(data.frames)} cameras")
        if not data.frames:
            raise ValueError("frames: expected at least one, got none")
        made: dict[str, PinholeCamera] = {}
        common = data.model_dump(exclude_unset=True, exclude={"frames"})
        for at, frame in enumerate(data.frames):
            with naming(f"frames[{at}]"):
                name = PureWindowsPath(frame.file_path).as_posix()
                if name in made:
                    raise ValueError(f"file_path: {shorten(name)} comes twice")
                own = frame.model_dump(exclude_unset=True)
                merged = _Frame.model_validate(common | own)
                made[name] = _camera(path.parent, name, merged)
    unused = [*(data.model_extra or {})]
    unused += [key for frame in data.frames for key in frame.model_extra or {}]
    if unused:
        _warn(path, list(dict.fromkeys(unused)))
    return made


def _warn(path: Path, unused: list[str]) -> None:
    named = listed([shorten(key) for key in unused], FEW, "more")
    remedy = "Check that none of these changes what a camera sees"
    warn("part-unused", f"{path}: not used: {named}", remedy, stacklevel=4)


def _camera(folder: Path, name: str, frame: _Frame) -> PinholeCamera:
    width, height = _size(folder, name, frame)
    pose = camera_pose(_matrix(frame), "nerf")
    return PinholeCamera(
        width,
        height,
        **_focal(frame, width, height),
        # Measured from the corner of the first pixel, as in COLMAP, their source.
        cx=frame.cx,
        cy=frame.cy,
        distortion=_distortion(frame),
        position=pose.position,
        rotation=pose.rotation,
    )


def _matrix(frame: _Frame) -> list[list[float]]:
    rows = frame.transform_matrix
    if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
        raise ValueError(
            f"transform_matrix: expected four rows of four numbers, got {shorten(rows)}"
        )
    return rows


def _size(folder: Path, name: str, frame: _Frame) -> tuple[int, int]:
    if frame.w is None or frame.h is None:
        with naming("file_path"):
            return read_head(image_of(folder, name)).size
    for key, value in (("w", frame.w), ("h", frame.h)):
        if not value.is_integer() or value > 2**31:
            raise ValueError(f"{key}: expected a whole number of pixels, got {value:g}")
    return int(frame.w), int(frame.h)


def image_of(folder: Path, name: str) -> Path:
    """The image file of a frame, in the folder or below it.

    Its name may lack the suffix .png, as in the original NeRF data. If it has folders
    of another machine, the longest end of the name that exists here is used.

    **Raises:** `ValueError` for a file outside the folder.
    """
    known = Path(name).suffix.lower() in SUFFIXES
    name = name if known else f"{name}.png"
    return beside(folder, name) or inside(folder, name)


def _focal(frame: _Frame, width: int, height: int) -> Mapping[str, float]:
    x, y = frame.fl_x, frame.fl_y
    if x is None and frame.camera_angle_x is not None:
        x = width / 2 / math.tan(frame.camera_angle_x / 2)
    if y is None and frame.camera_angle_y is not None:
        y = height / 2 / math.tan(frame.camera_angle_y / 2)
    if x is None and y is None:
        raise ValueError("fl_x: expected it or camera_angle_x, got neither")
    fx, fy = (x if x is not None else y), (y if y is not None else x)
    assert fx is not None and fy is not None
    return {"fx": fx, "fy": fy}


def _distortion(frame: _Frame) -> AbstractDistortion | None:
    model = frame.camera_model
    if model is not None and model not in MODELS:
        wanted = ", ".join(MODELS)
        raise ValueError(
            f"camera_model: expected one of {wanted}, got {shorten(model)}"
        )
    radial: dict[str, Any] = {key: getattr(frame, key) for key in ("k1", "k2", "k3")}
    tangential = {"p1": frame.p1, "p2": frame.p2}
    if frame.is_fisheye or model == "OPENCV_FISHEYE":
        if any(tangential.values()):
            raise ValueError("p1: expected 0 of a fisheye, which has k1 … k4")
        return FisheyeDistortion(**radial, k4=frame.k4)
    if frame.k4:
        raise ValueError(
            "k4: expected 0 unless is_fisheye is true, got an eighth power of the "
            "radius, which is not modelled"
        )
    known = any((*radial.values(), *tangential.values()))
    if known and model in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise ValueError(f"k1: expected no distortion of a {model} camera")
    return BrownDistortion(**radial, **tangential) if known else None
