"""Situations of captures: normals, lamps' strengths or an angle of view are unknown."""

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.honesty.answers import REFUSED, Answers, DrawAnswer, join_draws
from experiments.honesty.situations.base import (
    MATERIAL,
    UNCLAMPED,
    Draws,
    Situation,
    alike,
)
from phongfit.files.captures import open_capture

# Width and height in pixels, number of lamps, and standard deviation of the noise.
SIZE, LAMPS, NOISE = 24, 12, 0.004
CAMERA = pf.OrthographicCamera(SIZE, SIZE, view_height=2.2)
DIRECTIONS = spread_directions(LAMPS)
# True ρ_s and f of the ball.
SPECULAR, SHININESS = 0.3, 25.0
# Distance of near lamps from the ball's centre in world units, and the perspective
# camera's angle of view from the lower to the upper edge in degrees.
NEAR, FOV = 3.0, 50.0
# Standard deviation of the logarithm of the lamps' strengths.
STRENGTH_SCATTER = 0.1
# Number of texels along a side of the texture.
TEXELS = 4
HIGHLIGHT = ("specular.red", "specular.green", "specular.blue", "shininess")


class Answer(NamedTuple):
    """Estimates of one draw with their truth and standard errors; warnings.

    Numbers are in the order of the labels, or one number for all.
    """

    truth: Any
    estimate: Any
    error: Any
    warnings: tuple[str, ...]
    at_bound: Any = False


def situations() -> list[Situation]:
    """All situations with captures."""
    bounds = {"shininess": (15.0, 1000.0)}
    # Each draw fits a whole map.
    few_draws: Any = {"draw_fraction": 0.04}
    right = {
        "normals, a shared highlight": shared_highlight(),
        "normals, materials of a matte ball counted": matte_ball_materials,
    }
    wide = {
        "normals, near lamps": shared_highlight(near=True),
        "normals, strengths fitted": strengths,
        "an angle of view fitted": angle_of_view,
    }
    without_exponent = {
        "normals, a shared highlight of a matte ball": shared_highlight(0.0),
        "normals, the same, f from 15": shared_highlight(0.0, bounds=bounds),
        "the texture of a matte mesh": texture,
    }
    wrong = {
        "normals, near lamps in one pass": (
            shared_highlight(near=True, passes=1),
            "[pixels-misplaced]",
        ),
        "normals, lamps of other strengths": (
            shared_highlight(unequal_strengths=True),
            "[strengths-doubtful]",
        ),
        "lamps behind the surface": (lamps_behind, "turn the sign of z"),
    }
    return [
        *alike("right", right, **few_draws),
        *alike("right", wide, wide=True, **few_draws),
        *alike(
            "open",
            without_exponent,
            unidentifiable=("shininess",),
            wide=True,
            draw_fraction=0.2,
        ),
        *(
            Situation(name, "wrong", answer, required_warning=warning, **few_draws)
            for name, (answer, warning) in wrong.items()
        ),
    ]


def per_draw(
    labels: tuple[str, ...], answer: Callable[[np.random.Generator], Answer]
) -> Callable[[Draws], Answers]:
    """A function that calls `answer` for each draw, with intervals of ± 1.96 errors.

    A draw that raises `ValueError` has its message in place of estimates.
    """

    def answers(draws: Draws) -> Answers:
        joined: list[DrawAnswer | str] = []
        for rng in draws:
            try:
                result = answer(rng)
            except ValueError as error:
                joined.append(f"{REFUSED}{error}")
                continue
            truth, estimate, error, at_bound = (
                np.broadcast_to(np.asarray(one, float), len(labels))
                for one in (
                    result.truth,
                    result.estimate,
                    result.error,
                    result.at_bound,
                )
            )
            low, high = estimate - 1.96 * error, estimate + 1.96 * error
            bound = at_bound.astype(bool)
            joined.append(
                DrawAnswer(truth, estimate, error, low, high, bound, result.warnings)
            )
        bounds = [
            (1.0, 1000.0) if label == "shininess" else (0.0, np.inf) for label in labels
        ]
        return join_draws(labels, np.array(bounds), joined)

    return answers


def ball_scenes(near: bool = False) -> list[pf.Scene]:
    """Scenes of the ball, one for each lamp.

    **Arguments:** `near`: whether the lamps are at a distance of `NEAR`, with light
    that falls off as 1/r², and not infinitely far away.
    """
    lights = [
        pf.PointLight(NEAR * direction, attenuation=(0, 0, 1 / NEAR**2))
        if near
        else pf.DirectionalLight(direction)
        for direction in DIRECTIONS
    ]
    return [pf.Scene(pf.Sphere(), CAMERA, light) for light in lights]


