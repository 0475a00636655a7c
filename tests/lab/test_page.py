"""The page, as a user moves it: headless Chromium by Playwright."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

import phongfit as pf

pytestmark = pytest.mark.extended

# The mean colour of the picture.
MEAN = """async () => {
  const image = document.querySelector("#picture img");
  await image.decode();
  const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
  const sums = [0, 0, 0];
  for (let k = 0; k < data.length; k++) if (k % 4 < 3) sums[k % 4] += data[k];
  return sums.map((sum) => sum / (data.length / 4));
}"""
# From the slider's event to the new picture, decoded.
MOVE = """async ([name, value]) => {
  const slider = document.querySelector(`input[type=range][name="${name}"]`);
  const image = document.querySelector("#picture img");
  const shown = new Promise((done, fail) => {
    image.addEventListener("load", done, { once: true });
    setTimeout(() => fail(new Error("no new picture within 60 s")), 60_000);
  });
  slider.value = value;
  slider.dispatchEvent(new Event("input", { bubbles: true }));
  await shown;
  await image.decode();
}"""


@pytest.fixture(scope="module")
def opened(browser, port):
    """The page at the width of a desk, where no script may fail or ask elsewhere."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    failures, asked = [], []
    page.on("pageerror", lambda error: failures.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"http://127.0.0.1:{port}/")
    _settle(page)
    yield page
    page.close()
    assert failures == []
    ours = (f"http://127.0.0.1:{port}/", f"blob:http://127.0.0.1:{port}/", "data:")
    assert [url for url in asked if not url.startswith(ours)] == []


@pytest.fixture
def page(opened):
    """The page as it was at the start, but for what is loaded."""
    opened.click("#reset")
    if opened.locator("#sphere").is_visible():
        opened.click("#sphere")
    return opened


def _settle(page) -> None:
    """Wait until the picture shows what the sliders say."""
    page.locator("#picture[aria-busy=false]").wait_for()


def _move(page, name: str, value: float) -> None:
    _settle(page)
    page.evaluate(MOVE, [name, str(value)])


def _mean(page) -> np.ndarray:
    _settle(page)
    return np.array(page.evaluate(MEAN))


def test_sliders_move_the_picture(page):
    before = _mean(page)
    page.uncheck("[data-group=material] .colour:nth-of-type(1) .tie input")
    _move(page, "diffuse.red", 0.1)
    less_red = _mean(page)
    assert less_red[0] < before[0] - 5
    np.testing.assert_allclose(less_red[1:], before[1:], atol=0.01)
    assert page.input_value("[aria-label='diffuse, red, as a number']") == "0.1"
    _move(page, "azimuth", 180)
    assert (_mean(page) < less_red - 5).all()
    page.click("#reset")
    np.testing.assert_allclose(_mean(page), before, atol=0.01)


def test_the_keyboard_is_enough(page):
    page.focus("input[type=range][name=shininess]")
    page.keyboard.press("Home")
    number = page.get_by_label("exponent, as a number").first
    assert number.input_value() == "1"
    page.keyboard.press("Tab")
    page.keyboard.type("5000")
    page.keyboard.press("Tab")
    assert number.input_value() == "1000"
    page.select_option("#preset", "brass")
    assert page.input_value("[aria-label='diffuse, red, as a number']") == "0.78"


def test_only_what_matters_is_shown(page):
    assert not page.is_visible("input[name=cutoff]")
    page.check("input[name=light][value=spot]")
    assert page.is_visible("input[name=cutoff]")
    page.check("input[name=light][value=none]")
    assert not page.is_visible("input[name=azimuth]")


def test_flat_faces_need_triangles(page):
    before = _mean(page)
    page.check("input[name=shading][value=flat]")
    page.locator("#surface-name", has_text="Sphere, cut into triangles").wait_for()
    assert not np.allclose(_mean(page), before, atol=0.01)
    page.click("#reset")
    assert page.inner_text("#surface-name") == "Sphere"


def test_a_fit_with_one_press(page):
    page.fill("#noise", "0.01")
    page.click("#make")
    page.locator("#target-figure").wait_for()
    page.click("#fit")
    page.locator("#result").wait_for(timeout=120_000)
    rows = page.locator("#result tbody tr")
    assert rows.count() == 10
    for row in rows.all():
        _, truth, value, error, off, note = row.locator("th, td").all_inner_texts()
        assert abs(float(value) - float(truth)) < 4 * float(error.removeprefix("± "))
        assert off.endswith("σ") and note == ""
    assert "Converged" in page.inner_text("#head")
    assert page.is_visible("#residual-figure") and page.is_visible("#fitted-figure")
    assert page.locator(".ends span").first.inner_text().startswith("−0.0")
    page.click("#take")
    shininess = page.input_value("[aria-label='exponent, as a number'] >> nth=0")
    assert 50 < float(shininess) < 70 and shininess != "60"
    page.click("#back")
    shininess = page.input_value("[aria-label='exponent, as a number'] >> nth=0")
    assert shininess == "60" and page.locator("#back").is_hidden()
    page.click("#drop")
    assert page.locator("#result").is_hidden() and page.locator("#fit").is_disabled()


