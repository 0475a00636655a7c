"""What holds unknowns together: bounds, fixed values, ties and priors, by label."""

import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.charts import tangents
from phongfit.fitting.problem.parameters import scene_arrays
from phongfit.fitting.problem.unknowns import Unknowns, in_units
from tests.fitting.scenes import ball, unknowns_of
from tests.helpers import floats, near, said

KNOWN = pf.Material(0.1, 0.2, 50.0, 0.5)
SCENE = ball()
INTENSITY = "scene.lights[0].intensity"
DIRECTION = "scene.lights[0].direction"


def layout(*names: str, **options) -> Unknowns:
    """Unknowns of these names; diffuse has three channels."""
    scenes = [SCENE] * options.pop("images", 1)
    return unknowns_of(
        names, ("diffuse",), KNOWN, options.pop("bounds", {}), scenes=scenes, **options
    )


_entries = jax.jit(Unknowns.entries)


def entries(unknowns: Unknowns, *y: float) -> dict[str, float]:
    """Every entry by its label, at a y."""
    found = np.asarray(_entries(unknowns, floats(y)), float)
    return dict(zip(unknowns.table.label, found.tolist(), strict=True))


def test_a_tie_has_a_factor_and_its_error_too():
    unknowns = layout("diffuse", "specular", ties={"specular": (0.5, "diffuse.red")})
    at = entries(unknowns, 0.2, 0.3, 0.4)
    near(at["specular"], 0.1)
    assert unknowns.labels[-1] == "specular"
    assert unknowns.tied.tolist() == [False, False, False, True]
    _, slope = in_units(unknowns, floats([0.2, 0.3, 0.4]))
    near(slope, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]])
    near(unknowns.bounds[-1], [0, 0.5])


@pytest.mark.parametrize(
    "factor, bounds, own, followers",
    [
        (3.0, {}, (0, 1 / 3), (0, 1)),
        (0.5, {}, (0, 1), (0, 0.5)),
        (0.0, {}, (0, 1), (0, 0)),
        # A factor below 0 turns the bounds.
        (-2.0, {"ambient": (-1, 0.25)}, (-0.5, 0), (0, 1)),
        (-2.0, {"ambient": (-np.inf, 0.25)}, (-0.5, 0), (0, 1)),
        (3.0, {"specular": (0, 2)}, (0, 2 / 3), (0, 2)),
        (-1.0, {"specular": (-np.inf, np.inf)}, (0, 1), (-1, 0)),
    ],
)
def test_what_follows_stays_in_its_bounds_too(factor, bounds, own, followers):
    ties = {"specular": (factor, "ambient")}
    unknowns = layout("ambient", "specular", bounds=bounds, ties=ties)
    near(unknowns.bounds, [own, followers], 1e-6)
    for edge in (unknowns.lower, unknowns.upper):
        values = np.asarray(unknowns.values(edge))
        assert np.all(values >= unknowns.bounds[:, 0] - 1e-6)
        assert np.all(values <= unknowns.bounds[:, 1] + 1e-6)


def test_a_chain_of_followers_stays_in_all_their_bounds():
    ties = {"specular": (3.0, "emission"), "emission": (0.5, "diffuse")}
    bounds = {"emission": (0.2, 0.9)}
    names = ("diffuse", "specular", "emission")
    unknowns = unknowns_of(names, (), KNOWN, bounds, ties=ties)
    near(unknowns.bounds, [(0.4, 2 / 3), (0.6, 1), (0.2, 1 / 3)], 1e-6)


def test_chains_of_ties():
    """Whatever the order in which they are named."""
    chain = {"ambient": (2.0, "emission"), "emission": (0.5, "specular")}
    for names in (tuple(chain), tuple(reversed(chain))):
        ties = {name: chain[name] for name in names}
        ties["specular"] = (0.1, "diffuse.blue")
        unknowns = layout("ambient", "diffuse", "specular", "emission", ties=ties)
        at = entries(unknowns, 0.2, 0.3, 0.4)
        near([at[k] for k in ("ambient", "specular", "emission")], [0.04, 0.04, 0.02])


