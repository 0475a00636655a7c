"""Calls of the library with one wrong argument: it works, or the argument is named."""

import contextlib
import decimal
import fractions
import functools
import io
import os
import pathlib
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.cli import main
from tests.campaign.cases import Case, Kind, Wrong


class _Hostile:
    """Whatever it is asked for, it fails in a way of its own."""

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        raise RuntimeError("no array today")

    def __repr__(self) -> str:
        raise RuntimeError("no words today")

    def __bool__(self) -> bool:
        raise RuntimeError("neither")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("incomparable")

    __hash__ = None  # pyright: ignore


@functools.cache
def _parts() -> dict[str, Any]:
    """Good arguments, of which each call gets some: made once a process."""
    import phongfit as pf

    camera = pf.OrthographicCamera(8, 8)
    light = pf.DirectionalLight((1, 1, 2))
    scene = pf.Scene(pf.Sphere(), camera, light, 0.3)
    material = pf.Material((0.6, 0.3, 0.2), 0.3, 20.0, 0.5)
    image = np.asarray(pf.render(scene, material), np.float32)
    gbuffer = scene.trace()
    mesh = pf.shapes.Ball().mesh(6, 4)
    return {
        "camera": camera,
        "light": light,
        "scene": scene,
        "material": material,
        "image": image,
        "gbuffer": gbuffer,
        "mesh": mesh,
        "terms": pf.terms(scene, gbuffer),
        "fit": pf.fit(scene, image),
        "film": pf.Film(),
    }


