"""OpenGL itself draws with the parameters that phongfit hands it: Mesa, off screen.

In a process of its own, since PyOpenGL fixes its platform when it is first imported.
"""

import ctypes.util
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import phongfit as pf
from experiments import textured_object
from phongfit.material import stack_materials
from tests.files import opengl_context
from tests.helpers import known

ROOT = Path(__file__).parents[2]
SIZE = 96
# How many scenes there are, which take long to make.
PLAIN, TEXTURED = 7, 8
missing = [
    what
    for what, there in (
        ("PyOpenGL", importlib.util.find_spec("OpenGL")),
        ("libosmesa6", ctypes.util.find_library("OSMesa")),
    )
    if not there
]
needs_mesa = pytest.mark.skipif(
    bool(missing), reason=f"{' and '.join(missing)} not installed"
)


def scenes():
    """Scenes with their materials, between them all of what OpenGL can do."""
    torus = pf.shapes.Torus().mesh(48, 24)
    ball = pf.shapes.Ball(0.8).mesh(48, 24)
    pair = pf.geometry.join([torus, ball])
    tube = pf.shapes.Cylinder(0.6, 1.4).mesh(48, 24, two_sided=True)
    near_view = pf.PerspectiveCamera.look_at(
        (1, 2, 3), width=SIZE, height=SIZE, fov_y=40
    )
    parallel = pf.OrthographicCamera.look_at((1, 2, 3), width=SIZE, height=SIZE)
    lights = (
        # No vertex at the horizon, where the highlight is there or not by rounding.
        pf.DirectionalLight((1, 0.9, 0.3), (0.3, 0.2, 0.1), specular=0.4, ambient=0.05),
        pf.PointLight((0, 1, 3), 0.6, attenuation=(0.5, 0.1, 0.05)),
        pf.SpotLight((1, 2, 2), (-1, -2, -2), 0.7, cutoff=25, exponent=3),
    )
    shiny = pf.Material((0.6, 0.3, 0.2), 0.5, 40.0, 0.4, (0.02, 0.01, 0.03))
    two = stack_materials([shiny, pf.preset("brass")])
    smooth, flat = pf.GouraudShading(clamp=True), pf.FlatShading("last_vertex", True)
    bright = pf.Material(1.0, 1.0, 5.0, 1.0)
    return [
        (
            pf.Scene(torus, near_view, lights, 0.2, shading=smooth, background=0.1),
            shiny,
        ),
        (pf.Scene(torus, near_view, lights, 0.2, shading=flat), shiny),
        (pf.Scene(pair, near_view, lights, 0.2, shading=smooth), two),
        (
            pf.Scene(
                pair,
                near_view,
                lights,
                0.2,
                shading=smooth,
                fog=pf.Fog((0.3, 0.4, 0.5), "linear", start=2, end=5),
                local_viewer=False,
            ),
            two,
        ),
        (
            pf.Scene(
                ball,
                parallel,
                lights,
                0.3,
                shading=flat,
                fog=pf.Fog(0.4, "exp2", density=0.2),
            ),
            bright,
        ),
        (
            pf.Scene(
                torus,
                parallel,
                lights,
                shading=pf.GouraudShading(),
                fog=pf.Fog((0, 0.1, 0), density=0.1),
                local_viewer=True,
            ),
            bright,
        ),
        (pf.Scene(tube, near_view, lights, 0.2, shading=smooth), shiny),
    ]


def textured_scenes():
    """A curved and a tilted flat surface, by both filters and both ways to go on."""
    values = np.random.default_rng(0).uniform(0.05, 0.95, (24, 16, 3))
    camera = pf.PerspectiveCamera.look_at((1, 2, 3), width=SIZE, height=SIZE, fov_y=40)
    lights = (
        pf.DirectionalLight((1, 0.9, 0.3), (0.5, 0.4, 0.4), ambient=0.05),
        pf.PointLight((0, 1, 3), 0.4),
    )
    material = pf.Material(0.6, 0.15, 40.0, 0.4, (0.02, 0.01, 0.03))
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    # More than one image, and none that ends at an edge.
    places = np.array([[-0.3, 1.6], [1.4, 1.6], [1.4, -0.4], [-0.3, -0.4]])
    vase = textured_object.vase(48, 24)
    made = []
    for filter in ("bilinear", "nearest"):
        for wrap in ("repeat", "clamp"):
            texture = pf.Texture(values, filter, wrap)
            all_but = pf.Textures(diffuse=texture, ambient=texture, emission=texture)
            flat = pf.Mesh(corners, faces, uv=places[faces], textures=all_but)
            round_ = pf.Mesh(
                vase.vertices,
                vase.faces,
                vase.normals,
                uv=known(vase.uv) * 1.7 - 0.3,
                textures=all_but,
            )
            for mesh in (flat, round_):
                shading = pf.GouraudShading()
                made.append(
                    (pf.Scene(mesh, camera, lights, 0.2, shading=shading), material)
                )
    return made


