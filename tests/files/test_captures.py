"""A folder of photographs, as it comes out of a camera or a dome."""

import numpy as np
import pytest
from PIL import Image

import phongfit as pf
from tests.files.test_photographs import exif


def photograph(path, value=0.5, size=(4, 6)):
    pf.write_image(path, np.full((*size, 3), value), "srgb")


@pytest.fixture
def folder(tmp_path):
    for number in (1, 2, 10):
        photograph(tmp_path / f"img{number}.jpg", number / 20)
    photograph(tmp_path / "object.mask.png", 1)
    (tmp_path / "notes.txt").write_text("lamps: three")
    return tmp_path


def test_photographs_in_the_order_of_their_numbers(folder):
    capture = pf.open_capture(folder)
    assert capture.names == ("img1.jpg", "img2.jpg", "img10.jpg")
    assert capture.others == ("object.mask.png",)
    assert capture.encoding == "srgb"
    means = [float(image.mean()) for image in capture]
    assert means == pytest.approx([0.05, 0.1, 0.5], rel=0.05)
    assert float(capture[-1].mean()) == means[2]
    assert len(capture[:2]) == 2


def test_a_list_of_lights_says_which_and_in_what_order(folder):
    pf.write_lp(folder / "a.lp", ["x/IMG10.JPG", "img1.jpg"], np.eye(3)[:2] + 1)
    capture = pf.open_capture(folder)
    assert capture.names == ("img10.jpg", "img1.jpg")
    assert capture.others == ("img2.jpg", "object.mask.png")


def test_room_light_is_taken_away_and_a_flat_divided_out(folder):
    photograph(folder / "ambient.jpg", 0.05)
    ramp = np.linspace(0.4, 0.8, 6)[None, :, None] * np.ones((4, 1, 3))
    pf.write_image(folder / "flat.png", ramp, "srgb")
    plain = pf.open_capture(folder)
    assert plain.names == ("img1.jpg", "img2.jpg", "img10.jpg")
    capture = pf.open_capture(
        folder, ambient=folder / "ambient.jpg", flat=folder / "flat.png"
    )
    expected = 0.45 / (ramp / np.median(ramp))
    assert capture[2] == pytest.approx(expected, rel=0.05)


def exposed(path, light, time):
    """A photograph of so much light, in linear numbers, that states its time."""
    levels = np.round(255 * np.clip(time * np.asarray(light), 0, 1)).astype(np.uint8)
    Image.fromarray(levels).save(path, exif=exif(time=time))


def test_photographs_of_different_exposure_come_to_common_light(tmp_path):
    light = np.full((4, 6, 3), 0.6)
    light[0, 0] = 2.0
    for name, time in (("1.png", 1.0), ("2.png", 0.5), ("3.png", 0.25)):
        exposed(tmp_path / name, light, time)
    exposed(tmp_path / "ambient.png", np.full((4, 6, 3), 0.2), 2.0)
    flat = np.ones((4, 6, 3)) * np.array([[[1.0]], [[1.0]], [[1.0]], [[0.5]]])
    exposed(tmp_path / "flat.png", flat, 0.8)
    capture = pf.open_capture(tmp_path, "linear")
    assert capture.names == ("1.png", "2.png", "3.png")
    # What was cut off at white is 1, in whatever light; the rest is that of 1/4 s.
    assert [image[0, 0, 0] for image in capture] == pytest.approx([1, 1, 0.5], abs=3e-3)
    for image in capture:
        assert image[1:] == pytest.approx(0.15, abs=0.003)
    assert not capture.read(0).mask[0, 0].any() and capture.read(0).mask[1:].all()
    assert capture.notes == (
        "1.png 1 s, 2.png 0.5 s, 3.png 1/4 s: brought to common light, to some 5 %, as "
        "cameras state rounded numbers",
    )
    beyond = {"ambient": tmp_path / "ambient.png", "flat": tmp_path / "flat.png"}
    capture = pf.open_capture(tmp_path, "linear", **beyond)
    for image in capture:
        assert image[1:3] == pytest.approx(0.1, abs=0.003)
        assert image[3] == pytest.approx(0.2, abs=0.006)
    assert "ambient.png 2 s: brought to common light" in capture.notes[0]


