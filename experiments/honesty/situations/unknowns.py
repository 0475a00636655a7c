"""Unknowns of the scene, and what is known beforehand: ties and priors."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.honesty.situations.base import (
    MATERIAL,
    SMALL,
    Image,
    Situation,
    Subject,
    ball_scene,
    clamped,
    fits,
    lamp,
    noisy,
    usual_material,
    usual_subject,
)

USUAL = ("ambient", "diffuse", "specular", "shininess")
EXPOSURES = (1.0, 0.7, 1.4)
# Rotation of the camera about the world's axes, degrees.
TURN = (0.6, -0.8, 2.0)
# Standard deviation of a measured position, in radii of the ball.
POSITION_SIGMA = 0.1
TURN_LABELS = tuple(f"scene.camera.rotation.{axis}" for axis in "xyz")


def situations() -> list[Situation]:
    """All situations with unknowns of scenes, ties and priors."""
    return [*scene_unknowns(), *ties_and_priors()]


def small_ball(*lights: pf.AbstractLight, **changes: Any) -> pf.Scene:
    """A ball of few pixels, since these fits try many starts."""
    return ball_scene(*lights, size=SMALL, **changes)


def scene_unknowns() -> list[Situation]:
    """Situations with unknowns of lights, surface and camera."""
    true_bulb, first_guess = (
        pf.PointLight(at, 0.6) for at in ((2, 1.5, 2.5), (1.5, 2, 3))
    )
    true_spot, wider_spot = (
        pf.SpotLight((1, 1, 3), (-1, -1, -3), 0.6, cutoff=angle) for angle in (12, 14)
    )
    subject = usual_subject(MATERIAL, small_ball())
    return [
        Situation(
            "the lamp's intensity unknown",
            "right",
            fits(
                subject,
                noisy(),
                fitted=small_ball(lamp(intensity=0.3)),
                unknowns=("specular", "shininess", "scene.lights[0].intensity"),
                known=MATERIAL,
            ),
        ),
        Situation(
            "the lamp's direction unknown, 20° off",
            "right",
            fits(
                subject,
                noisy(),
                fitted=small_ball(lamp(tilted_direction(20.0))),
                unknowns=(*USUAL, "scene.lights[0].direction"),
            ),
        ),
        Situation(
            "the lamp's direction unknown, 120° off",
            "right",
            fits(
                subject,
                noisy(),
                fitted=small_ball(lamp(tilted_direction(120.0))),
                unknowns=(*USUAL, "scene.lights[0].direction"),
            ),
        ),
        Situation(
            "the lamp unknown, a weak and narrow highlight",
            "right",
            fits(
                usual_subject(
                    pf.Material((0.4, 0.3, 0.2), 0.06, 400.0, 0.1),
                    small_ball(lamp((-0.6, -0.2, 0.75))),
                ),
                noisy(0.005),
                fitted=small_ball(lamp((0, 0, 1))),
                unknowns=(*USUAL, "scene.lights[0].direction"),
            ),
        ),
        Situation(
            "a bulb's position unknown",
            "right",
            fits(
                usual_subject(MATERIAL, small_ball(true_bulb)),
                noisy(),
                fitted=small_ball(first_guess),
                unknowns=(*USUAL, "scene.lights[0].position"),
            ),
        ),
        Situation(
            "a bulb's position uncertain",
            "right",
            fits(
                bulb_misplaced,
                noisy(0.03),
                fitted=small_ball(near_bulb()),
                uncertain={"scene.lights[0].position": POSITION_SIGMA},
            ),
        ),
        Situation(
            "a spot's position unknown, its rim seen",
            "right",
            fits(
                usual_subject(MATERIAL, small_ball(true_spot)),
                noisy(0.002),
                fitted=small_ball(
                    pf.SpotLight((1.1, 1, 3), (-1, -1, -3), 0.6, cutoff=12)
                ),
                unknowns=("ambient", "diffuse", "scene.lights[0].position"),
                known=MATERIAL,
            ),
        ),
        Situation(
            "the ball's radius unknown",
            "right",
            fits(
                usual_subject(MATERIAL, small_ball(surface=pf.Sphere(radius=0.8))),
                noisy(0.002),
                fitted=small_ball(surface=pf.Sphere(radius=0.83)),
                unknowns=("ambient", "diffuse", "scene.surface.radius"),
                known=MATERIAL,
            ),
        ),
        Situation(
            "a spot's cutoff unknown",
            "doubtful",
            fits(
                usual_subject(MATERIAL, small_ball(true_spot)),
                noisy(),
                fitted=small_ball(wider_spot),
                unknowns=("diffuse", "scene.lights[0].cutoff"),
                known=MATERIAL,
            ),
            wide=True,
        ),
        Situation(
            "exposures unknown",
            "right",
            fits(
                usual_subject(MATERIAL, *exposure_scenes(EXPOSURES)),
                noisy(),
                fitted=exposure_scenes((1.0, 1.0, 1.0)),
                unknowns=(*USUAL, "exposure"),
                fixed={"exposure[0]": 1.0},
                other_truths={f"exposure[{k}]": x for k, x in enumerate(EXPOSURES)},
            ),
        ),
        Situation(
            "two lamps mirrored by a tie",
            "right",
            fits(
                usual_subject(MATERIAL, small_ball(*bulbs(1.5))),
                noisy(),
                fitted=small_ball(*bulbs(1.2)),
                unknowns=(
                    "diffuse",
                    "scene.lights[0].position",
                    "scene.lights[1].position",
                ),
                known=MATERIAL,
                ties=mirrored(),
            ),
        ),
        Situation(
            "the camera's rotation unknown",
            "right",
            fits(
                usual_subject(MATERIAL, small_ball(camera=turned_camera(TURN))),
                noisy(),
                fitted=small_ball(),
                draw_options=central_mask,
                unknowns=("diffuse", "scene.camera.rotation"),
                known=MATERIAL,
                other_truths=dict(zip(TURN_LABELS, TURN, strict=True)),
            ),
        ),
    ]


def near_bulb(offset: Sequence[float] | np.ndarray = (0, 0, 0)) -> pf.PointLight:
    """A bulb so near that its light falls off, moved by `offset` from its place."""
    return pf.PointLight(np.array((0.8, 0.9, 2.2)) + offset, attenuation=(0.5, 0, 0.3))


def bulb_misplaced(rng: np.random.Generator) -> Subject:
    """The ball under a bulb that is not quite where it was measured."""
    return usual_subject(
        MATERIAL, small_ball(near_bulb(POSITION_SIGMA * rng.normal(size=3)))
    )


def tilted_direction(degrees: float) -> np.ndarray:
    """The lamp's direction, turned by an angle towards the viewer's direction."""
    way = np.asarray(lamp().direction, float)
    across = np.array([0, 0, 1]) - way[2] * way
    across /= np.linalg.norm(across)
    angle = np.deg2rad(degrees)
    return np.cos(angle) * way + np.sin(angle) * across


def turned_camera(degrees: Sequence[float]) -> pf.OrthographicCamera:
    """The usual camera, rotated from its view along −z."""
    turn = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
    return pf.OrthographicCamera(SMALL, SMALL, rotation=turn)


def central_mask(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
    """Options with a mask of pixels that see the ball however the camera is turned."""
    del rng
    rows, columns = (np.indices(light.shape[:2]) + 0.5) / len(light) * 2 - 1
    return {"mask": rows**2 + columns**2 < 0.6**2}


def exposure_scenes(times: Sequence[float]) -> tuple[pf.Scene, ...]:
    """Scenes of the ball, one for each lamp, with exposure times that differ."""
    ways = spread_directions(len(times))
    return tuple(
        small_ball(lamp(way, 0.4 * time), ambient=0.3 * time)
        for way, time in zip(ways, times, strict=True)
    )


def bulbs(x: float) -> tuple[pf.PointLight, pf.PointLight]:
    """Two bulbs, one at each side; the right one is brighter, so they differ."""
    right = pf.PointLight((x, 1.0, 2.5), 0.5)
    return right, pf.PointLight((-x, 1.0, 2.5), 0.25)


def mirrored() -> dict[str, Any]:
    """Ties that make the second bulb the mirror image of the first."""
    one, other = ("scene.lights[0].position", "scene.lights[1].position")
    return {
        f"{other}.x": (-1.0, f"{one}.x"),
        f"{other}.y": f"{one}.y",
        f"{other}.z": f"{one}.z",
    }


def ties_and_priors() -> list[Situation]:
    """Situations with right and with wrong ties and priors."""
    grey_specular = usual_material(specular=0.3)
    equal = {"specular.green": "specular.red", "specular.blue": "specular.red"}
    half = {"diffuse.green": (0.5, "diffuse.red")}
    contradictory = {"diffuse.red": (0.3, 1e-4), "shininess": (60.0, 0.1)}
    cases: dict[str, tuple[Any, Any]] = {
        "equal by a tie": (
            "right",
            fits(usual_subject(grey_specular), noisy(), ties=equal),
        ),
        "half by a tie": ("right", fits(usual_subject(), noisy(), ties=half)),
        "a tie to what is negative": (
            "wrong",
            fits(
                usual_subject(), noisy(), ties={"diffuse.green": (-0.5, "diffuse.red")}
            ),
        ),
        "a tie to what is wrong": (
            "wrong",
            fits(
                usual_subject(), noisy(), ties={"diffuse.green": (0.55, "diffuse.red")}
            ),
        ),
        "a right prior": ("right", with_prior(20.0, 0.2)),
        "a prior 25 σ off": ("doubtful", with_prior(25.0, 0.2)),
        "contradictory priors": (
            "wrong",
            fits(usual_subject(), noisy(), priors=contradictory),
        ),
        "a right prior, clamped": ("right", with_prior(20.0, 0.2, cut=True)),
    }
    return [Situation(name, kind, answer) for name, (kind, answer) in cases.items()]


def with_prior(center: float, deviation: float, cut: bool = False) -> Any:
    """Fits with a prior on the exponent whose centre is a noisy measurement."""

    def draw_options(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
        del light
        mean = center + deviation * rng.normal()
        return {"priors": {"shininess": (mean, deviation)}}

    photograph = clamped(noisy()) if cut else noisy()
    return fits(usual_subject(), photograph, draw_options=draw_options)
