"""The page that relights: it draws what `relight` gives, in headless Chromium."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.result import ParameterMaps
from phongfit.report.viewer import octahedral
from tests.maps.hills import CAMERA, SIZE, made

LAMPS = ((0.0, 0.0, 1.0), (0.6, 0.3, 0.7), (-0.8, 0.3, 0.3), (0.1, -0.9, 0.4))
PINHOLE = pf.PerspectiveCamera(40, 32, fov_y=35.0, position=(0, 0, 5))


def shiny(camera: pf.geometry.AbstractCamera = CAMERA) -> pf.Maps:
    """The hills, each pixel with an exponent of its own, and some of them outside."""
    rng = np.random.default_rng(1)
    flags = np.zeros(SIZE, int)
    flags[-4:, :7] = int(pf.Flag.OUTSIDE)
    return dataclasses.replace(
        made(camera),
        shininess=np.exp(rng.uniform(np.log(4), np.log(200), (*SIZE, 1))),
        flags=flags,
    )


def opened(browser, path: Path, **settings):
    """The page, and all that it complained of or asked for."""
    page = browser.new_page(**settings)
    heard: list[str] = []
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on("request", lambda request: heard.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_function("globalThis.phongfit || !problem.hidden")
    # What a driver says of its speed is no complaint of the page.
    return page, [
        w for w in heard if not w.startswith("data:") and "GPU stall" not in w
    ]


@pytest.mark.extended
@pytest.mark.parametrize(
    "camera, model",
    [
        (CAMERA, pf.BlinnPhong()),
        (CAMERA, pf.Phong()),
        (PINHOLE, pf.BlinnPhong(normalized=True)),
    ],
)
def test_it_draws_what_relight_gives(browser, tmp_path, camera, model):
    """Within 2 of 255 on 99 % of the pixels, with shadows and without."""
    maps = dataclasses.replace(shiny(camera), specular_model=model)
    path = tmp_path / "page.html"
    pf.write_view(path, maps, title="hills")
    page, asked = opened(browser, path)
    assert asked == [path.as_uri()], "no complaint, and nothing but the page"
    world = np.asarray(camera.rotation)
    film = pf.Film(encoding="srgb", bits=8)
    for shadows in (True, False):
        lights = [pf.DirectionalLight(world @ np.array(lamp)) for lamp in LAMPS]
        wanted = maps.relight(lights, shadows=shadows, film=film)
        for lamp, expected in zip(LAMPS, wanted, strict=True):
            rows = page.evaluate(
                "([lamp, shadows]) => phongfit.relight(lamp, shadows)",
                [list(lamp), shadows],
            )
            drawn = np.array(rows).reshape(*SIZE, 4)[..., :3]
            off = np.abs(drawn - 255 * expected).max(axis=-1)
            assert np.mean(off <= 2.01) >= 0.99, (lamp, shadows, np.sort(off.ravel()))
            assert drawn.std() > 10
    page.close()


@pytest.mark.extended
def test_no_light_leaks_through_ridges(browser, tmp_path):
    """Of a rough surface under low lamps: between rows and columns as well."""
    maps = shiny()
    rough = maps.normals + 0.35 * np.random.default_rng(0).normal(size=(*SIZE, 3))
    rough /= np.linalg.norm(rough, axis=-1, keepdims=True)
    maps = dataclasses.replace(maps, normals=rough)
    path = tmp_path / "page.html"
    pf.write_view(path, maps, title="rough")
    page, _ = opened(browser, path)
    film = pf.Film(encoding="srgb", bits=8)
    lamps = [(-0.7, 0.6, 0.25), (0.3, -0.9, 0.3)]
    wanted = maps.relight([pf.DirectionalLight(x) for x in lamps], film=film)
    for lamp, expected in zip(lamps, wanted, strict=True):
        rows = page.evaluate("(lamp) => phongfit.relight(lamp, true)", list(lamp))
        drawn = np.array(rows).reshape(*SIZE, 4)[..., :3]
        # With columns or rows alone 1.1 % and 0.5 % of the pixels were too bright.
        assert np.mean((drawn - 255 * expected).max(axis=-1) > 20) < 0.0045
    page.close()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "hills.html"
    pf.write_view(path, shiny(), title="hills </script> & more")
    return path


@pytest.mark.extended
def test_pointer_and_keys_move_the_lamp(browser, written):
    page, _ = opened(browser, written, viewport={"width": 900, "height": 600})
    assert page.inner_text("h1") == "hills </script> & more"

    def where() -> str:
        return page.inner_text("#where")

    before = where()
    box = page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert where().startswith("90°") and where() != before
    page.mouse.move(box["x"] + box["width"] / 2 + 150, box["y"] + box["height"] / 2)
    # Half a radius to the right: 60° up.
    assert where() == "60° up, 0° round"
    page.focus("#stage")
    page.keyboard.press("ArrowRight")
    assert where() == "57° up, 0° round"
    assert page.is_checked("#shadows")
    page.keyboard.press("s")
    assert not page.is_checked("#shadows")
    page.keyboard.press("v")
    assert page.input_value("#view") == "normals"
    assert page.is_hidden("#legend")
    page.select_option("#view", "exponent")
    ends = page.inner_text("#least"), page.inner_text("#most")
    assert 3.9 < float(ends[0]) < 6 and 180 < float(ends[1]) < 201
    page.keyboard.press("0")
    assert page.input_value("#view") == "light" and where() == before
    size = "() => picture.getBoundingClientRect().width"
    wide = page.evaluate(size)
    page.keyboard.press("+")
    assert page.evaluate(size) == pytest.approx(1.25 * wide, rel=0.01)
    page.mouse.wheel(0, -600)
    page.wait_for_function(f"({size})() > {3 * wide}")
    page.click("#reset")
    assert page.evaluate(size) == pytest.approx(wide)
    page.close()


@pytest.mark.extended
def test_a_finger_moves_the_lamp(browser, written):
    page, _ = opened(
        browser,
        written,
        viewport={"width": 375, "height": 700},
        has_touch=True,
        is_mobile=True,
    )
    before = page.inner_text("#where")
    box = page.locator("#stage").bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert page.inner_text("#where").startswith("90°") and before[:3] != "90°"
    assert page.evaluate("document.documentElement.scrollWidth") <= 375
    assert box["height"] > 250
    page.close()


def test_octahedral_normals():
    """Twelve bits tell normals to a twentieth of a degree."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20, 30, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    high, low = np.split(octahedral(normals).astype(int), [2], axis=-1)
    levels = high * 16 + np.concatenate([low >> 4, low & 15], axis=-1)
    flat = levels / 4095 * 2 - 1
    up = 1 - np.abs(flat).sum(axis=-1, keepdims=True)
    folded = (1 - np.abs(flat[..., ::-1])) * np.where(flat < 0, -1, 1)
    found = np.concatenate([np.where(up < 0, folded, flat), up], axis=-1)
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    cosine = np.clip((found * normals).sum(axis=-1), -1, 1)
    assert np.rad2deg(np.arccos(cosine)).max() < 0.05


