"""`fit`: images and geometry in, a material with error bars out."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.diagnostics import neighbour_correlation, variance_inflation
from phongfit.fitting.inputs import Photograph, as_photographs
from phongfit.fitting.losses import AbstractLoss, as_loss
from phongfit.fitting.noise import clipped_variance_share, find_film, rounding_steps
from phongfit.fitting.problem import Problem, differences, linearize, solve
from phongfit.fitting.result import Fit
from phongfit.fitting.samples import Samples, gather
from phongfit.fitting.start import choose_subset, scan
from phongfit.fitting.statistics import Statistics, statistics
from phongfit.fitting.unknowns import Unknowns, make_unknowns
from phongfit.geometry.surfaces import GBuffer
from phongfit.geometry.tracing import trace
from phongfit.material import Material
from phongfit.rendering.film import Film
from phongfit.rendering.terms import ShadingTerms, combine, terms
from phongfit.scene import Scene

# A pass solves with the noise level that the pass before left over.
MOST_PASSES = 8


def fit(
    scene: Scene | Sequence[Scene],
    image: Any,
    *,
    unknowns: Sequence[str] = ("ambient", "diffuse", "specular", "shininess"),
    per_channel: Sequence[str] = ("ambient", "diffuse", "specular"),
    known: Material | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
    film: Film | None = None,
    loss: str | AbstractLoss = "linear",
    max_steps: int = 200,
) -> Fit:
    r"""The material that explains one or several images, with standard errors.

    Minimises $\sum_i w_i\, \rho\big((I_i(\rho_a, \rho_d, \rho_s, f) - t_i)^2 /
    \sigma^2\big)$ in a box, by a bounded Levenberg-Marquardt solver that starts from
    the best of a scan over $\log f$: no starting guess is needed.

    **Arguments:**

    - `scene`: one, or a sequence of scenes (lights, views) of one material.
    - `image`: (height, width, 3) linear light where white is 1, or a sequence of these,
        one a scene.
    - `unknowns`: leaves of the material to be found.
    - `per_channel`: those of them with one value for each of red, green and blue; the
        others have one for all.
    - `known`: values of the leaves that are not unknown; default no reflectance, no
        emission and an exponent of 32.
    - `bounds`: name → (low, high), in place of 0 … 1 for reflectances and emission and
        1 … 1000 for shininess.
    - `mask`: (height, width) or (height, width, 3), true where a sample is used; with
        several scenes a sequence. Pixels that see no surface are never used.
    - `weights`: relative inverse variances, shaped as `mask`; 0 leaves a sample out.
    - `noise`: standard deviation of the sensor's noise in linear light, a number or as
        `weights`; default estimated from the residuals.
    - `film`: how light became numbers (clamp, encoding, bits). By default its clamp and
        rounding are found from the values themselves.
    - `loss`: `"linear"`, `"huber"`, `"soft_l1"`, `"cauchy"`, `"tukey"`, or an
        [`AbstractLoss`][].
    - `max_steps`: of the solver, in each of its passes.

    **Returns:** a [`Fit`][]. Numerical failure is told in its `converged` and
    `warnings`; nothing is raised.

    **Raises:** `ValueError` that names the argument: wrong shapes, NaN or infinite
    pixels, a mask that leaves nothing, fewer samples than unknowns, ambient and emission
    both unknown where no pixel can tell them apart.
    """
    photographs = as_photographs(scene, image, mask, weights, noise)
    known = Material(0.0, 0.0, 32.0, 0.0) if known is None else known
    layout = make_unknowns(unknowns, per_channel, known, bounds or {})
    film = _checked_film(film, photographs)
    loss = as_loss(loss)

    geometry = [_resolve(p.scene) for p in photographs]
    shading = [shaded for _, shaded in geometry]
    weighted = [_weights(p, g) for p, (g, _) in zip(photographs, geometry, strict=True)]
    _check_samples(weighted, layout)
    _check_constants(layout, shading, weighted)
    samples = gather(
        shading,
        [p.image for p in photographs],
        weighted,
        [rounding_steps(p.image, film) for p in photographs],
    )
    problem, y, converged, steps = _search(
        samples, layout, loss, film.clamp, noise is not None, max_steps
    )
    used = [weight > 0 for weight in weighted]
    material = layout.material(y)
    fitted = [
        _shown(g, s, p.scene, material, film.clamp)
        for p, (g, s) in zip(photographs, geometry, strict=True)
    ]
    residuals = [
        np.where(mask, p.image - shown, 0)
        for p, shown, mask in zip(photographs, fitted, used, strict=True)
    ]
    linear = linearize(problem, y)
    correlation = _misfit(problem, residuals, used)
    inflation = variance_inflation(correlation)
    uncertainty = statistics(problem, y, linear, inflation)
    single = isinstance(scene, Scene)
    return _report(
        problem,
        y,
        uncertainty,
        correlation=correlation,
        inflation=inflation,
        fitted=fitted[0] if single else tuple(fitted),
        residuals=residuals[0] if single else tuple(residuals),
        samples=int(sum(mask.sum() for mask in used)),
        images=len(photographs),
        noise_given=noise is not None,
        film=film,
        converged=converged,
        steps=steps,
        max_steps=max_steps,
    )


def _resolve(scene: Scene) -> tuple[GBuffer, ShadingTerms]:
    gbuffer = trace(scene.surface, scene.camera)
    return gbuffer, terms(scene, gbuffer)


@eqx.filter_jit
def _expose(shaded: ShadingTerms, material: Material, clamp: bool) -> Array:
    light = combine(shaded, material)
    return jnp.clip(light, 0, 1) if clamp else light


def _shown(
    gbuffer: GBuffer,
    shaded: ShadingTerms,
    scene: Scene,
    material: Material,
    clamp: bool,
) -> np.ndarray:
    """The fitted image in linear light."""
    light = np.asarray(_expose(shaded, material, clamp))
    mask = np.asarray(gbuffer.mask)[..., None]
    return np.where(mask, light, np.asarray(scene.background))


def _checked_film(film: Film | None, photographs: list[Photograph]) -> Film:
    images = [p.image[p.weight > 0] for p in photographs]
    if film is None:
        return find_film(images)
    for p, values in zip(photographs, images, strict=True):
        if film.clamp and values.size and not 0 <= values.min() <= values.max() <= 1:
            raise ValueError(
                f"{p.name}: values from {values.min():.4g} to {values.max():.4g} came, "
                "a clamped film holds [0, 1]; say film=Film(clamp=False)"
            )
    return film


def _weights(photograph: Photograph, gbuffer: GBuffer) -> np.ndarray:
    """Weights of the pixels that see the surface; the others have none."""
    seen = np.asarray(gbuffer.mask)[..., None]
    return np.where(seen, photograph.weight, 0).astype(photograph.image.dtype)


def _check_samples(weights: list[np.ndarray], unknowns: Unknowns) -> None:
    count = sum(int(np.count_nonzero(weight)) for weight in weights)
    if count == 0:
        raise ValueError("mask: it leaves no pixel that sees the surface")
    if count <= len(unknowns.labels):
        raise ValueError(
            f"mask: {count} samples are left for {len(unknowns.labels)} unknowns; more "
            "samples than unknowns are wanted"
        )


def _check_constants(
    unknowns: Unknowns, shading: list[ShadingTerms], weights: list[np.ndarray]
) -> None:
    """Ambient and emission are one constant wherever the ambient light is the same."""
    if not {"ambient", "emission"} <= set(unknowns.names):
        return
    light = np.concatenate(
        [
            np.asarray(shaded.ambient)[weight.any(axis=-1)]
            for shaded, weight in zip(shading, weights, strict=True)
        ]
    )
    if np.all(np.ptp(light, axis=0) <= 1e-6 * np.abs(light).max()):
        raise ValueError(
            "unknowns: ambient and emission both came, but under constant ambient light "
            "they are one constant; leave one out"
        )


def _search(
    samples: Samples,
    unknowns: Unknowns,
    loss: AbstractLoss,
    clamp: bool,
    noise_given: bool,
    max_steps: int,
) -> tuple[Problem, Array, bool, int]:
    """Start, then solve until the noise level that it rests on is what it leaves."""
    subset = samples.take(choose_subset(samples))
    y = scan(subset, unknowns, clamp)
    resolution = float(jnp.finfo(y.dtype).eps)
    # Before the noise is known the clamp is a hard one.
    sigma = jnp.asarray(1.0 if noise_given else resolution, y.dtype)
    problem = Problem(samples, unknowns, sigma, loss, clamp)
    if not noise_given:
        problem = _with_sigma(problem, _noise_level(problem, y, robust=True))
    steps = 0
    for _ in range(MOST_PASSES):
        solution = solve(problem, y, max_steps)
        y, steps = solution.y, steps + int(solution.steps)
        if noise_given:
            break
        robust = not _is_linear(loss)
        before, after = float(problem.sigma), _noise_level(problem, y, robust)
        problem = _with_sigma(problem, after)
        if after > 0.97 * before:
            break
    return problem, y, bool(solution.converged), steps


def _is_linear(loss: AbstractLoss) -> bool:
    far = jnp.asarray(1e3)
    return bool(loss.root(far) == far)


def _with_sigma(problem: Problem, sigma: float) -> Problem:
    value = jnp.asarray(sigma, problem.sigma.dtype)
    return dataclasses.replace(problem, sigma=value)


def _noise_level(problem: Problem, y: Float[Array, " n"], robust: bool) -> float:
    """Standard deviation of a sample of weight 1, before rounding, from residuals.

    Robust: from the median, which outliers do not reach.
    """
    weight = np.asarray(problem.samples.weight)
    used = weight > 0
    difference = np.asarray(differences(problem, y))[used] * np.sqrt(weight[used])
    rounding = (np.asarray(problem.samples.step)[used] ** 2 * weight[used]).mean() / 12
    target = np.asarray(problem.samples.target)[used]
    # Far from a resolution of the arithmetic nothing can be said.
    floor = 16 * np.finfo(difference.dtype).eps * max(float(np.abs(target).max()), 1e-3)
    if robust:
        inside = (
            (target > 0) & (target < 1) if problem.clamp else np.ones_like(target, bool)
        )
        if inside.sum() > len(y):
            difference = difference[inside]
        variance = (1.4826 * float(np.median(np.abs(difference)))) ** 2
    else:
        share = float(used.sum())
        if problem.clamp:
            light = problem.samples.light(problem.unknowns.material(y))
            shares = clipped_variance_share(light, problem.noise())
            share = float(np.asarray(shares)[used].sum())
        variance = float(np.sum(difference.astype(float) ** 2)) / max(share - len(y), 1)
    return float(np.sqrt(max(variance - float(rounding), floor**2)))


def _misfit(
    problem: Problem, residuals: list[np.ndarray], used: list[np.ndarray]
) -> float:
    """Correlation of neighbouring residuals, where these are more than rounding."""
    total = sum(float(np.sum(r.astype(float) ** 2)) for r in residuals)
    count = sum(int(m.sum()) for m in used)
    step = np.asarray(problem.samples.step)[np.asarray(problem.samples.weight) > 0]
    resolution = float(jnp.finfo(problem.sigma.dtype).eps)
    rounding = float((step.astype(float) ** 2).mean()) / 12
    if total / count <= 2 * rounding + (64 * resolution) ** 2:
        return 0.0
    return neighbour_correlation(residuals, used)


def _report(
    problem: Problem,
    y: Float[Array, " n"],
    uncertainty: Statistics,
    *,
    correlation: float,
    inflation: float,
    film: Film,
    converged: bool,
    max_steps: int,
    noise_given: bool,
    **rest: Any,
) -> Fit:
    """The result in the user's units, with warnings in words."""
    unknowns = problem.unknowns
    values = np.asarray(unknowns.values(y), float)
    # d f / d log f = f.
    scale = np.where(unknowns.logarithmic, values, 1.0)
    residual = np.asarray(problem.residual(y), float)
    chi_squared = float(np.sum(residual**2))
    untold, reasons = _beyond_sense(unknowns, np.asarray(y), uncertainty)
    errors = np.where(untold, np.inf, uncertainty.stderr * scale)
    covariance = uncertainty.covariance * np.outer(scale, scale)
    covariance[untold, :] = covariance[:, untold] = np.nan
    covariance[untold, untold] = np.inf
    at_bound = uncertainty.at_bound & ~untold
    warnings = [*reasons]
    for label in np.array(unknowns.labels)[at_bound]:
        warnings.append(f"{label} lies at its bound: its error is one-sided")
    if not converged:
        warnings.insert(0, f"the solver did not converge within {max_steps} steps")
    if correlation > 0.1:
        warnings.append(
            f"residuals are not noise: neighbouring pixels correlate by "
            f"{correlation:.2f}. The model does not describe the image fully; errors "
            f"are widened {np.sqrt(inflation):.1f} times, and cannot tell a bias"
        )
    bounds = np.stack(
        [np.asarray(unknowns.values(b)) for b in (unknowns.lower, unknowns.upper)], 1
    )
    result = Fit(
        material=unknowns.with_leaves(jnp.asarray(values, y.dtype)),
        stderr=_error_material(unknowns, errors),
        labels=unknowns.labels,
        values=values,
        errors=errors,
        covariance=covariance,
        at_bound=at_bound,
        untold=untold,
        bounds=bounds.astype(float),
        noise=float(problem.sigma),
        noise_given=noise_given,
        chi_squared=chi_squared,
        neighbour_correlation=correlation,
        loss=type(problem.loss).__name__,
        model=type(problem.samples.terms.model).__name__,
        film=_film_words(film),
        converged=converged,
        reason=(
            "the step and the change of the residuals fell below the tolerance"
            if converged
            else "the limit of steps was reached"
        ),
        warnings=tuple(warnings),
        **rest,
    )
    if noise_given and result.reduced_chi_squared > 1.5:
        more = (
            f"residuals are {np.sqrt(result.reduced_chi_squared):.1f} times as large as "
            "the noise that was given: the noise or the model is wrong, and errors are "
            "too small"
        )
        result = dataclasses.replace(result, warnings=(*result.warnings, more))
    return result


