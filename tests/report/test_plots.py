"""Figures: that they show what they say, with labels and units."""

import dataclasses

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import phongfit as pf
from phongfit.fitting.uncertainty.convergence import trace_convergence
from phongfit.fitting.uncertainty.profile import Profile
from phongfit.report.pictures import displayed, draw_residual, signed
from phongfit.report.plots import (
    MOST_UNKNOWNS,
    brightening,
    chosen,
    residuals,
    shown_unknowns,
)
from phongfit.report.profiles import difference_words, draw_profile
from phongfit.report.style import picture, png, styled
from tests.helpers import near


def texts(figure: Figure) -> str:
    """All words in a figure: titles, labels of axes, legends, what is written in it."""
    words = []
    for axes in figure.axes:
        words += [axes.get_title(loc) for loc in ("left", "center")]
        words += [axes.get_xlabel(), axes.get_ylabel()]
        words += [text.get_text() for text in axes.texts]
        words += [label.get_text() for label in axes.get_yticklabels()]
        if legend := axes.get_legend():
            words += [text.get_text() for text in legend.get_texts()]
    return "\n".join(words)


def images(figure: Figure) -> list[np.ndarray]:
    """Every image that a figure shows."""
    found = [image for axes in figure.axes for image in axes.images]
    return [np.asarray(image.get_array()) for image in found]


def test_photograph_fit_and_residual(one):
    figure = one.plot()
    photograph, fitted, left = images(figure)
    near(photograph, displayed(one.photographs))
    near(fitted, displayed(one.fitted))
    near(left, signed(one.residuals))
    words = texts(figure)
    assert "photograph" in words and "photograph − fit (linear light)" in words
    assert len(figure.axes) == 4, "three pictures and a scale"


def test_a_dark_photograph_is_shown_brighter_and_says_so(open_fit):
    factor = brightening([open_fit.photographs])
    assert 3 < factor < 10
    figure = open_fit.plot(["5.png"])
    assert f"5.png  (shown {factor:.2g} × brighter)" in texts(figure)
    near(images(figure)[0], displayed(factor * open_fit.photographs))
    with pytest.raises(ValueError, match="names: expected 1, one an image, got 2"):
        open_fit.plot(["a", "b"])


@pytest.mark.extended
def test_some_of_six_photographs_are_shown(six):
    factor = brightening(six.photographs)
    figure = six.plot([f"{k}.png" for k in range(6)])
    words = texts(figure)
    assert f"5.png  (shown {factor:.2g} × brighter)" in words
    near(images(figure)[0], displayed(factor * six.photographs[0]))
    # Some of them, spread over all.
    assert [k for k in range(6) if f"{k}.png" in words] == [0, 1, 3, 5]
    # Of each image its residuals, and their sums over blocks.
    assert len(images(six.plot_residuals())) == 8


@pytest.mark.parametrize("size", [2e-6, 0.02])
def test_scales_of_residuals_have_no_power_beside_them(size):
    figure = picture(3, 3)
    axes = figure.subplots()
    draw_residual(axes, size * np.linspace(-1, 1, 27).reshape(3, 3, 3), below=True)
    FigureCanvasAgg(figure).draw()
    scale = figure.axes[1].xaxis
    assert scale.get_offset_text().get_text() == ""
    told = [label.get_text() for label in scale.get_ticklabels()]
    assert "0" in told and told[0].startswith("−"), told


@pytest.mark.parametrize(
    "count, most, expected",
    [(1, 4, [0]), (3, 4, [0, 1, 2]), (96, 4, [0, 31, 63, 95]), (9, 1, [0])],
)
def test_some_of_many(count, most, expected):
    assert chosen(count, most) == expected


def test_residuals_are_in_standard_deviations(one):
    found = residuals(one)
    every = np.concatenate([values for _, values in found])
    assert every.size == one.n_samples and 0.95 < every.std() < 1.05
    left = one.residuals[one.residuals != 0] / one.noise
    near(np.sort(every), np.sort(left), 1e-3)
    light = np.sort(np.concatenate([light for light, _ in found]))
    near(light, np.sort(one.fitted[one.residuals != 0]), 1e-3)


def test_plot_of_residuals(one):
    figure = one.plot_residuals()
    words = texts(figure)
    for label in (
        "(photograph − fit) / σ",
        "light of the fit (linear, white = 1)",
        "share of samples per σ",
        "pure noise",
        "% of samples lie beyond ±5 σ",
    ):
        assert label in words
    # Its residuals, and their sums over blocks.
    assert len(images(figure)) == 2


def test_correlations_leave_out_what_has_none(one, open_fit):
    (shown,) = images(one.plot_correlations())
    near(shown, one.correlation)
    assert "−.92" in texts(one.plot_correlations())
    # What is widened over the exponents has errors, but no covariance.
    covariance = one.covariance.copy()
    covariance[3:], covariance[:, 3:] = np.nan, np.nan
    wide = dataclasses.replace(one, covariance=covariance)
    assert shown_unknowns(wide) == [0, 1, 2]
    (shown,) = images(wide.plot_correlations())
    near(shown, one.correlation[:3, :3])
    assert not images(open_fit.plot_correlations())
    assert "nothing to correlate" in texts(open_fit.plot_correlations())