@pytest.mark.extended
def test_a_megapixel_is_small(tmp_path):
    """Noisy maps, of a shape that is not smooth: below 10 MB."""
    small, rng = made(), np.random.default_rng(0)
    size = (1000, 1000)
    y, x = np.mgrid[:1000, :1000] / 10
    height = 8 * np.sin(x / 3) * np.cos(y / 4) + 0.3 * np.sin(3 * x + y)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones(size)], axis=-1)
    normals += 0.003 * rng.normal(size=normals.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    texture = 0.4 + 0.2 * np.sin(x)[..., None] * np.cos(y)[..., None] * [1, 0.8, 0.6]

    def noisy(array: np.ndarray, share: float) -> np.ndarray:
        return array * (1 + share * rng.normal(size=size)[..., None])

    camera = pf.OrthographicCamera(1000, 1000)
    zeros = np.zeros(size)
    maps = dataclasses.replace(
        small,
        camera=camera,
        normals=normals,
        ambient=0 * texture,
        diffuse=noisy(texture, 0.01),
        specular=noisy(0.3 + 0 * texture, 0.03),
        shininess=noisy(np.full((*size, 1), 40.0), 0.05),
        stderr=ParameterMaps(0 * texture, 0 * texture, 0 * texture, texture[..., :1]),
        flags=zeros.astype(int),
        noise=np.full(size, 0.01),
        samples=np.full(size, 90),
        normals_stderr=zeros,
        depth=5 - height,
    )
    surface = pf.geometry.HeightField(height, np.ones(size, int), camera)
    path = tmp_path / "large.html"
    pf.write_view(path, maps, surface=surface)
    assert path.stat().st_size < 10e6


def test_a_model_of_ones_own_is_refused(tmp_path):
    with pytest.raises(ValueError, match="specular_model: expected Phong or Blinn"):
        pf.write_view(
            tmp_path / "a.html", dataclasses.replace(made(), specular_model=None)
        )
    assert not (tmp_path / "a.html").exists()