def _film_words(film: Film) -> str:
    rounded = "not rounded" if film.bits is None else f"{film.bits}-bit {film.encoding}"
    return f"{'clamped' if film.clamp else 'not clamped'}, {rounded}"


def _error_material(unknowns: Unknowns, errors: np.ndarray) -> Material:
    """Errors as a material; what was known has none."""
    zero = Material(0.0, 0.0, 0.0, 0.0, 0.0)
    layout = dataclasses.replace(unknowns, known=zero)
    return layout.with_leaves(jnp.asarray(errors, unknowns.lower.dtype))


def _beyond_sense(
    unknowns: Unknowns, y: np.ndarray, uncertainty: Statistics
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Unknowns whose error, though finite, says that nothing is known."""
    untold = uncertainty.untold.copy()
    reasons = [*uncertainty.reasons]
    labels = np.array(unknowns.labels)
    width = np.asarray(unknowns.upper) - np.asarray(unknowns.lower)
    kinds = np.repeat(unknowns.names, unknowns.sizes)
    with np.errstate(invalid="ignore"):
        vague = ~untold & (uncertainty.stderr > width)
        dark = (kinds == "specular") & (y < 3 * uncertainty.stderr)
    for label in labels[vague]:
        reasons.append(f"{label} cannot be told: its error is wider than its bounds")
    untold |= vague
    if (kinds == "specular").any() and dark[kinds == "specular"].all():
        unseen = (kinds == "shininess") & ~untold
        for label in labels[unseen]:
            reasons.append(f"{label} cannot be told: specular is 0 within its error")
        untold |= unseen
    return untold, tuple(reasons)