def test_a_leaf_tied_to_a_leaf_goes_channel_by_channel():
    unknowns = unknowns_of(
        ("ambient", "diffuse"),
        ("ambient", "diffuse"),
        KNOWN,
        {},
        ties={"ambient": "diffuse"},
    )
    at = entries(unknowns, 0.2, 0.3, 0.4)
    near([at[f"ambient.{c}"] for c in ("red", "green", "blue")], [0.2, 0.3, 0.4])


def test_exponents_are_tied_in_the_users_units():
    unknowns = unknowns_of(
        ("shininess",),
        (),
        KNOWN,
        {},
        materials=2,
        ties={"shininess[1]": (3.0, "shininess[0]")},
    )
    near(list(entries(unknowns, np.log(20)).values()), [20, 60], 1e-5)
    near(unknowns.bounds, [(1, 1000 / 3), (3, 1000)], 1e-5)


@pytest.mark.parametrize(
    "fixed, expected",
    [
        ({"diffuse": 0.7}, (0.7, 0.7, 0.7)),
        ({"diffuse": (0.7, 0.8, 0.9)}, (0.7, 0.8, 0.9)),
        ({"diffuse.green": 0.7}, (0.1, 0.7, 0.2)),
        ({"diffuse.green": 0.7, "diffuse.red": 0.6}, (0.6, 0.7, 0.1)),
    ],
)
def test_what_is_fixed_stays(fixed, expected):
    unknowns = layout("diffuse", "specular", fixed=fixed)
    free = 4 - np.isin(expected, (0.6, 0.7, 0.8, 0.9)).sum()
    assert unknowns.lower.size == free
    assert len(unknowns.labels) == free
    at = entries(unknowns, *(0.1, 0.2, 0.3)[:free])
    near([at[f"diffuse.{c}"] for c in ("red", "green", "blue")], expected)


def test_a_tie_to_what_is_fixed_is_fixed():
    unknowns = layout(
        *("ambient", "diffuse", "specular"),
        fixed={"diffuse.red": 0.6},
        ties={"specular": (0.5, "diffuse.red"), "ambient": (0.5, "specular")},
    )
    assert unknowns.labels == ("diffuse.green", "diffuse.blue")
    at = entries(unknowns, 0.1, 0.2)
    near([at["specular"], at["ambient"]], [0.3, 0.15])


def test_numbers_of_scenes_are_of_order_one_and_told_in_their_units():
    unknowns = layout("diffuse", "scene.ambient", INTENSITY, images=2)
    near(unknowns.start[3:], [1, 1])
    assert unknowns.labels[3:] == ("scene.ambient", INTENSITY)
    at = entries(unknowns, 0, 0, 0, 1, 2)
    near([at["scene.ambient"], at[INTENSITY]], [0.3, 0.7])
    assert unknowns.bounds[3:].tolist() == [[0, np.inf]] * 2
    scenes = unknowns.scenes(unknowns.entries(floats([0, 0, 0, 1, 2])), (SCENE, SCENE))
    for scene in scenes:
        near(scene.ambient, [0.3] * 3)
        arrays = scene_arrays(scene)
        near(arrays[INTENSITY], [0.7] * 3)
        other = "scene.lights[1].intensity"
        near(arrays[other], scene_arrays(SCENE)[other])


def test_each_image_has_its_own():
    unknowns = layout("exposure", INTENSITY, images=2, per_image=(INTENSITY,))
    names = tuple(f"scenes[{k}].lights[0].intensity" for k in range(2))
    assert unknowns.labels == ("exposure[0]", "exposure[1]", *names)
    at = unknowns.entries(floats([1, 2, 1, 3]))
    near(unknowns.exposures(at), [1, 2])
    first, second = unknowns.scenes(at, (SCENE, SCENE))
    near(scene_arrays(first)[INTENSITY], [0.35] * 3)
    near(scene_arrays(second)[INTENSITY], [1.05] * 3)
    near(unknowns.as_material(at).diffuse, KNOWN.diffuse)


