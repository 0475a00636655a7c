"""Situations with a right model: each kind of scene, material and photograph once."""

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
    alike,
    ball_scene,
    cached_subject,
    fits,
    lamp,
    noisy,
    usual_material,
    usual_subject,
)
from phongfit.material import stack_materials

PARAMETERS = ("ambient", "diffuse", "specular", "shininess")


def situations() -> list[Situation]:
    """Situations in which the fitted model is the one that made the images.

    Their kind is `"right"`: intervals must contain the truth as often as they state,
    and warnings are false alarms (`experiments/honesty/judge.py`).
    """
    spot = pf.SpotLight((2, 2, 3), (-2, -2, -3), 0.9, cutoff=40, exponent=2)
    subjects: dict[str, Subject | Draw] = {
        "one lamp": usual_subject(),
        "Phong's highlight": usual_subject(
            usual_material(shininess=6.0), under_two_lamps(specular_model=pf.Phong())
        ),
        "two lamps": usual_subject(MATERIAL, under_two_lamps()),
        "point light": usual_subject(
            MATERIAL, ball_scene(pf.PointLight((2, 2, 3), 0.6))
        ),
        "spot light": usual_subject(MATERIAL, ball_scene(spot)),
        "fog": usual_subject(MATERIAL, ball_scene(fog=pf.Fog(0.4, density=0.1))),
        "four images": usual_subject(MATERIAL, *four_balls()),
        "three materials on a mesh": cached_subject(three_materials),
        "flat shading": mesh_ball(pf.FlatShading()),
        "Gouraud shading": mesh_ball(pf.GouraudShading()),
    }
    answers = {name: fits(subject, noisy()) for name, subject in subjects.items()}
    grey = pf.Material(0.5, 0.3, 20.0, 0.4)
    coloured = usual_material(shininess=(12.0, 20.0, 40.0))
    answers |= {
        "any material": fits(random_material, noisy()),
        "grey": fits(usual_subject(grey), noisy(), per_channel=()),
        "one channel thrice": fits(usual_subject(grey), grey_noise),
        "an exponent a channel": fits(
            usual_subject(coloured), noisy(), per_channel=PARAMETERS
        ),
    }
    return alike("right", answers)


def under_two_lamps(**changes: Any) -> pf.Scene:
    """A ball under two lamps; `changes` are arguments of [`ball_scene`][]."""
    return ball_scene(lamp(), lamp((-1, 0.3, 1), (0.3, 0.2, 0.1)), **changes)


def random_material(rng: np.random.Generator) -> Subject:
    """A ball of a random material within the bounds, with a highlight (ρ_s ≥ 0.15)."""
    material = pf.Material(
        diffuse=rng.uniform(0.1, 0.9, 3),
        specular=rng.uniform(0.15, 0.8, 3),
        shininess=np.exp(rng.uniform(np.log(5), np.log(100))),
        ambient=rng.uniform(0.1, 0.9, 3),
    )
    return usual_subject(material)


def grey_noise(light: Image, rng: np.random.Generator) -> Image:
    """Add noise that is equal in all three channels, as from a monochrome camera."""
    return light + NOISE * rng.normal(size=(*light.shape[:2], 1))


def four_balls(**changes: Any) -> tuple[pf.Scene, ...]:
    """Scenes of one ball, one for each of four lamps.

    **Arguments:** `changes`: arguments of [`ball_scene`][].
    """
    return tuple(
        ball_scene(lamp(direction), **changes) for direction in spread_directions(4)
    )


def mesh_ball(shading: pf.geometry.AbstractShading) -> Draw:
    """A ball of 576 triangles, shaded in this way."""
    return cached_subject(
        lambda: usual_subject(
            MATERIAL, ball_scene(surface=unit_ball(12), shading=shading)
        )
    )


def three_materials() -> Subject:
    """A ball of triangles with three bands of different materials."""
    whole = unit_ball(24)
    centroids = np.asarray(whole.vertices)[np.asarray(whole.faces)].mean(axis=1)
    # By height (y) above the ball's centre, whose radius is 1.
    bands = np.digitize(centroids[:, 1], (-0.3, 0.35))
    surface = pf.Mesh(whole.vertices, whole.faces, whole.normals, bands)
    materials = stack_materials(
        [
            MATERIAL,
            pf.Material((0.2, 0.5, 0.3), 0.5, 40.0, 0.5),
            pf.Material(0.4, (0.5, 0.4, 0.2), 10.0, (0.3, 0.4, 0.5)),
        ]
    )
    return Subject((ball_scene(surface=surface),), materials)
