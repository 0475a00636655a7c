"""What a notebook shows of fits, materials and scenes."""

import base64
import io
import re

import matplotlib.image
import numpy as np

import phongfit as pf
from data_synth import make_lights
from phongfit.material import PRESETS, stack_materials


def pictures(html: str) -> list[np.ndarray]:
    """The pictures in a piece of HTML, (H, W, 3 or 4)."""
    codes = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return [
        matplotlib.image.imread(io.BytesIO(base64.b64decode(code)), format="png")
        for code in codes
    ]


def test_a_fit(one, open_fit):
    html = one._repr_html_()
    assert len(pictures(html)) == 1 and html.count("<tr") == 1 + len(one.labels)
    assert "shininess" in html and "converged after" in html
    assert "⚠" not in html
    html = open_fit._repr_html_()
    assert html.count("⚠") == len(open_fit.warnings) and "not identifiable" in html


def test_a_material_looks_like_itself():
    html = pf.Material((0.8, 0.1, 0.1), 0.0, 30.0, 0.2)._repr_html_()
    (ball,) = pictures(html)
    assert "0.8, 0.1, 0.1" in html and "30" in html
    # Nothing around the ball, and the ball is red.
    assert ball[0, 0, 3] == 0 and ball[72, 72, 3] == 1
    assert ball[60, 60, 0] > 2 * ball[60, 60, 1]


def test_several_materials_and_maps():
    every = stack_materials([pf.preset(name) for name in PRESETS[:10]])
    html = every._repr_html_()
    assert len(pictures(html)) == 8 and "and 2 more materials" in html
    ramp = np.linspace(0, 1, 600).reshape(1, 600, 1) * np.ones((20, 1, 3))
    html = pf.Material(ramp, 0.1, 100 * ramp[..., :1] + 1)._repr_html_()
    assert "0 … 1" in html and "1 … 101" in html
    diffuse, shininess = pictures(html)
    assert diffuse.shape[1] <= 240 and shininess.shape[:2] == diffuse.shape[:2]


def test_a_scene_lists_its_lights():
    corners = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    plate = pf.Mesh(np.array(corners, float), [(0, 1, 2), (0, 2, 3)])
    scene = pf.Scene(
        plate,
        pf.PerspectiveCamera(48, 32, position=(2, 1.5, 4)),
        make_lights(14, "mixed"),
        ambient=(0.1, 0.2, 0.3),
        fog=pf.Fog(0.4),
        shadows=True,
    )
    html = scene._repr_html_()
    assert "Mesh, 2 faces" in html and "PerspectiveCamera, 48 × 32 pixels" in html
    assert html.count("SpotLight") + html.count("PointLight") > 2
    assert "and 2 more lights" in html and "0.1, 0.2, 0.3" in html and "exp" in html
    (shape,) = pictures(html)
    assert shape.shape == (32, 48, 4)
    cover, mask = shape[..., 3], np.asarray(scene.trace().mask)
    assert mask[cover == 1].all() and not mask[cover == 0].any()
    # The outline is smooth.
    assert {0, 1} < set(np.unique(cover)) and (cover == 1).sum() > 0.7 * mask.sum()


def test_a_dark_scene():
    assert "no light" in pf.Scene(pf.Sphere())._repr_html_()
