"""A folder of photographs, as it comes out of a camera or a dome."""

import numpy as np
import pytest

import phongfit as pf


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


def test_bad_folders(folder, tmp_path):
    with pytest.raises(ValueError, match="there is no such folder"):
        pf.open_capture(tmp_path / "nowhere")
    pf.write_lp(folder / "a.lp", ["other.jpg", "img1.jpg"], np.eye(3)[:2] + 1)
    with pytest.raises(ValueError, match="1 of the 2 photographs .* other.jpg first"):
        pf.open_capture(folder)
    pf.write_lp(folder / "b.lp", ["img1.jpg"], np.eye(3)[:1] + 1)
    with pytest.raises(ValueError, match="expected one list of lights, got a.lp, b.lp"):
        pf.open_capture(folder)
    with pytest.raises(ValueError, match="expected several photographs, .* img1.jpg"):
        pf.open_capture(folder, lights=folder / "b.lp")


def test_the_encoding_is_not_guessed(tmp_path):
    for number in (1, 2):
        photograph(tmp_path / f"{number}.png")
    with pytest.raises(ValueError, match="encoding: expected linear or srgb"):
        pf.open_capture(tmp_path)
    assert pf.open_capture(tmp_path, "linear").encoding == "linear"


def test_others_of_another_size(folder):
    photograph(folder / "dark.jpg", 0.01, (5, 6))
    capture = pf.open_capture(folder, ambient=folder / "dark.jpg")
    with pytest.raises(ValueError, match="ambient: expected 6 × 4 pixels"):
        capture[0]
