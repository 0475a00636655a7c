"""Colour profiles: what they say of a picture's numbers is never ignored."""

import struct

import imagecodecs
import numpy as np
import pytest
from PIL import Image, ImageCms

import phongfit as pf
from phongfit.files.images import read_film, read_image, read_light
from phongfit.files.photographs import read_photograph
from phongfit.rendering.film import decode, encode

D65 = (0.3127, 0.3290, 1.0)
P3 = (0.68, 0.32, 1.0, 0.265, 0.69, 1.0, 0.15, 0.06, 1.0)
SRGB = (0.64, 0.33, 1.0, 0.30, 0.60, 1.0, 0.15, 0.06, 1.0)
# SMPTE EG 432-1's primaries in those of sRGB, both white at D65.
FROM_P3 = np.array(
    [[1.2249, -0.2249, 0], [-0.0420, 1.0420, 0], [-0.0197, -0.0786, 1.0983]]
)


def rgb_profile(primaries: tuple[float, ...], gamma: float) -> bytes:
    return imagecodecs.cms_profile(
        "rgb", whitepoint=D65, primaries=primaries, gamma=gamma
    )


@pytest.fixture
def levels():
    return np.random.default_rng(0).integers(80, 230, (5, 6, 3), np.uint8)


def save(path, levels, profile):
    Image.fromarray(levels).save(path, icc_profile=profile)


def save_tiff(path, numbers, profile):
    """A TIFF of 16 bits or of floats, with its tags again at its end and one more."""
    data = bytes(imagecodecs.tiff_encode(numbers, photometric="rgb"))
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    tags = data[start + 2 : start + 2 + 12 * count]
    one_more = struct.pack("<HHII", 34675, 7, len(profile), len(data))
    data = data[:4] + struct.pack("<I", len(data) + len(profile)) + data[8:] + profile
    path.write_bytes(data + struct.pack("<H", count + 1) + tags + one_more + bytes(4))


def test_any_profile_of_srgb_changes_nothing(tmp_path, levels):
    built = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile in (built, imagecodecs.cms_profile("srgb")):
        save(tmp_path / "a.png", levels, profile)
        photo = read_light(tmp_path / "a.png", "srgb")
        image = photo.image
        expected = decode(levels / 255, "srgb").astype(image.dtype)
        np.testing.assert_allclose(image, expected, rtol=1e-6)
        assert photo.usable.all()
        film = pf.Film(encoding="srgb", bits=8)
        assert read_film(tmp_path / "a.png", "srgb") == film
        with pytest.raises(ValueError, match=r"a\.png: expected encoding 'srgb', sinc"):
            read_image(tmp_path / "a.png", "linear")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_display_p3_becomes_srgb(tmp_path, levels, suffix):
    path = tmp_path / f"a{suffix}"
    save(path, levels, rgb_profile(P3, 2.2))
    expected = np.clip((levels / 255) ** 2.2 @ FROM_P3.T, 0, 1)
    np.testing.assert_allclose(read_image(path, "srgb"), expected, atol=3e-4)
    # Its numbers are no whole levels any more.
    assert read_film(path, "srgb") == pf.Film(encoding="srgb")


def test_a_jpeg_in_display_p3_keeps_what_it_rounds(tmp_path):
    levels = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    Image.fromarray(levels).save(
        tmp_path / "a.jpg", icc_profile=rgb_profile(P3, 2.2), quality=98, subsampling=0
    )
    expected = (levels / 255) ** 2.2 @ FROM_P3.T
    light = read_image(tmp_path / "a.jpg", "srgb")
    np.testing.assert_allclose(light, expected, atol=0.01)
    assert read_film(tmp_path / "a.jpg", "srgb").jpeg is not None


def test_little_cms_agrees_at_8_bits(tmp_path, levels):
    profile = imagecodecs.cms_profile("adobergb")
    save(tmp_path / "a.png", levels, profile)
    light = read_image(tmp_path / "a.png", "srgb")
    other = ImageCms.profileToProfile(
        Image.fromarray(levels),
        ImageCms.getOpenProfile(str(_write(tmp_path / "a.icc", profile))),
        ImageCms.createProfile("sRGB"),
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )
    shown = encode(light.astype(float), "srgb") * 255
    assert np.abs(shown - np.asarray(other, float)).max() <= 1.0


