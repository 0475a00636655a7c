"""Cameras as COLMAP, instant-ngp and nerfstudio write them, and as they come broken."""

import json
import math
import struct
import warnings

import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.colmap import MODELS
from tests.geometry.test_conventions import HEIGHT, OTHERS, VIEWS, WIDTH
from tests.helpers import close, floats, near, random_rotation

POINTS = np.array(OTHERS["opencv"]["points"])
PIXELS = 1e-3
"""What single precision leaves of a place in the image."""
# One with each of COLMAP's models that OpenCV knows.
SAME = {
    "none": "PINHOLE",
    "barrel": "OPENCV",
    "rational": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE",
}
THREE = [view for view in VIEWS if view["lens"] == "barrel"]


def quaternion(rotation):
    """w, x, y, z: the eigenvector of Bar-Itzhack's matrix."""
    r = np.array(rotation)
    k = np.zeros((4, 4))
    k[0, 0] = np.trace(r)
    k[0, 1:] = k[1:, 0] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    k[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    return np.linalg.eigh(k)[1][:, -1]


def parameters(view):
    """As COLMAP counts pixels: from the corner of the first one."""
    k = np.array(view["matrix"])
    return [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *view["distortion"]]


def write_text(folder, views, names, model=None):
    cameras, images = ["# Camera list", "#   CAMERA_ID, MODEL, …"], ["# Image list"]
    for at, (view, name) in enumerate(zip(views, names, strict=True), 1):
        kind = model or SAME[view["lens"]]
        numbers = " ".join(map(repr, map(float, parameters(view))))
        cameras.append(f"{at} {kind} {WIDTH} {HEIGHT} {numbers}")
        pose = [*map(float, quaternion(view["R"])), *view["translation"]]
        images.append(f"{at} {' '.join(map(repr, pose))} {at} {name}")
        images.append("1.5 2.5 -1 3.5 4.5 7" if at % 2 else "")
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")


def write_binary(folder, views, names):
    cameras = images = struct.pack("<Q", len(views))
    for at, (view, name) in enumerate(zip(views, names, strict=True), 1):
        numbers = parameters(view)
        model = MODELS[SAME[view["lens"]]].number
        cameras += struct.pack("<iiQQ", at, model, WIDTH, HEIGHT)
        cameras += struct.pack(f"<{len(numbers)}d", *numbers)
        pose = [*quaternion(view["R"]), *view["translation"]]
        images += struct.pack("<i7di", at, *pose, at) + name.encode() + b"\0"
        images += struct.pack("<Q", 1) + struct.pack("<ddq", 1.5, 2.5, -1)
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(images)


@eqx.filter_jit
def projected(camera):
    return jax.vmap(camera.project)(floats(POINTS))


@pytest.mark.parametrize("write", [write_text, write_binary])
@pytest.mark.parametrize("place", [".", "sparse/0"])
def test_a_model_projects_as_opencv_does(write, place, tmp_path):
    """Three cameras with OpenCV's distortion, to OpenCV's own answer."""
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    names = ["b.jpg", "a photograph.jpg", "left/c.jpg"]
    write(tmp_path / place, THREE, names)
    cameras = pf.load_cameras(tmp_path)
    assert list(cameras) == sorted(names)
    for view, name in zip(THREE, names, strict=True):
        near(projected(cameras[name]), np.array(view["pixels"]) + 0.5, PIXELS)


@pytest.mark.parametrize("lens", SAME)
@pytest.mark.parametrize("write", [write_text, write_binary])
def test_models_that_opencv_knows(lens, write, tmp_path):
    views = [view for view in VIEWS if view["lens"] == lens]
    write(tmp_path, views, "abc")
    for view, camera in zip(views, pf.load_cameras(tmp_path).values(), strict=True):
        near(projected(camera), np.array(view["pixels"]) + 0.5, PIXELS)


@pytest.mark.parametrize(
    "line, camera",
    [
        ("SIMPLE_PINHOLE 8 6 5 4 3", pf.PinholeCamera(8, 6, fx=5)),
        ("SIMPLE_RADIAL 8 6 5 4 2 0", pf.PinholeCamera(8, 6, fx=5, cy=2)),
        (
            "SIMPLE_RADIAL 8 6 5 4 3 0.1",
            pf.PinholeCamera(8, 6, fx=5, distortion=pf.geometry.BrownDistortion(0.1)),
        ),
        (
            "RADIAL 8 6 5 4 3 0.1 0.2",
            pf.PinholeCamera(
                8, 6, fx=5, distortion=pf.geometry.BrownDistortion(0.1, 0.2)
            ),
        ),
        (
            "SIMPLE_RADIAL_FISHEYE 8 6 5 4 3 0",
            pf.PinholeCamera(8, 6, fx=5, distortion=pf.geometry.FisheyeDistortion()),
        ),
        (
            "RADIAL_FISHEYE 8 6 5 4 3 0.1 0.2",
            pf.PinholeCamera(
                8, 6, fx=5, distortion=pf.geometry.FisheyeDistortion(0.1, 0.2)
            ),
        ),
    ],
)
def test_simpler_models(line, camera, tmp_path):
    (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
    (tmp_path / "images.txt").write_text("7 1 0 0 0 0 0 0 1 a.jpg\n\n")
    found = pf.load_cameras(tmp_path)["a.jpg"]
    axes = np.diag([1, -1, -1])
    near(found.rotation, axes)
    there = pf.PinholeCamera(8, 6, fx=5, rotation=axes)
    same = {"position": there.position, "rotation": there.rotation}
    for name, value in vars(camera).items():
        expected = same.get(name, value)
        if isinstance(value, pf.geometry.AbstractDistortion):
            expected = jax.tree.leaves(value)
            assert type(found.distortion) is type(value)
            near(jax.tree.leaves(found.distortion), expected)
        elif value is not None:
            near(getattr(found, name), expected)
    assert (found.distortion is None) == (camera.distortion is None)


MATRIX = np.eye(4)
MATRIX[:3, :3], MATRIX[:3, 3] = random_rotation(9), (1, 2, 3)
FRAME = {"file_path": "./images/a.png", "transform_matrix": MATRIX.tolist()}


def write_transforms(folder, *frames, **common):
    content = common | {"frames": list(frames or (FRAME,))}
    text = json.dumps(content).replace("Infinity", "1e999")
    (folder / "transforms.json").write_text(text)
    return folder / "transforms.json"


def test_transforms(tmp_path):
    """As instant-ngp writes them, with numbers of one frame for itself."""
    second = FRAME | {"file_path": "images/b.png", "fl_x": 12.0, "fl_y": 13, "k1": 0}
    path = write_transforms(
        tmp_path, FRAME, second, fl_x=10.0, fl_y=11, cx=4.5, cy=2.5, w=8.0, h=6, k1=0.1
    )
    found = pf.load_cameras(path)
    assert list(found) == ["images/a.png", "images/b.png"]
    one, other = found.values()
    assert (one.width, one.height) == (8, 6)
    near([one.fx, one.fy, one.cx, one.cy], [10, 11, 4.5, 2.5])
    near(one.rotation, MATRIX[:3, :3])
    near(one.position, (1, 2, 3))
    assert (
        isinstance(one.distortion, pf.geometry.BrownDistortion)
        and other.distortion is None
    )
    near([other.fx, other.fy], [12, 13])
    near(list(pf.load_cameras(tmp_path).values())[0].fx, 10)


def test_the_first_nerfs(tmp_path):
    """One angle for all, names without a suffix, and the size that of the images."""
    (tmp_path / "train").mkdir()
    pf.write_image(tmp_path / "train" / "r_0.png", np.zeros((6, 8, 3)), "srgb")
    frame = FRAME | {"file_path": "./train/r_0", "rotation": 0.1}
    write_transforms(tmp_path, frame, camera_angle_x=math.pi / 2, aabb_scale=4)
    with pytest.warns(
        UserWarning, match="not used: .*aabb_scale.*, .*rotation"
    ) as said:
        (found,) = pf.load_cameras(tmp_path).values()
    assert len(said) == 1
    assert (found.width, found.height) == (8, 6)
    near([found.fx, found.fy, found.cx, found.cy], [4, 4, 4, 3], 1e-6)


def test_a_fisheye_of_transforms(tmp_path):
    numbers = dict(fl_x=10, w=8, h=6, k1=0.1, k4=0.2)
    for words in ({"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}):
        write_transforms(tmp_path, **numbers, **words)
        (found,) = pf.load_cameras(tmp_path).values()
        assert isinstance(found.distortion, pf.geometry.FisheyeDistortion)
        near([found.distortion.k1, found.distortion.k4], [0.1, 0.2])


SIZED = dict(fl_x=10, w=8, h=6)


@pytest.mark.parametrize(
    "frame, common, words",
    [
        ({}, dict(w=8, h=6), "fl_x: expected it or camera_angle_x"),
        ({}, dict(fl_x=10), "there is no|cannot be read"),
        ({"file_path": "../a.png"}, dict(fl_x=10), "file in this folder"),
        ({}, SIZED | {"camera_model": "FOV"}, "camera_model: expected one of"),
        ({}, SIZED | {"k4": 0.1}, "k4: expected 0 unless"),
        ({}, SIZED | {"camera_model": "PINHOLE", "k1": 0.1}, "k1: expected no"),
        ({}, SIZED | {"is_fisheye": True, "p1": 0.1}, "p1: expected 0"),
        ({}, SIZED | {"w": 8.5}, "w: expected a whole number"),
        ({}, SIZED | {"fl_x": -1}, "fx: expected"),
        ({}, SIZED | {"fl_x": True}, "fl_x: expected a number, got true"),
        ({"transform_matrix": [[1, 2]]}, SIZED, "transform_matrix: expected four rows"),
        ({"transform_matrix": np.ones((4, 4)).tolist()}, SIZED, "to_world: expected"),
        ({"transform_matrix": 7}, SIZED, "transform_matrix"),
        ({}, SIZED | {"w": math.inf}, "w: expected a number"),
        ({}, SIZED | {"is_fisheye": "false"}, "is_fisheye: expected true or false"),
        ({"file_path": ""}, SIZED, "file_path: expected a file's name"),
    ],
)
def test_broken_transforms(frame, common, words, tmp_path):
    path = write_transforms(tmp_path, FRAME | frame, **common)
    with pytest.raises(ValueError, match=words) as raised:
        pf.load_cameras(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


def test_null_is_as_if_absent(tmp_path):
    absent = dict.fromkeys(("fl_y", "cx", "cy", "camera_angle_x", "camera_model"))
    path = write_transforms(tmp_path, FRAME | absent, **SIZED)
    (found,) = pf.load_cameras(path).values()
    near([found.fx, found.fy, found.cx, found.cy], [10, 10, 4, 3])


@pytest.mark.parametrize("key", ["transform_matrix", "file_path"])
def test_a_key_of_frames_at_the_top_is_not_used(key, tmp_path):
    top = SIZED | {key: FRAME[key]}
    path = write_transforms(tmp_path, **top)
    with pytest.warns(UserWarning, match=f"not used: .*{key}"):
        pf.load_cameras(path)
    path = write_transforms(tmp_path, FRAME | {key: None}, **top)
    with pytest.raises(ValueError, match=f"{key}: expected"):
        pf.load_cameras(path)


def test_a_frame_that_comes_twice(tmp_path):
    path = write_transforms(tmp_path, FRAME, FRAME, **SIZED)
    with pytest.raises(ValueError, match="file_path: .* comes twice"):
        pf.load_cameras(path)
    path.write_text('{"frames": []}')
    with pytest.raises(ValueError, match="frames: expected at least one"):
        pf.load_cameras(path)


CAMERA, IMAGE = "1 PINHOLE 8 6 5 5 4 3", "1 1 0 0 0 0 0 0 1 a.jpg"


@pytest.mark.parametrize(
    "camera, images, words",
    [
        (
            "1 FOV 8 6 5 5 4 3 0.1",
            IMAGE,
            "cameras.txt: line 1: expected a camera model",
        ),
        ("1 PINHOLE 8 6 5 5 4", IMAGE, "PINHOLE: expected fx, fy, cx, cy, got 3"),
        ("1 PINHOLE 8 0 5 5 4 3", IMAGE, "line 1: height: expected a whole number"),
        ("1 PINHOLE 8 6 -5 5 4 3", IMAGE, "line 1: fx: expected a number > 0"),
        ("1 PINHOLE 8 6 nan 5 4 3", IMAGE, "line 1: fx: expected"),
        ("1 PINHOLE", IMAGE, "line 1: expected a camera"),
        (CAMERA + "\n" + CAMERA, IMAGE, "line 2: camera 1 comes twice"),
        (CAMERA, "1 1 0 0 0 0 0 0 2 a.jpg", "expected one of the model's cameras"),
        (CAMERA, "1 0 0 0 0 0 0 0 1 a.jpg", "expected a quaternion"),
        (CAMERA, "1 1 0 0 0 0 0 0 1", "images.txt: line 1: expected an image"),
        (CAMERA, f"{IMAGE}\n\n{IMAGE}", "'a.jpg': comes twice"),
        (CAMERA, f"{IMAGE}\n{IMAGE}", "'a.jpg': comes twice"),
        (CAMERA, f"{IMAGE}\n1.5 2.5 -1 3", "line 2: expected an image"),
        (CAMERA, "", "expected at least one image"),
    ],
)
def test_broken_texts(camera, images, words, tmp_path):
    (tmp_path / "cameras.txt").write_text(camera + "\n")
    (tmp_path / "images.txt").write_text(images + "\n")
    with pytest.raises(ValueError, match=words):
        pf.load_cameras(tmp_path)


@pytest.mark.parametrize("name", ["{}.jpg", "IMG {} copy.jpg", "a {} b c d.jpg", "{}"])
@pytest.mark.parametrize("points", ["", "\n", "\n1.5 2.5 -1 3.5e+1 4.5 7", "one blank"])
def test_images_of_one_line_each(name, points, tmp_path):
    """As people write poses by hand: without the lines that have COLMAP's points."""
    names = [name.format(k) for k in range(4)]
    lines = [f"{k} 1 0 0 0 0 0 4 1 {word}" for k, word in enumerate(names)]
    after = ["\n", "", "", ""] if points == "one blank" else [points] * 4
    text = "\n".join(map(str.__add__, lines, after))
    (tmp_path / "cameras.txt").write_text(CAMERA + "\n")
    (tmp_path / "images.txt").write_text(text)
    assert list(pf.load_cameras(tmp_path)) == names


@pytest.mark.parametrize("name", [
    "/home/me/project/images/a.png", r"C:\project\images\a.png", r"images\a.png",
    r".\images\a.png", "../../project/images/a", "file/a.png", r"\\server\all\images\a",
])  # fmt: skip
def test_names_of_another_machine(name, tmp_path):
    """The longest end of a name that is here: of two, the one in its folder."""
    (tmp_path / "images").mkdir()
    inner, outer = tmp_path / "images" / "a.png", tmp_path / "a.png"
    pf.write_image(inner, np.zeros((6, 8, 3)), "srgb")
    pf.write_image(outer, np.zeros((3, 4, 3)), "srgb")
    write_transforms(tmp_path, FRAME | {"file_path": name}, fl_x=10)
    (found,) = pf.load_cameras(tmp_path).values()
    assert (found.width, found.height) == ((8, 6) if "images" in name else (4, 3))
    inner.unlink()
    outer.unlink()
    with pytest.raises(ValueError, match="file_path: "):
        pf.load_cameras(tmp_path)


def test_broken_binaries(tmp_path, monkeypatch):
    write_binary(tmp_path, THREE, "abc")
    cameras, images = tmp_path / "cameras.bin", tmp_path / "images.bin"
    for path in (cameras, images):
        whole = path.read_bytes()
        for data, words in (
            (whole[:-9], "is truncated"),
            (whole + b"!", "expected nothing after"),
            (struct.pack("<Q", 2**60) + whole[8:], "is truncated"),
        ):
            path.write_bytes(data)
            with pytest.raises(ValueError, match=f"{path.name}: .*{words}"):
                pf.load_cameras(tmp_path)
        path.write_bytes(whole)
    whole = cameras.read_bytes()
    cameras.write_bytes(whole[:12] + struct.pack("<i", 99) + whole[16:])
    with pytest.raises(ValueError, match="camera 1: expected a camera model .*got 99"):
        pf.load_cameras(tmp_path)
    cameras.write_bytes(whole)
    monkeypatch.setenv("PHONGFIT_MAX_MEMORY", "50K")
    with pytest.raises(ValueError, match="images.bin: .*3 cameras"):
        pf.load_cameras(tmp_path)


def test_what_is_no_file_of_cameras(tmp_path):
    for path, words in (
        (tmp_path / "none", "there is no such file or folder"),
        (tmp_path, "expected the folder of a COLMAP model"),
        (tmp_path / "a.txt", "expected a transforms.json"),
    ):
        if path.suffix:
            path.write_text("")
        with pytest.raises(ValueError, match=words):
            pf.load_cameras(path)


def test_a_scene_file_keeps_a_camera_with_its_lens(tmp_path):
    write_text(tmp_path, THREE, "abc")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera = pf.load_cameras(tmp_path)["b"]
    pf.save_scene(tmp_path / "s.json", pf.Scene(pf.Sphere(), camera))
    again = pf.load_scene(tmp_path / "s.json").camera
    assert type(again) is type(camera)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(camera), strict=True):
        near(one, other, close())
