"""Question: how well does an image identify a material, and do fits reach the limit?

The Cramér-Rao bound, which no unbiased estimate can beat, is predicted for each
parameter as noise, lamps, resolution, clipping and the part of the highlight that is
seen change, and compared with the spread of many fits of noisy images. Errors are
relative to the true value; that of f is of its logarithm. Where the exponent is not
identifiable, the predicted errors of the other parameters hold for any exponent.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

import phongfit as pf
from data_synth.lights import spread_directions
from experiments import style
from experiments.finding import Experiment, Finding, Table

TRUTH = pf.Material(0.5, 0.3, 20.0, 0.5)
# The true material of close-ups.
SHARP = pf.Material(0.5, 0.3, 60.0, 0.5)
# Standard deviation in linear light, where white is 1.
NOISE = 0.01
# Width and height of an image, pixels.
SIZE = 48
UNCLAMPED = pf.Film(clamp=False)
PARAMETERS = tuple(style.PARAMETERS)


@dataclasses.dataclass(frozen=True)
class Setting:
    """One point of a sweep, at the coordinate `x`: scenes, noise, material and film."""

    x: float
    scenes: tuple[pf.Scene, ...]
    noise: float = NOISE
    material: pf.Material = TRUTH
    film: pf.Film = UNCLAMPED


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Settings that differ in one thing, which is their coordinate `x`.

    - `name`: a word for it; `label`: label of the x axis, with its unit;
    - `log`: whether the x axis is logarithmic.
    """

    name: str
    label: str
    settings: tuple[Setting, ...]
    log: bool = True


@dataclasses.dataclass(frozen=True)
class Spread:
    """Errors of many fits of one setting; arrays are in the order of `PARAMETERS`.

    - `x`: coordinate of the setting;
    - `bound`: predicted standard error, relative to the truth (for f: of log f);
    - `observed`: root mean square of estimate − truth over the fits, likewise relative;
    - `pull`: root mean square of (estimate − truth) / stated error, over the fits that
        state a finite one; NaN if half of the fits or more do not;
    - `identified`: whether the prediction states a finite error, away from the bounds;
    - `draws`: number of fits.
    """

    x: float
    bound: np.ndarray
    observed: np.ndarray
    pull: np.ndarray
    identified: np.ndarray
    draws: int

    @property
    def ratio(self) -> np.ndarray:
        """Observed over predicted errors; NaN for parameters not identified."""
        return np.where(self.identified, self.observed / self.bound, np.nan)

    @property
    def tolerance(self) -> float:
        """Limit for |ratio − 1|: 3 standard errors of an RMS over `draws` fits."""
        return 3 / np.sqrt(2 * self.draws)


def ball(size: int, directions: np.ndarray, exposure: float = 1.0) -> list[pf.Scene]:
    """Scenes of a ball, one for each lamp.

    **Arguments:** `size`: width and height of the images, pixels; `directions`: (lamps,
    3), to the lamps; `exposure`: factor on all light.
    """
    camera = pf.OrthographicCamera(size, size)
    return [
        pf.Scene(
            pf.Sphere(),
            camera,
            pf.DirectionalLight(direction, 0.7 * exposure),
            ambient=0.3 * exposure,
        )
        for direction in directions
    ]


LAMP = np.array([[1.0, 1.0, 2.0]])
"""Direction to the only lamp of most sweeps, as an array of shape (1, 3)."""


def noises(levels: Sequence[float]) -> Sweep:
    """A sweep over the standard deviation of the noise."""
    scenes = tuple(ball(SIZE, LAMP))
    settings = tuple(Setting(noise, scenes, noise) for noise in levels)
    return Sweep("noise", "noise (white is 1)", settings)


def lamps(counts: Sequence[int]) -> Sweep:
    """A sweep over the number of photographs, each under another lamp."""
    directions = spread_directions(max(counts))
    settings = tuple(Setting(n, tuple(ball(32, directions[:n]))) for n in counts)
    return Sweep("lamps", "photographs, each with its lamp", settings)


