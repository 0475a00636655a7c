"""Question: what happens where lights add up, and where there is too much light?

Coloured lamps are added on one ball, in linear light and in what a screen shows, and
one lamp is made brighter until the picture is clamped at white. Measured are how well
pictures of single lamps add up, what is clamped, and how the clamp changes colours.
"""

import colorsys
import dataclasses

import numpy as np
from matplotlib.figure import Figure

import phongfit as pf
from experiments import style
from experiments.finding import Experiment, Finding, Table
from phongfit.rendering.film import decode, encode

LAMPS = {
    "red": ((-1.2, 0.7, 1.0), (0.9, 0.05, 0.05)),
    "green": ((0.0, -1.2, 1.0), (0.05, 0.8, 0.05)),
    "blue": ((1.2, 0.7, 1.0), (0.05, 0.1, 0.95)),
}
"""Direction to each lamp (z to the camera), and its RGB intensity."""

INTENSITIES = (0.5, 1.0, 2.0, 4.0)
"""Intensities of the white lamp; at 1, a matte white surface facing it is white."""

GREY = pf.Material(0.85, 0.4, 40.0, 0.0)
ORANGE = pf.Material((0.8, 0.35, 0.08), 0.3, 25.0, 0.0)
UNCLAMPED = pf.Film(clamp=False)


@dataclasses.dataclass(frozen=True)
class Result:
    """Sums of pictures against pictures of summed light, and effects of the clamp.

    - `sum_error`: largest difference, in units of white, between the picture under all
        lamps and the sum of the pictures under each;
    - `shown_error`: that difference if clamped, sRGB-encoded pictures are added and
        the sum is decoded;
    - `clipped`: fraction of the ball's samples at white, for each of `INTENSITIES`;
    - `hue`: hue of the brightest spot without highlight, for each of `INTENSITIES`, in
        degrees: 0 is red, 60 yellow, 120 green.
    """

    sum_error: float
    shown_error: float
    clipped: np.ndarray
    hue: np.ndarray


def ball(
    size: int, lights: list[pf.DirectionalLight], background: float = 0.0
) -> pf.Scene:
    """A ball under `lights`, in `size` × `size` pixels."""
    camera = pf.OrthographicCamera(size, size, view_height=2.05)
    return pf.Scene(pf.Sphere(), camera, lights, background=background)


def lamps() -> list[pf.DirectionalLight]:
    """A red, a green and a blue lamp, from three sides."""
    return [pf.DirectionalLight(*lamp) for lamp in LAMPS.values()]


def light(scene: pf.Scene, material: pf.Material) -> np.ndarray:
    """Linear light of an image, (H, W, 3), not clamped at white."""
    return np.asarray(pf.render(scene, material, film=UNCLAMPED), float)


def under_white_lamp(size: int, intensity: float, background: float = 0.0) -> pf.Scene:
    """A ball under one white lamp of this intensity, to the upper left."""
    lamp = pf.DirectionalLight((-0.6, 0.6, 1.0), intensity)
    return ball(size, [lamp], background)


def measure(size: int) -> Result:
    """Measure everything on pictures of `size` × `size` pixels."""
    together = light(ball(size, lamps()), GREY)
    alone = [light(ball(size, [lamp]), GREY) for lamp in lamps()]
    # As a screen shows them: first the picture under all lamps, then those under one.
    shown = [encode(np.clip(image, 0, 1), "srgb") for image in (together, *alone)]
    added = decode(np.clip(sum(shown[1:]), 0, 1), "srgb")
    seen = np.asarray(ball(size, []).trace().mask)
    clipped, hue = [], []
    # The emission of GREY is an array of zeros.
    matte = dataclasses.replace(ORANGE, specular=GREY.emission)
    for intensity in INTENSITIES:
        scene = under_white_lamp(size, intensity)
        clipped.append(np.mean(light(scene, ORANGE)[seen] >= 1))
        # Without a highlight all channels are largest at the same spot.
        spot = np.clip(light(scene, matte).max(axis=(0, 1)), 0, 1)
        # `rgb_to_hsv` returns the hue first, as a fraction of a turn.
        hue.append(360 * colorsys.rgb_to_hsv(*spot)[0])
    return Result(
        float(np.abs(sum(alone) - together).max()),
        float(np.abs(added - np.clip(together, 0, 1)).max()),
        np.array(clipped),
        np.array(hue),
    )


