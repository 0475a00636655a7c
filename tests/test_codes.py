"""Codes of warnings: one table, one paragraph each, and no warning without."""

import ast
import re
import warnings
from email.message import Message
from pathlib import Path

import pytest

import phongfit as pf
from phongfit.codes import PAGE as PARAGRAPHS, REMEDIES, _site, coded, paragraph, warn
from phongfit.report.html import linked

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "phongfit").rglob("*.py"))
PAGE = ROOT / "docs/how-to/warnings.md"


def test_a_warning_names_its_remedy_and_its_code():
    words = coded("degenerate", "a, b are degenerate")
    assert words == f"a, b are degenerate. {REMEDIES['degenerate']} [degenerate]"
    assert pf.warning_code(words) == "degenerate"
    other = coded("at-bound", "f lies at its bound", "Try bounds={'f': (1, 5)}")
    assert other == "f lies at its bound. Try bounds={'f': (1, 5)} [at-bound]"
    for words in ("the solver did not converge", "scene.lights[0] is far [1]", ""):
        assert pf.warning_code(words) is None
    with pytest.raises(KeyError):
        coded("full-moon", "the moon is full")


def test_python_silences_them_by_code():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r".*\[texture-unread\]$")
        warn("texture-unread", "a.mtl: line 3: a texture", stacklevel=1)
        with pytest.warns(UserWarning, match="b.mtl.* missing") as said:
            warn("part-unused", "b.mtl: it is missing", stacklevel=1)
    assert pf.warning_code(said[0].message) == "part-unused"


def test_a_warning_is_where_it_was_called():
    with pytest.warns(UserWarning, match="b.mtl.* missing") as said:
        warn("part-unused", "b.mtl: it is missing", stacklevel=1)
    assert said[0].filename == __file__


def test_every_code_has_a_paragraph():
    text = PAGE.read_text(encoding="utf-8")
    found = re.findall(r"^### (\S+)\n\n(\S.*)$", text, re.MULTILINE)
    assert sorted(code for code, _ in found) == sorted(REMEDIES)
    assert len(re.findall("^### ", text, re.MULTILINE)) == len(found)


def test_codes_and_remedies_are_of_one_form():
    for code, remedy in REMEDIES.items():
        assert pf.warning_code(f"words [{code}]") == code
        assert remedy[0].isupper() and not remedy.endswith("."), code


def test_a_code_leads_to_its_paragraph(monkeypatch):
    """On the site whose address the package states; else in the sources."""
    stated = {"Documentation": "https://example.org/phongfit/", "Source": "https://b.c"}
    for urls, place in (
        (stated, "https://example.org/phongfit/how-to/warnings.html#at-bound"),
        ({}, "docs/how-to/warnings.md#at-bound"),
    ):
        message = Message()
        for name, url in urls.items():
            message["Project-URL"] = f"{name}, {url}"
        monkeypatch.setattr("importlib.metadata.metadata", lambda _, m=message: m)
        _site.cache_clear()
        assert paragraph("at-bound") == place
        html = linked(coded("at-bound", "f < 1000 & so on", "Try it"))
        assert place in html and html.startswith("f &lt; 1000 &amp; so on. Try it <")
        assert ("<a href=" in html) == bool(urls)
    _site.cache_clear()
    assert linked("a sentence without one") == "a sentence without one"
    assert (ROOT / PARAGRAPHS) == PAGE


def codes_of(path: Path) -> set[str]:
    """The words of a module that are codes."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    found = {node.value for node in nodes if isinstance(node, ast.Constant)}
    return {one for one in found if isinstance(one, str)} & set(REMEDIES)


def test_every_code_is_given_by_someone():
    others = [path for path in SOURCES if path.name != "codes.py"]
    assert set().union(*map(codes_of, others)) == set(REMEDIES)


def test_no_warning_goes_without_a_code():
    # Lists of warnings are checked by the tests of the results that hold them, and
    # deprecations, which `moved.py` makes, have no code.
    others = [path for path in SOURCES if path.name not in ("codes.py", "moved.py")]
    bare = [path for path in others if "warnings.warn(" in path.read_text("utf-8")]
    assert bare == []
