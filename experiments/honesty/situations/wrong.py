"""Situations in which the fitted scene or model differs from the true one."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter

import phongfit as pf
from experiments.honesty.answers import Answers
from experiments.honesty.situations.base import (
    LAMP,
    LARGE,
    MATERIAL,
    Draws,
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
from experiments.honesty.situations.models import four_balls
from phongfit.rendering.film import Encoding, decode, encode

# Part of the warning that is required, where any warning would not do.
REQUIRED_WARNINGS = {
    "sRGB read as linear": "Read it with encoding=srgb",
    "linear read as sRGB": "Read it with encoding=linear",
    "12 bits in 16": "[low-white]",
}


def situations() -> list[Situation]:
    """All situations with a wrong model."""
    cases: dict[str, Callable[[Draws], Answers]] = {
        "f held at 66 for 60": wrong_exponent(ball_scene(size=LARGE)),
        "the same, four images": wrong_exponent(*four_balls(size=LARGE)),
        "a lamp of 4% left out": lamp_left_out(0.04, LARGE, 0.03),
        "a lamp of 25% left out": lamp_left_out(0.25, 48, 0.01),
        "sRGB read as linear": read_as("srgb", "linear"),
        "linear read as sRGB": read_as("linear", "srgb"),
        "12 bits in 16": fits(usual_subject(MATERIAL, bright()), twelve_bits),
        "gamma 2.2 read as sRGB": fits(usual_subject(), gamma),
        "Phong for Blinn": fits(
            lamps_far_apart(), noisy(), fitted=lamps_far_apart(pf.Phong()).scenes
        ),
        "lamp 2° off": fits(
            usual_subject(), noisy(), fitted=ball_scene(lamp(turned_lamp(2.0)))
        ),
        "light from the ground": fits(usual_subject(), ground),
        "vignetting": fits(usual_subject(), vignetting),
        "out of focus": fits(usual_subject(), blurred),
        "half a pixel off": fits(
            usual_subject(MATERIAL, shifted()), noisy(), fitted=ball_scene()
        ),
        "a shadow left out": fits(usual_subject(), shadowed),
        "ripples": fits(usual_subject(), rippled),
        "a black level left in": fits(usual_subject(), clamped(black_level)),
    }
    return [
        Situation(
            name, "wrong", answer, required_warning=REQUIRED_WARNINGS.get(name, "")
        )
        for name, answer in cases.items()
    ]


def wrong_exponent(*scenes: pf.Scene) -> Callable[[Draws], Answers]:
    """A function that fits with the exponent fixed at 66, while the true one is 60.

    **Arguments:** `scenes`: photographed and fitted.
    """
    subject = usual_subject(usual_material(shininess=60.0), *scenes)
    return fits(subject, noisy(), fixed={"shininess": 66.0})


def lamp_left_out(
    fraction: float, size: int, noise: float
) -> Callable[[Draws], Answers]:
    """A function that fits with one lamp, while the true scene has a weak second one.

    **Arguments:** `fraction`: intensity of the second lamp over that of the first;
    `noise`: standard deviation.
    """
    # 0.6 is the usual lamp's intensity.
    both = ball_scene(lamp(), lamp((-1, -0.4, 1), 0.6 * fraction), size=size)
    return fits(
        usual_subject(MATERIAL, both), noisy(noise), fitted=ball_scene(size=size)
    )


def lamps_far_apart(specular: pf.AbstractSpecular | None = None) -> Subject:
    """A ball under two lamps far apart, where the specular models differ most.

    **Arguments:** `specular`: the specular model; `None`: Blinn-Phong.
    """
    lamps = lamp(), lamp((-1.0, -0.4, -0.2))
    return usual_subject(MATERIAL, ball_scene(*lamps, specular_model=specular))


def turned_lamp(degrees: float) -> tuple[float, float, float]:
    """The usual lamp's direction, rotated about z by an arc of `degrees` on the sphere.

    The angle to the viewer (+z) stays as it is.
    """
    # On its circle about z, which is smaller than a great circle, an arc takes a
    # larger angle.
    angle = np.deg2rad(degrees) / np.sin(np.arccos(LAMP[2] / np.linalg.norm(LAMP)))
    x, y, z = LAMP
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    return cos * x - sin * y, sin * x + cos * y, z


def read_as(written: Encoding, read: Encoding) -> Callable[[Draws], Answers]:
    """A function that fits photographs stored in one encoding and read in another.

    **Arguments:** `written`: encoding of the file; `read`: the one used to decode it.
    """

    def photograph(light: Image, rng: np.random.Generator) -> Image:
        return decode(encode(clamped(noisy())(light, rng), written), read)

    return fits(usual_subject(), photograph, film=pf.Film(encoding=read))


def bright() -> pf.Scene:
    """The ball under a lamp so strong that its highlight exceeds white."""
    return ball_scene(lamp(intensity=1.2))


def twelve_bits(light: Image, rng: np.random.Generator) -> Image:
    """A photograph of 12 bits in a file of 16 bits: white is 4095 of 65535."""
    return np.round(4095 * clamped(noisy())(light, rng)) / 65535


def gamma(light: Image, rng: np.random.Generator) -> Image:
    """A noisy photograph encoded by gamma 2.2 and decoded as sRGB.

    The curves are so alike that only low noise shows the difference.
    """
    return decode(clamped(noisy(0.0015))(light, rng) ** (1 / 2.2), "srgb")


def pixel_coordinates(light: Image) -> tuple[np.ndarray, np.ndarray]:
    """x to the right and y up of each pixel, from −1 to 1, of shape (H, W, 1) each."""
    steps = [(np.arange(n) + 0.5) / n * 2 - 1 for n in light.shape[:2]]
    y, x = np.meshgrid(-steps[0], steps[1], indexing="ij")
    return x[..., None], y[..., None]


def ground(light: Image, rng: np.random.Generator) -> Image:
    """Add light that a table reflects from below, and noise.

    0.03 at the lower edge of the image, falling linearly to 0 at the upper one.
    """
    _, y = pixel_coordinates(light)
    seen = light.any(axis=-1, keepdims=True)
    return noisy()(light + np.where(seen, 0.03 * (1 - y) / 2, 0), rng)


def vignetting(light: Image, rng: np.random.Generator) -> Image:
    """Darken the image towards its corners, by 5 % at the ball's rim; add noise."""
    x, y = pixel_coordinates(light)
    return noisy()(light * (1 - 0.06 * (x**2 + y**2)), rng)