def resolutions(sizes: Sequence[int]) -> Sweep:
    """A sweep over the width and height of the image, pixels."""
    settings = tuple(Setting(size, tuple(ball(size, LAMP))) for size in sizes)
    return Sweep("resolution", "width of the image (pixels)", settings)


def exposures(fractions: Sequence[float]) -> Sweep:
    """A sweep over the exposure: these fractions of the ball's samples are white."""
    (scene,) = ball(SIZE, LAMP)
    seen = np.asarray(pf.render(scene, TRUTH, film=UNCLAMPED))[scene.trace().mask]
    settings = []
    for fraction in fractions:
        exposure = (
            0.9 / seen.max() if fraction == 0 else 1 / np.quantile(seen, 1 - fraction)
        )
        scenes = tuple(ball(SIZE, LAMP, float(exposure)))
        settings.append(Setting(100 * fraction, scenes, film=pf.Film()))
    return Sweep("clipping", "samples at white (%)", tuple(settings), log=False)


def close_ups(centres: Sequence[float], size: int = 39) -> Sweep:
    """A sweep over the percentage of the highlight's light that a close-up shows.

    **Arguments:** `centres`: x of the middle of each close-up, on a ball of radius 1;
    `size`: width and height in pixels.
    """
    settings = []
    (whole,) = close_up(-0.2, 2.0, size)
    for centre in centres:
        scenes = close_up(centre, 0.8, size)
        fraction = highlight_light(scenes[0]) / highlight_light(whole)
        settings.append(Setting(100 * fraction, scenes, material=SHARP))
    label = "share of the highlight that is seen (%)"
    return Sweep("highlight", label, tuple(settings), log=False)


def close_up(x: float, view: float, size: int) -> tuple[pf.Scene, ...]:
    """A close-up of the ball around (x, 0), `view` world units wide.

    `size` pixels cover 0.8 world units, however wide the view is.
    """
    size = round(size * view / 0.8)
    camera = pf.OrthographicCamera(size, size, view_height=view, position=(x, 0.0, 5.0))
    # The highlight is centred where the normal halves the angle between the lamp and
    # the viewer: here at x = −0.35.
    lamp_angle = 2 * np.arcsin(-0.35)
    lamp = pf.DirectionalLight((np.sin(lamp_angle), 0, np.cos(lamp_angle)), 0.7)
    return (pf.Scene(pf.Sphere(), camera, lamp, ambient=0.3),)


def highlight_light(scene: pf.Scene) -> float:
    """Light of the highlight for ρ_s = 1, integrated over the image in world units."""
    glint = pf.Material(0.0, 1.0, SHARP.shininess, 0.0)
    camera = scene.camera
    assert isinstance(camera, pf.OrthographicCamera)
    pixel = float(camera.view_height) / camera.height
    image = np.asarray(pf.render(scene, glint, film=UNCLAMPED), float)
    # All channels are equal.
    return float(image[..., 0].sum()) * pixel**2


def sweeps(small: bool) -> list[Sweep]:
    """Sweeps over noise, number of lamps, resolution, clipping and close-ups."""
    if small:
        return [
            noises([0.01, 0.03]),
            lamps([1, 4]),
            resolutions([32, SIZE]),
            exposures([0.0, 0.3]),
            # The size of the other sweeps, so that compiled programs are shared.
            close_ups([-0.1, 0.5], SIZE),
        ]
    return [
        noises([0.003, 0.01, 0.03, 0.1, 0.3]),
        lamps([1, 2, 4, 8]),
        resolutions([16, 24, 32, 48, 64]),
        exposures([0.0, 0.1, 0.25, 0.5, 0.75]),
        close_ups([-0.1, 0.0, 0.1, 0.2, 0.3, 0.45, 0.55]),
    ]


