"""Question: where does the light of a picture come from, from day to night?

One ball over a floor through 24 hours: sun and moon are directional lights, a street
lamp is a spot, the sky is ambient light, and there is fog in the morning. Light adds,
so each picture is split into the parts due to each source, hour by hour.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

import phongfit as pf
from experiments import style
from experiments.balls import ball
from experiments.finding import Experiment, Finding, Table
from experiments.light_kinds import MATERIAL, RADIUS, floor

SHOWN = (6.5, 8.0, 12.0, 16.0, 17.5, 19.0, 21.0, 24.0)
"""Hours of the pictures that are drawn."""

LAMPS = ("sun", "moon", "street lamp")
SOURCES = (*LAMPS, "sky", "fog")
COLOURS = (style.ORANGE, style.SKY, style.VERMILION, style.BLUE, style.PALE)
"""Colours of `SOURCES` in the figure."""

UNCLAMPED = pf.Film(clamp=False)

# RGB in linear light: of the sky, and of the lamps at their brightest.
DAY_SKY, NIGHT_SKY = np.array([0.35, 0.5, 0.75]), np.array([0.012, 0.016, 0.04])
DUSK = np.array([0.75, 0.3, 0.12])
MOON, LAMP = (0.045, 0.055, 0.09), (2.4, 1.7, 0.9)


@dataclasses.dataclass(frozen=True)
class Result:
    """Light of the scene over the day.

    - `hours`: times of the images.
    - `light_by_source`: mean light of the pixels of ball and floor, where 1 is white:
        (hours, sources), in the order of `SOURCES`.
    - `sum_error`: largest difference of a sample from the sum of its parts.
    """

    hours: np.ndarray
    light_by_source: np.ndarray
    sum_error: float


def elevation(hour: float) -> float:
    """Sine of the sun's angle over the horizon: 0 at 6 and 18 o'clock, < 0 at night."""
    return float(np.sin(np.pi * (hour - 6) / 12))


def ramp(value: float, low: float, high: float) -> float:
    """A factor that is 0 below `low`, 1 above `high`, and linear between them."""
    return float(np.clip((value - low) / (high - low), 0, 1))


def sky(hour: float) -> Float[np.ndarray, "3"]:
    """The sky's RGB: blue by day, red at dusk and dawn, nearly black at night."""
    elevation_sine = elevation(hour)
    plain = NIGHT_SKY + ramp(elevation_sine, -0.25, 0.35) * (DAY_SKY - NIGHT_SKY)
    redness = np.exp(-((elevation_sine / 0.18) ** 2)) * 0.6
    return (1 - redness) * plain + redness * 0.6 * DUSK


def scene_at(hour: float, size: int) -> pf.Scene:
    """The scene at an hour of the day, in `size` × `size` pixels; y is up.

    It has sun, moon and street lamp at any hour, some of intensity 0: scenes of one
    structure share a compiled program.
    """
    # The sun rises at +x at 6 o'clock; the moon stands opposite it.
    hour_angle = np.pi * (hour - 6) / 12
    elevation_sine = elevation(hour)
    # A lamp below the horizon has no intensity, but needs a direction.
    up = max(abs(elevation_sine), 0.05)
    direction = (np.cos(hour_angle), up, 0.5)
    low_sun = np.array([1.0, 0.45, 0.15])
    high_sun = np.array([0.8, 0.77, 0.7])
    sun = low_sun + ramp(elevation_sine, 0.0, 0.5) * (high_sun - low_sun)
    lamp = pf.SpotLight(
        (-0.5, 2.0, 0.8),
        (0.4, -1.4, -0.7),
        ramp(-elevation_sine, -0.12, 0.05) * np.array(LAMP),
        cutoff=32.0,
        exponent=3.0,
        attenuation=(0, 0, 1),
    )
    fog = pf.Fog(sky(hour), density=0.02 + 0.16 * np.exp(-((hour - 7.0) ** 2)))
    camera = pf.PerspectiveCamera.look_at(
        (0.6, 1.5, 4.2), (0.15, 0.62, 0), width=size, height=size, fov_y=34.0
    )
    return pf.Scene(
        pf.geometry.join([floor(60.0), ball(48, RADIUS, (0, 0.6, 0))]),
        camera,
        [
            pf.DirectionalLight(direction, ramp(elevation_sine, 0.0, 0.2) * sun),
            pf.DirectionalLight(
                (-direction[0], up, 0.5),
                ramp(-elevation_sine, 0.0, 0.2) * np.array(MOON),
            ),
            lamp,
        ],
        ambient=0.5 * sky(hour),
        fog=fog,
        shadows=True,
        background=sky(hour),
    )


