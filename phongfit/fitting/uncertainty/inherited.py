r"""Refinement of uncertain scene parameters by the images, and their remaining errors.

A calibration gives parameters of lights as $\eta \sim N(\eta_0, \Sigma)$, which is one
more measurement. With $\Sigma = L L^\top$ and $\eta = \eta_0 + L z$ the fit minimises
cost / κ + $|z|^2$. κ is the variance of the gradient over that of independent samples,
and so the factor by which the samples count less. Let B be the curvature of half the
cost in the unknowns, C the mixed curvature in unknowns and z, and S the curvature in z
with the unknowns at their best. Then a step to the minimum is $-(1 + S / \kappa)^{-1}$
times the gradient, and $(1 + S / \kappa)^{-1}$ is the remaining covariance of z. It
changes the unknowns by $-B^{-1} C z$ to first order, so $C \operatorname{cov}(z)
C^\top$ is added to the covariance of the cost's gradient.

Each principal axis of S has its own κ. JPEG rounding that is equal in all images makes
the strengths of lamps uncertain, but hardly their positions.

??? cite "Source"
    Lindley and Smith, *Bayes estimates for the linear model*, J. R. Stat. Soc. B 34(1),
    1972; Murphy and Topel, *Estimation and inference in two-step econometric models*,
    J. Business & Economic Statistics 3(4), 1985.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.problem import Problem, evaluate
from phongfit.fitting.problem.samples import Channels, Samples, Source
from phongfit.fitting.problem.uncertain import Nuisance
from phongfit.fitting.problem.unknowns import in_units
from phongfit.fitting.solve.jpeg import Beside
from phongfit.fitting.solve.search import SearchResult, search_on
from phongfit.fitting.uncertainty.sandwich import inverse_of
from phongfit.fitting.uncertainty.statistics import in_numpy, sums_in_double
from phongfit.geometry.surfaces import GBuffer
from phongfit.programs import program
from phongfit.rendering.pixels import PixelTerms, pixel_terms, resolve_terms
from phongfit.scene import Scene

# Most steps, most halvings of a step that overshoots, and the length of a step in
# standard deviations of the prior that ends the iteration.
STEPS, HALVED, SMALL = 12, 6, 0.02
# Fraction of the largest variance below which a variance is rounding.
ROUNDING = 1e-9


class Refined(NamedTuple):
    """A fit with refined scenes.

    - `found`, `sources`: the fit, and its images with the refined scenes.
    - `moved`: z, the change of the scenes in standard deviations of the prior.
    """

    found: SearchResult
    sources: list[Source]
    moved: Float[np.ndarray, " k"]


def refine(
    found: SearchResult,
    sources: list[Source],
    nuisance: Nuisance,
    noise_given: bool,
    max_steps: int,
    moved: Float[np.ndarray, " k"] | None = None,
    scores: Float[np.ndarray, "rows m"] | None = None,
) -> Refined:
    """Minimise the cost of images and of the scenes' prior together.

    A step that overshoots, since the images are not linear in it, is halved.

    **Arguments:**

    - `moved`: as in [`Refined`][], if the scenes were refined already.
    - `scores`: as in [`Restored`][], if samples are not independent.
    """
    root = _root(nuisance, found.problem, found.y)
    moved = np.zeros(root.shape[1]) if moved is None else moved
    best = Refined(found, sources, moved)
    for _ in range(STEPS):
        problem, y = best.found.problem, best.found.y
        seen = _look(problem, y, nuisance, root, best.moved, scores)
        step = -seen.covariance @ (best.moved + seen.pull)
        for _ in range(HALVED):
            there = _moved_by(step, best, nuisance, root, noise_given, max_steps)
            if _is_better(there, best):
                break
            step = step / 2
        else:
            break
        best = there
        if np.abs(step).max(initial=0) < SMALL:
            break
    scenes = _scenes(
        best.found.problem, best.found.y, nuisance, root @ best.moved, sources
    )
    pairs = zip(sources, scenes, strict=True)
    return best._replace(sources=[_in_scene(*pair) for pair in pairs])


def _moved_by(
    step: Float[np.ndarray, " k"],
    before: Refined,
    nuisance: Nuisance,
    root: Float[np.ndarray, "m k"],
    noise_given: bool,
    max_steps: int,
) -> Refined:
    """The fit in scenes that differ by `step` from those of `before`."""
    problem, moved = before.found.problem, before.moved + step
    scenes = _scenes(problem, before.found.y, nuisance, root @ moved, before.sources)
    found = search_on(
        before.found, _moved(problem.samples, scenes), noise_given, max_steps
    )
    return Refined(found, before.sources, moved)


def _is_better(there: Refined, before: Refined) -> bool:
    """Whether the images or the prior fit better than before."""
    problem = before.found.problem
    # At the same noise level, since residuals are in units of it.
    again = dataclasses.replace(there.found.problem, sigma=problem.sigma)
    better = _cost(again, there.found.y) < _cost(problem, before.found.y)
    return bool(better or there.moved @ there.moved < before.moved @ before.moved)


def with_samples_of(refined: SearchResult, first: SearchResult) -> SearchResult:
    """A refined fit with samples of the original images, without JPEG correction."""
    problem, old = refined.problem, first.problem
    samples = dataclasses.replace(
        problem.samples, target=old.samples.target, step=old.samples.step
    )
    problem = Problem(samples, problem.unknowns, old.sigma, old.loss, old.clamp)
    return dataclasses.replace(refined, problem=problem)


def with_inherited(
    problem: Problem,
    y: Float[Array, " n"],
    nuisance: Nuisance,
    moved: Float[np.ndarray, " k"] | None = None,
    scores: Float[np.ndarray, "rows m"] | None = None,
) -> Problem:
    """The problem with the covariance of scores that is due to uncertain scenes.

    **Arguments:** `moved`, `scores`: as in [`refine`][].
    """
    root = _root(nuisance, problem, y)
    moved = np.zeros(root.shape[1]) if moved is None else moved
    seen = _look(problem, y, nuisance, root, moved, scores)
    inherited = seen.mixed @ seen.covariance @ seen.mixed.T
    inherited = (inherited + inherited.T) / 2
    # In double precision, which keeps tiny variances.
    return dataclasses.replace(problem, inherited=inherited)


def _root(
    nuisance: Nuisance, problem: Problem, y: Float[Array, " n"]
) -> Float[np.ndarray, "m k"]:
    """L, in the solver's units."""
    _, there = nuisance.beside(problem, y)
    covariance = nuisance.solver_covariance(there, len(y))
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    kept = values > ROUNDING * values.max(initial=0)
    return vectors[:, kept] * np.sqrt(values[kept])