def photographs(
    scenes: list[pf.Scene], specular: float, rng: np.random.Generator
) -> Float[np.ndarray, "lamps height width 3"]:
    """Noisy images of the scenes; the material has this ρ_s, and f = `SHININESS`."""
    ball = pf.Material(MATERIAL.diffuse, specular, SHININESS, 0.0)
    light = [np.asarray(pf.render(one, ball, film=UNCLAMPED)) for one in scenes]
    noise = NOISE * rng.normal(size=(len(light), *light[0].shape))
    return np.stack(light) + noise.astype(light[0].dtype)


def on_plane(scenes: list[pf.Scene]) -> list[pf.Scene]:
    """Scenes with the plane z = 0 in place of the ball, whose shape is to be fitted."""
    steps = (np.arange(SIZE) + 0.5 - SIZE / 2) * float(CAMERA.view_height) / SIZE
    x, y = np.meshgrid(steps, -steps)
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1)
    plane = pf.NormalMap(np.ones((SIZE, SIZE, 1)) * [0.0, 0.0, 1.0], None, positions)
    return [dataclasses.replace(one, surface=plane) for one in scenes]


def central_mask(rim: float = 0.35) -> np.ndarray:
    """Pixels of the ball, (H, W), where the cosine of normal and view exceeds `rim`."""
    gbuffer = pf.geometry.trace(pf.Sphere(), CAMERA)
    return np.asarray(gbuffer.mask) & (np.asarray(gbuffer.normal)[..., 2] > rim)


def fit_normals(scenes: list[pf.Scene], images: np.ndarray, **options: Any) -> pf.Maps:
    """Maps of normals and materials; by default all pixels share one ρ_s and f.

    **Arguments:** `scenes`: with the true lamps; `options`: of
    [`fit_maps`][phongfit.fit_maps].
    """
    defaults: dict[str, Any] = {
        "unknowns": ("diffuse", "specular", "shininess"),
        "materials": 1,
    }
    return pf.fit_maps(
        on_plane(scenes),
        images,
        per_channel=("diffuse",),
        normals="fit",
        mask=central_mask(),
        film=UNCLAMPED,
        progress=False,
        **(defaults | options),
    )


def shared_highlight(
    specular: float = SPECULAR,
    near: bool = False,
    unequal_strengths: bool = False,
    **options: Any,
) -> Callable[[Draws], Answers]:
    """A function that fits normals, and the ρ_s and f that all pixels share.

    Its answers have ρ_s, f, and one number for the normals: the root mean square of
    their angles to the true ones, whose truth is 0 and whose standard error is the root
    mean square of the stated ones, in degrees.

    **Arguments:**

    - `specular`: the true ρ_s.
    - `near`: see [`ball_scenes`][].
    - `unequal_strengths`: whether the lamps' true strengths differ from those of the
        fitted scenes, which are 1.
    - `options`: of [`fit_normals`][].
    """

    def answer(rng: np.random.Generator) -> Answer:
        scenes = ball_scenes(near)
        images = photographs(scenes, specular, rng)
        if unequal_strengths:
            images *= factors(rng).astype(images.dtype)[:, None, None, None]
        maps = fit_normals(scenes, images, **options)
        result = maps.materials
        assert result is not None
        return Answer(
            (specular, SHININESS, 0.0),
            # Material 0, red; all channels share ρ_s.
            (result.specular[0, 0], result.shininess[0], angle_off(maps)),
            (
                result.stderr_specular[0, 0],
                result.stderr_shininess[0],
                stated_error(maps),
            ),
            maps.warnings,
            (result.specular[0, 0] == 0, result.at_bound[0], False),
        )

    return per_draw(("specular", "shininess", "normals"), answer)


def angle_off(maps: pf.Maps) -> float:
    """Root mean square of the normals' angles to the true ones, degrees."""
    true = np.asarray(pf.geometry.trace(pf.Sphere(), CAMERA).normal)
    cosine = np.sum(maps.normals * true, axis=-1)[has_normal(maps)]
    return float(np.sqrt(np.mean(np.degrees(np.arccos(cosine.clip(-1, 1))) ** 2)))


def stated_error(maps: pf.Maps) -> float:
    """Root mean square of the normals' standard errors, degrees."""
    return float(np.sqrt(np.mean(maps.normals_stderr[has_normal(maps)] ** 2)))


def has_normal(maps: pf.Maps) -> np.ndarray:
    """Pixels with a fitted normal, (H, W): those with a finite standard error > 0."""
    return np.isfinite(maps.normals_stderr) & (maps.normals_stderr > 0)


def factors(rng: np.random.Generator) -> np.ndarray:
    """Random strengths of the lamps, (lamps,), whose mean is 1."""
    values = np.exp(STRENGTH_SCATTER * rng.normal(size=LAMPS))
    return values / values.mean()


