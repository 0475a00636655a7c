"""The public edge: what is of a wrong kind is refused by name, all else passes."""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import phongfit as pf
from phongfit.edge import checked, kind_of, shown
from phongfit.material import Material, stack_materials
from phongfit.reflectance import blinn_from_phong, phong_from_blinn

ONE = Material()


class Hostile:
    """Fails whatever it is asked."""

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        raise RuntimeError("no")

    def __repr__(self) -> str:
        raise RuntimeError("no")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("no")

    __hash__ = None  # pyright: ignore


# An annotation, its words, what it allows, and what it does not.
KINDS = [
    (int, "a whole number of at most 64 bits", [3, np.int64(3)],
     [np.array(3), True, 3.0, "3", 2**63, 10**5000, None, np.ones(1, int)]),
    (float, "a number", [1, 2.5, np.float32(1), np.array(1.0), jnp.array(1.0),
     float("inf")], [float("nan"), "1", 1j, 10**400, None, np.ones(2), Hostile()]),
    (bool, "True or False", [True, np.True_, 0, 1, np.array(True)], [2, "yes", None]),
    (str, "text", ["", np.str_("a")], [b"a", 1, None, Path("a")]),
    (type, "a class", [int, pf.Scene], [1, "int"]),
    (Material, "a Material", [ONE], [Material, None, "brass", {}]),
    (pf.AbstractLight, "an AbstractLight", [pf.PointLight((0, 0, 1))], [ONE]),
    (Material | None, "a Material or None", [ONE, None], [0, Hostile()]),
    (Literal["a", "b"], "'a' or 'b'", ["a", np.str_("b")], ["c", ["a"], np.ones(3)]),
    (Literal[8, 16] | None, "8 or 16 or None", [8, np.int64(16), None], [9, 8.5]),
    (Callable[[], None], "a function", [print, lambda: 1], [1, "f"]),
    (str | Path, "text or a Path", ["a", Path("a")], [b"a"]),
    (Sequence[str], "a list of names", [["a"], (), {"a"}, np.array(["a"])],
     ["a", b"a", [1], {"a": 1}, None, 3, np.array(1), np.ones((2, 2))]),
    (Iterable[Material], "a list, each entry a Material", [[ONE], (ONE,), []],
     [ONE, [ONE, 1], np.ones(3), jax.random.key(0)]),
    (Sequence[float], "a list, each entry a number", [[1.0], np.ones(2), jnp.ones(2)],
     [1.0, ["x"], [float("nan")]]),
    (tuple[str, ...], "a list of names", [("a",)], [("a", 1)]),
    (Mapping[str, Any], "a mapping of names", [{}, {"a": Hostile()}], [[], {1: 1}]),
    (Mapping[str, Material], "a mapping of names, each to a Material", [{"a": ONE}],
     [{"a": 1}]),
    (Float[Array, "..."], "an array of real numbers", [1.0, 2, np.ones(3),
     jnp.ones(3), np.float16(1)], [[1.0], np.ma.masked_equal([3.0], 3), "a", 1j,
     np.array(["a"]), None, Hostile(), jax.random.key(0),
     jax.ShapeDtypeStruct((3,), np.float32)]),
]  # fmt: skip


@pytest.mark.parametrize("hint, words, good, bad", KINDS, ids=[k[1] for k in KINDS])
def test_kinds(hint, words, good, bad):
    kind = kind_of(hint)
    assert kind is not None and kind.words == words
    for value in good:
        assert kind.holds(value), shown(value)
    for value in bad:
        assert not kind.holds(value), shown(value)


def test_paths():
    kind = kind_of(pf.load_scene.__annotations__["path"])
    assert kind is not None and kind.words == "a path"
    assert kind.holds("a") and kind.holds(Path("a"))
    assert not any(kind.holds(value) for value in (None, b"a", 1, "a\0b", Hostile()))


