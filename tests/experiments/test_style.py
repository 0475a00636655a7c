import matplotlib
import numpy as np
import pytest

from experiments import style


@style.styled
def draw():
    figure = style.page(2.0)
    style.picture_grid(
        figure, [[np.zeros((2, 2, 3)), np.full((2, 2, 3), 9.0)]], columns="ab", rows="c"
    )
    return figure


def test_the_style_is_used_and_left():
    before = matplotlib.rcParamsDefault["font.size"]
    figure = draw()
    assert figure.get_size_inches().tolist() == [style.PAGE, 2.0]
    dark, bright = figure.axes
    assert dark.title.get_fontsize() == style.STYLE["axes.titlesize"]
    assert dark.get_ylabel() == "c" and bright.get_title() == "b"
    assert matplotlib.rcParams["font.size"] == before


def test_light_is_shown_as_a_screen_shows_it():
    dark, bright = draw().axes
    assert np.asarray(dark.images[0].get_array()).max() == 0
    assert np.asarray(bright.images[0].get_array()).max() == pytest.approx(1)
