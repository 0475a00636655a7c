"""The page: what it says, that it stands alone, and that it is whole or not there."""

import dataclasses
import html.parser
import re

import numpy as np
import pytest

from phongfit.report.page import write_page
from phongfit.report.panels import convergence, profiles
from phongfit.report.words import bounds_words, known_words, listed, unit


class Elements(html.parser.HTMLParser):
    """All start tags with their attributes, and all text."""

    def __init__(self, source: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, {name: value or "" for name, value in attrs}))

    def handle_data(self, data):
        self.text += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The elements of a fit's page."""
    path = tmp_path_factory.mktemp("page") / "report.html"

    def elements(fit, **given) -> Elements:
        write_page(path, fit, **given)
        return Elements(path.read_text(encoding="utf-8"))

    return elements


EVIL = "<script>alert('&')</script>"


@pytest.fixture(scope="module")
def whole(page, one) -> Elements:
    """The page of a fit, with words from outside that are never markup."""
    given = {"title": EVIL, "names": [EVIL], "assumptions": {EVIL: EVIL}}
    command = f"phongfit fit ball {EVIL}"
    return page(one, **given, command=command, diagnostics=one.diagnose())


def words(elements: Elements) -> str:
    return " ".join(elements.text.split())


def test_sections(whole):
    found = [attributes["id"] for attributes in whole.all("section")]
    assert found == [
        "summary",
        "pictures",
        "parameters",
        "profiles",
        "correlations",
        "residuals",
        "convergence",
        "assumptions",
        "repeat",
    ]
    assert [a["href"] for a in whole.all("a")] == [f"#{name}" for name in found]


def test_every_number_is_there(whole, one):
    text = words(whole)
    for label in one.labels:
        assert label in text
    value, error = one["shininess"][:2]
    assert f"shininess {value:.1f}" in text or f"{value:.2f} ± {error:.2g}" in text
    assert "The data identify everything that was asked." in text
    assert "converged" in text and "NOT" not in text
    for assumption in (
        "BlinnPhong (no highlight where the light is behind; ",
        "clamped, not rounded",
        "optimistix ",
    ):
        assert assumption in text
    assert "phongfit fit ball" in text and "fit = pf.fit( scene, image, )" in text
    assert "In Python, with the same scene and image:" in text


def test_it_stands_alone_and_pictures_have_words(whole):
    pictures = whole.all("img")
    # Three of the photograph, three profiles, correlations, two of residuals, costs.
    assert len(pictures) == 3 + 3 + 1 + 3 + 1
    for attributes in pictures:
        assert attributes["src"].startswith("data:image/png;base64,")
        assert len(attributes["alt"]) > 10
    for tag, attributes in whole.tags:
        assert tag not in ("script", "iframe", "object")
        for name in ("src", "href"):
            assert re.match(r"data:|#|$", attributes.get(name, ""))
    # Title twice, name, assumption twice, command.
    assert whole.text.count(EVIL) == 6


@pytest.mark.extended
def test_what_is_not_identifiable(page, open_fit):
    text = words(page(open_fit, title="matte"))
    assert "The data do not identify shininess: the warnings say why." in text
    assert "± ∞" in text and "not identifiable" in text
    assert "At the end of what was allowed: " in text and "at its bound" in text
    for warning in open_fit.warnings:
        assert warning in text
    assert "times brighter than" in text
    assert "Profiles were not asked for." in text
    assert "everything that was asked" not in text


@pytest.mark.extended
def test_of_many_photographs_some_are_shown(page, six):
    text = words(page(six, title="matte"))
    assert "Shown are 4 of 6." in text and "times brighter than they are" in text
    assert "image 5" in text


def test_what_did_not_converge(page, one):
    failed = dataclasses.replace(
        one, converged=False, warnings=("the solver did not converge",)
    )
    text = words(page(failed, title="failed", diagnostics=failed.diagnose()))
    assert "NOT converged" in text and "1 warning " in text
    assert "The solver did not converge in" in text
    assert "There are none: the solver did not converge." in text


def test_written_whole_or_not_at_all(one, tmp_path):
    path = tmp_path / "report.html"
    write_page(path, one, title="first")
    before = path.read_text(encoding="utf-8")
    assert before.startswith("<!doctype html>") and before.rstrip().endswith("</html>")
    with pytest.raises(ValueError, match="names: expected 1, one an image, got 2"):
        write_page(path, one, title="second", names=["a", "b"])
    with pytest.raises(OSError, match="is a file, expected a folder"):
        write_page(path / "report.html", one, title="t")
    assert path.read_text(encoding="utf-8") == before
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_of_many_samples_there_are_few_profiles(one):
    many = dataclasses.replace(one, n_samples=2_000_000)
    pictures, about = profiles(many, many.diagnose())
    assert [shown["alt"].split()[2] for shown in pictures] == ["shininess:"]
    assert "all 2,000,000 samples" in about and about.startswith("1 of 3 are drawn")
    assert 'fit.plot_profile("specular.red") draws' in about
    endless = dataclasses.replace(one, n_samples=4_000_000)
    pictures, about = profiles(endless, endless.diagnose())
    assert pictures == [] and about.startswith("0 of 3 are drawn")
    assert 'fit.plot_profile("shininess") draws' in about
    course, about = convergence(endless, endless.diagnose())
    assert course is None and "Its course is not drawn" in about
    matte = dataclasses.replace(endless, unidentified=np.ones(10, bool))
    about = profiles(matte, matte.diagnose())[1]
    assert about == "There are none: no unknown is identified."


@pytest.mark.parametrize(
    "label, expected",
    [
        ("diffuse.red", "reflectance, 0 … 1"),
        ("ambient[2].red", "reflectance, 0 … 1"),
        ("shininess[1]", "exponent"),
        ("emission", "light, white = 1"),
        ("exposure[3]", "factor"),
        ("scene.lights[0].direction.x", "unit vector"),
        ("scene.lights[0].position.z", "world units"),
        ("scenes[1].lights[0].intensity.red", "light, white = 1"),
        ("scene.ambient.red", "light, white = 1"),
        ("scene.lights[0].cutoff", "degrees"),
        ("scene.lights[0].attenuation[1]", "per world unit and its square"),
        ("scene.fog.density", "per world unit"),
        ("scene.camera.fx", "pixels"),
        ("scene.camera.distortion.k1", "coefficient of the lens"),
        ("scene.lights[0].coefficients[3,1]", "light, white = 1"),
    ],
)
def test_units(label, expected):
    assert unit(label) == expected


def test_words_in_a_row():
    assert listed(["a"]) == "a"
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert listed(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"


def test_what_was_known_in_words(one):
    assert known_words(one) == "nothing"
    box = "ambient, diffuse and specular 0 … 1; shininess 1 … 1000"
    assert bounds_words(one) == box


@pytest.mark.extended
def test_what_else_was_known_in_words(held):
    assert known_words(held) == (
        "held: diffuse.blue; tied: specular.blue; with a prior: diffuse.green"
    )
    assert "diffuse 0.1 … 0.9" in bounds_words(held)
