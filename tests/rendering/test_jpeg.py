"""What a JPEG file loses, next to what a library that reads and writes them loses."""

import imageio.v3 as iio
import numpy as np
import pytest

import phongfit as pf
from phongfit.rendering.jpeg import SAMPLINGS, JpegCompression, compressed

# As Pillow counts them.
NUMBERS = {"4:4:4": 0, "4:2:2": 1, "4:2:0": 2}


def picture(noise):
    """Levels of a slope and an edge, of no whole number of blocks."""
    y, x = np.mgrid[0:44, 0:52] / 52
    levels = np.stack([60 + 120 * x, 90 + 50 * y, 40 + 30 * x * y], axis=-1)
    levels[20:] += 30 * (x[20:, :, None] > 0.4)
    noise = noise * np.random.default_rng(0).normal(size=levels.shape)
    return np.round(levels + noise).clip(0, 255)


def written_and_read(levels, quality, sampling):
    data = iio.imwrite(
        "<bytes>",
        levels.astype(np.uint8),
        extension=".jpg",
        plugin="pillow",
        quality=quality,
        subsampling=NUMBERS[sampling],
    )
    return iio.imread(data, extension=".jpg").astype(float)


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("quality", [60, 95])
def test_it_is_what_the_library_makes_of_it(quality, sampling):
    levels = picture(noise=0)
    read = written_and_read(levels, quality, sampling)
    ours = compressed(levels, JpegCompression.at_quality(quality, sampling))
    # The library works with whole numbers, so that some roundings fall otherwise.
    assert np.sqrt(np.mean((ours - read) ** 2)) < 0.9
    assert np.mean(np.abs(ours - read) <= 2) > 0.98


def test_noise_is_lost_as_the_library_loses_it():
    levels, smooth = picture(noise=4), picture(noise=0)
    for quality in (75, 95):
        read = written_and_read(levels, quality, "4:2:0")
        ours = compressed(levels, JpegCompression.at_quality(quality, "4:2:0"))
        wanted = np.std(read - smooth)
        assert np.std(ours - smooth) == pytest.approx(wanted, rel=0.05)


def test_a_film_of_it_is_the_same_for_light():
    levels = picture(noise=0).astype(np.float32)
    jpeg = JpegCompression.at_quality(75)
    film = pf.Film(jpeg=jpeg)
    assert film.bits == 8
    shown = np.asarray(film.expose(levels / np.float32(255))) * 255
    np.testing.assert_allclose(shown, compressed(levels, jpeg), atol=2)
    assert np.mean(np.abs(shown - compressed(levels, jpeg)) > 0.01) < 0.01


@pytest.mark.parametrize(
    "wrong, words",
    [
        (lambda: JpegCompression(np.ones((2, 8, 8))), r"tables: expected shape \(1, 8"),
        (lambda: JpegCompression(np.zeros((1, 8, 8))), "tables: expected whole"),
        (
            lambda: JpegCompression(np.ones((3, 8, 8)), ((1, 1),)),
            "sampling: .* 3 pairs",
        ),
        (
            lambda: JpegCompression(np.ones((1, 8, 8)), ((0, 1),)),
            "sampling: .* whole",
        ),
        (lambda: JpegCompression.at_quality(0), "quality: expected 1"),
        (lambda: JpegCompression.at_quality(90, "4:1:1"), "subsampling: expected 4"),
        (lambda: pf.Film(bits=16, jpeg=JpegCompression.at_quality(90)), "bits: expec"),
    ],
)
def test_what_is_no_compression(wrong, words):
    with pytest.raises(ValueError, match=words):
        wrong()


def test_the_widest_rounding_is_that_of_the_coarsest_mean():
    # T.81's table K.2 begins with 17, as it stands at quality 50; a mean has an eighth.
    assert pf.rendering.JpegCompression.at_quality(50).widest == 17 / 8
    assert pf.rendering.JpegCompression.at_quality(100).widest == 1
