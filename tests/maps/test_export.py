"""What pixels that identify nothing become in textures, where there are no errors."""

import dataclasses

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm

import phongfit as pf
from phongfit.maps.export import filled_in, texture_maps
from phongfit.maps.result import MAP_PARAMETERS, Maps, ParameterMaps
from phongfit.report.scales import draw_flags, draw_parameter

SIZE = (2, 3)
# Of six pixels: two that identify all, a matte one, one that no light shows a highlight
# of, one with its exponent at the bound, and one outside.
FLAGS = np.array(
    [
        [0, 0, pf.Flag.NO_HIGHLIGHT],
        [pf.Flag.NO_HIGHLIGHT | pf.Flag.DEGENERATE, pf.Flag.AT_BOUND, pf.Flag.OUTSIDE],
    ]
)


def made() -> Maps:
    """Numbers of which those that are chance stand out."""
    grey = np.ones((*SIZE, 3))
    specular = np.array([[0.2, 0.4, 0.03], [0.9, 0.3, 0]])[..., None] * grey
    shininess = np.array([[10.0, 40, 777], [888, 1000, 0]])[..., None]
    errors = {name: np.full((*SIZE, 3), 0.01) for name in MAP_PARAMETERS[:2]}
    speculars = np.array([[0.01, 0.01, 0.02], [np.inf, 0.01, np.inf]])[..., None] * grey
    exponents = np.array([[1.0, 1, np.inf], [np.inf, np.inf, np.inf]])[..., None]
    return Maps(
        ambient=0.1 * grey,
        diffuse=0.5 * grey,
        specular=specular,
        shininess=shininess,
        stderr=ParameterMaps(**errors, specular=speculars, shininess=exponents),
        noise=np.full(SIZE, 0.01),
        samples=np.full(SIZE, 90),
        flags=FLAGS,
        unknowns=MAP_PARAMETERS,
        noise_given=None,
        normals=np.tile([0.0, 0, 1], (*SIZE, 1)),
        normals_stderr=np.zeros(SIZE),
        depth=np.full(SIZE, np.nan),
    )


def test_chance_is_filled_in():
    filled, where = filled_in(made())
    # Medians of .2, .4, .03 and .3, and of 10, 40 and 1000.
    expected = [[0.2, 0.4, 0], [0.25, 0.3, 0]]
    np.testing.assert_allclose(np.asarray(filled.specular)[..., 1], expected, 1e-6)
    expected = [[10, 40, 40], [40, 1000, 0]]
    np.testing.assert_allclose(np.asarray(filled.shininess)[..., 0], expected, 1e-6)
    np.testing.assert_array_equal(where, [[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(filled.diffuse, np.asarray(made().material.diffuse))


@pytest.mark.parametrize("model", [pf.Phong(), pf.BlinnPhong(normalized=True)])
def test_before_exponents_are_converted(model):
    """What is filled in is converted like the rest."""
    textured = texture_maps(made(), model)
    times = 4 if isinstance(model, pf.Phong) else 1
    expected = np.array([[10, 40, 40], [40, 1000, 0]]) * times
    np.testing.assert_allclose(textured.shininess[..., 0], expected, rtol=1e-6)
    assert np.all(textured.specular[0, 2] == 0) and textured.filled.sum() == 2


def test_where_no_pixel_tells():
    none = dataclasses.replace(made(), flags=FLAGS | int(pf.Flag.TOO_FEW))
    lost = ParameterMaps(*(np.full_like(leaf, np.inf) for leaf in none.stderr))
    filled, where = filled_in(dataclasses.replace(none, stderr=lost))
    assert not np.asarray(filled.specular).any() and where.sum() == 5


def test_what_is_known_or_black_stays():
    maps = made()
    known = ParameterMaps(*(np.zeros_like(leaf) for leaf in maps.stderr))
    filled, where = filled_in(dataclasses.replace(maps, stderr=known, flags=0 * FLAGS))
    np.testing.assert_array_equal(filled.shininess, maps.material.shininess)
    assert not where.any()
    black = dataclasses.replace(maps, flags=np.full(SIZE, int(pf.Flag.BLACK)))
    assert not filled_in(black)[1].any()


def test_previews_leave_chance_out():
    figure = draw_parameter(made(), "shininess")
    numbers = np.ma.asarray(figure.axes[0].images[0].get_array())
    shown = np.ma.filled(numbers.astype(float), np.nan)
    np.testing.assert_array_equal(np.isfinite(shown), [[1, 1, 0], [0, 0, 0]])
    figure = draw_parameter(made(), "specular")
    colours = np.asarray(figure.axes[0].images[0].get_array())
    assert np.all(colours[1, 0] == 0.85) and np.ptp(colours[0, :, 0]) > 0.1


def test_exponents_are_drawn_in_a_logarithmic_scale():
    figure = draw_parameter(made(), "shininess")
    assert isinstance(figure.axes[0].images[0].norm, LogNorm)
    assert "logarithmic" in figure.axes[0].get_title("left")


def test_a_map_of_nothing_but_noise_is_not_brightened():
    maps = made()
    faint = np.full((*SIZE, 3), 1e-3)
    for error, brightened in ((faint, False), (faint / 10, True)):
        one = dataclasses.replace(
            maps,
            specular=faint,
            stderr=maps.stderr._replace(specular=error),
            flags=0 * FLAGS,
        )
        title = draw_parameter(one, "specular").axes[0].get_title("left")
        assert ("brighter" in title) == brightened


def test_flags_are_one_picture_with_a_legend():
    figure = draw_flags(made())
    (axes,), (legend,) = figure.axes, figure.legends
    words = [text.get_text() for text in legend.get_texts()]
    assert words[0].startswith("identified, no flag") and len(words) > 1
    assert len(axes.images) == 1


def test_large_counts_of_flags_are_not_cut_off():
    """Of as many pixels as a camera has, in a picture as narrow as one is."""

    def tiled(values: np.ndarray) -> np.ndarray:
        return np.tile(values, (600, 333, *[1] * (values.ndim - 2)))

    one = made()
    arrays = {k: tiled(v) for k, v in vars(one).items() if isinstance(v, np.ndarray)}
    arrays["flags"] = np.zeros((1200, 999), int)
    arrays["flags"][:10] = pf.Flag.NO_HIGHLIGHT
    stderr = ParameterMaps(**{k: tiled(v) for k, v in one.stderr._asdict().items()})
    figure = draw_flags(dataclasses.replace(one, **arrays, stderr=stderr))
    FigureCanvasAgg(figure).draw()
    legend, pictured = figure.legends[0].get_window_extent(), figure.axes[0].bbox
    assert pictured.x1 < legend.x0 and legend.x1 < figure.bbox.x1