def matte_ball_materials(draws: Draws) -> Answers:
    """Red ρ_s that `materials="auto"` finds on a matte ball; the truth is 0.

    Where it finds no material with a highlight (`maps.materials` is `None`), the answer
    is 0 ± 0, which is right.
    """

    def answer(rng: np.random.Generator) -> Answer:
        scenes = ball_scenes()
        maps = fit_normals(scenes, photographs(scenes, 0.0, rng), materials="auto")
        result = maps.materials
        value, error = 0.0, 0.0
        if result is not None:
            # Material 0, red; all channels share ρ_s.
            value, error = result.specular[0, 0], result.stderr_specular[0, 0]
        return Answer(0.0, value, error, maps.warnings)

    return per_draw(("specular",), answer)(draws)


def strengths(draws: Draws) -> Answers:
    """Strengths of the lamps of a matte ball, fitted together with its normals."""

    def answer(rng: np.random.Generator) -> Answer:
        scenes, true = ball_scenes(), factors(rng)
        images = photographs(scenes, 0.0, rng)
        images *= true.astype(images.dtype)[:, None, None, None]
        maps = fit_normals(
            scenes, images, unknowns=("diffuse",), materials=None, strengths="fit"
        )
        result = maps.strengths
        assert result is not None
        return Answer(true, result.values, result.stderr, maps.warnings)

    return per_draw(tuple(f"strength[{k}]" for k in range(LAMPS)), answer)(draws)


def angle_of_view(draws: Draws) -> Answers:
    """The camera's angle of view in degrees, from a ball that fills the image."""

    def answer(rng: np.random.Generator) -> Answer:
        camera = pf.PerspectiveCamera(SIZE, SIZE, fov_y=FOV, position=(0, 0, 0))
        # At this distance the ball's outline touches the edges of the image.
        distance = 1 / np.sin(np.radians(FOV / 2))
        ball = pf.Sphere((0.0, 0.0, -float(distance)))
        lights = [pf.DirectionalLight(direction) for direction in DIRECTIONS]
        scenes = [pf.Scene(ball, camera, light) for light in lights]
        rows, columns = np.indices((SIZE, SIZE)) - (SIZE - 1) / 2
        # Only the lamps of these scenes count: `fit_fov` replaces camera and surface.
        result = pf.fit_fov(
            on_plane(ball_scenes()),
            photographs(scenes, SPECULAR, rng),
            unknowns=("diffuse", "specular", "shininess"),
            per_channel=("diffuse", "specular"),
            mask=np.hypot(rows, columns) < 0.45 * SIZE,
            film=UNCLAMPED,
        )
        return Answer(FOV, result.degrees, result.stderr, ())

    return per_draw(("fov",), answer)(draws)


def lamps_behind(draws: Draws) -> Answers:
    """Captures whose .lp file has z pointing away from the camera, which is refused."""

    def answer(rng: np.random.Generator) -> Answer:
        names = [f"{k}.png" for k in range(LAMPS)]
        with tempfile.TemporaryDirectory() as folder:
            images = photographs(ball_scenes(), SPECULAR, rng).clip(0, 1)
            for name, image in zip(names, images, strict=True):
                pf.write_image(Path(folder, name), image, "linear", 16)
            pf.write_lp(Path(folder, "lamps.lp"), names, DIRECTIONS * (1, 1, -1))
            # Expected to raise `ValueError`, which becomes the draw's warning.
            open_capture(Path(folder), "linear")
        return Answer(0.0, 0.0, 0.0, ())

    return per_draw(("diffuse",), answer)(draws)


def texture(draws: Draws) -> Answers:
    """ρ_s and f of a matte square with a texture: ρ_s is 0, f is not identifiable."""
    corners = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    uv = np.array([[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]], float)
    mesh = pf.Mesh(corners, [(0, 1, 2), (0, 2, 3)], uv=uv)
    camera = pf.PerspectiveCamera(
        SIZE, SIZE, fov_y=float(np.degrees(2 * np.arctan(0.2))), position=(0, 0, 5)
    )
    scenes = [
        pf.Scene(mesh, camera, pf.DirectionalLight(direction))
        for direction in DIRECTIONS
    ]
    # Pixels along the side of a texel: the square fills the image.
    side = SIZE // TEXELS

    def answer(rng: np.random.Generator) -> Answer:
        texels = rng.uniform(0.1, 0.6, (TEXELS, TEXELS, 3))
        plain = texels.repeat(side, axis=0).repeat(side, axis=1)
        # Lambert's cosine: the square's normal is +z.
        images = [
            direction[2] * plain + 0.01 * rng.normal(size=plain.shape)
            for direction in DIRECTIONS
        ]
        result = pf.fit_texture(
            scenes,
            images,
            size=(TEXELS, TEXELS),
            unknowns=("diffuse.texture", "specular", "shininess"),
            filter="nearest",
            wrap="clamp",
            film=UNCLAMPED,
        )
        numbers = {one.label: one for one in result.shared}
        estimates = [numbers[label] for label in HIGHLIGHT]
        return Answer(
            (0.0, 0.0, 0.0, SHININESS),
            [one.value for one in estimates],
            [one.stderr for one in estimates],
            result.warnings,
            [one.value == 0 for one in estimates],
        )

    return per_draw(HIGHLIGHT, answer)(draws)
