"""Messages of fits name the page's controls."""

import re

import pytest

from phongfit.codes import coded
from phongfit.lab.words import PAGE_REMEDIES, in_page_words

OF_PYTHON = re.compile(r"\w+=|\w+\(|[{}_]|--bounds")


@pytest.mark.parametrize("code", PAGE_REMEDIES)
def test_remedies_are_not_calls_of_python(code):
    words = in_page_words(coded(code, "light is missing. It matters: 3.5 σ"))
    assert words.startswith("light is missing. It matters: 3.5 σ. ")
    assert words.endswith(f" [{code}]")
    assert not OF_PYTHON.search(words)


def test_a_remedy_of_one_warning_alone():
    bound = coded(
        "bound-decides",
        "shininess lies at its upper bound 15: its error is one-sided. Without it the "
        "estimate would be 8 σ beyond it",
        "If it may lie beyond, try bounds={'shininess': (1, 75)}, or --bounds "
        "shininess=1:75",
    )
    words = in_page_words(bound)
    assert "be 8 σ beyond it. Compare “intensity”" in words
    assert not OF_PYTHON.search(words)
    label = coded("at-bound", "scene.lights[0].position.z lies at its bound")
    assert in_page_words(label).startswith("light position.z lies at its bound. ")


def test_other_words_stay():
    for words in ("no code", coded("shared-cache", "others may write")):
        assert in_page_words(words) == words
