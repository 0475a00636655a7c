"""Question: how well does an image identify a material, and do fits reach the limit?

The Cramér-Rao bound, which no unbiased estimate can beat, is predicted for each
parameter as noise, lamps, resolution, clipping and the part of the highlight that is
seen change, and compared with the spread of many fits of noisy images. Errors are
relative to the true value; that of f is of its logarithm. Where the exponent is not
identifiable, errors of the other parameters are predicted from simulated fits.
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
SHARP = pf.Material(0.5, 0.3, 60.0, 0.5)
NOISE = 0.01
SIZE = 48
UNCLAMPED = pf.Film(clamp=False)
PARAMETERS = tuple(style.PARAMETERS)


@dataclasses.dataclass(frozen=True)
class Setting:
    """A set of scenes with its noise; `x` is its coordinate in a sweep."""

    x: float
    scenes: tuple[pf.Scene, ...]
    noise: float = NOISE
    material: pf.Material = TRUTH
    film: pf.Film = UNCLAMPED


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Settings that differ in one thing."""

    name: str
    label: str
    settings: tuple[Setting, ...]
    log: bool = True


@dataclasses.dataclass(frozen=True)
class Spread:
    """Errors of many fits of one setting, in the order of `PARAMETERS`.

    - `bound`, `observed`: the predicted error, and the root mean square of the fits'
        errors, as shares of the truth;
    - `pull`: root mean square of error / stated error, over the fits that state one;
    - `identified`: whether the prediction says that the parameter is identifiable;
    - `draws`: how many fits.
    """

    x: float
    bound: np.ndarray
    observed: np.ndarray
    pull: np.ndarray
    identified: np.ndarray
    draws: int

    @property
    def ratio(self) -> np.ndarray:
        """Observed over predicted; NaN for what is not identifiable."""
        return np.where(self.identified, self.observed / self.bound, np.nan)

    @property
    def slack(self) -> float:
        """Three relative standard errors of a root mean square over `draws` fits."""
        return 3 / np.sqrt(2 * self.draws)


def ball(size: int, directions: np.ndarray, exposure: float = 1.0) -> list[pf.Scene]:
    """A ball photographed once under each lamp."""
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


def noises(levels: Sequence[float]) -> Sweep:
    """A sweep over the level of noise."""
    scenes = tuple(ball(SIZE, LAMP))
    settings = tuple(Setting(noise, scenes, noise) for noise in levels)
    return Sweep("noise", "noise (white is 1)", settings)


def lamps(counts: Sequence[int]) -> Sweep:
    """A sweep over the number of photographs, each under another lamp."""
    directions = spread_directions(max(counts))
    settings = tuple(Setting(n, tuple(ball(32, directions[:n]))) for n in counts)
    return Sweep("lamps", "photographs, each with its lamp", settings)


def resolutions(sizes: Sequence[int]) -> Sweep:
    """A sweep over the resolution of the image."""
    settings = tuple(Setting(size, tuple(ball(size, LAMP))) for size in sizes)
    return Sweep("resolution", "width of the image (pixels)", settings)


def clipped(shares: Sequence[float]) -> Sweep:
    """A sweep over the exposure: these fractions of the ball's samples are white."""
    (scene,) = ball(SIZE, LAMP)
    seen = np.asarray(pf.render(scene, TRUTH, film=UNCLAMPED))[scene.trace().mask]
    settings = []
    for share in shares:
        exposure = 0.9 / seen.max() if share == 0 else 1 / np.quantile(seen, 1 - share)
        scenes = tuple(ball(SIZE, LAMP, float(exposure)))
        settings.append(Setting(100 * share, scenes, film=pf.Film()))
    return Sweep("clipping", "samples at white (%)", tuple(settings), log=False)


def windows(places: Sequence[float], size: int = 39) -> Sweep:
    """A sweep of close-ups; x is the fraction of the highlight that is seen."""
    settings = []
    (whole,) = close_up(-0.2, 2.0, size)
    for place in places:
        scenes = close_up(place, 0.8, size)
        share = highlight_light(scenes[0]) / highlight_light(whole)
        settings.append(Setting(100 * share, scenes, material=SHARP))
    label = "share of the highlight that is seen (%)"
    return Sweep("highlight", label, tuple(settings), log=False)