@pytest.mark.parametrize("y", [(0, 0), (0.5, -2), (1e3, 1e3)])
def test_directions_stay_on_the_sphere(y):
    unknowns = layout(DIRECTION)
    assert unknowns.labels == tuple(f"{DIRECTION}.{axis}" for axis in "xyz")
    assert unknowns.y_labels == (DIRECTION, DIRECTION)
    values, slope = in_units(unknowns, floats(y))
    near(np.linalg.norm(values), 1)
    if y == (0, 0):
        near(values, np.array([1, 1, 2]) / 6**0.5)
        # A step across moves by its own length, at right angles.
        near(slope.T @ slope, np.eye(2))
        near(slope.T @ values, [0, 0])


def test_directions_are_told_around_any_other():
    """The numbers that they are made of change, and they themselves do not."""
    unknowns = layout("diffuse", DIRECTION)
    bases = np.array([[0, 0, -1.0]])
    other = unknowns.aimed(floats(bases), floats(tangents(bases)))
    near(other.values(floats([0.1, 0.2, 0.3, 0, 0]))[3:], [0, 0, -1])
    assert other.labels == unknowns.labels
    assert np.array_equal(other.bounds, unknowns.bounds)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)])
def test_directions_along_an_axis(axis):
    light = pf.DirectionalLight(axis)
    scene = pf.Scene(pf.Sphere(), SCENE.camera, light)
    unknowns = unknowns_of((DIRECTION,), (), KNOWN, {}, scenes=[scene])
    values, slope = in_units(unknowns, floats([0, 0]))
    near(values, axis)
    near(slope.T @ slope, np.eye(2))


ROTATION = "scene.camera.rotation"


def test_a_rotation_is_three_angles_and_stays_a_rotation():
    """In degrees about the camera's own axes, from where it was."""
    start = np.asarray(pf.geometry.look_at((1, 2, 4), (0, 0, 0)))
    camera = pf.OrthographicCamera(4, 4, rotation=start + 1e-5)
    scene = pf.Scene(pf.Sphere(), camera, SCENE.lights)
    unknowns = unknowns_of((ROTATION,), (), KNOWN, {}, scenes=[scene])
    assert unknowns.labels == tuple(f"{ROTATION}.{axis}" for axis in "xyz")
    near(unknowns.bounds, [(-180, 180)] * 3)
    near(unknowns.start, [0, 0, 0])

    @jax.jit
    def turned(y):
        return unknowns.scenes(unknowns.entries(y), (scene,))[0].camera.rotation

    def rotation(y):
        return np.asarray(turned(floats(y)), float)

    near(rotation((0, 0, 0)), start, 1e-4)
    for y in ((0, 0, 0), (1, 0, 0), (0.3, -2, 1), (1e-4, 0, 0)):
        near(rotation(y).T @ rotation(y), np.eye(3))
        near(np.linalg.det(rotation(y)), 1)
        near(_entries(unknowns, floats(y)), np.rad2deg(y))
    # A tilt of 90° looks where up was; the other two turn right towards them.
    right, up, back = rotation((0, 0, 0)).T
    near(rotation((np.pi / 2, 0, 0)).T, [right, back, -up])
    near(rotation((0, np.pi / 2, 0)).T, [-back, up, right])
    near(rotation((0, 0, np.pi / 2)).T, [up, -right, back])


def test_rotations_of_several_images():
    turns = [
        pf.geometry.look_at((0, 0, 4), (0, 0, 0)),
        pf.geometry.look_at((4, 0, 1), (0, 0, 0)),
    ]
    scenes = [
        pf.Scene(pf.Sphere(), pf.OrthographicCamera(4, 4, rotation=turn), SCENE.lights)
        for turn in turns
    ]
    held = {f"scenes[1].camera.rotation.{axis}": 0 for axis in "xy"}
    unknowns = unknowns_of(
        (ROTATION,), (), KNOWN, {}, scenes=scenes, per_image=(ROTATION,), fixed=held
    )
    assert unknowns.labels[-1] == "scenes[1].camera.rotation.z"
    entries = unknowns.entries(floats([0, 0, 0, np.pi / 2]))
    found = unknowns.scenes(entries, tuple(scenes))
    near(found[0].camera.rotation, turns[0])
    right, up, back = np.asarray(turns[1]).T
    near(found[1].camera.rotation.T, [up, -right, back])