def draw_all(out: str) -> None:
    """Have Mesa draw every scene, and save the images: run in a process of its own."""
    from OpenGL import osmesa

    gl = opengl_context._gl()
    context = osmesa.OSMesaCreateContextExt(osmesa.OSMESA_RGBA, 32, 0, 0, None)
    buffer = np.zeros((SIZE, SIZE, 4), np.float32)
    assert osmesa.OSMesaMakeCurrent(context, buffer, gl.GL_FLOAT, SIZE, SIZE)
    gl.glClampColor(gl.GL_CLAMP_FRAGMENT_COLOR, gl.GL_FALSE)
    images, plain, textured = [], scenes(), textured_scenes()
    assert (len(plain), len(textured)) == (PLAIN, TEXTURED)
    for scene, material in [*plain, *textured]:
        opengl_context.apply_scene(scene, near=0.5, far=10)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT | gl.GL_DEPTH_BUFFER_BIT)
        mesh = scene.surface
        assert isinstance(mesh, pf.Mesh)
        bare = mesh.textures is None
        draw = opengl_context.draw_mesh if bare else opengl_context.draw_textured
        draw(mesh, material)
        gl.glFinish()
        assert gl.glGetError() == gl.GL_NO_ERROR
        images.append(buffer[::-1, :, :3].copy())
    np.savez(out, *images)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    out = tmp_path_factory.mktemp("opengl") / "images.npz"
    code = f"from {__name__} import draw_all; draw_all({str(out)!r})"
    subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYOPENGL_PLATFORM": "osmesa"},
        cwd=ROOT,
        check=True,
    )
    with np.load(out) as images:
        return [images[name] for name in images.files]


@pytest.mark.extended
@needs_mesa
@pytest.mark.parametrize("number", range(PLAIN))
def test_opengl_sees_what_phongfit_does(drawn, number):
    scene, material = scenes()[number]
    gbuffer = scene.trace()
    film = pf.Film(clamp=scene.shading.clamp)
    image = np.asarray(pf.render(scene, material, film=film, gbuffer=gbuffer))
    error = abs(image - drawn[number]).max(axis=-1)
    assert np.median(error) < 1e-6
    # A pixel whose centre lies on an edge may fall to either side.
    assert (error < 1e-4).mean() > 0.995
    mask = np.asarray(gbuffer.mask)
    assert 0.1 < mask.mean() < 0.9
    assert (error[mask] < 1e-4).mean() > 0.99
    assert np.std(drawn[number][mask]) > 0.02, "there is something to see"


@pytest.mark.extended
@needs_mesa
@pytest.mark.parametrize("number", range(TEXTURED))
def test_opengl_looks_textures_up_as_phongfit_does(drawn, number):
    scene, material = textured_scenes()[number]
    gbuffer = scene.trace()
    image = np.asarray(pf.render(scene, material, gbuffer=gbuffer))
    theirs = drawn[PLAIN + number]
    # Where both see the surface: which does at an edge is no matter of its texture.
    covered = np.asarray(gbuffer.mask) & (theirs.max(axis=-1) > 0)
    assert covered.mean() > 0.1
    error = abs(image - theirs).max(axis=-1)[covered]
    assert (error <= 1 / 255).mean() >= 0.999, np.quantile(error, [0.5, 0.99, 0.999])
    assert np.median(error) < 1e-5
    assert np.std(theirs[covered]) > 0.05, "there is something to see"
