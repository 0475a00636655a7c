"""All experiments at their small size, and the page that shows them."""

import dataclasses
import html.parser
import json

import pytest
from matplotlib.axes import Axes

from experiments import all as every
from phongfit.cli import run

pytestmark = pytest.mark.extended


class Page(html.parser.HTMLParser):
    """Pictures, links and ids of a page, and its text."""

    def __init__(self, text: str):
        html.parser.HTMLParser.__init__(self)
        self.images, self.links, self.ids, self.text = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        if tag == "img":
            self.images.append(named)
        if tag == "a":
            self.links.append(named["href"])
        if "id" in named:
            self.ids.append(named["id"])

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def made(found, tmp_path_factory):
    """A folder of all experiments."""
    out = tmp_path_factory.mktemp("experiments") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(every, "EXPERIMENTS", remembered(found))
        status = run(every.main, [str(out), "--small"])
    return out, status


def remembered(found):
    """The same experiments, each of them made once for all tests."""
    return tuple(
        dataclasses.replace(one, find=lambda small, one=one: found(one))
        for one in every.EXPERIMENTS
    )


def test_all_that_should_hold_does(made):
    assert made[1] == 0


def test_the_page_shows_every_experiment(made, found):
    out, _ = made
    page = Page((out / every.PAGE).read_text(encoding="utf-8"))
    words = " ".join(page.text.split())
    for one in every.EXPERIMENTS:
        finding = found(one)
        assert one.question in words
        assert finding.answer.replace("ρ_", "ρ") in words
        assert one.name in page.ids and f"#{one.name}" in page.links
        numbers = json.loads((out / f"{one.name}.json").read_text())
        assert numbers.keys() == finding.numbers.keys()
    assert len(every.EXPERIMENTS) == 8 and "small size" in words


def test_links_and_pictures_are_there(made):
    out, _ = made
    page = Page((out / every.PAGE).read_text(encoding="utf-8"))
    assert len(page.images) == 9
    for image in page.images:
        assert (out / image["src"]).stat().st_size > 1000 and len(image["alt"]) > 20
    for link in page.links:
        assert link.startswith("#") or (out / link).exists()
    assert {path.name for path in out.iterdir()} <= every.FILES


def test_axes_are_labelled(found):
    for one in every.EXPERIMENTS:
        for axes in found(one).figure.axes:
            for axis in (axes.xaxis, axes.yaxis):
                assert is_labelled(axes, axis), f"{one.name}: {axes.get_title()!r}"


def is_labelled(axes: Axes, axis) -> bool:
    """A label where there are ticks, unless these are words."""
    ticks = [text.get_text() for text in axis.get_ticklabels() if text.get_text()]
    words = any(letter.isalpha() for tick in ticks for letter in tick)
    return not axes.axison or not ticks or words or bool(axis.get_label_text())


def test_no_unknown_file_is_lost(found, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(every, "EXPERIMENTS", remembered(found)[:1])
    kept = tmp_path / "out" / "thesis.txt"
    kept.parent.mkdir()
    kept.write_text("years of work")
    assert run(every.main, [str(kept.parent), "--small"]) == 2
    assert "thesis.txt" in capsys.readouterr().err and kept.read_text()
    # One that was made like this is replaced.
    kept.unlink()
    for _ in range(2):
        assert run(every.main, [str(kept.parent), "--small"]) == 0
    assert len(list(kept.parent.iterdir())) == 3


def test_what_fails_is_said(found, tmp_path, capsys, monkeypatch):
    first = every.EXPERIMENTS[0]
    failed = dataclasses.replace(found(first), failed_checks=("the sum is < off",))
    broken = dataclasses.replace(first, find=lambda small: failed)
    monkeypatch.setattr(every, "EXPERIMENTS", (broken,))
    assert run(every.main, [str(tmp_path / "out"), "--small"]) == 1
    assert "the sum is < off" in capsys.readouterr().out
    page = (tmp_path / "out" / every.PAGE).read_text(encoding="utf-8")
    assert "Failed check: the sum is &lt; off." in page