@pytest.mark.parametrize("hint", [Any, object, "Figure", tuple[int, str]])
def test_what_is_not_for_us_to_say(hint):
    assert kind_of(hint) is None


@checked
def example(scene: pf.Scene, count: int = 1, *, names: Sequence[str] = ()) -> Any:
    """An example."""
    return scene, count, names


SCENE = pf.Scene(pf.Sphere(), pf.OrthographicCamera(4, 4))


def test_the_function_is_called_as_before():
    assert example(SCENE) == (SCENE, 1, ())
    assert example(SCENE, count=3, names=["a"]) == (SCENE, 3, ["a"])
    once: Any = iter("ab")
    assert example(SCENE, names=once)[2] == ("a", "b")
    assert example.__name__ == "example" and example.__doc__ == "An example."


def test_numpy_numbers_do_not_overflow():
    wide: Any = np.uint8(200)
    count = example(SCENE, wide)[1]
    assert type(count) is int and count + count == 400
    assert type(wishing(SCENE, count=wide)[1]) is int
    mesh = pf.geometry.tessellate(
        lambda u, v: jnp.stack([u, v, u * v]), columns=wide, rows=2
    )
    assert mesh.faces.shape == (800, 3)


@pytest.mark.parametrize(
    "args, words",
    [
        ((3,), "scene: expected a Scene, got 3"),
        ((Hostile(),), "scene: expected a Scene, got Hostile"),
        ((pf.Scene,), "scene: expected a Scene, got the class Scene"),
        ((SCENE, "x"), "count: expected a whole number of at most 64 bits, got 'x'"),
        ((SCENE, 10**5000), "count: expected a whole number of at most 64 bits, "
         "got int"),
        ((SCENE, np.ones((2, 3))), "got an array of shape (2, 3), float64"),
    ],
)  # fmt: skip
def test_words(args, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        example(*args)


class Wishes(TypedDict, total=False):
    """Options of a function."""

    colour: Literal["red", "blue"]


@checked
def wishing(scene: pf.Scene, *, count: int = 1, **wishes: Unpack[Wishes]) -> Any:
    """An example with options."""
    return scene, count, wishes


def test_options_are_checked_one_by_one():
    assert wishing(SCENE, colour="red") == (SCENE, 1, {"colour": "red"})
    with pytest.raises(ValueError, match="colour: expected 'red' or 'blue', got 3"):
        wishing(SCENE, colour=3)  # pyright: ignore
    with pytest.raises(
        TypeError, match=r"wishing\(\) got .* 'color', expected one of scene, count, c"
    ):
        wishing(SCENE, color="red")  # pyright: ignore
    # Programs that complete names and write help read them here.
    assert {"scene", "mask", "unknowns"} <= inspect.signature(pf.fit).parameters.keys()


def test_what_python_says_itself():
    with pytest.raises(TypeError, match=r"example\(\) takes from 1 to 2"):
        example(SCENE, 1, 2)  # pyright: ignore
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        example(SCENE, colour=1)  # pyright: ignore
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        example()  # pyright: ignore


def test_a_message_is_one_short_line():
    assert shown("a\n" * 1000) == "'" + r"a\n" * 19 + "a…"
    assert shown([1, "x"]) == "[1, 'x']" and shown(10**5000) == "int"
    assert "\x1b" not in shown("\x1b[31m") and shown(SCENE) == "Scene"


def test_tracers_pass():
    camera = pf.OrthographicCamera(4, 4)
    light = pf.DirectionalLight((1, 1, 2))
    scene = pf.Scene(pf.Sphere(), camera, light, 0.2)

    def total(material: Material, shininess: Any) -> Any:
        other = eqx.tree_at(lambda m: m.shininess, material, shininess)
        return jnp.sum(pf.render(scene, other)) + blinn_from_phong(shininess)

    material = Material(0.5, 0.3, 20.0)
    slope = jax.jit(jax.grad(total, argnums=1))(material, jnp.asarray(20.0))
    assert np.isfinite(slope)
    slopes = jax.vmap(phong_from_blinn)(jnp.arange(3.0))
    assert slopes.tolist() == [0, 0.25, 0.5]


FIT_DATA = (SCENE, np.zeros((4, 4, 3), np.float32))


# What was accepted, or failed without the name, as a user may write it.
@pytest.mark.parametrize(
    "call, name",
    [
        (lambda: pf.fit(pf.Sphere(), FIT_DATA[1]), "scene"),  # pyright: ignore
        (lambda: pf.fit([SCENE, 1], FIT_DATA[1]), "scene"),  # pyright: ignore
        (lambda: pf.fit(*FIT_DATA, known=0.5), "known"),  # pyright: ignore
        (lambda: pf.fit(*FIT_DATA, max_steps=1e3), "max_steps"),  # pyright: ignore
        (lambda: pf.fit(*FIT_DATA, loss=[]), "loss"),  # pyright: ignore
        (lambda: pf.fit(*FIT_DATA, film="srgb"), "film"),  # pyright: ignore
        (lambda: pf.fit(*FIT_DATA, bounds={"diffuse": (0, 10**400)}), "bounds"),
        (lambda: pf.fit(*FIT_DATA, fixed={"diffuse": Hostile()}), "fixed"),
        (lambda: pf.fit(*FIT_DATA, weights=Hostile()), "weights"),
        (lambda: pf.render(SCENE, "brass"), "material"),  # pyright: ignore
        (lambda: pf.terms(SCENE, ONE), "gbuffer"),  # pyright: ignore
        (lambda: pf.rendering.combine(ONE, ONE), "terms"),  # pyright: ignore
        (lambda: pf.geometry.trace(SCENE, SCENE.camera), "surface"),  # pyright: ignore
        (lambda: SCENE.surface.trace(ONE), "camera"),  # pyright: ignore
        (lambda: pf.geometry.join([1]), "meshes"),  # pyright: ignore
        (lambda: pf.geometry.join(x for x in (1, 2)), "meshes"),  # pyright: ignore
        (lambda: pf.predict_errors(SCENE, 3, 0.1), "material"),  # pyright: ignore
        (lambda: stack_materials(ONE), "materials"),  # pyright: ignore
        (lambda: blinn_from_phong([1, 2]), "shininess"),  # pyright: ignore
        (lambda: pf.load_scene(3), "path"),  # pyright: ignore
        (lambda: pf.read_image("a.png", np.ones(3)), "encoding"),  # pyright: ignore
        (lambda: pf.save_scene("a.json", ONE), "scene"),  # pyright: ignore
        (lambda: pf.Huber(-1), "k"),
        (lambda: pf.Tukey(float("nan")), "k"),
        (lambda: pf.Cauchy("x"), "k"),  # pyright: ignore
        (lambda: pf.SoftL1(1e-320), "k"),
        (lambda: pf.Film(jpeg=3), "jpeg"),  # pyright: ignore
        (lambda: pf.rendering.JpegCompression(3), "tables"),
        (lambda: pf.Material(10**5000), "diffuse"),
        (lambda: pf.Material(Hostile()), "diffuse"),
        (lambda: pf.Mesh(np.eye(3), [[0, 1], [2]]), "faces"),
        (lambda: pf.OrthographicCamera(10**30), "width"),
        (lambda: pf.preset(3), "name"),  # pyright: ignore
    ],
)
def test_the_argument_is_named(call, name):
    with pytest.raises(ValueError, match=rf"^{name}(\[\d\])?: "):
        call()


def test_a_flag_is_named():
    for call, name in (
        (lambda: pf.BlinnPhong("no"), "gate"),  # pyright: ignore
        (lambda: pf.GouraudShading([]), "clamp"),  # pyright: ignore
    ):
        with pytest.raises(ValueError, match=f"^{name}: "):
            call()