@functools.cache
def _calls() -> list[partial[Any]]:
    """Every public function and class that a user calls, with good arguments."""
    import phongfit as pf
    from phongfit.material import stack_materials, unstack_materials
    from phongfit.reflectance import blinn_from_phong, phong_from_blinn

    p = _parts()
    scene, image, material = p["scene"], p["image"], p["material"]
    fit, mesh, camera, light = p["fit"], p["mesh"], p["camera"], p["light"]
    film, seen, lights = p["film"], p["gbuffer"], (light,)
    place = dict(position=(0, 0, 3), attenuation=(1, 0, 0))
    colours = dict(intensity=1.0, specular=1.0, ambient=0.1)
    flat = np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3))
    colourful = ("ambient", "diffuse", "specular")
    asked = dict(
        unknowns=(*colourful, "shininess"), per_channel=colourful, per_image=(),
        bounds={"shininess": (1, 500)}, fixed={"ambient": 0.5}, ties={}, priors={},
    )  # fmt: skip
    data = dict(scene=scene, image=image)
    more = dict(known=material, film=film, loss="linear", max_steps=50)
    weighed = dict(mask=np.ones((8, 8), bool), weights=1.0, noise=0.01)
    size = dict(width=8, height=8)
    stands = dict(position=(0, 0, 5), rotation=np.eye(3))
    looks = dict(position=(0, 0, 5), target=(0, 0, 0), up=(0, 1, 0))
    triangle = dict(vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces=[[0, 1, 2]])
    grazing = dict(folder="in", min_cosine=0.1, min_facing=0.1)

    number: Any = np.float32(3.0)
    three: Any = np.ones(3)

    def bumpy(u: Any, v: Any) -> Any:
        import jax.numpy as jnp

        return jnp.stack([u, v, u * v])

    return [
        partial(pf.Material, diffuse=0.5, specular=0.1, shininess=10, ambient=0.1,
                emission=0),
        partial(pf.DirectionalLight, direction=(0, 0, 1), **colours),
        partial(pf.PointLight, **place, **colours),
        partial(pf.SpotLight, axis=(0, 0, -1), cutoff=30.0, exponent=1.0, **place,
                **colours),
        partial(pf.Fog, color=0.5, mode="exp", density=1.0, start=0.0, end=1.0),
        partial(pf.Sphere, center=(0, 0, 0), radius=1.0),
        partial(pf.Mesh, **triangle, normals=None, material_index=[0],
                weighting="area", crease_angle=None, two_sided=False),
        partial(pf.NormalMap, normals=flat, mask=None, positions=None,
                material_index=None),
        partial(pf.ImplicitSurface, function=lambda p: (p**2).sum() - 1,
                lower=(-1, -1, -1), upper=(1, 1, 1), steps=16),
        partial(pf.geometry.tessellate, function=bumpy, u=(0, 1), v=(0, 1), columns=2,
                rows=2, two_sided=False),
        partial(pf.shapes.Ball, radius=1.0),
        partial(pf.shapes.Ball().mesh, columns=6, rows=4, two_sided=False),
        partial(pf.shapes.Ball().surface, steps=16),
        partial(pf.shapes.Torus, major=1.0, minor=0.2),
        partial(pf.shapes.Cylinder, radius=1.0, height=2.0),
        partial(pf.shapes.HeightField, function=lambda x, y: x, width=1.0, height=1.0,
                relief=2.0),
        partial(pf.shapes.plane, width=1.0, height=1.0),
        partial(pf.OrthographicCamera, **size, **stands, view_height=2.2),
        partial(pf.PerspectiveCamera, **size, **stands, fov_y=30.0),
        partial(pf.OrthographicCamera.look_at, **size, **looks, view_height=2.2),
        partial(pf.PerspectiveCamera.look_at, **size, **looks, fov_y=30.0),
        partial(pf.geometry.look_at, **looks),
        partial(pf.Scene, surface=pf.Sphere(), camera=camera, lights=lights,
                ambient=0.3, specular_model=pf.BlinnPhong(), shading=pf.PhongShading(),
                fog=None, shadows=False, background=0.0, local_viewer=None),
        partial(pf.Film, clamp=True, encoding="srgb", bits=8, jpeg=None),
        partial(pf.Film().expose, light=image),
        partial(pf.rendering.JpegCompression, tables=np.ones((3, 8, 8), int),
                sampling=((1, 1),) * 3, ycbcr=True),
        partial(pf.rendering.JpegCompression.at_quality, quality=90,
                subsampling="4:2:0"),
        partial(pf.BlinnPhong, gate=True, normalized=False),
        partial(pf.Phong, gate=True),
        partial(pf.FlatShading, at="centroid", clamp=False),
        partial(pf.GouraudShading, clamp=False),
        *(partial(loss, k=1.0) for loss in (pf.Huber, pf.SoftL1, pf.Cauchy, pf.Tukey)),
        partial(blinn_from_phong, shininess=number),
        partial(phong_from_blinn, shininess=three),
        partial(pf.preset, name="brass"),
        partial(stack_materials, materials=[material, material]),
        partial(unstack_materials, material=material, count=None),
        partial(pf.geometry.join, meshes=[mesh, mesh]),
        partial(pf.geometry.trace, surface=pf.Sphere(), camera=camera, lights=lights,
                shadows=False, shading=None),
        partial(pf.Sphere().trace, camera=camera),
        partial(mesh.trace, camera=camera),
        partial(pf.terms, scene=scene, gbuffer=seen),
        partial(pf.rendering.pixel_terms, scene=scene, gbuffer=seen),
        partial(pf.rendering.combine, terms=p["terms"], material=material),
        partial(pf.render, scene=scene, material=material, film=film, gbuffer=seen),
        partial(pf.fit, **data, **asked, **more, **weighed),
        partial(pf.Specification, **asked, **more),
        partial(pf.make_problem, **data, **asked, **weighed),
        partial(pf.predict_errors, scene=scene, material=material, film=film, **asked,
                **weighed),
        partial(pf.refit, fit=fit, **data),
        partial(pf.fit_maps, scenes=[scene] * 6, images=[image] * 6,
                unknowns=("diffuse",), per_channel=colourful, known=material,
                bounds={"diffuse": (0, 1)}, mask=np.ones((8, 8), bool), noise=0.01,
                film=film, loss="linear", start=material, min_cosine=0.0,
                tile_pixels=512, devices=None, output=None, progress=False),
        partial(fit.intervals, level=0.95),
        partial(fit.profile, name="shininess", other=None, levels=(0.9,)),
        partial(fit.plot, names=("one",)),
        partial(fit.plot_profile, name="shininess", other=None),
        partial(pf.show, image=image, title="title", brighten=1.0),
        partial(pf.write_image, path="out.png", image=image, encoding="srgb", bits=8),
        partial(pf.read_image, path="in.png", encoding="srgb", max_pixels=None),
        partial(pf.read_film, path="in.png", encoding="srgb"),
        partial(pf.read_mtl, path="in.mtl"),
        partial(pf.write_mtl, path="out.mtl", materials={"one": material},
                nearest=False),
        partial(pf.save_scene, path="out.json", scene=scene, film=film, images=()),
        partial(pf.load_scene, path="in.json"),
        partial(pf.load_mesh, path="in.obj"),
        partial(pf.save_fit, path="out.fit", fit=fit),
        partial(fit.save, path="out.fit"),
        partial(pf.load_fit, path="in.fit"),
        partial(pf.load_maps, path="in.npz"),
        partial(pf.open_dataset, **grazing),
        partial(pf.read_dataset, **grazing),
        partial(pf.PhotographStack, paths=["in.png"], encoding="srgb"),
        partial(pf.write_page, path="out.html", fit=fit, title="title", names=("one",),
                assumptions={"a": "b"}, command="", loading="", diagnostics=None),
        partial(pf.testing.check_gradients, lambda x: x**2, np.ones(2), order=1,
                finite_differences=True),
    ]  # fmt: skip