def measure_setting(setting: Setting, draws: int, seed: int) -> Spread:
    """Errors of many fits of one setting, and the errors predicted for them."""
    options: dict[str, Any] = dict(
        noise=setting.noise, film=setting.film, per_channel=()
    )
    scenes = list(setting.scenes)
    predicted = pf.predict_errors(scenes, setting.material, **options)
    order = [predicted.labels.index(name) for name in PARAMETERS]
    truth = predicted.values[order]
    lights = [
        np.asarray(pf.render(scene, setting.material, film=UNCLAMPED))
        for scene in scenes
    ]
    rng = np.random.default_rng(seed)
    errors, pulls = [], []
    for _ in range(draws):
        images = [
            light + setting.noise * rng.normal(size=light.shape) for light in lights
        ]
        if setting.film.clamp:
            images = [np.clip(image, 0, 1) for image in images]
        fit = pf.fit(scenes, images, **options)
        errors.append(relative(fit.values[order], truth))
        stated = np.where(fit.unidentified | fit.at_bound, np.nan, fit.errors)[order]
        pulls.append(errors[-1] * truth / stated)
    return Spread(
        setting.x,
        predicted.errors[order] / truth,
        np.sqrt(np.mean(np.square(errors), axis=0)),
        root_mean_square(np.array(pulls)),
        ~predicted.unidentified[order] & ~predicted.at_bound[order],
        draws,
    )


