"""The model is right: each kind of scene, material and photograph once."""

from typing import Any

import numpy as np

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.balls import unit_ball
from experiments.honesty.situations.base import (
    MATERIAL,
    NOISE,
    Draw,
    Image,
    Situation,
    Subject,
    ball,
    changed,
    fits,
    lamp,
    noisy,
    usual,
    when_asked,
)

PARAMETERS = ("ambient", "diffuse", "specular", "shininess")


def situations() -> list[Situation]:
    """All situations with a right model."""
    spot = pf.SpotLight((2, 2, 3), (-2, -2, -3), 0.9, cutoff=40, exponent=2)
    subjects: dict[str, Subject | Draw] = {
        "one lamp": usual(),
        "Phong's highlight": usual(
            changed(shininess=6.0), two(specular_model=pf.Phong())
        ),
        "two lamps": usual(MATERIAL, two()),
        "point light": usual(MATERIAL, ball(pf.PointLight((2, 2, 3), 0.6))),
        "spot light": usual(MATERIAL, ball(spot)),
        "fog": usual(MATERIAL, ball(fog=pf.Fog(0.4, density=0.1))),
        "four images": usual(MATERIAL, *four_balls()),
        "three materials on a mesh": when_asked(three_materials),
        "flat shading": mesh(pf.FlatShading()),
        "Gouraud shading": mesh(pf.GouraudShading()),
    }
    plain = [
        Situation(name, "right", fits(subject, noisy()))
        for name, subject in subjects.items()
    ]
    grey = pf.Material(0.5, 0.3, 20.0, 0.4)
    coloured = changed(shininess=(12.0, 20.0, 40.0))
    return [
        *plain,
        Situation("any material", "right", fits(any_material, noisy())),
        Situation("grey", "right", fits(usual(grey), noisy(), per_channel=())),
        Situation("one channel thrice", "right", fits(usual(grey), grey_noise)),
        Situation(
            "an exponent a channel",
            "right",
            fits(usual(coloured), noisy(), per_channel=PARAMETERS),
        ),
    ]


def two(**changes: Any) -> pf.Scene:
    """A ball under two lamps."""
    return ball(lamp(), lamp((-1, 0.3, 1), (0.3, 0.2, 0.1)), **changes)


def any_material(rng: np.random.Generator) -> Subject:
    """A ball of a random material within the bounds, with a visible highlight."""
    material = pf.Material(
        diffuse=rng.uniform(0.1, 0.9, 3),
        specular=rng.uniform(0.15, 0.8, 3),
        shininess=np.exp(rng.uniform(np.log(5), np.log(100))),
        ambient=rng.uniform(0.1, 0.9, 3),
    )
    return usual(material)


def grey_noise(light: Image, rng: np.random.Generator) -> Image:
    """Add noise that is the same in all three channels, as in a grey camera's file."""
    return light + NOISE * rng.normal(size=(*light.shape[:2], 1))


def four_balls(**changes: Any) -> tuple[pf.Scene, ...]:
    """One ball, photographed once under each of four lamps."""
    return tuple(ball(lamp(way), **changes) for way in spread_directions(4))


def mesh(shading: pf.AbstractShading) -> Draw:
    """A ball of triangles."""
    return when_asked(
        lambda: usual(MATERIAL, ball(surface=unit_ball(12), shading=shading))
    )


def three_materials() -> Subject:
    """A ball of triangles with three bands of different materials."""
    whole = unit_ball(24)
    heights = np.asarray(whole.vertices)[np.asarray(whole.faces)].mean(axis=1)[:, 1]
    bands = np.digitize(heights, (-0.3, 0.35))
    surface = pf.Mesh(whole.vertices, whole.faces, whole.normals, bands)
    materials = pf.stack_materials(
        [
            MATERIAL,
            pf.Material((0.2, 0.5, 0.3), 0.5, 40.0, 0.5),
            pf.Material(0.4, (0.5, 0.4, 0.2), 10.0, (0.3, 0.4, 0.5)),
        ]
    )
    return Subject((ball(surface=surface),), materials)