def close_up(x: float, view: float, size: int) -> tuple[pf.Scene, ...]:
    """A close-up of the ball around (x, 0), `view` wide; `size` pixels are 0.8 wide."""
    size = round(size * view / 0.8)
    camera = pf.OrthographicCamera(size, size, view_height=view, position=(x, 0.0, 5.0))
    # Its highlight is centred on x = −0.35.
    turn = 2 * np.arcsin(-0.35)
    lamp = pf.DirectionalLight((np.sin(turn), 0, np.cos(turn)), 0.7)
    return (pf.Scene(pf.Sphere(), camera, lamp, ambient=0.3),)


def highlight_light(scene: pf.Scene) -> float:
    """Light of the highlight, summed over the area of the image."""
    glint = pf.Material(0.0, 1.0, SHARP.shininess, 0.0)
    camera = scene.camera
    assert isinstance(camera, pf.OrthographicCamera)
    pixel = float(camera.view_height) / camera.height
    image = np.asarray(pf.render(scene, glint, film=UNCLAMPED), float)
    return float(image[..., 0].sum()) * pixel**2


def sweeps(small: bool) -> list[Sweep]:
    """Sweeps of noise, number of lamps, resolution, clipping and window of light."""
    if small:
        return [
            noises([0.01, 0.03]),
            lamps([1, 4]),
            resolutions([32, SIZE]),
            clipped([0.0, 0.3]),
            # The size of the other sweeps, so that compiled programs are shared.
            windows([-0.1, 0.5], SIZE),
        ]
    return [
        noises([0.003, 0.01, 0.03, 0.1, 0.3]),
        lamps([1, 2, 4, 8]),
        resolutions([16, 24, 32, 48, 64]),
        clipped([0.0, 0.1, 0.25, 0.5, 0.75]),
        windows([-0.1, 0.0, 0.1, 0.2, 0.3, 0.45, 0.55]),
    ]


def spread(setting: Setting, draws: int, seed: int) -> Spread:
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
    off, pulls = [], []
    for _ in range(draws):
        images = [
            light + setting.noise * rng.normal(size=light.shape) for light in lights
        ]
        if setting.film.clamp:
            images = [np.clip(image, 0, 1) for image in images]
        fit = pf.fit(scenes, images, **options)
        off.append(relative(fit.values[order], truth))
        stated = np.where(fit.unidentified | fit.at_bound, np.nan, fit.errors)[order]
        pulls.append(off[-1] * truth / stated)
    return Spread(
        setting.x,
        predicted.errors[order] / truth,
        np.sqrt(np.mean(np.square(off), axis=0)),
        root_mean_square(np.array(pulls)),
        ~predicted.unidentified[order] & ~predicted.at_bound[order],
        draws,
    )