def relative(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(values − truth) / truth; for f the difference of log f, since log f is fitted.

    Both arrays are in the order of `PARAMETERS`.
    """
    error = values / truth - 1
    f = PARAMETERS.index("shininess")
    error[f] = np.log(values[f] / truth[f])
    return error


def root_mean_square(columns: np.ndarray) -> np.ndarray:
    """Root mean square of each column without its NaN; NaN if half or more are NaN."""
    known = np.isfinite(columns)
    count = known.sum(axis=0)
    squares = np.where(known, columns, 0) ** 2
    mean = squares.sum(axis=0) / np.maximum(count, 1)
    return np.where(count > len(columns) / 2, np.sqrt(mean), np.nan)


Results = list[tuple[Sweep, list[Spread]]]
"""Each sweep, with the spread of the fits at each of its settings."""


def measure(small: bool) -> Results:
    """Fit the images of all sweeps, with independent noise for every setting."""
    draws, seed, results = 40 if small else 200, 0, []
    for sweep in sweeps(small):
        seeds = range(seed, seed + len(sweep.settings))
        seed += len(seeds)
        spreads = [
            measure_setting(setting, draws, seed_of_setting)
            for setting, seed_of_setting in zip(sweep.settings, seeds, strict=True)
        ]
        results.append((sweep, spreads))
    return results


@style.styled
def draw(results: Results) -> Figure:
    """Draw a panel for each sweep, and one with all ratios."""
    figure = style.page(7.4)
    panels = figure.subplots(3, 2).ravel()
    for axes, (sweep, spreads) in zip(panels, results, strict=False):
        draw_sweep(axes, sweep, spreads)
    panels[0].legend(ncols=2, title="lines: predicted; marks: fits")
    panels[3].set_title("hollow marks: something is not identifiable")
    for axes in panels[:-1]:
        axes.set_ylabel("error (% of the value)")
    draw_ratios(panels[-1], results)
    return figure


def draw_ratios(axes: Axes, results: Results) -> None:
    """Draw observed over predicted errors at all settings, sweep beside sweep."""
    first = results[0][1][0]
    draws, tolerance = first.draws, first.tolerance
    axes.axhspan(1 - tolerance, 1 + tolerance, color=style.GRID, lw=0)
    start, middles = 0, []
    for _, spreads in results:
        x = start + np.arange(len(spreads))
        for k, name in enumerate(PARAMETERS):
            colour, marker, _ = style.PARAMETERS[name]
            ratio = [spread.ratio[k] for spread in spreads]
            # Marks of the four parameters stand side by side.
            axes.plot(x + 0.18 * (k - 1.5), ratio, marker, c=colour, ms=3.5)
        middles.append(x.mean())
        start += len(spreads) + 1
    axes.set_ylim(1 - 1.5 * tolerance, 1 + 1.5 * tolerance)
    axes.set_xticks(middles, [sweep.name for sweep, _ in results])
    axes.tick_params("x", length=0)
    axes.grid(False, axis="x")
    axes.set_ylabel("spread of the fits / predicted")
    axes.set_title(f"ratios; band: 3 standard errors, {draws} fits")


def draw_sweep(axes: Axes, sweep: Sweep, spreads: list[Spread]) -> None:
    """Draw predicted errors as lines and fits as marks, parameter by parameter."""
    x = np.array([spread.x for spread in spreads])
    for k, name in enumerate(PARAMETERS):
        colour, marker, _ = style.PARAMETERS[name]
        bound = np.array(
            [spread.bound[k] if spread.identified[k] else np.nan for spread in spreads]
        )
        observed = np.array([spread.observed[k] for spread in spreads])
        identified = np.array([spread.identified.all() for spread in spreads])
        axes.plot(x, 100 * bound, c=colour)
        label = style.symbol(name)
        axes.plot(
            x[identified], 100 * observed[identified], marker, c=colour, label=label
        )
        axes.plot(
            x[~identified], 100 * observed[~identified], marker, c=colour, mfc="none"
        )
    axes.set_yscale("log")
    if sweep.log:
        axes.set_xscale("log")
        axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.minorticks_off()
    axes.set_xlabel(sweep.label)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    style.plain_numbers(axes, "y")


def summarize(results: Results) -> str:
    """The answer to the experiment's question, as sentences."""
    spreads = [spread for _, spreads in results for spread in spreads]
    identified = np.array([spread.identified.all() for spread in spreads])
    ratio = np.array([spread.ratio for spread in spreads])
    # The parameters that remain identified where another one is not.
    others = ~identified[:, None] & np.isfinite(ratio)
    answer = (
        "Where all four parameters are identifiable, the spread of "
        f"{spreads[0].draws} fits lies on the Cramér-Rao bound: "
        f"{ratio[identified].min():.2f} to "
        f"{ratio[identified].max():.2f} of it in {ratio[identified].size} comparisons, "
        f"their mean {ratio[identified].mean():.3f}. Errors grow as the noise does; "
        "ρ_s and f have the largest errors, and are lost first: where too much of the "
        "highlight is white or out of view, "
        f"{np.count_nonzero(~identified)} of {len(identified)} "
        "settings say that they are not identifiable."
    )
    if others.any():
        answer += (
            " There the exponent of a fit may be anything, and a broad highlight looks "
            "like ρ_d. So the predicted errors of ρ_d and ρ_a hold for any exponent; "
            "the spread is "
            f"{ratio[others].min():.2f} to {ratio[others].max():.2f} of it."
        )
    return answer


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    results = measure(small)
    rows = tuple(
        (
            sweep.name,
            f"{spread.x:.3g}",
            *(f"{ratio:.2f}" if np.isfinite(ratio) else "–" for ratio in spread.ratio),
        )
        for sweep, spreads in results
        for spread in spreads
    )
    return Finding(
        summarize(results),
        {sweep.name: list(map(dataclasses.asdict, group)) for sweep, group in results},
        draw(results),
        "Errors of the four parameters against noise, number of photographs, "
        "resolution, clipped share, and share of the highlight seen: lines of the "
        "predicted errors, and marks of fits that lie on them.",
        Table(
            (
                "spread / predicted",
                "x",
                *(style.PARAMETERS[name][2] for name in PARAMETERS),
            ),
            rows,
        ),
        failed_checks=failures(results),
    )


def failures(results: Results) -> tuple[str, ...]:
    """Sentences on spreads that differ from their prediction by more than chance."""
    failed_checks = []
    for sweep, spreads in results:
        for spread in spreads:
            # Ratios, their lower limit, and what they are relative to.
            judged = [(spread.ratio, 1 - spread.tolerance, "the prediction")]
            if not spread.identified.all():
                # Without an identified exponent, fits state errors for the widest
                # exponent that the image allows, which exceed the spread of the fits.
                judged += [(spread.pull, 0.0, "the errors that fits state")]
            failed_checks += [
                f"{sweep.name} {spread.x:.3g}: {name} scatters {ratio:.2f} times "
                f"{reference}"
                for ratios, least, reference in judged
                for name, ratio, identified in zip(
                    PARAMETERS, ratios, spread.identified, strict=True
                )
                if identified and not least <= ratio <= 1 + spread.tolerance
            ]
    return tuple(failed_checks)


EXPERIMENT = Experiment("how_well", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