def test_what_is_saturated_beside_the_photographs(tmp_path):
    light = np.full((4, 6, 3), 0.5)
    for name in ("1.png", "2.png"):
        exposed(tmp_path / name, light, 1.0)
    spot = np.full((4, 6, 3), 0.1)
    spot[2, 3] = 3.0
    exposed(tmp_path / "ambient.png", spot, 1.0)
    exposed(tmp_path / "flat.png", 3 * light, 1.0)
    capture = pf.open_capture(tmp_path, "linear", ambient=tmp_path / "ambient.png")
    assert capture[0][2, 3].tolist() == [1, 1, 1]
    assert np.delete(capture[0].reshape(-1, 3), 2 * 6 + 3, 0) == pytest.approx(
        0.4, abs=0.005
    )
    with pytest.raises(ValueError, match="flat.png: expected a flat below white"):
        pf.open_capture(tmp_path, "linear", flat=tmp_path / "flat.png")


def test_an_exposure_that_one_photograph_does_not_state(tmp_path):
    light = np.full((4, 6, 3), 0.5)
    exposed(tmp_path / "1.png", light, 1.0)
    exposed(tmp_path / "2.png", light, 0.5)
    pf.write_image(tmp_path / "3.png", light, "linear")
    with pytest.raises(ValueError, match="3.png: expected an exposure time"):
        pf.open_capture(tmp_path, "linear")


def test_bad_folders(folder, tmp_path):
    with pytest.raises(ValueError, match="there is no such file or folder"):
        pf.open_capture(tmp_path / "nowhere.jpg")
    photo = folder / "img2.jpg"
    with pytest.raises(ValueError, match="ambient and flat: expected other files"):
        pf.open_capture(photo, "linear", ambient=photo)
    missing = tmp_path / "no.lp"
    with pytest.raises(ValueError, match=rf"^{missing}: cannot be read"):
        pf.open_capture(folder / "img1.jpg", lights=missing)
    pf.write_lp(folder / "a.lp", ["other.jpg", "img1.jpg"], np.eye(3)[:2] + 1)
    with pytest.raises(ValueError, match="1 of the 2 photographs .* other.jpg first"):
        pf.open_capture(folder)
    pf.write_lp(folder / "b.lp", ["img1.jpg"], np.eye(3)[:1] + 1)
    with pytest.raises(ValueError, match="expected one list of lights, got a.lp, b.lp"):
        pf.open_capture(folder)
    with pytest.raises(ValueError, match="expected several photographs, .* img1.jpg"):
        pf.open_capture(folder, lights=folder / "b.lp")


def test_lamps_behind_the_surface_have_a_wrong_z(folder):
    names, vectors = ["img1.jpg", "IMG10.JPG"], np.array([(0.3, 0.1, 1), (0, 1, 0.5)])
    pf.write_lp(folder / "a.lp", names, vectors * (1, -1, -1))
    with pytest.raises(ValueError, match=r"a.lp: .* behind .*: turn the sign of z"):
        pf.open_capture(folder, "srgb")
    # One may well shine from behind.
    pf.write_lp(folder / "a.lp", names, vectors * ((1, 1, 1), (1, 1, -1)))
    assert len(pf.open_capture(folder, "srgb")) == 2


def test_the_encoding_is_not_guessed(tmp_path):
    for number in (1, 2):
        photograph(tmp_path / f"{number}.png")
    with pytest.raises(ValueError, match="encoding: expected linear or srgb"):
        pf.open_capture(tmp_path)
    assert pf.open_capture(tmp_path, "linear").encoding == "linear"


def test_others_of_another_size(folder):
    photograph(folder / "dark.jpg", 0.01, (5, 6))
    for name in ("ambient", "flat"):
        words = "dark.jpg: expected 6 × 4 pixels, as img1.jpg has, got 6 × 5"
        with pytest.raises(ValueError, match=words):
            pf.open_capture(folder, **{name: folder / "dark.jpg"})