def relative(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors relative to the truth; for f the error of log f, which is fitted."""
    share = values / truth - 1
    f = PARAMETERS.index("shininess")
    share[f] = np.log(values[f] / truth[f])
    return share


def root_mean_square(columns: np.ndarray) -> np.ndarray:
    """Root mean square of each column without its NaN; NaN if half or more are NaN."""
    known = np.isfinite(columns)
    count = known.sum(axis=0)
    squares = np.where(known, columns, 0) ** 2
    mean = squares.sum(axis=0) / np.maximum(count, 1)
    return np.where(count > len(columns) / 2, np.sqrt(mean), np.nan)


Found = list[tuple[Sweep, list[Spread]]]


def measure(small: bool) -> Found:
    """Measure all sweeps, with independent noise for every setting."""
    draws, seed, found = 40 if small else 200, 0, []
    for sweep in sweeps(small):
        seeds = range(seed, seed + len(sweep.settings))
        seed += len(seeds)
        spreads = [
            spread(setting, draws, one)
            for setting, one in zip(sweep.settings, seeds, strict=True)
        ]
        found.append((sweep, spreads))
    return found


@style.styled
def draw(found: Found) -> Figure:
    """Draw a panel for each sweep, and one with all ratios."""
    figure = style.page(7.4)
    panels = figure.subplots(3, 2).ravel()
    for axes, (sweep, spreads) in zip(panels, found, strict=False):
        draw_sweep(axes, sweep, spreads)
    panels[0].legend(ncols=2, title="lines: predicted; marks: fits")
    panels[3].set_title("hollow marks: something is not identifiable")
    for axes in panels[:-1]:
        axes.set_ylabel("error (% of the value)")
    ratios, start = panels[-1], 0
    draws = found[0][1][0].draws
    slack = found[0][1][0].slack
    ratios.axhspan(1 - slack, 1 + slack, color=style.GRID, lw=0)
    middles = []
    for _, spreads in found:
        places = start + np.arange(len(spreads))
        for k, name in enumerate(PARAMETERS):
            colour, marker, _ = style.PARAMETERS[name]
            judged = [one.ratio[k] for one in spreads]
            ratios.plot(places + 0.18 * (k - 1.5), judged, marker, c=colour, ms=3.5)
        middles.append(places.mean())
        start += len(spreads) + 1
    ratios.set_ylim(1 - 1.5 * slack, 1 + 1.5 * slack)
    ratios.set_xticks(middles, [sweep.name for sweep, _ in found])
    ratios.tick_params("x", length=0)
    ratios.grid(False, axis="x")
    ratios.set_ylabel("spread of the fits / predicted")
    ratios.set_title(f"ratios; band: 3 standard errors, {draws} fits")
    return figure


def draw_sweep(axes: Axes, sweep: Sweep, spreads: list[Spread]) -> None:
    """Draw predicted errors as lines and fits as marks, parameter by parameter."""
    x = np.array([one.x for one in spreads])
    for k, name in enumerate(PARAMETERS):
        colour, marker, _ = style.PARAMETERS[name]
        bound = np.array(
            [one.bound[k] if one.identified[k] else np.nan for one in spreads]
        )
        observed = np.array([one.observed[k] for one in spreads])
        identified = np.array([one.identified.all() for one in spreads])
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


def say(found: Found) -> str:
    """The answer in words."""
    spreads = [one for _, spreads in found for one in spreads]
    identified = np.array([one.identified.all() for one in spreads])
    ratio = np.array([one.ratio for one in spreads])
    beside = ~identified[:, None] & np.isfinite(ratio)
    answer = (
        "Where all four parameters are identifiable, the spread of "
        f"{spreads[0].draws} fits lies on the Cramér-Rao bound: "
        f"{ratio[identified].min():.2f} to "
        f"{ratio[identified].max():.2f} of it in {ratio[identified].size} comparisons, "
        f"their mean {ratio[identified].mean():.3f}. Errors grow as the noise does; "
        "ρ_s and f are known worst, and first lost: where too much of the highlight is "
        f"white or out of view, {np.count_nonzero(~identified)} of {len(identified)} "
        "settings say that they are not identifiable."
    )
    if beside.any():
        answer += (
            " There the exponent roams, and a broad highlight passes for ρ_d, which no "
            "formula at the true f knows: the prediction for ρ_d and ρ_a rests on fits "
            f"of its own, and the spread is {ratio[beside].min():.2f} to "
            f"{ratio[beside].max():.2f} of it."
        )
    return answer


def find(small: bool) -> Finding:
    """Measure, draw and answer."""
    found = measure(small)
    rows = tuple(
        (
            sweep.name,
            f"{one.x:.3g}",
            *(f"{share:.2f}" if np.isfinite(share) else "–" for share in one.ratio),
        )
        for sweep, spreads in found
        for one in spreads
    )
    return Finding(
        say(found),
        {sweep.name: list(map(dataclasses.asdict, group)) for sweep, group in found},
        draw(found),
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
        wrong=failures(found),
    )


def failures(found: Found) -> tuple[str, ...]:
    """Sentences on spreads that differ from their prediction by more than chance."""
    wrong = []
    for sweep, spreads in found:
        for one in spreads:
            judged = [(one.ratio, 1 - one.slack, "the prediction")]
            if not one.identified.all():
                # Without an identified exponent, fits state errors for the widest
                # exponent that the image allows, which exceed the spread of the fits.
                judged += [(one.pull, 0.0, "the errors that fits state")]
            wrong += [
                f"{sweep.name} {one.x:.3g}: {name} scatters {share:.2f} times {what}"
                for shares, least, what in judged
                for name, share, identified in zip(
                    PARAMETERS, shares, one.identified, strict=True
                )
                if identified and not least <= share <= 1 + one.slack
            ]
    return tuple(wrong)


EXPERIMENT = Experiment("how_well", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