def test_priors_are_residuals():
    priors = {"diffuse": (0.3, 0.1), "shininess": (60, 10)}
    unknowns = layout("diffuse", "shininess", priors=priors)
    off = unknowns.prior_residual(floats([0.2, 0.3, 0.5, np.log(40)]))
    near(off, [-1, 0, 2, -2], 1e-5)


def test_a_position_and_back():
    """The vector that makes given entries, ties and scales included."""
    unknowns = layout(
        *("diffuse", "specular", "shininess", INTENSITY),
        ties={"specular": (0.5, "diffuse.red")},
    )
    y = floats([0.2, 0.3, 0.4, np.log(40), 1.5])
    back = unknowns.position(np.asarray(unknowns.entries(y)))
    near(back, y, 1e-5)


ERRORS = [
    (dict(fixed={"gloss": 1}), "fixed: expected one of diffuse, specular"),
    (dict(fixed={"diffuse": (1, 2)}), "fixed: diffuse: expected 3 numbers"),
    (dict(fixed={"diffuse": "red"}), "fixed: diffuse: expected 3 numbers"),
    (dict(fixed={"diffuse.red": np.nan}), "fixed: diffuse.red: nan is not finite"),
    (dict(fixed={DIRECTION: 1}), f"fixed: {DIRECTION} is a direction"),
    (
        dict(fixed={"diffuse": 1, "specular": 1, "shininess": 9, INTENSITY: 1}, n=4),
        "fixed: nothing unknown is left",
    ),
    (dict(ties={"gloss": "diffuse"}), "ties: expected ... got 'gloss'"),
    (dict(ties={"specular": "gloss"}), "ties: expected ... got 'gloss'"),
    (dict(ties={"specular": "diffuse"}), "ties: specular has 1 numbers, diffuse has 3"),
    (dict(ties={"specular": (1, 2, 3)}), "ties: specular: expected ... got (1, 2, 3)"),
    (dict(ties={"specular": 3.0}), "ties: specular: expected ... got 3.0"),
    (dict(ties={"specular": (np.inf, "diffuse.red")}), "ties: specular: "),
    (
        dict(ties={"specular": ("diffuse.red", 2)}),
        "ties: specular: expected ... got ('diffuse.red', 2)",
    ),
    (
        dict(ties={"specular": "diffuse.red"}, fixed={"specular": 1}),
        "ties: specular is fixed already",
    ),
    (
        dict(ties={"diffuse": "specular", "diffuse.red": "specular"}),
        "ties: diffuse.red is tied twice",
    ),
    (dict(ties={"specular": "specular"}), "ties: specular is tied to itself"),
    (
        dict(ties={"specular": "diffuse.red", "diffuse.red": "specular"}),
        "is tied to itself",
    ),
    (dict(ties={"specular": "shininess"}), "ties: specular to shininess: "),
    (dict(ties={"specular": INTENSITY}), "ties: specular to scene.lights"),
    (dict(ties={INTENSITY: f"{DIRECTION}.x"}), "directions cannot be tied"),
    (dict(bounds={"gloss": (0, 1)}), "bounds: expected ... got 'gloss'"),
    (dict(bounds={"diffuse": 1}), "bounds: diffuse: expected (low, high)"),
    (
        dict(bounds={"diffuse": (0, 1, 2)}),
        "bounds: diffuse: expected ... got (0, 1, 2)",
    ),
    (dict(bounds={"diffuse": (1, 0)}), "bounds: diffuse: 1 < 0 does not hold"),
    (dict(bounds={"diffuse": (0, np.nan)}), "bounds: diffuse: 0 < nan"),
    (dict(bounds={"shininess": (0, 9)}), "bounds: shininess: expected ... got (0, 9)"),
    (dict(bounds={DIRECTION: (0, 1)}), f"bounds: {DIRECTION}: a direction has none"),
    (
        dict(bounds={"specular": (0, 1)}, fixed={"specular": 0.5}),
        "bounds: specular is fixed",
    ),
    (
        dict(ties={"specular": (-1, "diffuse.red")}),
        "ties: specular = -1 × diffuse.red leaves diffuse.red no range of values",
    ),
    (
        dict(ties={"specular": (5, "diffuse.red")}, bounds={"diffuse": (0.3, 0.4)}),
        "ties: specular = 5 × diffuse.red leaves",
    ),
    (
        dict(ties={"specular": (0, "diffuse.red")}, bounds={"specular": (0.1, 1)}),
        "ties: specular = 0 × diffuse.red leaves",
    ),
    (dict(fixed={"diffuse.red": -0.5}), "fixed: diffuse.red is held at -0.5"),
    (dict(fixed={"shininess": -5}), "fixed: shininess is held at -5"),
    (dict(fixed={INTENSITY: -5}), f"fixed: {INTENSITY} is held at -5"),
    (
        dict(fixed={"diffuse.red": 0.5}, ties={"specular": (-1, "diffuse.red")}),
        "ties: specular is held at -0.5, a number ≥ 0",
    ),
    (dict(priors={"gloss": (0, 1)}), "priors: expected ... got 'gloss'"),
    (dict(priors={"diffuse": 1}), "priors: diffuse: expected (mean, standard"),
    (
        dict(priors={"diffuse": (1, 0)}),
        "priors: diffuse: expected a standard deviation > 0",
    ),
    (dict(priors={"diffuse": ((1, 2), 1)}), "priors: diffuse: expected 3 numbers"),
    (dict(priors={"diffuse": (np.inf, 1)}), "priors: diffuse: inf is not finite"),
    (
        dict(priors={"specular": (0, 1)}, fixed={"specular": 0.5}),
        "priors: specular is fixed",
    ),
    (dict(per_image=("diffuse",)), "per_image: expected an array"),
    (dict(per_image=("scene.gloss",)), "per_image: expected one of"),
    (dict(per_image=INTENSITY), "per_image: expected a list of names"),
]