def _junk(random: np.random.Generator) -> Any:
    """A value that hardly any argument is."""
    import jax
    import jax.numpy as jnp

    dates = np.array(["2020-01-01"], "datetime64[D]")
    ragged = [[1.0, 2.0], [3.0]]
    deep: Any = 1.0
    for _ in range(100):
        deep = [deep]
    plain = [
        *(None, True, False, 0, 1, -1, 2, 3, 10**6, 2**31, 2**63, 2**64, -(2**63)),
        *(10**400, -(10**400), 10**5000, 0.5, -0.5, 1e-320, 1e308, 1e39, -0.0),
        *(float("nan"), float("inf"), -float("inf"), 1j, "", "x", "0.5", "linear"),
        *("diffuse", "\0", "é" * 10_000, "\x1b[31m", b"", b"x", (), [], {}, set()),
        *((1, 2), [1, 2, 3], (1, 2, 3, 4), {"a": 1}, {1: 2}, {"diffuse": "x"}),
        *({"diffuse": (1, 0)}, {"diffuse": None}, {"diffuse": (0, 10**400)}),
        *({"shininess": {}}, {"diffuse": 10**400}, {None: (0, 1)}, [None], ["x", 1]),
        *(("diffuse",), ("shininess", "shininess"), [[]], ragged, deep, [10**400]),
        *(object(), object, int, len, print, lambda: None, lambda x: x, Ellipsis),
        *(NotImplemented, range(3), iter([1]), (x for x in (1, 2)), slice(1), os),
        *(pathlib.Path("in.png"), pathlib.Path("/"), "/", ".", "/dev/null/x"),
        *(decimal.Decimal("0.5"), fractions.Fraction(1, 2), io.BytesIO(), _Hostile()),
        *(_Hostile, [_Hostile()], {"diffuse": _Hostile()}, bytearray(3)),
        *(memoryview(b"abc"), frozenset({1}), Exception("x"), Wrong, re.compile("x")),
    ]
    arrays = [
        *(np.array(1.0), np.array(3), np.array(True), np.float32(0.5), np.int64(5)),
        *(np.str_("srgb"), np.datetime64("2020-01-01"), np.float16(1), np.uint8(200)),
        *(np.zeros(0), np.zeros((0, 3)), np.zeros((8, 8)), np.ones((8, 8, 3))),
        *(np.full((8, 8, 3), np.nan), np.full((8, 8, 3), np.inf), np.ones((8, 8, 4))),
        *(-np.ones((8, 8, 3)), np.ones((1,) * 20), np.array(["a", "b"]), dates),
        *(np.array([None, 1], object), np.array([1j, 2]), np.ones((3, 3), np.int8)),
        *(np.zeros(3, [("a", "f4")]), np.ma.masked_less([1.0, 2], 2)),
        *(np.ma.masked_all((8, 8, 3)), np.eye(3), np.ones(3), np.zeros(3), jnp.ones(3)),
        *(jnp.ones((8, 8, 3)), jnp.zeros(()), jnp.array(3), jnp.array([1j])),
        *(jax.random.key(0), jax.ShapeDtypeStruct((3,), np.float32), np.float64),
        np.ones((8, 8, 3), np.uint8),
    ]
    parts = list(_parts().values())
    pool = [plain, arrays, parts, [[part] for part in parts]]
    kinds = pool[int(random.choice(len(pool), p=[0.5, 0.3, 0.1, 0.1]))]
    return kinds[int(random.integers(len(kinds)))]


def _told(value: Any) -> str:
    try:
        return f"{type(value).__name__} {value!r}"[:80]
    except Exception as error:
        return f"{type(value).__name__} ({type(error).__name__})"


def _named(argument: str, junk: Any, words: str) -> bool:
    """Whether an error speaks of the argument, or of the file that it names."""
    if re.search(rf"(?<!\w){argument}(?!\w)", words):
        return True
    # A path is told by its own name, which may be shown in another way.
    return argument == "paths" or (
        argument in PATHS and isinstance(junk, str | os.PathLike)
    )


def make(random: np.random.Generator, stock: Path) -> Case:
    calls = _calls()
    call = calls[int(random.integers(len(calls)))]
    argument = str(random.choice(list(call.keywords)))
    junk = _junk(random)

    def act(folder: Path) -> None:
        with contextlib.chdir(folder / WORK), contextlib.redirect_stdout(io.StringIO()):
            try:
                call(**{argument: junk})
            except (ValueError, OSError) as error:
                if not _named(argument, junk, str(error)):
                    raise Wrong(f"{argument} is not named: {error!r}") from error
                raise

    def arrange(folder: Path) -> None:
        shutil.copytree(stock / "calls", folder / WORK)

    name = call.func.__qualname__
    return Case(f"{name}({argument}={_told(junk)})", arrange, act, (WORK,))


WORK = "work"
PATHS = ("path", "folder", "output", "paths")


def prepare(stock: Path) -> None:
    """Good files of all kinds that are read."""
    import phongfit as pf

    folder, p = stock / "calls", _parts()
    folder.mkdir()
    pf.write_image(folder / "in.png", p["image"], "srgb")
    pf.write_mtl(folder / "in.mtl", {"one": p["material"]})
    pf.save_scene(folder / "in.json", p["scene"])
    pf.save_fit(folder / "in.fit", p["fit"])
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (folder / "in.obj").write_text(triangle)
    stack = [p["scene"]] * 6, [p["image"]] * 6
    maps = pf.fit_maps(*stack, unknowns=("diffuse",), known=p["material"])
    maps.save(folder / "in.npz")
    main(["synth", str(folder / "in"), "--resolution", "16", "--lights", "2"])


KIND = Kind(make, prepare, seconds=60.0, megabytes=2500.0, share=2.0)