class _Seen(NamedTuple):
    """Information of the images about z at a point, divided by κ.

    - `pull`: gradient of the cost.
    - `mixed`: C.
    - `covariance`: remaining covariance of z.
    """

    pull: Float[np.ndarray, " k"]
    mixed: Float[np.ndarray, "n k"]
    covariance: Float[np.ndarray, "k k"]


def _look(
    problem: Problem,
    y: Float[Array, " n"],
    nuisance: Nuisance,
    root: Float[np.ndarray, "m k"],
    moved: Float[np.ndarray, " k"],
    scores: Float[np.ndarray, "rows n+m"] | None,
) -> _Seen:
    wider, there = _beside(problem, y, nuisance, root @ moved)
    # Effects of degenerate parameters cancel, which needs double precision.
    sums, count = in_numpy(sums_in_double(wider, there)), len(y)
    own, mixed = sums.bread[:count, :count], sums.bread[:count, count:] @ root
    # Unknowns at a bound are held there.
    at, box = np.asarray(y), problem.unknowns
    free = (at > np.asarray(box.lower)) & (at < np.asarray(box.upper))
    inverse = np.zeros_like(own)
    some = np.ix_(free, free)
    inverse[some] = inverse_of(own[some], float(np.finfo(y.dtype).eps))
    alone = root.T @ sums.bread[count:, count:] @ root - mixed.T @ inverse @ mixed
    information, basis = np.linalg.eigh((alone + alone.T) / 2)
    information = np.maximum(information, 0)
    pull = root.T @ sums.pull[count:] - mixed.T @ inverse @ sums.pull[:count]
    if scores is None:
        meat = sums.meat[:count, :count]
        excess = np.trace(inverse @ meat) / max(np.count_nonzero(free), 1)
    else:
        # Rounding of files affects some components of z far more than others.
        rest = scores[:, count:] @ root - scores[:, :count] @ inverse @ mixed
        excess = np.sum((rest @ basis) ** 2, axis=0) / np.maximum(information, 1e-30)
    excess = np.maximum(excess, 1.0)
    pull = (basis / excess) @ (basis.T @ pull)
    return _Seen(pull, mixed, (basis / (1 + information / excess)) @ basis.T)


def beside(nuisance: Nuisance, moved: Float[np.ndarray, " k"] | None = None) -> Beside:
    """A function that adds the refined uncertain parameters to a fit's problem.

    **Arguments:** `moved`: as in [`refine`][].
    """

    def wider(problem: Problem, y: Float[Array, " n"]) -> tuple[Problem, Array]:
        root = _root(nuisance, problem, y)
        step = np.zeros(len(root)) if moved is None else root @ moved
        return _beside(problem, y, nuisance, step)

    return wider


def _beside(
    problem: Problem,
    y: Float[Array, " n"],
    nuisance: Nuisance,
    step: Float[np.ndarray, " m"],
) -> tuple[Problem, Array]:
    wider, there = nuisance.beside(problem, y)
    return wider, there.at[len(y) :].add(jnp.asarray(step, y.dtype))


def _scenes(
    problem: Problem,
    y: Float[Array, " n"],
    nuisance: Nuisance,
    step: Float[np.ndarray, " m"],
    sources: list[Source],
) -> tuple[Scene, ...]:
    """The images' scenes with changed uncertain parameters."""
    wider, there = _beside(problem, y, nuisance, step)
    entries = in_units(wider.unknowns, there)[0]
    return wider.unknowns.scenes(entries, tuple(source.scene for source in sources))


def _moved(samples: Samples, scenes: tuple[Scene, ...]) -> Samples:
    views = [
        dataclasses.replace(view, scene=scene)
        for view, scene in zip(samples.views, scenes, strict=True)
    ]
    channels = _lit(samples, scenes)
    return dataclasses.replace(samples, channels=channels, views=tuple(views))


@program()
def _lit(samples: Samples, scenes: tuple[Scene, ...]) -> Channels:
    return samples.lit(scenes)


def _in_scene(source: Source, scene: Scene) -> Source:
    """An image with another scene."""
    return dataclasses.replace(source, scene=scene, pixels=_seen_in(source, scene))


def _seen_in(source: Source, scene: Scene) -> PixelTerms:
    if source.gbuffer is None:
        return resolve_terms(scene)[1]
    return _terms(scene, source.gbuffer)


@program()
def _terms(scene: Scene, gbuffer: GBuffer) -> PixelTerms:
    return pixel_terms(scene, gbuffer)


def _cost(problem: Problem, y: Float[Array, " n"]) -> float:
    """Sum of the loss over the samples."""
    residual = evaluate(problem, y).residual
    return float(np.sum(np.asarray(problem.loss.root(residual), float) ** 2))
