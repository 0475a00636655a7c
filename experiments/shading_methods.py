"""Question: what do flat and Gouraud shading lose next to Phong shading on one mesh?

A ball of ever more triangles is shaded with all three methods. Measured, under lamps
from many sides: the highlight's peak and its energy (the sum of its pixels) as a
fraction of Phong shading's on the same mesh; how much the slope of the light jumps
where two faces meet, which the eye
sees as Mach bands; and the time of an image, with the methods timed alternately.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import phongfit as pf
from data_synth.lights import spread_directions
from experiments import style
from experiments.balls import unit_ball
from experiments.finding import Experiment, Finding, Table

METHODS: dict[str, pf.geometry.AbstractShading] = {
    "flat": pf.FlatShading(),
    "Gouraud": pf.GouraudShading(),
    "Phong": pf.PhongShading(),
}
LINES = {
    "Gouraud": (style.VERMILION, "o"),
    "Phong": (style.BLUE, "^"),
}
"""Colour and marker of each method, where both are drawn."""

ROWS = (6, 12, 24, 48, 96)
"""Numbers of faces from pole to pole; there are twice as many around."""

EXPONENTS = (10.0, 50.0, 200.0)
"""Exponents f of the highlights."""

GOOD = 0.05
"""Largest fraction of the highlight's peak whose loss is good enough."""

TIMED = (1, 8)
"""Numbers of lamps in the images that are timed."""

UNCLAMPED = pf.Film(clamp=False)


@dataclasses.dataclass(frozen=True)
class Size:
    """Pixels along an image's side, number of lamps, and of runs that are timed."""

    pixels: int
    lamps: int
    runs: int


@dataclasses.dataclass(frozen=True)
class Result:
    """Measurements of all meshes.

    - `edge`: length of the mesh's edges as an angle at the ball's centre, degrees, for
        each of `ROWS`;
    - `half_width`: angle from the highlight's centre to half its height, degrees, for
        each of `EXPONENTS`;
    - `peak`, `energy`: largest pixel and sum of the highlight's pixels, over those of
        Phong shading: by method, (rows, exponents, lamps);
    - `slope_jump`: jump of the light's slope from face to face, light per radius of the
        ball, by method, for each of `ROWS`; `value_jump`: jump of the light itself;
    - `seconds`: for an image, by method, for each of `TIMED`; `trace`: seconds to trace
        its geometry;
    - `fine_enough`: largest edge / half width at which Gouraud shading loses no more
        than `GOOD` of the peak, for each of `EXPONENTS`; NaN if there is none.
    """

    edge: np.ndarray
    half_width: np.ndarray
    peak: dict[str, np.ndarray]
    energy: dict[str, np.ndarray]
    slope_jump: dict[str, np.ndarray]
    value_jump: dict[str, np.ndarray]
    seconds: dict[str, np.ndarray]
    trace: float
    fine_enough: np.ndarray


def ball(
    rows: int,
    method: str,
    camera: pf.geometry.AbstractCamera,
    direction: Any,
    background: float = 0.0,
) -> pf.Scene:
    """A ball of triangles under lamps, shaded by a method.

    **Arguments:** `rows`: rows of faces from pole to pole; `method`: one of `METHODS`;
    `direction`: to the lamp, (3,), or to several, (lamps, 3).
    """
    return pf.Scene(
        unit_ball(rows),
        camera,
        [pf.DirectionalLight(one) for one in np.reshape(direction, (-1, 3))],
        shading=METHODS[method],
        background=background,
    )


def measure(size: Size) -> Result:
    """Compare the three methods on balls of several mesh sizes."""

    def by_method(rows: list[Any], k: int) -> dict[str, np.ndarray]:
        """Entry `k` of each mesh's result, stacked over the meshes."""
        return {name: np.array([row[name][k] for row in rows]) for name in METHODS}

    edge = 180 / np.array(ROWS)  # 180° from pole to pole
    # Where cosᶠ falls to ½.
    half_width = np.rad2deg(np.arccos(0.5 ** (1 / np.array(EXPONENTS))))
    highlights = [highlight(rows, size) for rows in ROWS]
    jumps = [edge_jumps(rows, size.pixels) for rows in ROWS]
    peak = by_method(highlights, 0)
    peak_loss = 1 - peak["Gouraud"].mean(axis=-1)
    fine_enough = [
        crossing(edge / width, losses, GOOD)
        for width, losses in zip(half_width, peak_loss.T, strict=True)
    ]
    seconds, trace = costs(size)
    return Result(
        edge=edge,
        half_width=half_width,
        peak=peak,
        energy=by_method(highlights, 1),
        slope_jump=by_method(jumps, 0),
        value_jump=by_method(jumps, 1),
        seconds=seconds,
        trace=trace,
        fine_enough=np.array(fine_enough),
    )


