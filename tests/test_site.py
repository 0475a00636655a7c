"""The site, built and read in a browser from the file system, wide and on a phone."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from phongfit.codes import REMEDIES

pytest.importorskip("material", reason="mkdocs-material is not installed here")

pytestmark = pytest.mark.extended
ROOT = Path(__file__).parents[1]
PAGES = ("index", "gallery", "how-to/capture", "explanation/model", "reference/formats")
WIDTHS = {"desktop": 1280, "phone": 375}
# What sticks out on the right, unless it scrolls within something.
STICKING_OUT = """() => [...document.querySelectorAll(".md-content *")]
    .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5)
    .filter(e => !e.closest("pre, math, .md-typeset__scrollwrap, p:has(> img)"))
    .map(e => e.tagName + " " + e.textContent.slice(0, 40))"""
BROKEN = "() => [...document.images].filter(i => !i.naturalWidth).map(i => i.src)"
SHADES = r"""() => { const style = getComputedStyle(document.body);
    const ink = getComputedStyle(document.querySelector(".md-content p")).color;
    return [ink, style.backgroundColor]
        .map(colour => colour.match(/\d+/g).slice(0, 3).map(Number))
        .map(rgb => rgb[0] + rgb[1] + rgb[2]); }"""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    words = ["build", "--strict", "--quiet", "--site-dir", f"{folder}"]
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *words],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture
def opened(browser):
    """A window of some width; in the end nothing may have been complained of."""
    windows, heard = [], []

    def open_window(width: int, scheme: str = "light"):
        size = {"width": width, "height": 900}
        window = browser.new_page(viewport=size, color_scheme=scheme)
        windows.append(window)
        window.on("console", lambda message: heard.append(message.text))
        window.on("pageerror", lambda error: heard.append(str(error)))
        window.on("request", lambda request: heard.append(request.url))
        return window

    yield open_window
    for window in windows:
        window.close()
    assert [words for words in heard if not words.startswith(("file:", "data:"))] == []


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_pages_fit_their_window(site, opened, width):
    window = opened(width)
    for page in PAGES:
        window.goto((site / f"{page}.html").as_uri())
        assert window.evaluate("document.documentElement.scrollWidth") <= width
        assert window.evaluate(STICKING_OUT) == []
        assert window.evaluate(BROKEN) == []


def test_letters_can_be_read_in_the_dark(site, opened):
    for scheme, sign in (("light", 1), ("dark", -1)):
        window = opened(WIDTHS["desktop"], scheme)
        window.goto((site / "index.html").as_uri())
        ink, paper = window.evaluate(SHADES)
        assert sign * (paper - ink) > 250, scheme


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
def test_the_search_needs_no_network(site, opened, width):
    window = opened(width)
    window.goto((site / "index.html").as_uri())
    if width == WIDTHS["phone"]:
        window.click("header label[for=__search]")
    window.click("input.md-search__input")
    window.keyboard.type("degenerate")
    window.locator(".md-search-result__item").first.wait_for()
    found = window.locator(".md-search-result__link").all()
    assert any("how-to/warnings.html" in one.get_attribute("href") for one in found)


def test_warnings_lead_to_their_paragraphs(site):
    text = (site / "how-to/warnings.html").read_text(encoding="utf-8")
    assert set(REMEDIES) <= set(re.findall(r'<h3 id="([^"]+)"', text))


def test_nothing_is_fetched_from_elsewhere(site):
    scripts = r'<(?:script|link|img|iframe)[^>]+(?:src|href)="(https?:[^"]+)"'
    for page in site.rglob("*.html"):
        found = re.findall(scripts, page.read_text(encoding="utf-8"))
        assert found == [], page
