"""Errors, misfit and warnings of a fit of textures."""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from phongfit.codes import coded
from phongfit.fitting.problem.losses import Linear
from phongfit.fitting.problem.posing import tile_side
from phongfit.fitting.texels.equations import light_of
from phongfit.fitting.texels.job import IDENTIFIED, Few, Job, State
from phongfit.fitting.texels.lit import BASIS, before_rounding
from phongfit.fitting.texels.result import CHANNELS, Shared, TextureFit, as_textures
from phongfit.fitting.texels.steps import LEAST, System
from phongfit.fitting.uncertainty.identifiability import (
    SEEN,
    not_identifiable,
    stands_out,
)
from phongfit.fitting.uncertainty.misfit import find_misfit
from phongfit.fitting.uncertainty.quantiles import chi_squared_reach
from phongfit.fitting.uncertainty.sandwich import unit_diagonal
from phongfit.fitting.uncertainty.tiles import Measured, Tiles, sum_over_tiles
from phongfit.fitting.uncertainty.warnings import misfit_words, spread_words
from phongfit.material import Material


def judge(
    job: Job,
    state: State,
    sigma: float,
    system: System,
    noise_given: bool,
    converged: bool,
    steps: int,
) -> TextureFit:
    """The result at the solution, with errors, misfit and warnings."""
    covariance, identified = _few_covariance(system.information)
    variances = []
    for s, (alone, moved) in enumerate(
        zip(system.alone, system.eliminated, strict=True)
    ):
        shared = job.of_system(s)
        both = np.outer(identified, identified)
        part = np.where(both, covariance, 0)[np.ix_(shared, shared)]
        more = np.einsum("ti,ij,tj->t", moved, part, moved, optimize=False)
        variances.append(alone + more)
    freedom, spread = system.freedom, 1.0
    seen, samples = np.zeros(job.grid.shape), 0
    residuals, tiles = [], []
    for k in range(len(job.images.given)):
        # Sum here, since one count an image would fill memory if there are many texels.
        residual, of_image, looks, used = _image(job, k, state, sigma)
        seen += looks
        samples += used
        residuals.append(residual)
        tiles.append(of_image)
    side = max(tile_side(*one.shape[:2]) for one in residuals)
    misfit = find_misfit(tiles, side)
    left = None if noise_given else (samples, freedom)
    if noise_given:
        over = system.left.squares / freedom
        spread = float(np.sqrt(over)) if over > 1 + 5 * np.sqrt(2 / freedom) else 1.0
    inflation = max(misfit.inflation, spread**2)
    errors = [
        np.sqrt(np.where(v < IDENTIFIED**2, v * inflation, np.inf)) for v in variances
    ]
    values, stderr = as_textures(job, job.vectors(state)), as_textures(job, errors)
    if "shininess" in job.names:
        values["shininess"] = np.exp(values["shininess"])
        stderr["shininess"] *= values["shininess"]
    covariance = covariance * inflation
    few_errors = np.sqrt(np.where(identified, np.diag(covariance), np.inf))
    unseen = _unseen(job, state, covariance, values, stderr)
    few_errors[unseen] = np.inf
    if "shininess" in job.names:
        stderr["shininess"][_exponents_unseen(job, unseen, values, stderr)] = np.inf
    numbers = {name: value.copy() for name, value in state.numbers.items()}
    for name in job.names:
        numbers[name][:] = 1
    shared = []
    for k, one in enumerate(job.few):
        value = state.value(one)
        # The covariance of an exponent is that of its logarithm.
        error = few_errors[k] * (value if one.name == "shininess" else 1)
        shared.append(Shared(_label(job, one), value, float(error)))
    hidden = [one.label for one, none in zip(shared, unseen, strict=True) if none]
    lost = [one.label for one in shared if not np.isfinite(one.stderr)]
    lost = [label for label in lost if label not in hidden]
    return TextureFit(
        values,
        stderr,
        seen,
        Material(
            **{name: numbers[name] for name in BASIS},
            shininess=numbers["shininess"][:, None],
        ),
        tuple(shared),
        covariance,
        job.names,
        sigma if not noise_given else 1.0,
        system.left.counted,
        tuple(residuals),
        misfit,
        converged,
        steps,
        (
            *_warnings(job, converged, hidden, lost, left),
            *spread_words(spread),
            *misfit_words(misfit, len(tiles)),
        ),
        job.grid,
    )


