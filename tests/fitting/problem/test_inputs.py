import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.inputs import as_photographs
from tests.fitting.scenes import SIZE, ball

SHAPE = (SIZE, SIZE, 3)
SCENE = ball()
GREY = np.full(SHAPE, 0.25)
NOWHERE = np.zeros((SIZE, SIZE))
CORNER = NOWHERE.copy()
CORNER[0, 0] = 1  # sees no surface
THREE = NOWHERE.copy()
THREE[16, 15:18] = 1  # nine samples
TEN = np.zeros(SHAPE)
TEN[16, 15:18] = 1
TEN[17, 16, 0] = 1
BROKEN = GREY.copy()
BROKEN[7, 8, 2] = np.nan
BROKEN[9, 8, 1] = np.inf
CENTRE = np.hypot(*(np.indices((SIZE, SIZE)) + 0.5 - SIZE / 2)) < 10


BOTH = {"scene": [SCENE] * 2, "image": [GREY] * 2}


@pytest.mark.parametrize(
    "message, options",
    [
        (r"image: .* \(32, 32, 3\), .*, got \(3, 3, 3\)", {"image": GREY[:3, :3]}),
        (r"image: expected .*, got \(32, 32\)", {"image": GREY[..., 0]}),
        ("image: expected linear .*, got uint8", {"image": GREY.astype(np.uint8)}),
        ("image: expected .*, got <U1", {"image": np.full(SHAPE, "x")}),
        ("image: expected .*, got complex128", {"image": GREY * 1j}),
        (
            "image: 2 samples are NaN or infinite, the first in row 7, column 8, "
            "channel 2; mask them out",
            {"image": BROKEN},
        ),
        ("scene: expected a Scene.* or a", {"scene": [], "image": []}),
        ("scene: expected a Scene.* or a", {"scene": [GREY], "image": [GREY]}),
        ("scene: expected a Scene.* or a", {"scene": 3.0}),
        ("image: expected 2, one a scene, got 1", BOTH | {"image": [GREY]}),
        ("image: expected a sequence of 2", BOTH | {"image": None}),
        (r"image\[1\]: expected shape", BOTH | {"image": [GREY, GREY[:5]]}),
        (
            "scene: all scenes must have the same specular model",
            BOTH | {"scene": [SCENE, ball(specular_model=pf.Phong())]},
        ),
        ("mask: expected 2, one a scene, got 1", BOTH | {"mask": [CENTRE]}),
        (r"mask\[1\]: .* leave no pixel", BOTH | {"mask": [CENTRE, NOWHERE]}),
        ("weights: expected 2, .*, got 3", BOTH | {"weights": [CENTRE] * 3}),
        ("mask: mask and weights leave no pixel", {"mask": NOWHERE}),
        ("mask: mask and weights leave no pixel", {"weights": NOWHERE}),
        ("mask: it leaves no pixel that sees the surf", {"mask": CORNER}),
        ("mask: expected more samples than unknowns, got 9", {"mask": THREE}),
        # Exactly as many samples as unknowns leave no room for an error.
        ("mask: .*, got 10 samples for 10 unknowns", {"mask": TEN}),
        (r"mask: expected .*, got \(3, 3\)", {"mask": CENTRE[:3, :3]}),
        ("mask: expected true or false", {"mask": np.nan}),
        ("mask: .* without a mask", {"mask": np.ma.ones((5, 5))}),
        (r"weights: expected .*, got \(3,\)", {"weights": np.ones(3)}),
        ("weights: expected finite numbers ≥ 0", {"weights": CENTRE - 0.5}),
        ("weights: expected finite numbers ≥ 0", {"weights": CENTRE * np.nan}),
        ("noise: expected finite numbers > 0", {"noise": -0.01}),
        ("noise: expected finite numbers > 0", {"noise": 0.0}),
        ("noise: expected finite numbers > 0", {"noise": np.inf}),
        ("noise: expected finite numbers > 0", {"noise": 1e-320}),
        ("noise: expected .*, got <U3 values", {"noise": "low"}),
        (r"noise: expected .*, got \(5, 5\)", {"noise": np.ones((5, 5))}),
        ("max_steps: expected .* whole", {"max_steps": 2**32}),
        ("max_steps: expected .* whole", {"max_steps": 0}),
        # Names, bounds and losses are in `test_specification` and `test_layout`.
        ("unknowns: expected one of ambient, .*got 'gloss'", {"unknowns": ["gloss"]}),
        (r"bounds: .*, got \(1, inf\)", {"bounds": {"shininess": (1, np.inf)}}),
        (
            r"known: diffuse: expected .*, got \(4, 1\)",
            {"known": pf.Material(diffuse=np.ones((4, 1)))},
        ),
        (
            r"image: expected values in \[0, 1\], .*, got 0.25 … 1.25",
            {"image": np.where(CENTRE[..., None], GREY, 1.25), "film": pf.Film()},
        ),
        (
            "unknowns: expected ambient or emission, got both",
            {"unknowns": ("ambient", "emission", "diffuse")},
        ),
    ],
)
def test_errors_name_the_argument(message, options):
    with pytest.raises(ValueError, match=f"^{message}"):
        pf.fit(**({"scene": SCENE, "image": GREY} | options))