def _write(path, data):
    path.write_bytes(data)
    return path


def test_saturated_pixels_are_left_out_where_channels_are_mixed(tmp_path, levels):
    path = tmp_path / "a.png"
    levels[0, 0] = (255, 100, 100)
    levels[1, 1] = 255
    save(path, levels, rgb_profile(P3, 2.2))
    photo = read_photograph(path, "srgb")
    expected = np.ones((5, 6), bool)
    expected[0, 0] = expected[1, 1] = False
    assert np.array_equal(photo.usable, expected)
    assert not photo.unsaturated[0, 0].any() and photo.image[1, 1].min() > 1 - 1e-6
    with pytest.warns(UserWarning, match=r"a\.png: 2 pixels are saturated.*mask"):
        read_image(path, "srgb")
    stack = pf.PhotographStack([path], "srgb")
    taken = stack.take(np.arange(30), [0])
    assert np.array_equal(np.ma.getmaskarray(taken)[0, :, 0], ~expected.ravel())


def test_another_curve_with_the_primaries_of_srgb(tmp_path, levels):
    levels[0, 0] = (255, 100, 100)
    save(tmp_path / "a.png", levels, rgb_profile(SRGB, 2.2))
    wide = levels.astype(np.uint16) * 257
    save_tiff(tmp_path / "a.tif", wide, rgb_profile(SRGB, 2.2))
    for path in (tmp_path / "a.png", tmp_path / "a.tif"):
        photo = read_light(path, "srgb")
        image = photo.image
        np.testing.assert_allclose(image, (levels / 255) ** 2.2, atol=2e-4)
        # Channels are not mixed: what is saturated is known to be.
        assert image[0, 0, 0] == 1 and photo.usable.all()


def test_linear_profiles(tmp_path, levels):
    linear = rgb_profile(SRGB, 1.0)
    save(tmp_path / "a.png", levels, linear)
    np.testing.assert_allclose(
        read_image(tmp_path / "a.png", "linear"), levels / 255, rtol=1e-6
    )
    with pytest.raises(ValueError, match=r"expected encoding 'linear', since its col"):
        read_image(tmp_path / "a.png", "srgb")
    # Floats are converted too, and not cut off.
    light = np.array([[[0.2, 0.9, 3.0]]], np.float32)
    profile = rgb_profile(P3, 1.0)
    save_tiff(tmp_path / "a.tif", light, profile)
    np.testing.assert_allclose(
        read_image(tmp_path / "a.tif", "linear"), light @ FROM_P3.T, atol=1e-3
    )


def test_grey_pictures(tmp_path):
    grey = np.array([[0, 90, 255]], np.uint8)
    curve = imagecodecs.cms_profile("gray", whitepoint=D65, gamma=1.8)
    save(tmp_path / "a.png", grey, curve)
    image = read_image(tmp_path / "a.png", "srgb")
    expected = np.repeat((grey[..., None] / 255) ** 1.8, 3, axis=-1)
    np.testing.assert_allclose(image, expected, atol=1e-4)
    # With a profile of coloured pictures, as some programs write it.
    save(tmp_path / "b.png", grey, rgb_profile(P3, 1.8))
    np.testing.assert_allclose(read_image(tmp_path / "b.png", "srgb"), image, atol=1e-3)


P3_BYTES = rgb_profile(P3, 2.2)


@pytest.mark.parametrize(
    "profile, words",
    [
        (P3_BYTES[:200], "cannot be used.*convert it to sRGB"),
        (P3_BYTES[:300] + bytes(300), "cannot be used.*convert it to sRGB"),
        (b"x" * 400, "expected a colour profile .* of RGB or grey, got 'xxxx'"),
        (imagecodecs.cms_profile("lab4"), "of RGB or grey, got 'Lab'"),
        (bytes(2**23 + 1), "at most 8388608 bytes, got more"),
    ],
)
def test_profiles_that_are_refused(tmp_path, levels, profile, words, capfd):
    for name in ("a.png", "a.jpg"):
        save(tmp_path / name, levels, profile)
        with pytest.raises(ValueError, match=words) as caught:
            read_image(tmp_path / name, "srgb")
        assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value) and capfd.readouterr() == ("", "")