def test_of_many_unknowns_the_most_correlated_are_shown(one):
    many = MOST_UNKNOWNS + 6
    covariance = np.eye(many)
    covariance[0, 29] = covariance[29, 0] = 0.9
    wide = dataclasses.replace(
        one,
        labels=tuple(f"exposure[{k}]" for k in range(many)),
        errors=np.ones(many),
        covariance=covariance,
        at_bound=np.zeros(many, bool),
        unidentified=np.zeros(many, bool),
        tied=np.zeros(many, bool),
    )
    shown = shown_unknowns(wide)
    assert len(shown) == MOST_UNKNOWNS and {0, 29} <= set(shown)


def test_profile(one):
    figure = one.plot_profile("shininess")
    words = texts(figure)
    for part in ("shininess  (exponent)", "Δχ²", "68.3 %", "standard error", "profile"):
        assert part in words
    curve, points, parabola = figure.axes[0].lines
    near(np.asarray(parabola.get_ydata()).min(), 0, 1e-2)
    x, y = (np.asarray(data) for data in points.get_data())
    near(x[np.argmin(y)], one["shininess"].value, 1e-5)
    # Near the estimate the two agree.
    away = np.abs(np.asarray(curve.get_xdata()) - x[np.argmin(y)])
    inner = away < one["shininess"].error
    both = [np.asarray(line.get_ydata())[inner] for line in (curve, parabola)]
    near(both[0], both[1], 0.1)
    with pytest.raises(ValueError, match="name: expected .*, got 'shiny'"):
        one.plot_profile("shiny")


def test_words_of_a_profile_do_not_overlap(one):
    """Intervals that end at the same bound, or close to it."""
    found = one.profile("shininess")
    end = float(found.values[-1])
    ends = dict.fromkeys(found.intervals, (float(found.values[0]), end))
    with styled():
        figure = picture(4.4, 3.1)
        draw_profile(figure.subplots(), one, dataclasses.replace(found, intervals=ends))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    axes = figure.axes[0]
    legend = axes.get_legend()
    assert legend is not None
    words = [*axes.texts, *legend.get_texts()]
    assert "99.7 %" in texts(figure)
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in words]
    for k, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
        assert not any(box.overlaps(other) for other in boxes[:k])


@pytest.mark.parametrize(
    "below, above, words",
    [
        (1.05, 0.9, ""),
        (0.8, 1.6, "up to 60 %. Quote the profile's interval"),
        (0.6, 1.05, "up to 40 %. Quote the profile's interval"),
        (0.5, 0.6, "up to 50 %. Quote ±"),
    ],
)
def test_which_of_profile_and_error_to_quote(one, below, above, words):
    value, error = one["shininess"][:2]
    ends = (float(value - below * error), float(value + above * error))
    found = Profile("shininess", np.array(ends), np.ones(2), {0.6827: ends})
    said = difference_words(one, found)
    assert words in said and bool(said) == bool(words)
    assert not said or f"{ends[0]:.2f} … " in said and "± " in said
    # Agreement at 68 % is none at 95 %.
    wider = (ends[0], float(value + 3 * error))
    more = dataclasses.replace(found, intervals={0.6827: ends, 0.9545: wider})
    assert "(95.5 %)" in difference_words(one, more) or said


@pytest.mark.slow
def test_profile_of_a_pair(one):
    words = texts(one.plot_profile("shininess", "specular.red"))
    assert "shininess  (exponent)" in words
    assert "specular.red  (reflectance, 0 … 1)" in words


def test_the_way_down(one):
    convergence = trace_convergence(one.solution)
    costs = convergence.costs
    assert 2 < len(costs) < 40 and np.all(np.diff(costs) < 1e-6 * costs[0])
    assert costs[0] > costs[-1]
    assert abs(costs[-1] - convergence.least) < 0.05
    assert convergence.least == pytest.approx(one.chi_squared, rel=1e-3)


def test_show():
    image = np.full((20, 30, 3), 0.25)
    figure = pf.show(image, title="grey", brighten=2)
    near(images(figure)[0], displayed(2 * image))
    assert "grey" in texts(figure)
    assert len(pf.show(image[..., 0]).axes) == 2, "a map and its scale"


@pytest.mark.parametrize("shape", [(3,), (4, 4, 2), (2, 4, 4, 3)])
def test_show_wants_an_image(shape):
    with pytest.raises(ValueError, match="image: expected .* got shape"):
        pf.show(np.zeros(shape))


def test_what_is_no_number_is_black():
    near(displayed(np.array([np.nan, 0.0, 2.0])), [0, 0, 1])


def test_figures_need_neither_pyplot_nor_style_left_behind(one):
    before = dict(matplotlib.rcParams)
    figure = one.plot_correlations()
    assert dict(matplotlib.rcParams) == before
    assert png(figure, 50).startswith(b"\x89PNG")
    # What a notebook asks a figure for.
    assert figure._repr_png_().startswith(b"\x89PNG")