def highlight(rows: int, size: Size) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Peak and sum of a highlight's pixels, relative to Phong shading of the mesh.

    **Arguments:** `rows`: rows of the ball's faces.

    **Returns:** for each method, two arrays of shape (exponents, lamps).
    """
    camera = pf.OrthographicCamera(size.pixels, size.pixels, view_height=2.1)
    directions = spread_directions(size.lamps)
    # What a pixel sees depends on neither lamp nor shading, so it is traced once.
    gbuffer = ball(rows, "Phong", camera, directions[0]).trace()
    measured = {}
    # All channels are equal, so one is kept.
    for name in METHODS:
        images = np.array(
            [
                [
                    pf.render(
                        ball(rows, name, camera, direction),
                        pf.Material(0.0, 1.0, exponent, 0.0),
                        film=UNCLAMPED,
                        gbuffer=gbuffer,
                    )[..., 0]
                    for direction in directions
                ]
                for exponent in EXPONENTS
            ],
            float,
        )
        measured[name] = images.max(axis=(2, 3)), images.sum(axis=(2, 3))
    peak, energy = measured["Phong"]
    return {name: (p / peak, e / energy) for name, (p, e) in measured.items()}


def edge_jumps(rows: int, pixels: int) -> dict[str, tuple[float, float]]:
    """Jumps of a matte ball's light from face to face: root mean squares, by method.

    Along the rows of a close-up of 1 × 1 radii: where two pixels of one face are
    followed by two of the next one, the slopes of the two pairs are compared.

    **Returns:** jump of the slope, light per radius; jump of the light itself.
    """
    near = pf.OrthographicCamera(pixels, pixels, view_height=1.0)
    lamp = np.array([0.5, 0.6, 1.0])
    gbuffer = ball(rows, "Phong", near, lamp).trace()
    face = np.asarray(gbuffer.face)
    # Faces of each four neighbours in a row.
    a, b, c, d = (face[:, k : face.shape[1] - 3 + k] for k in range(4))
    meet = (a == b) & (c == d) & (b != c)
    pixel = 1.0 / pixels
    measured = {}
    for name in METHODS:
        image = pf.render(
            ball(rows, name, near, lamp),
            pf.Material(1.0, 0.0, ambient=0.0),
            film=UNCLAMPED,
            gbuffer=gbuffer,
        )
        # From pixel to pixel along rows, in one of the channels, which are all equal.
        step = np.diff(np.asarray(image, float)[..., 0], axis=1)
        slope = (step[:, 2:] - step[:, :-2])[meet] / pixel
        # The change across the edge, minus the part that the slopes of both faces
        # cause.
        value = (step[:, 1:-1] - (step[:, 2:] + step[:, :-2]) / 2)[meet]
        measured[name] = rms(slope), rms(value)
    return measured


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """Largest x below which y stays at or under `level`, interpolated on log scales.

    NaN if y is above `level` at the smallest x, or nowhere.
    """
    order = np.argsort(x)
    x, y = x[order], np.maximum(y[order], 1e-12)
    above = np.flatnonzero(y > level)
    if len(above) == 0 or above[0] == 0:
        return float("nan")
    k = above[0]
    ends = np.log(y[k - 1 : k + 1])
    fraction = (np.log(level) - ends[0]) / (ends[1] - ends[0])
    return float(np.exp((1 - fraction) * np.log(x[k - 1]) + fraction * np.log(x[k])))


def costs(size: Size) -> tuple[dict[str, np.ndarray], float]:
    """Median seconds of an image by each method, and of tracing its geometry.

    The methods take turns, since a machine's speed changes.

    **Returns:** seconds by method, for each of `TIMED`; seconds of the tracing.
    """
    camera = pf.OrthographicCamera(size.pixels, size.pixels, view_height=2.1)
    scenes = {
        (name, lamps): ball(ROWS[2], name, camera, spread_directions(lamps))
        for name in METHODS
        for lamps in TIMED
    }
    first = next(iter(scenes.values()))
    gbuffer = first.trace()
    material = pf.Material(0.6, 0.4, 50.0, 0.2)

    def image(scene: pf.Scene) -> Callable[[], jax.Array]:
        return lambda: pf.render(scene, material, gbuffer=gbuffer)

    work: dict[Any, Callable[[], jax.Array]]
    work = {key: image(scene) for key, scene in scenes.items()}
    work["trace"] = lambda: first.trace().position
    times: dict[Any, list[float]] = {key: [] for key in work}
    for call in work.values():
        jax.block_until_ready(call())
    for _ in range(size.runs):
        for key, call in work.items():
            begin = time.perf_counter()
            jax.block_until_ready(call())
            times[key].append(time.perf_counter() - begin)
    medians = {key: float(np.median(taken)) for key, taken in times.items()}
    seconds = {
        name: np.array([medians[name, lamps] for lamps in TIMED]) for name in METHODS
    }
    return seconds, medians["trace"]


@style.styled
def draw(result: Result, pixels: int) -> Figure:
    """Draw balls by all methods and meshes above, numbers below."""
    figure = style.page(8.9)
    top, bottom = style.bands(figure, 4.6, 4.3)
    camera = pf.OrthographicCamera(pixels, pixels, view_height=2.05)
    plastic = pf.Material((0.1, 0.3, 0.5), 0.7, EXPONENTS[1], (0.05, 0.1, 0.15))
    lamp = np.array([-0.6, 0.7, 1.0])
    images = [
        [
            np.asarray(
                pf.render(ball(rows, name, camera, lamp, 1.0), plastic, samples=4)
            )
            for rows in ROWS
        ]
        for name in METHODS
    ]
    names = [f"{4 * rows**2} triangles" for rows in ROWS]
    style.picture_grid(top, images, columns=names, rows=list(METHODS))
    (peak, energy), (flat_peak, slope) = bottom.subplots(2, 2)
    for k, (f, colour, marker) in enumerate(
        zip(EXPONENTS, (style.BLUE, style.GREEN, style.VERMILION), "os^", strict=True)
    ):
        x = result.edge / result.half_width[k]
        for axes, loss in (
            (peak, 1 - result.peak["Gouraud"][:, k]),
            (energy, np.abs(result.energy["Gouraud"][:, k] - 1)),
            (flat_peak, np.abs(result.peak["flat"][:, k] - 1)),
        ):
            # A mean over lamps; log scales have no 0.
            mean = np.maximum(100 * loss.mean(axis=-1), 1e-3)
            axes.loglog(x, mean, f"{marker}-", c=colour, label=f"$f$ = {f:g}")
    peak.axhline(100 * GOOD, c=style.BLACK, lw=0.8, ls=":")
    for axes, about, label in (
        (peak, "Gouraud: the highlight's peak", "lost of the peak (%)"),
        (energy, "Gouraud: the highlight's energy", "energy off by (%)"),
        (flat_peak, "flat: the highlight's peak", "peak off by (%)"),
    ):
        axes.set_xlabel("edge / half width of the highlight")
        axes.set_ylabel(label)
        axes.set_title(about)
        axes.legend()
    for name in ("Gouraud", "Phong"):
        colour, marker = LINES[name]
        jump = result.slope_jump[name]
        slope.loglog(result.edge, jump, f"{marker}-", c=colour, label=name)
    for axes in (peak, energy, flat_peak, slope):
        style.plain_numbers(axes)
    slope.set_xlabel("edge (degrees)")
    slope.set_ylabel("jump of the slope (1/radius)")
    slope.set_xticks(result.edge, [f"{e:.3g}" for e in result.edge])
    slope.minorticks_off()
    slope.set_title("Mach bands: slope across edges")
    slope.legend()
    return figure


COLUMNS = (
    "triangles",
    "edge",
    "peak, flat",
    "peak, Gouraud",
    "at worst",
    "energy, Gouraud",
    "slope jump / Phong's",
)
"""Column titles of [`rows_of`][]; "at worst" is over lamps."""


def rows_of(result: Result) -> tuple[tuple[str, ...], ...]:
    """Rows of the table: one for each mesh, at the middle exponent."""
    k = 1
    gouraud, jump = result.peak["Gouraud"], result.slope_jump
    return tuple(
        (
            f"{4 * rows**2}",
            f"{result.edge[at]:.3g}°",
            f"{100 * result.peak['flat'][at, k].mean():.1f} %",
            f"{100 * gouraud[at, k].mean():.1f} %",
            f"{100 * gouraud[at, k].min():.1f} %",
            f"{100 * result.energy['Gouraud'][at, k].mean():.1f} %",
            f"{jump['Gouraud'][at] / jump['Phong'][at]:.1f}",
        )
        for at, rows in enumerate(ROWS)
    )


def summarize(result: Result) -> str:
    """The answer to the experiment's question, as sentences."""
    # Exponent 1 is the middle one; meshes 0 and −1 are the coarsest and the finest.
    first, last = result.peak["Gouraud"][[0, -1], 1]
    ratio = {name: result.seconds[name] / result.seconds["Phong"] for name in METHODS}
    fine_enough = float(np.nanmean(result.fine_enough))
    wanted = 4 * np.ceil(180 / (fine_enough * result.half_width)) ** 2
    meshes = ", ".join(
        f"{n:.0f} triangles for f = {f:g}"
        for n, f in zip(wanted, EXPONENTS, strict=True)
    )
    jump = result.slope_jump["Gouraud"][2] / result.slope_jump["Phong"][2]
    energy = result.energy["Gouraud"][:2, 1].mean(axis=-1)
    return (
        "Gouraud shading loses highlights that fall between vertices: of the peak of "
        f"Phong shading on the same mesh, f = {EXPONENTS[1]:g}, it keeps "
        f"{100 * first.mean():.0f} % on {4 * ROWS[0] ** 2} triangles and "
        f"{100 * last.mean():.1f} % on {4 * ROWS[-1] ** 2}. Gouraud is good enough "
        f"(at most {100 * GOOD:.0f} % of the peak lost, on average over lamps) where "
        f"the mesh's edges are shorter than {fine_enough:.2f} of the highlight's half "
        f"width: a ball of {meshes}. The highlight's energy it keeps sooner: "
        f"{100 * energy[0]:.0f} % on {4 * ROWS[0] ** 2} triangles, "
        f"{100 * energy[1]:.0f} % on {4 * ROWS[1] ** 2}. From face to face the slope "
        f"of its light jumps by {jump:.1f} times as much as Phong shading's "
        f"({4 * ROWS[2] ** 2} triangles): these are Mach bands. Under one lamp an "
        f"image costs {ratio['flat'][0]:.2f} (flat) and {ratio['Gouraud'][0]:.2f} "
        f"(Gouraud) of Phong shading's time, under {TIMED[1]} lamps "
        f"{ratio['flat'][1]:.2f} and {ratio['Gouraud'][1]:.2f}, geometry not counted."
    )


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    size = Size(96, 6, 3) if small else Size(256, 16, 15)
    result = measure(size)
    kept = result.peak["Gouraud"].mean(axis=-1)
    # Means over lamps scatter, so a step back by 2 % is allowed.
    falls = np.all(np.diff(kept, axis=0) > -0.02) and np.all(kept[-1] > kept[0])
    return Finding(
        summarize(result),
        dataclasses.asdict(result),
        draw(result, 96 if small else 256),
        "Balls of 144 to 36864 triangles with flat, Gouraud and Phong shading; curves "
        "of what highlights lose against the length of the mesh's edges, and of the "
        "jump of the slope across edges.",
        Table(COLUMNS, rows_of(result)),
        failed_checks=()
        if falls
        else ("Gouraud's loss does not fall with finer meshes",),
    )


EXPERIMENT = Experiment("shading_methods", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