def blurred(light: Image, rng: np.random.Generator) -> Image:
    """Blur the light by a Gaussian of σ = 1 pixel, and add noise afterwards."""
    return noisy()(gaussian_filter(light, (1, 1, 0)), rng)


def shifted() -> pf.Scene:
    """The scene with the ball half a pixel to the right."""
    # The image is 2.2 world units and 48 pixels high.
    half = 0.5 * 2.2 / 48
    return ball_scene(surface=pf.Sphere(center=(half, 0.0, 0.0)))


def shadowed(light: Image, rng: np.random.Generator) -> Image:
    """Darken a disc to 0.6 of its light, as an object before the lamp; add noise."""
    x, y = pixel_coordinates(light)
    disc = (x + 0.2) ** 2 + (y - 0.1) ** 2 < 0.15**2
    return noisy()(np.where(disc, 0.6 * light, light), rng)


def rippled(light: Image, rng: np.random.Generator) -> Image:
    """Modulate the light by stripes of 2 %, and add noise."""
    x, _ = pixel_coordinates(light)
    return noisy()(light * (1 + 0.02 * np.sin(9 * x)), rng)


def black_level(light: Image, rng: np.random.Generator) -> Image:
    """Add a black level of 0.01 in every second band of 12 rows, and noise."""
    band = (np.arange(len(light)) // 12 % 2)[:, None, None]
    return noisy()(light + 0.01 * band, rng)