@pytest.mark.parametrize("options, words", ERRORS)
def test_errors_name_the_argument_and_the_entry(options, words):
    names = ("diffuse", "specular", "shininess", INTENSITY, DIRECTION)
    options = dict(options)
    with pytest.raises(ValueError) as raised:
        layout(*names[: options.pop("n", 5)], **options)
    assert said(words, str(raised.value))


@pytest.mark.parametrize(
    "name",
    [
        *("gloss", "scene", "scene.lights", "scene.lights[2].intensity", "scene.fog"),
        *("scene.lights[0].position", "scene.background", "scene.fog.density"),
    ],
)
def test_what_is_there_is_told(name):
    with pytest.raises(ValueError) as raised:
        layout(name)
    words = str(raised.value)
    assert words.startswith("unknowns: expected one of ambient, ")
    for there in ("exposure", INTENSITY, DIRECTION, "scene.surface.radius"):
        assert there in words


def test_a_spot_s_edge_is_no_unknown():
    """Pixels jump from lit to dark: no derivative says how they would."""
    scene = ball("spot")
    with pytest.raises(ValueError, match=r"unknowns: scene.lights\[0\].cutoff cannot"):
        unknowns_of(("scene.lights[0].cutoff",), (), KNOWN, {}, scenes=[scene])
    with pytest.raises(ValueError) as raised:
        unknowns_of(("gloss",), (), KNOWN, {}, scenes=[scene])
    assert "exponent" in str(raised.value) and "cutoff" not in str(raised.value)


def test_scenes_that_differ():
    bright = pf.Scene(pf.Sphere(), SCENE.camera, SCENE.lights, ambient=0.4)
    with pytest.raises(ValueError, match="scene.ambient differs .* per_image"):
        unknowns_of(("scene.ambient",), (), KNOWN, {}, scenes=[SCENE, bright])


def test_the_entries_are_differentiable():
    unknowns = layout("diffuse", DIRECTION, ties={"diffuse.red": "diffuse.blue"})
    slope = jax.jit(jax.jacrev(unknowns.entries))(floats([0.2, 0.3, 0.1, 0.1]))
    assert np.all(np.isfinite(slope))
    near(slope[0], slope[2])
