"""Question: are the error bars right, and do fits find the least cost?

Three tests by brute force:

- many noisy images of one scene: the spread of the estimates over the Cramér-Rao bound,
  and how often a 95 % interval contains the truth;
- these statistics where another unknown is on its bound in half of the draws;
- many random problems: the final cost of a fit, against the lowest one from many random
  starts of the same solver.

The exit status is 1 if a ratio leaves [0.95, 1.05], a share of intervals leaves
93.5-96.5 %, or a fit's cost lies more than 1e-4 above the best. Fewer draws are judged
by the sampling error of their number. An error that is one-sided because of a bound is
stated as the larger of both sides, so only the upper limit of its ratio is checked.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import phongfit as pf
from experiments.output import JsonFile, check_outputs, save_numbers
from phongfit.cli import run
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.solve.solution import Solution, solve
from phongfit.fitting.uncertainty.profile import total_cost

# Standard deviation in linear light, where white is 1.
NOISE = 0.01
# Confidence of the intervals.
LEVEL = 0.95
# Width and height of an image, pixels.
SIZE = 32


def ball(lights: int = 2) -> pf.Scene:
    """A sphere under one or two lights, so weak that no sample is near white."""
    both = (
        pf.DirectionalLight((1, 1, 2), 0.35),
        pf.DirectionalLight((-1, 0.3, 1), (0.3, 0.25, 0.2)),
    )
    camera = pf.OrthographicCamera(SIZE, SIZE)
    return pf.Scene(pf.Sphere(), camera, both[:lights], ambient=0.3)


TRUTH = pf.Material((0.6, 0.3, 0.2), (0.3, 0.25, 0.35), 20.0, (0.5, 0.4, 0.3))
# The true ρ_a of red lies on its bound 0, so in half of the draws the estimate does.
BOUND = dataclasses.replace(TRUTH, ambient=jnp.array([0.0, 0.4, 0.3]))


@dataclasses.dataclass(frozen=True)
class Spread:
    """Statistics of each parameter over many draws.

    - `ratio`: root mean square of estimate − truth over the standard error;
    - `coverage`: fraction of the 95 % intervals that contain the truth;
    - `one_sided`: whether a bound made the error one-sided in any draw.
    """

    labels: tuple[str, ...]
    ratio: np.ndarray
    coverage: np.ndarray
    one_sided: np.ndarray
    draws: int

    def failed_checks(self) -> list[str]:
        """Labels of parameters whose error bars are off by more than chance allows."""
        # From n draws, a standard deviation has the relative error 1/√(2n), and a
        # fraction p has the error √(p (1 − p) / n). Four such errors are allowed.
        tolerance = max(0.05, 4 / np.sqrt(2 * self.draws))
        coverage_tolerance = max(0.015, 4 * np.sqrt(LEVEL * (1 - LEVEL) / self.draws))
        too_wide = (self.ratio < 1 - tolerance) & ~self.one_sided
        too_narrow = self.ratio > 1 + tolerance
        wrong_coverage = np.abs(self.coverage - LEVEL) > coverage_tolerance
        failed = too_wide | too_narrow | wrong_coverage
        return [label for label, bad in zip(self.labels, failed, strict=True) if bad]


def measure_spread(
    material: pf.Material, draws: int, seed: int, console: Console
) -> Spread:
    """Fit noisy images of one scene, and compare the deviations with the stated errors.

    The ratio is the root mean square of estimate − truth, over the predicted standard
    error. If the true value of a parameter lies on a bound, the prediction does not
    hold for the others; then each deviation is divided by the error stated in its draw.
    Parameters whose true value lies on a bound are left out.
    """
    scene = ball()
    predicted = pf.predict_errors(scene, material, NOISE)
    free = ~predicted.at_bound
    light = np.asarray(pf.render(scene, material, film=pf.Film(clamp=False)), float)
    rng = np.random.default_rng(seed)
    truth = predicted.values
    pulls, covered, deviations = [], [], []
    one_sided = np.zeros(len(predicted.labels), bool)
    for _ in track(
        range(draws), "draws", console=console, disable=not console.is_terminal
    ):
        image = light + NOISE * rng.normal(size=light.shape)
        fit = pf.fit(scene, image, film=pf.Film(clamp=False))
        # A variance of NaN: the estimate is at its bound.
        one_sided |= np.isnan(np.diag(fit.covariance))
        low, high = fit.intervals(LEVEL).T
        deviations.append((fit.values - truth)[free])
        pulls.append(deviations[-1] / fit.errors[free])
        covered.append(((low <= truth) & (truth <= high))[free])
    ratio = np.sqrt(np.mean(np.square(pulls), axis=0))
    if free.all():
        ratio = np.sqrt(np.mean(np.square(deviations), axis=0)) / predicted.errors
    labels = tuple(np.array(predicted.labels)[free])
    return Spread(labels, ratio, np.mean(covered, axis=0), one_sided[free], draws)


def random_problem(seed: int) -> tuple[pf.Scene, np.ndarray]:
    """A random scene and its noisy image.

    It shows a part of a sphere or of a mesh under 1 to 3 lights. Up to a fifth of the
    samples are clipped; ρ_s is 0.02 or more, f from 1 to 200.
    """
    rng = np.random.default_rng(seed)
    material = pf.Material(
        diffuse=rng.uniform(0.05, 0.95, 3),
        specular=np.exp(rng.uniform(np.log(0.02), np.log(0.95), 3)),
        shininess=np.exp(rng.uniform(0, np.log(200))),
        ambient=rng.uniform(0.05, 0.95, 3),
    )
    if rng.random() < 0.5:
        # A window onto a part of the ball.
        surface = pf.Sphere(center=(*rng.uniform(-0.7, 0.7, 2), 0))
    else:
        surface = pf.shapes.Torus(0.8, 0.4).mesh(24, 12)
    lights = []
    for _ in range(rng.integers(1, 4)):
        direction = np.array([*rng.normal(size=2), rng.uniform(0.4, 2.0)])
        lights.append((direction, rng.uniform(0.3, 1.0, 3)))

    def scene(exposure: float) -> pf.Scene:
        return pf.Scene(
            surface,
            pf.OrthographicCamera(24, 24),
            [pf.DirectionalLight(d, exposure * colour) for d, colour in lights],
            ambient=0.3 * exposure,
        )

    light = np.asarray(
        pf.render(scene(1.0), material, film=pf.Film(clamp=False)), float
    )
    seen = light[light.any(axis=-1)]
    exposure = 1 / np.quantile(seen, 1 - rng.uniform(0, 0.2))
    noisy = exposure * light + NOISE * rng.normal(size=light.shape)
    return scene(exposure), np.clip(noisy, 0, 1)


@eqx.filter_jit
def _solve_all(problem: Problem, starts: jnp.ndarray) -> Solution:
    """Solutions from all `starts`, (starts, unknowns), in at most 100 steps each."""
    return eqx.filter_vmap(lambda start: solve(problem, start, 100))(starts)


def excess_cost(seed: int, starts: int) -> float:
    """(cost of a fit − lowest cost from random starts) / lowest cost.

    Negative if the fit's cost is below all of them.

    **Arguments:** `seed`: of the problem and of the starts; `starts`: their number.
    """
    scene, image = random_problem(seed)
    fit = pf.fit(scene, image)
    problem, unknowns = fit.solution.problem, fit.solution.problem.unknowns
    low, high = np.asarray(unknowns.lower), np.asarray(unknowns.upper)
    rng = np.random.default_rng(seed)
    # Uniform between the bounds of the solver's vector, which has log f.
    points = low + (high - low) * rng.random((starts, len(low)))
    ends = _solve_all(problem, jnp.asarray(points.astype(low.dtype)))
    costs = np.where(np.isfinite(ends.cost), ends.cost, np.inf)
    best = total_cost(problem, ends.y[int(np.argmin(costs))])
    return (total_cost(problem, fit.solution.y) - best) / best


def show(title: str, spread: Spread) -> Table:
    """Table of [`Spread`][]: ratio and coverage, parameter by parameter."""
    table = Table(title=f"{title}, {spread.draws} draws", title_justify="left")
    table.add_column("")
    table.add_column("RMSE / error", justify="right")
    table.add_column(f"truth in {LEVEL:.0%} interval", justify="right")
    table.add_column("error")
    rows = zip(
        spread.labels, spread.ratio, spread.coverage, spread.one_sided, strict=True
    )
    for label, ratio, coverage, one_sided in rows:
        word = "one-sided" if one_sided else ""
        table.add_row(label, f"{ratio:.3f}", f"{coverage:.2%}", word)
    return table


def main(
    draws: int = 4000,
    problems: int = 1000,
    starts: int = 64,
    seed: int = 0,
    json: JsonFile = None,
) -> int:
    """Are the error bars right, and is the least cost found?

    Fits many noisy images of one scene, and many random problems from many random
    starts. Exit status 1 if the answer to either is no.

    Args:
        draws: Noisy images of each of two scenes.
        problems: Random problems; 0 leaves them out.
        starts: Random starts of each of them.
        seed: Seed of the noise and of the problems.
        json: File for the numbers.
    """
    if min(draws, starts) < 1 or problems < 0:
        raise ValueError("draws, starts: expected whole numbers ≥ 1")
    check_outputs(None, json)
    console = Console()
    numbers, failed_checks = {}, []
    for title, material in (("all free", TRUTH), ("a bound binds", BOUND)):
        spread = measure_spread(material, draws, seed, console)
        console.print(show(title, spread))
        failed_checks += [f"{title}: {label}" for label in spread.failed_checks()]
        numbers[title] = dataclasses.asdict(spread)
    if problems:
        excesses = [
            excess_cost(seed + k, starts)
            for k in track(
                range(problems),
                "problems",
                console=console,
                disable=not console.is_terminal,
            )
        ]
        missed = [seed + k for k, excess in enumerate(excesses) if excess > 1e-4]
        console.print(
            f"{problems} random problems, {starts} random starts each: the fit's cost "
            f"is at most {max(excesses):.1e} above the best, {len(missed)} by more "
            f"than 1e-4{f' (seeds {missed})' if missed else ''}"
        )
        failed_checks += [f"problem {k} misses the least cost" for k in missed]
        numbers["global"] = {"excess": excesses, "starts": starts}
    save_numbers(json, numbers)
    console.print(
        f"FAILED: {'; '.join(failed_checks)}"
        if failed_checks
        else "all as it should be"
    )
    return 1 if failed_checks else 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.statistics"))
