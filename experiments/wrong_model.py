"""Question: which errors does a wrong model cause, and which diagnostics detect it?

Images are made in one way and fitted in another: the other highlight, the other
shading, a lamp missing or misplaced or too bright, a wrong encoding, a shadow or a
clamp left out. For each mistake the experiment measures the bias of every parameter, in
its unit and in stated errors, and which diagnostics of the fit detect the mistake.
"""

import dataclasses
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import phongfit as pf
from experiments import style
from experiments.balls import ball as ball_of_triangles, unit_ball
from experiments.finding import Experiment, Finding, Table
from phongfit.rendering.film import decode, encode
from phongfit.report.style import quiet

TRUTH = pf.Material(0.5, 0.3, 20.0, 0.4)
# Standard deviation in linear light, where white is 1.
NOISE = 0.01
PARAMETERS = tuple(style.PARAMETERS)
UNCLAMPED = pf.Film(clamp=False)
LAMP = (1.0, 1.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Mistake:
    """A wrong assumption of a fit.

    The noisy image of `true_scene` is changed by `distort` (by default not at all) and
    fitted with `fitted_scene`. `why_hidden` is the reason why no diagnostic may detect
    the mistake, as a clause for the answer.
    """

    name: str
    true_scene: pf.Scene
    fitted_scene: pf.Scene
    distort: Callable[[np.ndarray], np.ndarray] = np.asarray
    why_hidden: str = "the image is fitted as well as by the right model"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Effects of a mistake: means over noisy images.

    - `bias`: estimate − truth, in the order of `PARAMETERS`; `in_errors`: mean of
        (estimate − truth) / stated error;
    - `chi_squared`: reduced χ²; `correlation`: of neighbouring residuals;
    - `flags`: the diagnostics that detect it in most images: see `DIAGNOSTICS`;
    - `why_hidden`: see [`Mistake`][];
    - `residual`: map (H, W) of image − fit, mean of the channels, of one of the images;
        in standard deviations of the noise.
    """

    name: str
    bias: np.ndarray
    in_errors: np.ndarray
    chi_squared: float
    correlation: float
    flags: tuple[str, ...]
    why_hidden: str
    residual: np.ndarray

    @property
    def misled(self) -> bool:
        """Whether a parameter is more than 3 standard errors off."""
        return bool(np.any(np.abs(self.in_errors) > 3))


DIAGNOSTICS = ("χ²", "neighbours", "bound", "warning")
"""Reduced χ² above 1, for the noise given, by more than five of its standard errors;
residuals that correlate with their neighbours'; a parameter at its bound; a warning of
the fit's own."""


def ball(size: int, **changes: Any) -> pf.Scene:
    """A ball under one lamp in `size` × `size` pixels, with changed fields of Scene."""
    scene = pf.Scene(
        pf.Sphere(),
        pf.OrthographicCamera(size, size),
        pf.DirectionalLight(LAMP, 0.9),
        ambient=0.3,
    )
    return dataclasses.replace(scene, **changes)


def mistakes(size: int) -> list[Mistake]:
    """All mistakes, and first a fit without one; images have `size` × `size` pixels.

    Of each: its name, the scene that makes the image, the scene that is fitted, and
    what changes the image.
    """
    right = ball(size)
    coarse = ball(size, surface=unit_ball(12))
    pair = ball(
        size,
        surface=two_balls(),
        lights=(pf.DirectionalLight((1.0, 0.6, 0.7), 0.9),),
    )
    second = pf.DirectionalLight((-1.0, -0.4, 1.0), 0.15)
    # Both highlights are seen, and the two models shape them differently.
    lamps_far_apart = (*right.lights, pf.DirectionalLight((-1.0, -0.4, -0.2), 0.9))
    lamp_off = pf.DirectionalLight((1.0, 1.0, 1.7), 0.9)
    bright, brighter = (pf.DirectionalLight(LAMP, x * 0.9) for x in (1.5, 1.1))
    return [
        Mistake("none", right, right),
        Mistake(
            "Phong for Blinn",
            right,
            ball(size, specular_model=pf.Phong()),
            why_hidden="under one lamp near the viewer, Phong's model with about a "
            "quarter of the exponent makes nearly the same image",
        ),
        Mistake(
            "the same, lamps far apart",
            ball(size, lights=lamps_far_apart),
            ball(size, lights=lamps_far_apart, specular_model=pf.Phong()),
        ),
        Mistake(
            "Gouraud for Phong",
            coarse,
            dataclasses.replace(coarse, shading=pf.GouraudShading()),
        ),
        Mistake("lamp missing", ball(size, lights=(*right.lights, second)), right),
        Mistake(f"lamp {angle(lamp_off):.0f}° off", right, with_lamp(right, lamp_off)),
        Mistake(
            "lamp 10 % too bright",
            right,
            with_lamp(right, brighter),
            why_hidden="light and reflectance only ever come as their product",
        ),
        Mistake("sRGB read as linear", right, right, lambda i: encode(clip(i), "srgb")),
        Mistake("linear read as sRGB", right, right, lambda i: decode(clip(i), "srgb")),
        Mistake("shadow left out", dataclasses.replace(pair, shadows=True), pair),
        Mistake(
            "clamp left out", with_lamp(right, bright), with_lamp(right, bright), clip
        ),
    ]


def two_balls() -> pf.Mesh:
    """A mesh of a small ball that shades a large one from the lamp, of one material."""
    large, small = ((-0.2, -0.2, 0.0), 0.75), ((0.68, 0.33, 0.6), 0.25)
    both = pf.geometry.join(
        ball_of_triangles(24, radius, center) for center, radius in (large, small)
    )
    # `join` gives each ball a material of its own; this mesh has one.
    return pf.Mesh(both.vertices, both.faces, both.normals)


def clip(image: np.ndarray) -> np.ndarray:
    """Clip an image to [0, 1]."""
    return np.clip(image, 0, 1)


def with_lamp(scene: pf.Scene, lamp: pf.DirectionalLight) -> pf.Scene:
    """The scene with `lamp` as its only light."""
    return dataclasses.replace(scene, lights=(lamp,))


def angle(lamp: pf.DirectionalLight) -> float:
    """Angle between a lamp and the true one, degrees."""
    true, other = np.array(LAMP), np.asarray(lamp.direction, float)
    cosine = true @ other / np.linalg.norm(true) / np.linalg.norm(other)
    return float(np.rad2deg(np.arccos(cosine)))


def measure_outcome(mistake: Mistake, draws: int, seed: int) -> Outcome:
    """Fit `draws` noisy images with one mistake."""
    light = np.asarray(pf.render(mistake.true_scene, TRUTH, film=UNCLAMPED))
    rng = np.random.default_rng(seed)
    fits = [
        pf.fit(
            mistake.fitted_scene,
            mistake.distort(light + NOISE * rng.normal(size=light.shape)),
            per_channel=(),
            noise=NOISE,
            film=UNCLAMPED,
        )
        for _ in range(draws)
    ]
    order = [fits[0].labels.index(name) for name in PARAMETERS]
    truth = np.array([float(getattr(TRUTH, name)) for name in PARAMETERS])
    deviation = np.array([fit.values[order] - truth for fit in fits])
    errors = np.array([fit.errors[order] for fit in fits])
    detected = np.array([[name in flags(fit) for name in DIAGNOSTICS] for fit in fits])
    return Outcome(
        mistake.name,
        deviation.mean(axis=0),
        (deviation / errors).mean(axis=0),
        float(np.mean([fit.reduced_chi_squared for fit in fits])),
        float(np.mean([fit.neighbour_correlation for fit in fits])),
        tuple(np.array(DIAGNOSTICS)[detected.mean(axis=0) > 0.5].tolist()),
        mistake.why_hidden,
        np.mean(fits[0].residuals, axis=-1) / NOISE,
    )


def flags(fit: pf.Fit) -> tuple[str, ...]:
    """The `DIAGNOSTICS` that detect a fault of a fit."""
    # The variance of reduced χ² is 2 over the degrees of freedom.
    chance = 5 * np.sqrt(2 / fit.degrees_of_freedom)
    detected = (
        fit.reduced_chi_squared > 1 + chance,
        # Set to 0 by the fit where it is not significant.
        fit.neighbour_correlation > 0,
        bool(fit.at_bound.any()),
        bool(fit.warnings),
    )
    return tuple(
        name
        for name, is_detected in zip(DIAGNOSTICS, detected, strict=True)
        if is_detected
    )


def measure(small: bool) -> list[Outcome]:
    """Measure all mistakes; the first outcome is that of the fit without one."""
    size, draws = (32, 4) if small else (48, 20)
    return [
        measure_outcome(mistake, draws, seed)
        for seed, mistake in enumerate(mistakes(size))
    ]


@style.styled
def draw(outcomes: list[Outcome]) -> Figure:
    """Draw residuals, and a table of biases and diagnostics."""
    figure = style.page(8.3)
    top, bottom = style.bands(figure, 3.1, 5.2)
    panels = top.subplots(2, 6).ravel()
    for axes in panels[len(outcomes) :]:
        axes.set_axis_off()
    maps = []
    for axes, outcome in zip(panels, outcomes, strict=False):
        maps.append(axes.imshow(outcome.residual, cmap="RdBu_r", vmin=-8, vmax=8))
        quiet(axes)
        axes.set_title(textwrap.fill(outcome.name, 15), fontsize=8)
    bar = top.colorbar(maps[0], ax=panels.tolist(), fraction=0.02, pad=0.01)
    bar.set_label("image − fit (noise's standard deviations)")
    table = bottom.subplots()
    deviation = np.array([outcome.in_errors for outcome in outcomes])
    # Colours are logarithmic: a cell is pale below 1 σ, full from 1000 σ on.
    strength = np.sign(deviation) * np.log10(1 + np.abs(deviation))
    columns = len(PARAMETERS) + len(DIAGNOSTICS)
    cells = np.zeros((len(outcomes), columns))
    cells[:, : len(PARAMETERS)] = strength
    table.imshow(cells, cmap="RdBu_r", vmin=-3, vmax=3, aspect="auto")
    quiet(table)
    for row, outcome in enumerate(outcomes):
        for k, (value, in_errors) in enumerate(zip(*offsets(outcome), strict=True)):
            dark = abs(strength[row, k]) > 1.8
            ink = "white" if dark else style.BLACK
            write(table, k, row, f"{value}\n{in_errors}", ink)
        numbers = {"χ²": f"{outcome.chi_squared:.3g} "}
        numbers["neighbours"] = f"{outcome.correlation:.2f} "
        for k, name in enumerate(DIAGNOSTICS, len(PARAMETERS)):
            number = numbers.get(name, "")
            write(table, k, row, number + ("●" if name in outcome.flags else "·"))
    table.set_yticks(range(len(outcomes)), [outcome.name for outcome in outcomes])
    names = [f"{style.symbol(name)}: off by" for name in PARAMETERS]
    table.set_xticks(range(columns), [*names, *DIAGNOSTICS])
    table.tick_params(length=0, labeltop=True, labelbottom=False)
    table.axvline(len(PARAMETERS) - 0.5, c=style.BLACK, lw=0.8)
    table.set_xlabel(
        "off by: estimate − truth, and in standard errors stated      ●: detects it"
    )
    return figure


def write(axes: Axes, column: int, row: int, words: str, ink: str = "black") -> None:
    """Write text in a cell of the table."""
    axes.text(column, row, words, ha="center", va="center", fontsize=7.5, color=ink)


def offsets(outcome: Outcome) -> tuple[list[str], list[str]]:
    """Biases as text: in units of each parameter, and in stated errors (σ)."""
    digits = [1 if name == "shininess" else 3 for name in PARAMETERS]
    values = [f"{bias:+.{n}f}" for bias, n in zip(outcome.bias, digits, strict=True)]
    in_errors = [
        f"{ratio:+.0f} σ" if abs(ratio) >= 10 else f"{ratio:+.1f} σ"
        for ratio in outcome.in_errors
    ]
    return list(map(minus, values)), list(map(minus, in_errors))


def minus(number: str) -> str:
    """Replace a hyphen by a minus sign, which is as long as a plus."""
    return number.replace("-", "\N{MINUS SIGN}")


def summarize(right: Outcome, others: list[Outcome]) -> str:
    """The answer as sentences.

    **Arguments:** `right`: outcome of the fit without a mistake; `others`: those of
    the mistakes.
    """
    misled = [outcome for outcome in others if outcome.misled]
    hidden = [outcome for outcome in misled if not outcome.flags]
    counts = {
        name: sum(name in outcome.flags for outcome in others) for name in DIAGNOSTICS
    }
    worst = max(
        others, key=lambda outcome: abs(outcome.bias[PARAMETERS.index("shininess")])
    )
    return (
        f"{len(misled)} of {len(others)} mistakes move a parameter by more than three "
        "of its stated errors; the exponent suffers most: "
        f"{worst.name!r} moves f = {float(TRUTH.shininess):g} by "
        f"{worst.bias[PARAMETERS.index('shininess')]:+.0f}. Detected by: "
        + ", ".join(
            f"{name} {count} of {len(others)}" for name, count in counts.items()
        )
        + f"; the right model is {'flagged too' if right.flags else 'not flagged'}. "
        + "".join(
            f"Nothing shows {outcome.name!r} (reduced χ² {outcome.chi_squared:.2f}): "
            # The first three of `PARAMETERS` are ρ_d, ρ_s and f.
            f"{outcome.why_hidden}; ρ_d comes out {outcome.bias[0]:+.3f}, ρ_s "
            f"{outcome.bias[1]:+.3f} and f {outcome.bias[2]:+.1f} off. "
            for outcome in hidden
        )
    ).strip()


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    outcomes = measure(small)
    right, *others = outcomes
    rows = tuple(
        (
            outcome.name,
            *("\n".join(pair) for pair in zip(*offsets(outcome), strict=True)),
            ", ".join(outcome.flags) or "nothing",
        )
        for outcome in outcomes
    )
    sound = not right.flags and not right.misled
    return Finding(
        summarize(right, others),
        {
            outcome.name: {
                name: value
                for name, value in dataclasses.asdict(outcome).items()
                if name != "residual"
            }
            | {"misled": outcome.misled}
            for outcome in outcomes
        },
        draw(outcomes),
        "Maps of residuals: noise where the model is right, rings, crescents and "
        "patches where it is wrong; a table of how far each parameter is off, and "
        "which diagnostics detect it.",
        Table(
            (
                "mistake",
                *(f"{style.PARAMETERS[name][2]} off" for name in PARAMETERS),
                "detected by",
            ),
            rows,
        ),
        failed_checks=() if sound else ("the right model is flagged, or misleads",),
    )


EXPERIMENT = Experiment("wrong_model", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
