"""Situations with unknowns of scenes, with ties, and with priors."""

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
    alike,
    ball_scene,
    clamped,
    fits,
    lamp,
    noisy,
    usual_material,
    usual_subject,
)

# The unknowns that `pf.fit` has by default.
USUAL = ("ambient", "diffuse", "specular", "shininess")
# True exposures of three photographs.
EXPOSURES = (1.0, 0.7, 1.4)
# Rotation vector of the camera in the world's axes, degrees.
TURN = (0.6, -0.8, 2.0)
# Standard deviation of a bulb's measured position, world units; the ball's radius is 1.
POSITION_SIGMA = 0.1
TURN_LABELS = tuple(f"scene.camera.rotation.{axis}" for axis in "xyz")


def situations() -> list[Situation]:
    """All situations with unknowns of scenes, with ties, and with priors."""
    return [*scene_unknowns(), *ties_and_priors()]


def small_ball(*lights: pf.AbstractLight, **changes: Any) -> pf.Scene:
    """The usual ball in 32 × 32 pixels, since these fits try many starts.

    **Arguments:** `lights`, `changes`: as in [`ball_scene`][].
    """
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
    aim, place = "scene.lights[0].direction", "scene.lights[0].position"
    known: Any = {"known": MATERIAL}
    right = {
        "the lamp's intensity unknown": fits(
            subject,
            noisy(),
            fitted=small_ball(lamp(intensity=0.3)),
            unknowns=("specular", "shininess", "scene.lights[0].intensity"),
            **known,
        ),
        "the lamp's direction unknown, 20° off": fits(
            subject,
            noisy(),
            fitted=small_ball(lamp(tilted_direction(20.0))),
            unknowns=(*USUAL, aim),
        ),
        "the lamp's direction unknown, 120° off": fits(
            subject,
            noisy(),
            fitted=small_ball(lamp(tilted_direction(120.0))),
            unknowns=(*USUAL, aim),
        ),
        "the lamp unknown, a weak and narrow highlight": fits(
            usual_subject(
                pf.Material((0.4, 0.3, 0.2), 0.06, 400.0, 0.1),
                small_ball(lamp((-0.6, -0.2, 0.75))),
            ),
            noisy(0.005),
            fitted=small_ball(lamp((0, 0, 1))),
            unknowns=(*USUAL, aim),
        ),
        "a bulb's position unknown": fits(
            usual_subject(MATERIAL, small_ball(true_bulb)),
            noisy(),
            fitted=small_ball(first_guess),
            unknowns=(*USUAL, place),
        ),
        "a bulb's position uncertain": fits(
            bulb_misplaced,
            noisy(0.03),
            fitted=small_ball(near_bulb()),
            uncertain={place: POSITION_SIGMA},
        ),
        "a spot's position unknown, its rim seen": fits(
            usual_subject(MATERIAL, small_ball(true_spot)),
            noisy(0.002),
            fitted=small_ball(pf.SpotLight((1.1, 1, 3), (-1, -1, -3), 0.6, cutoff=12)),
            unknowns=("ambient", "diffuse", place),
            **known,
        ),
        "the ball's radius unknown": fits(
            usual_subject(MATERIAL, small_ball(surface=pf.Sphere(radius=0.8))),
            noisy(0.002),
            fitted=small_ball(surface=pf.Sphere(radius=0.83)),
            unknowns=("ambient", "diffuse", "scene.surface.radius"),
            **known,
        ),
        "exposures unknown": fits(
            usual_subject(MATERIAL, *exposure_scenes(EXPOSURES)),
            noisy(),
            fitted=exposure_scenes((1.0, 1.0, 1.0)),
            unknowns=(*USUAL, "exposure"),
            fixed={"exposure[0]": 1.0},
            other_truths={f"exposure[{k}]": x for k, x in enumerate(EXPOSURES)},
        ),
        "two lamps mirrored by a tie": fits(
            usual_subject(MATERIAL, small_ball(*bulbs(1.5))),
            noisy(),
            fitted=small_ball(*bulbs(1.2)),
            unknowns=("diffuse", place, "scene.lights[1].position"),
            ties=mirrored(),
            **known,
        ),
        "the camera's rotation unknown": fits(
            usual_subject(MATERIAL, small_ball(camera=turned_camera(TURN))),
            noisy(),
            fitted=small_ball(),
            draw_options=central_mask,
            unknowns=("diffuse", "scene.camera.rotation"),
            other_truths=dict(zip(TURN_LABELS, TURN, strict=True)),
            **known,
        ),
    }
    cutoff = fits(
        usual_subject(MATERIAL, small_ball(true_spot)),
        noisy(),
        fitted=small_ball(wider_spot),
        unknowns=("diffuse", "scene.lights[0].cutoff"),
        **known,
    )
    return [
        *alike("right", right),
        Situation("a spot's cutoff unknown", "doubtful", cutoff, wide=True),
    ]