@pytest.mark.parametrize(
    "options, expected",
    [
        ({}, np.ones(SHAPE)),
        ({"mask": CENTRE}, np.repeat(CENTRE[..., None], 3, axis=-1)),
        ({"mask": CENTRE.astype(int) * 255}, np.repeat(CENTRE[..., None], 3, axis=-1)),
        ({"mask": np.ones(SHAPE) * [1, 0, 1]}, np.ones(SHAPE) * [1, 0, 1]),
        ({"weights": 2 * CENTRE}, np.repeat(2.0 * CENTRE[..., None], 3, axis=-1)),
        ({"noise": 0.5}, np.full(SHAPE, 4.0)),
        ({"noise": np.full((SIZE, SIZE), 0.5)}, np.full(SHAPE, 4.0)),
        ({"weights": 3.0, "noise": 0.5, "mask": CENTRE}, 12.0 * CENTRE[..., None]),
    ],
)
def test_mask_weights_and_noise_become_weights(options, expected):
    given = {"mask": None, "weights": None, "noise": None} | options
    (photograph,) = as_photographs(SCENE, GREY, **given)
    assert photograph.weight.shape == (SHAPE if any(options) else (1, 1, 1))
    weight = np.broadcast_to(photograph.weight, SHAPE)
    assert np.array_equal(weight, np.broadcast_to(expected, SHAPE))
    assert np.array_equal(np.ravel(photograph.used()), GREY[weight > 0])
    assert photograph.weight.dtype == jnp.result_type(float)
    assert photograph.name == "image"


def test_broken_pixels_may_be_masked():
    mask = np.isfinite(BROKEN)
    (photograph,) = as_photographs(SCENE, BROKEN, mask, None, None)
    assert np.all(np.isfinite(photograph.image))
    assert np.array_equal(photograph.weight, mask)
    (weighted,) = as_photographs(SCENE, BROKEN, None, 1.0 * mask, None)
    assert np.array_equal(weighted.weight, mask)


@pytest.mark.parametrize("name", ["noise", "weights"])
def test_noise_and_weights_count_where_pixels_do(name):
    known = np.where(CENTRE, 0.1, np.nan)
    given = {"mask": CENTRE, "weights": None, "noise": None}
    (one,) = as_photographs(SCENE, GREY, **(given | {name: known}))
    (other,) = as_photographs(SCENE, GREY, **(given | {name: 0.1}))
    assert np.array_equal(one.weight, np.broadcast_to(other.weight, SHAPE))
    with pytest.raises(ValueError, match=f"^{name}: expected finite"):
        as_photographs(SCENE, GREY, **(given | {"mask": None, name: known}))


def test_several():
    masks, noises = [CENTRE, ~CENTRE], [0.5, np.full(SHAPE, 0.25)]
    photographs = as_photographs(
        (SCENE, SCENE), np.stack([GREY, 2 * GREY]), masks, None, noises
    )
    assert [p.name for p in photographs] == ["image[0]", "image[1]"]
    assert photographs[1].image.max() == 0.5
    assert photographs[0].weight[16, 16, 0] == 4
    assert photographs[1].weight[16, 16, 0] == 0
    assert photographs[1].weight[0, 0, 0] == 16
    # One number is the noise of all.
    both = as_photographs([SCENE] * 2, [GREY] * 2, None, None, 0.5)
    assert all(np.all(p.weight == 4) for p in both)


def test_arguments_stay_as_they_are():
    image, mask, weights = BROKEN.copy(), np.isfinite(BROKEN), np.ones(SHAPE)
    as_photographs(SCENE, image, mask, weights, 0.1)
    assert np.array_equal(image, BROKEN, equal_nan=True)
    assert np.all(weights == 1)


def test_a_masked_array_leaves_its_samples_out():
    masked = np.ma.MaskedArray(np.where(CENTRE[..., None], GREY, np.nan))
    masked[~CENTRE] = np.ma.masked
    ((one,), (wanted,)) = (
        as_photographs(SCENE, image, mask, None, 0.5)
        for image, mask in ((masked, None), (masked.data, CENTRE))
    )
    np.testing.assert_array_equal(one.weight, np.broadcast_to(wanted.weight, SHAPE))
    np.testing.assert_array_equal(one.image, wanted.image)
    assert not np.ma.isMaskedArray(one.image)