def split_by_source(
    scene: pf.Scene, gbuffer: pf.geometry.GBuffer
) -> Float[np.ndarray, "parts height width 3"]:
    """Parts of the picture due to each of `SOURCES`, and last the whole picture."""
    dark = jnp.zeros_like(scene.ambient)

    def image(on: int | None, ambient: bool) -> np.ndarray:
        """The picture with only lamp number `on` (`None`: none), and maybe ambient."""
        lamps = [
            light if k == on else eqx.tree_at(lambda one: one.intensity, light, dark)
            for k, light in enumerate(scene.lights)
        ]
        partly_lit = dataclasses.replace(
            scene, lights=tuple(lamps), ambient=scene.ambient if ambient else dark
        )
        picture = pf.render(partly_lit, MATERIAL, film=UNCLAMPED, gbuffer=gbuffer)
        return np.asarray(picture, float)

    # Without any light the fog and the background remain, in every picture.
    fog = image(None, False)
    lamps = [image(k, False) - fog for k in range(len(scene.lights))]
    whole = pf.render(scene, MATERIAL, film=UNCLAMPED, gbuffer=gbuffer)
    return np.array([*lamps, image(None, True) - fog, fog, np.asarray(whole, float)])


def measure(size: int, hours: np.ndarray) -> tuple[Result, np.ndarray]:
    """Measure every hour; returns the numbers, and pictures (hours, H, W, 3)."""
    light_by_source, sum_errors, pictures = [], [], []
    for hour in hours:
        scene = scene_at(hour, size)
        gbuffer = scene.trace()
        *by_source, whole = split_by_source(scene, gbuffer)
        light_by_source.append(
            np.array(by_source)[:, np.asarray(gbuffer.mask)].mean(axis=(1, 2))
        )
        sum_errors.append(np.abs(sum(by_source) - whole).max())
        pictures.append(whole)
    result = Result(hours, np.array(light_by_source), float(max(sum_errors)))
    return result, np.array(pictures)


@style.styled
def draw(result: Result, size: int) -> Figure:
    """Draw the scene at eight hours, and the sources of light through the day.

    **Arguments:** `size`: width and height of each picture, pixels.
    """
    figure = style.page(6.5)
    top, bottom = style.bands(figure, 4.1, 2.4)
    for axes, hour in zip(top.subplots(2, 4).flat, SHOWN, strict=True):
        minutes = round(60 * hour)
        picture = pf.render(scene_at(hour, size), MATERIAL, samples=4)
        style.show(axes, picture, f"{minutes // 60}:{minutes % 60:02d}")
    left, right = bottom.subplots(1, 2)
    light = result.light_by_source
    for axes, values in (
        (left, light),
        (right, 100 * light / light.sum(axis=1, keepdims=True)),
    ):
        axes.stackplot(
            result.hours, values.T, labels=SOURCES, colors=COLOURS, lw=0.5, ec="white"
        )
        axes.set_xlim(result.hours[0], result.hours[-1])
        axes.set_xticks(range(0, 25, 4))
        axes.set_xlabel("hour of the day")
    left.set_ylabel("light of ball and floor (white: 1)")
    right.set_ylabel("share of it (%)")
    right.set_ylim(0, 100)
    handles, names = left.get_legend_handles_labels()
    bottom.legend(handles, names, loc="outside lower center", ncols=len(SOURCES))
    return figure


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    hours = np.linspace(0, 24, 13 if small else 49)
    result, pictures = measure(48 if small else 160, hours)
    light = result.light_by_source.sum(axis=1)
    noon, night = int(np.argmin(np.abs(hours - 12))), 0
    fraction = result.light_by_source / light[:, None]
    sun, moon, street_lamp, sky_light, fog = range(len(SOURCES))
    answer = (
        f"At noon ball and floor send {light[noon] / light[night]:.0f} times the light "
        f"of midnight. The sun gives {100 * fraction[noon, sun]:.0f} % and the sky "
        f"{100 * fraction[noon, sky_light]:.0f} % at noon; at midnight the street lamp "
        f"gives {100 * fraction[night, street_lamp]:.0f} %, the moon "
        f"{100 * fraction[night, moon]:.0f} %. "
        f"The fog gives most at {hours[np.argmax(fraction[:, fog])]:g} o'clock, "
        f"{100 * fraction[:, fog].max():.0f} %. The parts add up to the whole picture "
        "to "
        f"{result.sum_error:.0e} of white, shadows and fog included."
    )
    rows = tuple(
        (f"{hour:g}:00", f"{total:.3f}", *(f"{100 * part:.0f} %" for part in line))
        for hour, total, line in zip(hours, light, fraction, strict=True)
        if hour % 4 == 0
    )
    added = result.sum_error < 1e-5
    return Finding(
        answer,
        dataclasses.asdict(result),
        draw(result, 48 if small else 256),
        "A ball over a floor at eight hours of the day: in fog at dawn, under the high "
        "sun, in red light, under a street lamp; the mean light of the picture by "
        "source, hour by hour.",
        Table(("hour", "light", *SOURCES), rows),
        # The last hour is the first again, and the animation repeats.
        frames=pictures[:-1],
        failed_checks=() if added else ("the parts do not add up to the whole",),
    )


EXPERIMENT = Experiment("day_to_night", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
