"""Situations with white samples, truths on bounds, and unidentified parameters."""

from typing import Any

import numpy as np

import phongfit as pf
from experiments.honesty.situations.base import (
    MATERIAL,
    NOISE,
    UNCLAMPED,
    Draw,
    Image,
    Situation,
    Subject,
    alike,
    ball_scene,
    cached_subject,
    clamped,
    fits,
    lamp,
    noisy,
    usual_material,
    usual_subject,
)


def situations() -> list[Situation]:
    """All situations with white samples, bounds, or parameters not identified."""
    return [*white(), *bounds(), *unidentified()]


def white() -> list[Situation]:
    """Situations with a growing fraction of samples at white."""
    fractions = (0.01, 0.3, 0.93, 0.97, 0.99)
    answers: dict[str, Any] = {
        f"{fraction:.0%} white": fits(bright(fraction), clamped(noisy()))
        for fraction in fractions
    }
    answers["97% white, noise given"] = fits(
        bright(0.97), clamped(noisy()), noise=NOISE
    )
    answers["10% at 1 beside negative values"] = fits(bright(0.1, 0.02), cut_above)
    # With few samples below white, a warning about the fit is right.
    clipped = tuple(f"{fraction:.0%}" for fraction in fractions[2:])
    return [
        Situation(name, "doubtful" if name.startswith(clipped) else "right", answer)
        for name, answer in answers.items()
    ]


def bright(fraction: float, ambient: float = 0.3) -> Draw:
    """The usual ball, lit so that this fraction of its samples exceeds white.

    **Arguments:** `ambient`: ambient light before all light is scaled.
    """

    def make() -> Subject:
        light = usual_subject(MATERIAL, ball_scene(ambient=ambient)).light[0]
        factor = 1 / np.quantile(light[light.any(axis=-1)], 1 - fraction)
        # 0.6 is the usual lamp's intensity.
        scene = ball_scene(lamp(intensity=0.6 * factor), ambient=ambient * factor)
        return usual_subject(MATERIAL, scene)

    return cached_subject(make)


def cut_above(light: Image, rng: np.random.Generator) -> Image:
    """Noisy light clipped at white, not at 0: as after a black level was subtracted."""
    return np.minimum(noisy()(light, rng), 1)


def bounds() -> list[Situation]:
    """Situations with the truth on a bound, near it or beyond it."""
    matte = usual_subject(usual_material(shininess=1.5), ball_scene(size=24))
    faint = usual_subject(
        pf.Material(0.6, 0.1, 1.5, 0.1), ball_scene(lamp(intensity=0.9), size=24)
    )
    narrow = usual_subject(
        usual_material(specular=0.51, shininess=500.0), ball_scene(size=24)
    )
    strong_noise = noisy(0.2)
    few_pixels = {
        "f = 1.5, noise 0.2, 24²": fits(matte, strong_noise),
        "the same, noise given": fits(matte, strong_noise, noise=0.2),
        "the same, a faint highlight": fits(faint, strong_noise),
    }
    twins = ball_scene(lamp(), lamp((1, 1.002, 2)))
    materials = {
        "no ambient": usual_material(ambient=(0.0, 0.4, 0.3)),
        "little ambient": usual_material(ambient=(0.003, 0.005, 0.01)),
        "no blue": usual_material(diffuse=(0.6, 0.3, 0.0)),
        "ρ_s at 1": usual_material(specular=1.0),
        "ρ_s beyond 1": usual_material(specular=(0.999, 0.998, 0.5)),
        "f = 1.2": usual_material(shininess=1.2),
    }
    plain = {name: fits(usual_subject(x), noisy()) for name, x in materials.items()}
    doubtful = {
        # The highlight covers two pixels, and the noise is half as high as its peak.
        "the same, a narrow highlight": fits(narrow, strong_noise),
        "two lamps 0.002 rad apart": fits(
            usual_subject(MATERIAL, twins),
            noisy(),
            unknowns=tuple(f"scene.lights[{k}].intensity" for k in range(2)),
            known=MATERIAL,
        ),
    }
    beyond = fits(usual_subject(usual_material(shininess=1600.0)), noisy())
    return [
        *alike("right", plain),
        *alike("right", few_pixels, wide=True),
        *alike("doubtful", doubtful, wide=True),
        Situation("f past its bound", "wrong", beyond),
    ]


def unidentified() -> list[Situation]:
    """Situations with parameters that no pixel identifies."""
    faint = usual_material(specular=0.004)
    shiny = usual_subject(usual_material(specular=0.51))
    plate = ball_scene(
        surface=pf.NormalMap(np.ones((36, 36, 1)) * [0.0, 0.0, 1.0]), size=36
    )
    white_scene = ball_scene(lamp(intensity=9.0), ambient=9.0)
    matte = {
        "no highlight": fits(usual_subject(usual_material(specular=0.0)), noisy()),
    }
    hardly_seen = {
        "a highlight hidden by the mask": fits(
            shiny, noisy(), draw_options=highlight_hidden
        ),
        "a highlight that is smooth all over": fits(
            usual_subject(shiny.material, window()), noisy(0.05)
        ),
    }
    nothing_told = {
        "a flat plate": fits(usual_subject(MATERIAL, plate), noisy()),
        "all white": fits(usual_subject(MATERIAL, white_scene), overexposed),
    }
    every = ("ambient", "diffuse", "specular", "shininess")
    return [
        *alike("open", matte, unidentifiable=("shininess",), wide=True),
        Situation("a faint highlight", "doubtful", fits(usual_subject(faint), noisy())),
        *alike("doubtful", hardly_seen, wide=True),
        *alike("open", nothing_told, unidentifiable=every, wide=True),
    ]


def highlight_hidden(light: Image, rng: np.random.Generator) -> dict[str, Any]:
    """Options with a mask without the highlight, where it exceeds 2 % of its peak."""
    del light, rng
    scene = usual_subject().scenes[0]
    shiny = pf.Material(0.0, 1.0, 20.0, 0.0)
    lobe = np.asarray(pf.render(scene, shiny, film=UNCLAMPED)).max(axis=-1)
    return {"mask": lobe < 0.02}


def window() -> pf.Scene:
    """A part of the ball around its highlight, so small that all of it is bright.

    It has about as many pixels as the usual ball, so compiled programs are shared.
    """
    # The highlight is centred where the normal halves the angle between lamp and
    # viewer (+z); on a ball of radius 1, normals are positions.
    half = np.array(lamp().direction, float) + (0, 0, 1)
    x, y, _ = half / np.linalg.norm(half)
    camera = pf.OrthographicCamera(
        36, 36, view_height=0.3, position=(float(x), float(y), 5.0)
    )
    return pf.Scene(pf.Sphere(), camera, lamp(), 0.3)


def overexposed(light: Image, rng: np.random.Generator) -> Image:
    """A photograph in which every pixel of the ball is white."""
    return np.where(light > 0, 1.0, clamped(noisy())(light, rng))