@style.styled
def draw(size: int) -> Figure:
    """Draw pictures under several lamps above, and under too bright lamps below.

    **Arguments:** `size`: width and height of each picture, pixels.
    """
    figure = style.page(6.6)
    top, middle, bottom = style.bands(figure, 2.0, 2.0, 2.4)
    sets = [[lamp] for lamp in lamps()] + [lamps()]
    style.picture_grid(
        top,
        [[light(ball(size, one, 1.0), GREY) for one in sets]],
        columns=[*LAMPS, "all three"],
        rows=["lamps"],
    )
    style.picture_grid(
        middle,
        [[light(under_white_lamp(size, one, 1.0), ORANGE) for one in INTENSITIES]],
        columns=[f"$I_s$ = {one:g}" for one in INTENSITIES],
        rows=["one lamp"],
    )
    across = np.linspace(-1, 1, size)
    for axes, intensity in zip(
        bottom.subplots(1, 2, sharey=True), INTENSITIES[1:3], strict=True
    ):
        # The row through the highlight's centre.
        image = light(under_white_lamp(size, intensity), ORANGE)
        row = image[int(np.argmax(image.max(axis=(1, 2))))]
        for name, colour, line, values in zip(
            ("red", "green", "blue"),
            (style.VERMILION, style.GREEN, style.BLUE),
            ("-", "--", "-."),
            row.T,
            strict=True,
        ):
            axes.plot(across, np.minimum(values, 1), line, c=colour, label=name)
            over = np.where(values > 1, values, np.nan)
            axes.plot(across, over, ":", c=colour, lw=1.2)
        axes.axhline(1, c=style.BLACK, lw=0.8)
        axes.set_title(f"$I_s$ = {intensity:g}: row through the highlight")
        axes.set_xlabel("x (radii of the ball)")
    axes = bottom.axes[0]
    axes.set_ylabel("light (white is 1)")
    axes.legend(loc="upper right", title="dotted: cut off")
    return figure


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    size = 64 if small else 256
    result = measure(size)
    answer = (
        "Linear light adds: the picture under three lamps is the sum of three pictures "
        f"(to {result.sum_error:.0e} of white). What a screen shows does not: added "
        f"after encoding, it is up to {result.shown_error:.2f} off. Too bright a lamp "
        f"is cut off at white, channel by channel: at twice full intensity "
        f"{100 * result.clipped[2]:.0f} % of the ball's samples are clamped, and the "
        f"hue of its orange moves from {result.hue[0]:.0f}° to {result.hue[2]:.0f}° "
        f"and, at four times, to {result.hue[3]:.0f}° (yellow is 60°)."
    )
    rows = tuple(
        (f"{intensity:g}", f"{100 * fraction:.1f} %", f"{hue:.0f}°")
        for intensity, fraction, hue in zip(
            INTENSITIES, result.clipped, result.hue, strict=True
        )
    )
    added = result.sum_error < 1e-5
    return Finding(
        answer,
        dataclasses.asdict(result),
        draw(size),
        "A grey ball under a red, a green and a blue lamp and under all three; an "
        "orange ball under an ever brighter lamp, which turns yellow and then white; "
        "light along a row of it, cut off at white channel by channel.",
        Table(("lamp's intensity", "clamped samples", "hue of the matte spot"), rows),
        failed_checks=() if added else ("pictures of single lamps do not add up",),
    )


EXPERIMENT = Experiment("adding_light", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