def test_a_fit_of_another_target_is_not_shown(page):
    """The answer to a fit comes late: after another target was made, or a cancel."""
    waiting = []
    page.route("**/api/fit", lambda route: waiting.append(route))
    try:
        page.click("#make")
        page.locator("#target-figure").wait_for()
        page.click("#fit")
        page.locator("#cancel").wait_for()
        page.click("#make")
        page.locator("#cancel").wait_for(state="hidden")
        assert page.is_enabled("#fit") and page.inner_text("#state") == ""
        page.click("#fit")
        page.click("#cancel")
        assert page.is_enabled("#fit") and page.inner_text("#state") == "Cancelled."
        assert page.is_hidden("#problem") and page.is_hidden("#result")
    finally:
        page.unroute("**/api/fit")
        page.click("#drop")
    assert len(waiting) == 2


def test_the_focus_is_never_behind_the_pictures(page):
    try:
        for width, height in ((1440, 500), (390, 700)):
            page.set_viewport_size({"width": width, "height": height})
            _settle(page)
            names = page.locator("input[type=range]:visible")
            names.last.focus()
            names.first.focus()
            box = names.first.bounding_box()
            view = page.locator("#view").bounding_box()
            beside = box["x"] + box["width"] < view["x"]
            assert beside or box["y"] >= view["y"] + view["height"] - 1
    finally:
        page.set_viewport_size({"width": 1440, "height": 900})


def test_a_mesh_is_loaded(page, tmp_path):
    before = _mean(page)
    path = tmp_path / "ring.obj"
    trimesh.creation.torus(0.7, 0.25).export(path)
    page.set_input_files("#mesh", path)
    page.locator("#surface-name", has_text="ring.obj, 2,048 faces").wait_for()
    _move(page, "tilt", 50)
    assert (_mean(page) < before - 5).all()


def test_the_outline_lies_over_the_photograph(page, tmp_path):
    pf.write_image(tmp_path / "dark.png", np.full((40, 60, 3), 0.05), "srgb")
    page.select_option("#encoding", "srgb")
    page.set_input_files("#photograph", tmp_path / "dark.png")
    try:
        page.locator("#target-figure figcaption", has_text="brighter").wait_for()
        for figure in ("#picture", "#fitted-figure"):
            words = page.locator(f"{figure} .brightened").text_content()
            assert re.fullmatch(r"shown [\d.]+ × brighter, like the target", words)
        page.locator("#outline path[d^=M]").wait_for(state="attached")
        _move(page, "radius", 20)
        _settle(page)
        image = page.locator("#target-figure img").bounding_box()
        drawn = page.evaluate(
            "(e => [e.width, e.height])"
            "(document.querySelector('#outline path').getBoundingClientRect())"
        )
        # Its radius is a fifth of the height, which is two thirds of the width.
        across = 2 * 0.2 * image["width"] * 40 / 60
        np.testing.assert_allclose(drawn, across, atol=4)
    finally:
        page.click("#drop")


def test_files_that_cannot_be_read(page, tmp_path):
    problem = page.locator("#problem span")
    for field, name, content in (
        ("#mesh", "bad.obj", "v 1 2\nf 1 2 3\n"),
        ("#photograph", "bad.png", "no picture"),
    ):
        path = Path(tmp_path, name)
        path.write_text(content)
        page.select_option("#encoding", "srgb")
        page.set_input_files(field, path)
        page.locator("#problem", has_text=name).wait_for()
        assert problem.inner_text().startswith(f"{name}: ")
        assert "\n" not in problem.inner_text()
    # The page is alive.
    before = _mean(page)
    _move(page, "azimuth", -90)
    assert not np.allclose(_mean(page), before, atol=0.1)
    page.click("#problem button")
    assert not page.is_visible("#problem")


def test_a_fit_is_in_sight_on_a_phone(page):
    try:
        page.set_viewport_size({"width": 390, "height": 844})
        page.click("#make")
        page.locator("#target-figure").wait_for()
        page.click("#fit")
        page.locator("#result").wait_for(timeout=120_000)
        for name in ("#target-figure", "#fitted-figure", "#residual-figure"):
            box = page.locator(name).bounding_box()
            assert box["y"] >= -1 and box["y"] + box["height"] <= 845, name
        # The table follows them.
        assert page.locator("#result").bounding_box()["y"] >= box["y"] + box["height"]
    finally:
        page.click("#drop")
        page.set_viewport_size({"width": 1440, "height": 900})


def test_it_fits_on_a_phone(page):
    try:
        for width in (360, 800, 1440):
            page.set_viewport_size({"width": width, "height": 800})
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width
            assert page.locator("#picture img").bounding_box()["width"] > 120
    finally:
        page.set_viewport_size({"width": 1440, "height": 900})
