"""Photographs and lamps find each other by names, numbers or order."""

import pytest

from phongfit.files.matching import match_names


@pytest.mark.parametrize(
    "names, others, places, how",
    [
        (["b.png", "a.png"], ["x/a.png", "C:\\y\\b.png"], [1, 0], ""),
        (["A.JPG", "b.jpg"], ["b.jpg", "a.jpg"], [1, 0], ""),
        # One name agrees: the others are missing, whatever their numbers.
        (["a1.png", "b2.png"], ["a1.png", "c2.png"], [0, None], ""),
        # Another object's photographs, of which one was left out.
        (["h.10.png", "h.2.png"], ["m.2.png", "m.3.png", "m.10.png"], [2, 0], "number"),
        # The last number counts, and must be each name's own.
        (["s1_07.png", "s1_08.png"], ["t2_08.png", "t2_07.png"], [1, 0], "number"),
        (["one.png", "two.png"], ["left.png", "right.png"], [0, 1], "order"),
        (["a1.png", "b1.png"], ["c1.png", "d1.png"], [0, 1], "order"),
        (["one.png", "two.png"], ["left.png"], [None, None], ""),
    ],
)  # fmt: skip
def test_partners(names, others, places, how):
    match = match_names(names, others)
    assert match.places == places
    assert (f"by {how}" in match.note) if how else not match.note
