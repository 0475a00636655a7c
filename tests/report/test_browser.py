"""The page in a real browser, at the width of a desktop and of a phone."""

from pathlib import Path
from typing import Any

import pytest

from phongfit.report.page import write_page

pytestmark = pytest.mark.extended

WIDTHS = {"desktop": 1280, "phone": 375}
LONG = "a_photograph_with_a_very_long_name_" * 6 + ".png"
# Elements that stick out on the right, unless they scroll within something.
STICKING_OUT = """() => [...document.querySelectorAll("body *")]
    .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5)
    .filter(e => !e.closest(".scroll, pre"))
    .map(e => e.tagName + " " + e.textContent.slice(0, 40))"""
PICTURES = """() => [...document.images]
    .map(i => [i.complete && i.naturalWidth > 0, i.alt.trim().length])"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory, one, six) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    for name, fit, names in (("one", one, []), ("open", six, [LONG] * 6)):
        write_page(
            folder / f"{name}.html",
            fit,
            title=f"Report of {name}",
            names=names,
            assumptions={"encoding": "linear", LONG: LONG},
            command=f"phongfit fit {LONG}",
            diagnostics=one.diagnose() if fit is one else None,
        )
    return {path.stem: path for path in folder.iterdir()}


def opened(browser: Any, path: Path, width: int, **settings: Any) -> tuple[Any, list]:
    """A page in a window of some width, and all that it complained of or asked for."""
    window = browser.new_page(viewport={"width": width, "height": 800}, **settings)
    heard: list[str] = []
    window.on("console", lambda message: heard.append(message.text))
    window.on("pageerror", lambda error: heard.append(str(error)))
    window.on("request", lambda request: heard.append(request.url))
    window.goto(path.as_uri())
    asked = [words for words in heard if not words.startswith("data:")]
    return window, asked


@pytest.mark.parametrize("width", WIDTHS.values(), ids=WIDTHS)
@pytest.mark.parametrize("name", ["one", "open"])
def test_it_looks_right(browser, pages, name, width):
    window, heard = opened(browser, pages[name], width)
    assert heard == [pages[name].as_uri()], "no complaint, and nothing but the page"
    assert window.evaluate("document.documentElement.scrollWidth") <= width
    assert window.evaluate(STICKING_OUT) == []
    pictures = window.evaluate(PICTURES)
    assert len(pictures) >= 10
    assert all(loaded and words > 0 for loaded, words in pictures)
    window.close()


def test_wide_tables_scroll_within_themselves(browser, pages):
    window, _ = opened(browser, pages["one"], WIDTHS["phone"])
    wide = "e => [...document.querySelectorAll('.scroll')].map(s => s.scrollWidth)"
    assert max(window.evaluate(wide)) > WIDTHS["phone"]
    window.close()


def test_pictures_that_scroll_stand_apart(browser, pages):
    """As those of several textures, one below the other."""
    window, _ = opened(browser, pages["one"], WIDTHS["phone"])
    gap = window.evaluate("""() => { const one = document.querySelector(".scroll");
        const next = one.cloneNode(true);
        one.after(next);
        const [above, below] = [one, next].map(e => e.getBoundingClientRect());
        return below.top - above.bottom; }""")
    assert gap >= 8
    window.close()


def test_letters_can_be_read_in_the_dark(browser, pages):
    shades = {}
    for scheme in ("light", "dark"):
        window, _ = opened(browser, pages["one"], 1280, color_scheme=scheme)
        colours = "() => { const s = getComputedStyle(document.body);"
        colours += " return [s.color, s.backgroundColor]; }"
        shades[scheme] = [
            sum(int(part) for part in colour[4:-1].split(","))
            for colour in window.evaluate(colours)
        ]
        window.close()
    (ink, paper), (dark_ink, dark_paper) = shades["light"], shades["dark"]
    assert paper - ink > 400 and dark_ink - dark_paper > 400