def _few_covariance(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of `information`, and which shared numbers are identified."""
    there = np.diag(information) > 0
    scaled, root = unit_diagonal(np.where(np.outer(there, there), information, 0))
    values, vectors = np.linalg.eigh(scaled)
    vague = values < LEAST
    inverse = (vectors / np.where(vague, np.inf, values)) @ vectors.T
    identified = (vectors[:, vague] ** 2).sum(axis=1) <= 0.01
    return inverse / np.outer(root, root), identified


def _unseen(
    job: Job,
    state: State,
    covariance: Float[np.ndarray, "k k"],
    values: dict[str, np.ndarray],
    stderr: dict[str, np.ndarray],
) -> Bool[np.ndarray, " k"]:
    """Marks shared numbers of highlights that noise alone explains, as in [`fit`][].

    An exponent is marked if its specular is 0 within its error. A shared specular is
    also marked if texels have exponents, which are then fitted to noise.

    **Arguments:** `covariance`: covariance of the shared numbers. `values`, `stderr`:
    textures and their errors.
    """
    unseen = np.zeros(len(job.few), bool)
    chosen = job.grid.texels // job.grid.layers if "shininess" in job.names else 0
    for material in {one.material for one in job.few}:
        own = [k for k, one in enumerate(job.few) if one.material == material]
        shares = [k for k in own if job.few[k].name == "specular"]
        if "specular" in job.names:
            layer = min(material, len(values["specular"]) - 1)
            seen = _any_texel(values["specular"][layer], stderr["specular"][layer])
        elif shares:
            height = np.array([state.value(job.few[k]) for k in shares])
            together = covariance[np.ix_(shares, shares)]
            seen = stands_out(height, together, SEEN, chosen)
        else:
            seen = state.numbers["specular"][material].any()
        depend = {"shininess", "specular"} if chosen else {"shininess"}
        unseen[[k for k in own if job.few[k].name in depend]] = not seen
    return unseen


def _any_texel(height: np.ndarray, error: np.ndarray) -> bool:
    """Whether the highest texel, or all texels together, are more than noise."""
    known = np.isfinite(error)
    if not known.any():
        return False
    deviations = height[known] / error[known]
    count = len(deviations)
    highest = np.sqrt(SEEN**2 + 2 * np.log(count))
    together = np.sum(deviations**2) >= chi_squared_reach(SEEN, count)
    return bool(deviations.max() >= highest or together)


def _exponents_unseen(
    job: Job,
    unseen: Bool[np.ndarray, " k"],
    values: dict[str, np.ndarray],
    stderr: dict[str, np.ndarray],
) -> Bool[np.ndarray, "layers *places 1"]:
    """Marks texels whose exponents belong to highlights that noise alone explains.

    A pixel between texels depends on the highlights and exponents of all of them.
    """
    if "specular" in job.names:
        with np.errstate(invalid="ignore"):
            deviations = values["specular"] / stderr["specular"]
        together = np.sum(deviations**2, axis=-1)
        shiny = together >= chi_squared_reach(SEEN, deviations.shape[-1])
        beside = np.zeros(job.grid.texels)
        for k in range(len(job.images.given)):
            lit = job.images.at(k)
            looks = (lit.touched.mean(shiny.ravel()) > 0) & (lit.weight > 0).any(axis=1)
            beside += lit.touched.scattered(looks.astype(float), job.grid.texels)
        return (beside == 0).reshape(values["shininess"].shape)
    hidden = np.zeros(values["shininess"].shape, bool)
    shares = [k for k, one in enumerate(job.few) if one.name == "specular"]
    if len(hidden) == 1:
        hidden[0] = bool(shares) and unseen[shares].all()
        return hidden
    for k in shares:
        hidden[job.few[k].material] = unseen[k]
    return hidden


def _label(job: Job, one: Few) -> str:
    several = max(k.material for k in job.few) > 0
    number = f"[{one.material}]" if several else ""
    return f"{one.name}{number}" + (
        "" if one.channel is None else f".{CHANNELS[one.channel]}"
    )


def _image(
    job: Job, k: int, state: State, sigma: float
) -> tuple[np.ndarray, Tiles, Float[np.ndarray, "..."], int]:
    """Residuals of one image, and sums that only a whole image gives.

    **Returns:** residuals; their sums over tiles; how many pixels see each texel; and
    the number of samples of positive weight.
    """
    lit, image, step = job.images.at(k), job.images.image(k), job.images.step(k)
    parts, light = light_of(job, lit, state, lit.touched)
    whole = np.zeros((4, image.size // 3, 3), image.dtype)
    whole[0, lit.place] = light
    whole[1, lit.place] = parts.light[1]
    whole[2, lit.place] = parts.light[2]
    whole[3, lit.place] = lit.weight
    light, diffuse, highlight, weight = whole.reshape(4, *image.shape)
    side = tile_side(*image.shape[:2])
    step = None if step is None else jnp.asarray(step)
    deviation = sigma / np.sqrt(np.where(weight > 0, weight, 1))
    noise = before_rounding(light, deviation, lit.ends)
    weight = np.where(weight > 0, (sigma / noise) ** 2, 0).astype(light.dtype)
    measured = Measured(
        jnp.asarray(image), jnp.asarray(weight), step, jnp.asarray(sigma, light.dtype)
    )
    shapes = light, diffuse, highlight
    tiles = sum_over_tiles(measured, *shapes, Linear(), job.clamp, side)
    fitted = np.clip(light, 0, 1) if job.clamp else light
    # Each pixel counts by the texel's weight in it.
    looks = (lit.weight > 0).any(axis=1).astype(float)
    residual = np.where(weight > 0, image - fitted, 0)
    seen = lit.touched.scattered(looks, job.grid.texels).reshape(job.grid.shape)
    return residual, tiles, seen, int(np.count_nonzero(lit.weight))


def _warnings(
    job: Job,
    converged: bool,
    unseen: list[str],
    lost: list[str],
    left: tuple[int, float] | None,
) -> Iterator[str]:
    """Warnings of a fit, without those of its residuals.

    **Arguments:**

    - `unseen`, `lost`: labels of shared numbers without a highlight, and of others that
        are not identified.
    - `left`: number of samples and degrees of freedom from which the noise was
        estimated, if it was.
    """
    if not converged:
        remedy = "Raise max_steps, or ask for fewer unknowns"
        yield coded("not-converged", "did not converge", remedy)
    if unseen:
        words = f"{not_identifiable(unseen)}: no highlight stands out"
        yield coded("no-highlight", words)
    if lost:
        yield coded(
            "not-identifiable",
            f"{', '.join(lost)}: not identifiable from these photographs",
            "Give it as known, or photographs under other lamps",
        )
    if left is not None and left[1] < 0.1 * left[0]:
        yield coded(
            "noise-level",
            f"{left[0]:,} samples leave {left[1]:,.0f} to estimate the noise from",
            "Give noise, or a smaller size",
        )
    if job.lossy:
        yield coded(
            "jpeg-texels",
            "rounding errors of JPEG files are correlated in blocks of pixels, which "
            "errors of texels do not include: they may be too small",
        )