def near_bulb(offset: Sequence[float] | np.ndarray = (0, 0, 0)) -> pf.PointLight:
    """A bulb so near that its light falls off over the ball.

    **Arguments:** `offset`: from its measured position, world units.
    """
    return pf.PointLight(np.array((0.8, 0.9, 2.2)) + offset, attenuation=(0.5, 0, 0.3))


def bulb_misplaced(rng: np.random.Generator) -> Subject:
    """The ball under a bulb at a random offset from its measured position."""
    return usual_subject(
        MATERIAL, small_ball(near_bulb(POSITION_SIGMA * rng.normal(size=3)))
    )


def tilted_direction(degrees: float) -> np.ndarray:
    """The usual lamp's direction, turned by an angle towards the viewer (+z)."""
    direction = np.asarray(lamp().direction, float)
    across = np.array([0, 0, 1]) - direction[2] * direction
    across /= np.linalg.norm(across)
    angle = np.deg2rad(degrees)
    return np.cos(angle) * direction + np.sin(angle) * across


def turned_camera(degrees: Sequence[float]) -> pf.OrthographicCamera:
    """The usual camera, rotated from its view along −z.

    **Arguments:** `degrees`: rotation vector in the world's axes.
    """
    rotation = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
    return pf.OrthographicCamera(SMALL, SMALL, rotation=rotation)


def central_mask(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
    """Options with a mask of pixels that see the ball also if the camera is turned.

    A disc of 0.6 of half the image's width; the ball's radius is 0.91 of it.
    """
    del rng
    rows, columns = (np.indices(light.shape[:2]) + 0.5) / len(light) * 2 - 1
    return {"mask": rows**2 + columns**2 < 0.6**2}


def exposure_scenes(times: Sequence[float]) -> tuple[pf.Scene, ...]:
    """Scenes of the ball, one for each lamp; an exposure is a factor on all light.

    **Arguments:** `times`: exposure of each scene.
    """
    directions = spread_directions(len(times))
    return tuple(
        small_ball(lamp(direction, 0.4 * time), ambient=0.3 * time)
        for direction, time in zip(directions, times, strict=True)
    )


def bulbs(x: float) -> tuple[pf.PointLight, pf.PointLight]:
    """Two bulbs at x and −x; the right one is brighter, so they are distinguishable."""
    right = pf.PointLight((x, 1.0, 2.5), 0.5)
    return right, pf.PointLight((-x, 1.0, 2.5), 0.25)


def mirrored() -> dict[str, Any]:
    """Ties that mirror the second bulb's position: x is −1 times that of the first."""
    first, second = "scene.lights[0].position", "scene.lights[1].position"
    return {
        f"{second}.x": (-1.0, f"{first}.x"),
        f"{second}.y": f"{first}.y",
        f"{second}.z": f"{first}.z",
    }


def ties_and_priors() -> list[Situation]:
    """Situations with right and with wrong ties and priors.

    A tie is a label, or a pair of factor and label; a prior is mean and standard
    deviation.
    """
    grey_specular = usual_material(specular=0.3)
    equal = {"specular.green": "specular.red", "specular.blue": "specular.red"}
    half = {"diffuse.green": (0.5, "diffuse.red")}
    contradictory = {"diffuse.red": (0.3, 1e-4), "shininess": (60.0, 0.1)}
    right = {
        "equal by a tie": fits(usual_subject(grey_specular), noisy(), ties=equal),
        "half by a tie": fits(usual_subject(), noisy(), ties=half),
        "a right prior": with_prior(20.0, 0.2),
        "a right prior, clamped": with_prior(20.0, 0.2, cut=True),
    }
    wrong = {
        "a tie to what is negative": fits(
            usual_subject(), noisy(), ties={"diffuse.green": (-0.5, "diffuse.red")}
        ),
        "a tie to what is wrong": fits(
            usual_subject(), noisy(), ties={"diffuse.green": (0.55, "diffuse.red")}
        ),
        "contradictory priors": fits(usual_subject(), noisy(), priors=contradictory),
    }
    return [
        *alike("right", right),
        *alike("wrong", wrong),
        Situation("a prior 25 σ off", "doubtful", with_prior(25.0, 0.2)),
    ]


def with_prior(center: float, deviation: float, cut: bool = False) -> Any:
    """A function that fits with a prior on the exponent, whose mean varies by draw.

    **Arguments:** `center`: expectation of the prior's mean; `deviation`: standard
    deviation of the prior, and of its mean; `cut`: whether images are clipped to
    [0, 1].
    """

    def draw_options(light: Image, rng: np.random.Generator) -> Mapping[str, Any]:
        del light
        mean = center + deviation * rng.normal()
        return {"priors": {"shininess": (mean, deviation)}}

    photograph = clamped(noisy()) if cut else noisy()
    return fits(usual_subject(), photograph, draw_options=draw_options)
