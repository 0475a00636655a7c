"""One pixel under many lights: its material, with errors, and what is unidentified.

The caller batches with `vmap`. Nothing here branches on numbers, so that a pixel that
fails costs no more than one that does not, and disturbs none.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.losses import Huber
from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.uncertainty.misfit import SIGNIFICANT
from phongfit.maps.pixel.columns import Columns, Lights, make_columns
from phongfit.maps.pixel.errors import VAGUE, Errors, standard_errors
from phongfit.maps.pixel.exponent import At, Box, evaluate
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.pixel.lobes import Angles
from phongfit.maps.pixel.robust import loss_weights, widening
from phongfit.maps.pixel.samples import PixelSamples, whitened
from phongfit.maps.pixel.search import (
    SHORTEST,
    Descent,
    candidates,
    refine_exponents,
    scan_exponents,
    where_wanted,
)
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import dot, optimization_barrier, over_channels

# Steps on the sum of the channels, which are a third of the price, then on all; and of
# those at most, where it takes longer.
SUMMED_STEPS = 4
STEPS = 4
MOST_STEPS = 16
# Rounds of reweighting of a robust loss; and where it takes longer.
REWEIGHTED = 10
MOST_REWEIGHTED = 40
# Of these the first have a loss whose reflectances cannot lie in a false minimum.
CONVEX = 5
REWEIGHTED_STEPS = 2
# Thorough starts, of which each leaves out one of so many groups of samples.
GROUPS = 3
# They are tried where less of the highlight's information is left than this share, or
# where residuals are larger than the noise by this factor.
KEPT = 0.6
LARGER = 1.3
# Efficiency of a median of absolute values as a measure of scale: Hampel, *The
# influence curve and its role in robust estimation*, J. Am. Stat. Assoc. 69(346), 1974.
MEDIAN = 0.37
# By how much channels may differ in how the lights share them, over their sum.
COLOURED = 0.1
# The axis along which pixels are batched.
BESIDE = "beside"


class PixelFit(NamedTuple):
    """The material of one pixel.

    - `ambient`, `diffuse`, `specular`: (3,) each, `shininess`: (3,) or (1,) if shared.
    - `errors`: the same four, infinite for what is not identified, 0 for what was
        known.
    - `noise`: root mean square of the residuals a degree of freedom, in linear light,
        or in the samples' own standard deviations.
    - `samples`: how many were used.
    - `flags`: bits of [`Flag`][].
    """

    ambient: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    shininess: Float[Array, " exponents"]
    errors: tuple[Array, Array, Array, Array]
    noise: Float[Array, ""]
    samples: Int[Array, ""]
    flags: Int[Array, ""]


class Known(NamedTuple):
    """Parameters of the material that are not unknown; of the exponent, the start.

    (3,) each, and (1,) for a shared exponent.
    """

    ambient: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    shininess: Float[Array, " exponents"]


class _Found(NamedTuple):
    """A group of channels with one exponent, solved.

    - `columns`: of the samples as they were weighed at the end.
    - `squares`: of all residuals; `scale`: their size, which outliers do not reach.
    - `widening`: factor on the errors of samples so weighed.
    - `moved`: by how much the last weights moved the reflectances.
    - `unsettled`: whether the search for the exponent was cut short.
    """

    at: At
    t: Array
    columns: Columns
    squares: Array
    scale: Array
    widening: Array
    moved: Array
    unsettled: Array


def fit_pixel(
    samples: PixelSamples,
    known: Known,
    noise: Float[Array, ""],
    thorough: Bool[Array, ""],
    settings: MapSettings,
) -> tuple[PixelFit, Bool[Array, ""]]:
    """The material of one pixel, from its samples alone.

    What a few pixels need all that are batched with them pay for. So there are two
    ways, one short and one thorough, and a pixel that is settled by the short one gets
    the same from both.

    **Arguments:**

    - `samples`: of three channels.
    - `known`: what is not unknown.
    - `noise`: standard deviation of a sample in linear light, 1 if
        `settings.weighted`; not read if `settings.noise_given` is false.
    - `thorough`: whether to do whatever helps.

    **Returns:** the material, and whether the thorough way is wanted.
    """
    dtype = samples.target.dtype
    finite = jnp.isfinite(samples.target)
    if settings.exactly:
        sound = finite & (samples.target != settings.cutoff)
    else:
        sound = finite & (samples.target < settings.cutoff)
    # Numbers rather than flags from here on: sums of those are slow.
    weight = jnp.where(sound, samples.weight, 0)
    light = samples.target if samples.veil is None else samples.target - samples.veil
    target = jnp.where(sound, light, 0) * weight
    infinite = jnp.where(finite, 0, samples.weight)
    weight, target = optimization_barrier((weight, target))
    lost = _sum(infinite) > 0
    black = _sum(jnp.abs(target)) == 0
    samples = PixelSamples(
        target,
        weight,
        samples.ambient,
        samples.diffuse,
        samples.strength,
        samples.angles,
    )
    unlike = jnp.any((weight > 0) != (weight[:1] > 0)) | _coloured(samples.strength)
    if settings.weighted:
        samples = optimization_barrier(whitened(samples))
        weight = samples.weight

    def solved(samples: PixelSamples, known: Known) -> _Found:
        return _solve(samples, known, noise, unlike, thorough, settings)

    if settings.shared:
        found = optimization_barrier(solved(samples, known))
    else:

        def alone(channel: PixelSamples, known: Known) -> _Found:
            # Channels on their own share nothing but the cosines.
            angles = samples.angles
            return solved(dataclasses.replace(channel, angles=angles), known)

        found = optimization_barrier(jax.vmap(alone)(*_split(samples, known)))
    total = _sum(weight)
    count = total.astype(jnp.int32)
    unknowns = settings.unknowns()
    freedom = total - unknowns
    enough = freedom > 0
    freedom = jnp.maximum(freedom, 1)
    if settings.loss.robust:
        # Each group's own scale, which outliers do not reach.
        share = jnp.sum(weight, axis=-1)
        share = jnp.sum(share) if settings.shared else share
        level = jnp.sqrt(jnp.sum(share * found.scale**2) / freedom)
    else:
        level = jnp.sqrt(jnp.sum(found.squares) / freedom)
    identified = ~black & (enough | (settings.noise_given & (count >= unknowns)))

    misfit = jnp.zeros((), bool)
    if settings.noise_given:
        # Of a normal distribution a median knows no more than a third of the samples.
        heard = freedom * (MEDIAN if settings.loss.robust else 1)
        misfit = identified & enough & ((level / noise) ** 2 > most_by_chance(heard))

    def errors_of(found: _Found) -> Errors:
        sigma = found.scale if settings.loss.robust else level
        if settings.noise_given:
            # What the model does not describe may pull as hard as it shows.
            sigma = jnp.where(misfit, level, noise)
        return standard_errors(
            found.at,
            found.columns,
            found.t,
            sigma * found.widening,
            found.moved,
            samples.angles,
            _box(settings, dtype),
            thorough,
            settings,
        )

    errors = errors_of(found) if settings.shared else jax.vmap(errors_of)(found)
    errors = optimization_barrier(errors)
    values = _values(found, known, settings)
    deviations = _leaves(errors, identified, dtype, settings)
    flags = (
        jnp.where(black, Flag.BLACK, 0)
        | jnp.where(lost, Flag.NOT_FINITE, 0)
        | jnp.where(
            enough | settings.noise_given & (count >= unknowns), 0, Flag.TOO_FEW
        )
        | jnp.where(identified & jnp.any(errors.dim), Flag.NO_HIGHLIGHT, 0)
        | jnp.where(identified & jnp.any(errors.degenerate), Flag.DEGENERATE, 0)
        | jnp.where(identified & jnp.any(errors.at_bound), Flag.AT_BOUND, 0)
        | jnp.where(identified & jnp.any(errors.moving), Flag.NOT_CONVERGED, 0)
        | jnp.where(misfit, Flag.MISFIT, 0)
    )
    ambient, diffuse, specular, shininess = values
    fit = PixelFit(
        ambient, diffuse, specular, shininess, deviations, level, count, flags
    )
    unsettled = jnp.any(found.unsettled | errors.vague | errors.moving)
    return fit, identified & unsettled & ~thorough


def most_by_chance(freedom: Array) -> Array:
    """What χ² a degree of freedom hardly ever exceeds if there is noise alone.

    ??? cite "Source"
        Wilson and Hilferty, *The distribution of chi-square*, Proc. Natl. Acad. Sci.
        17, 1931.
    """
    spread = 2 / (9 * freedom)
    return (1 - spread + SIGNIFICANT * jnp.sqrt(spread)) ** 3


def _coloured(strength: Lights) -> Array:
    """Whether the lights differ in colour: then the channels' sum says little."""
    sums = [jnp.sum(each, axis=-1, keepdims=True) for each in strength]
    total = functools.reduce(jnp.add, sums)
    coloured = jnp.zeros((), bool)
    for each in strength:
        own, first = each * total[:1], each[:1] * total
        coloured |= jnp.any(jnp.abs(own - first) > COLOURED * (own + first))
    return coloured


def _split(samples: PixelSamples, known: Known) -> tuple[PixelSamples, Known]:
    """Samples of channels, but for the cosines, along a new first axis."""

    def apart(leaf: Array) -> Array:
        return leaf[:, None]

    samples = dataclasses.replace(samples, angles=())
    return jax.tree.map(apart, samples), jax.tree.map(apart, known)


def _box(settings: MapSettings, dtype: jnp.dtype) -> Box:
    names = (*settings.columns, "specular")
    edges = [settings.bound(name) for name in names]
    low, high = (
        tuple(jnp.array(number, dtype) for number in edge)
        for edge in zip(*edges, strict=True)
    )
    return Box(low, high, *(jnp.array(edge, dtype) for edge in settings.log_bounds))


def _solve(
    samples: PixelSamples,
    known: Known,
    noise: Array,
    unlike: Array,
    thorough: Array,
    settings: MapSettings,
) -> _Found:
    """One group of channels: the exponent, then everything else."""
    dtype = samples.target.dtype
    box = _box(settings, dtype)
    target = optimization_barrier(_less_known(samples, known, settings))
    columns = _columns(samples, target, samples.weight, settings)
    t = jnp.log(known.shininess[0])
    unsettled = jnp.zeros((), bool)
    if settings.searched:
        t, unsettled = _search(
            samples, target, columns, t, noise, unlike, thorough, box, settings
        )
    at = optimization_barrier(_evaluate(columns, samples.angles, t, box, settings))
    if settings.loss.robust:
        found = _reweighted(samples, target, at, t, noise, thorough, box, settings)
        return found._replace(unsettled=found.unsettled | unsettled)
    squares = _sum(samples.weight * _residual(samples, target, at, t, settings) ** 2)
    one, still = jnp.ones((), dtype), jnp.zeros_like(jnp.stack(at.point, axis=-1))
    return _Found(at, t, columns, squares, one, one, still, unsettled)


def _search(
    samples: PixelSamples,
    target: Array,
    columns: Columns,
    t: Array,
    noise: Array,
    unlike: Array,
    thorough: Array,
    box: Box,
    settings: MapSettings,
) -> tuple[Array, Array]:
    """The exponent of a group of channels, and whether the search was cut short.

    The channels' sum is enough to start from, as if ρ were grey, where they have the
    same samples in the same light. Where they do not, or where the exponent stays
    vague, each of them is asked.
    """
    lobes, angles = settings.lobes, samples.angles
    channels, count = samples.target.shape[0], candidates(*settings.log_bounds)
    low, high = edges = box.lowest, box.highest
    if channels > 1:
        summed = _summed(samples, target, settings)
    else:
        summed = columns
    if settings.scanned:
        t, low, high = scan_exponents(summed, lobes, angles, box, count)
    t, low, high = optimization_barrier((jnp.clip(t, low, high), low, high))
    start = refine_exponents(summed, lobes, angles, t, low, high, box, SUMMED_STEPS)

    def variance(value: Array) -> Array:
        return _variance(columns, samples.weight, value, noise, settings)

    if channels > 1:
        level = _variance(summed, samples.weight[:1], start.value, noise, settings)
        level = channels * level if settings.noise_given else level
    else:
        level = variance(start.value)
    found, bend, unsettled = start.t, start.bend, jnp.zeros((), bool)
    if settings.scanned and channels > 1:
        wanted = unlike | _is_vague(start, level, box)
        # If most pixels beside this one have channels of their own, all do it at once.
        most = jax.lax.pmean(unlike.astype(t.dtype), BESIDE) > 0.5
        unsettled = wanted & ~(thorough | most)
        wanted = wanted & (thorough | most)
        found = where_wanted(
            wanted,
            lambda columns: scan_exponents(columns, lobes, angles, box, count).t,
            columns,
            found,
        )
        bend = jnp.where(wanted, 1, bend)
    t, bend = optimization_barrier((found, bend))
    steps = STEPS if channels > 1 else 0
    most = jnp.where(thorough, MOST_STEPS, STEPS)
    end = refine_exponents(
        columns, lobes, angles, t, *edges, box, steps, bend, most, variance
    )
    return end.t, unsettled | ~end.ended


def _variance(
    columns: Columns, weight: Array, value: Array, noise: Array, settings: MapSettings
) -> Array:
    """Of a sample: as it was given, or from the squares that a value of φ leaves."""
    if settings.noise_given:
        return noise**2 * jnp.ones_like(value)
    unknowns = weight.shape[0] * (len(columns.start) + 1) + 1
    freedom = jnp.maximum(_sum(weight) - unknowns, 1)
    return jnp.maximum(jnp.sum(columns.rest) + value, 0) / freedom


def _is_vague(found: Descent, variance: Array, box: Box) -> Array:
    """Whether the model may bend within the error of the exponent, or at its bound."""
    # φ rises by the variance at one standard error.
    steep = found.curvature * VAGUE**2 / 2 >= variance
    return ~steep | (found.t <= box.lowest) | (found.t >= box.highest)


def _less_known(samples: PixelSamples, known: Known, settings: MapSettings) -> Array:
    """The target without the light of parameters that are known."""
    target = samples.target
    if "ambient" not in settings.names:
        target = target - known.ambient[:, None] * samples.ambient
    if "diffuse" not in settings.names:
        target = target - known.diffuse[:, None] * samples.diffuse
    if not settings.shiny:
        lobe, _ = settings.lobes.at(samples.angles, jnp.log(known.shininess[0]))
        light = _shine(samples, lobe)
        target = target - known.specular[:, None] * light
    return target


def _shine(samples: PixelSamples, lobe: Lights) -> Array:
    """S(f): highlights of all lights of each image."""
    return dot(samples.strength, tuple(heights[None] for heights in lobe))


def _columns(
    samples: PixelSamples, target: Array, weight: Array, settings: MapSettings
) -> Columns:
    """Columns of all channels."""
    fixed = tuple(getattr(samples, name) for name in settings.columns)
    return over_channels(make_columns, fixed, target, weight, samples.strength)


def _summed(samples: PixelSamples, target: Array, settings: MapSettings) -> Columns:
    """Columns of the channels' sum, as if ρ were grey: enough to start from."""
    together = PixelSamples(
        target=_total(target),
        weight=samples.weight[:1],
        ambient=_total(samples.ambient),
        diffuse=_total(samples.diffuse),
        strength=tuple(_total(each) for each in samples.strength),
        angles=samples.angles,
    )
    together = optimization_barrier(together)
    return _columns(together, together.target, together.weight, settings)


def _total(channels: Float[Array, "channels images"]) -> Float[Array, "1 images"]:
    """The sum of the channels, without a sum over an axis of three."""
    red, *others = channels
    for channel in others:
        red = red + channel
    return red[None]


def _sum(values: Float[Array, "channels images"]) -> Float[Array, ""]:
    """The sum of all, one axis after the other: of two at once it is slow."""
    return jnp.sum(_total(values)[0])


def _evaluate(
    columns: Columns, angles: Angles, t: Array, box: Box, settings: MapSettings
) -> At:
    """The solution at t. A highlight that is known, or none, is held at 0 strength."""
    if not settings.shiny:
        nothing = (jnp.zeros_like(columns.moments), jnp.zeros_like(columns.squares))
        columns = columns._replace(moments=nothing[0], squares=nothing[1])
    return evaluate(columns, settings.lobes, angles, t, box)


def _residual(
    samples: PixelSamples, target: Array, at: At, t: Array, settings: MapSettings
) -> Array:
    """(model − measured) in linear light, of used samples and others."""
    light = jnp.zeros_like(target)
    for k, name in enumerate(settings.columns):
        light = light + at.point[k][:, None] * getattr(samples, name)
    if settings.shiny:
        lobe, _ = settings.lobes.at(samples.angles, t)
        light = light + at.point[-1][:, None] * _shine(samples, lobe)
    return light - target


def _reweighted(
    samples: PixelSamples,
    target: Array,
    at: At,
    t: Array,
    noise: Array,
    thorough: Array,
    box: Box,
    settings: MapSettings,
) -> _Found:
    r"""Iteratively reweighted least squares from a plain solution.

    All that is said of the end rests on its weights w, held: how $\phi$ rises from
    there, and the errors, with $\sigma^2$ times the mean of w and the square of
    [`widening`][]. So what a rejected sample would say of the exponent is not counted.

    A pixel that deserves it is begun several times, each time without some of the
    samples, and the end that the loss likes best counts: an outlier in the highlight
    may have drawn the plain solution after it.

    ??? cite "Source"
        Rousseeuw and Van Driessen, *Computing LTS regression for large data sets*, Data
        Min. Knowl. Discov. 12, 2006: starts from subsets.
    """
    lobes, angles = settings.lobes, samples.angles
    used = samples.weight > 0

    def measured(at: At, t: Array) -> tuple[Array, Array]:
        residual = optimization_barrier(_residual(samples, target, at, t, settings))
        scale = median_deviation(residual, used)
        return residual / (noise if settings.noise_given else scale), scale

    def step(state: _Rounds) -> _Rounds:
        residual, _ = measured(state.at, state.t)
        # A convex loss leads to where one that rejects outliers sees them.
        weight = jnp.where(
            state.done < CONVEX,
            loss_weights(Huber(), residual),
            loss_weights(settings.loss, residual),
        )
        weight = optimization_barrier(weight * samples.weight)
        columns = _columns(samples, target, weight, settings)
        t, bend = state.t, state.bend
        if settings.searched:
            edges = box.lowest, box.highest
            found = refine_exponents(
                columns, lobes, angles, t, *edges, box, REWEIGHTED_STEPS, bend
            )
            t, bend = found.t, found.bend
        at = _evaluate(columns, angles, t, box, settings)
        return _Rounds(at, t, bend, jnp.abs(t - state.t) <= SHORTEST, state.done + 1)

    most = jnp.where(thorough, MOST_REWEIGHTED, REWEIGHTED)

    def unfinished(state: _Rounds) -> Array:
        return (state.done < REWEIGHTED) | (~state.ended & (state.done < most))

    def begin(left: Array) -> tuple[At, Array]:
        """Where all samples but some lead to."""
        columns = _columns(
            samples, target, optimization_barrier(samples.weight * left), settings
        )
        begun = t
        if settings.scanned:
            count = candidates(*settings.log_bounds)
            begun = scan_exponents(columns, lobes, angles, box, count).t
        return _evaluate(columns, angles, begun, box, settings), begun

    def attempt(state: _Attempts) -> _Attempts:
        left = (_group(samples) != state.done - 1).astype(t.dtype)
        start = where_wanted(state.done > 0, begin, left, (at, t))
        last = jax.lax.while_loop(unfinished, step, _before_rounds(*start))
        residual = optimization_barrier(
            _residual(samples, target, last.at, last.t, settings)
        )
        better = (state.done == 0) | _is_better(
            residual, state.residual, used, noise, settings
        )
        last, residual = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (last, residual),
            (state.best, state.residual),
        )
        return _Attempts(last, residual, state.done + 1)

    none = jnp.zeros_like(target)
    first = _Attempts(_before_rounds(at, t), none, jnp.zeros((), int))
    wanted = jnp.where(thorough, 1 + GROUPS, 1)
    last = jax.lax.while_loop(lambda s: s.done < wanted, attempt, first).best
    at, t = last.at, last.t
    residual, scale = measured(at, t)
    weight = optimization_barrier(
        loss_weights(settings.loss, residual) * samples.weight
    )
    columns = _columns(samples, target, weight, settings)
    at = optimization_barrier(_evaluate(columns, angles, t, box, settings))
    moved = [abs(x - y) for x, y in zip(at.point, last.at.point, strict=True)]
    moved = jnp.stack(moved, axis=-1)
    share = _sum(weight) / jnp.maximum(_sum(samples.weight), 1)
    unknowns = settings.unknowns(channels=len(target))
    widened = widening(settings.loss, residual, used, unknowns)
    if settings.noise_given:
        # No loss says more of noise that is known than least squares.
        widened = jnp.maximum(widened, 1)
    widened = widened * jnp.sqrt(share)
    squares = _sum(samples.weight * _residual(samples, target, at, t, settings) ** 2)
    doubtful = ~last.ended | _is_doubtful(samples, weight, t, settings)
    if settings.noise_given:
        doubtful |= scale > LARGER * noise
    return _Found(at, t, columns, squares, scale, widened, moved, doubtful)


def _is_doubtful(
    samples: PixelSamples, weight: Array, t: Array, settings: MapSettings
) -> Array:
    """Whether a loss rejects much of what shows a channel's highlight."""
    lobe, _ = settings.lobes.at(samples.angles, t)
    height = _shine(samples, lobe) ** 2
    whole, kept = (jnp.sum(each * height, axis=-1) for each in (samples.weight, weight))
    return jnp.any(kept < KEPT * whole)


def _group(samples: PixelSamples) -> Array:
    """Samples in groups of which each has a share of every channel's lights."""
    channels, images = samples.target.shape
    return (jnp.arange(channels)[:, None] + jnp.arange(images)[None]) % GROUPS


def _is_better(
    residual: Array, other: Array, used: Array, noise: Array, settings: MapSettings
) -> Array:
    """Whether a loss finds less left over, at the smaller of both scales."""
    scale = noise
    if not settings.noise_given:
        scale = jnp.minimum(
            median_deviation(residual, used), median_deviation(other, used)
        )

    def cost(residual: Array) -> Array:
        return _sum(jnp.where(used, settings.loss.root(residual / scale) ** 2, 0))

    return cost(residual) < cost(other)


class _Rounds(NamedTuple):
    """Where reweighting stands: the solution, and whether it has come to rest."""

    at: At
    t: Array
    bend: Array
    ended: Array
    done: Array


def _before_rounds(at: At, t: Array) -> _Rounds:
    return _Rounds(at, t, jnp.ones_like(t), jnp.zeros((), bool), jnp.zeros((), int))


class _Attempts(NamedTuple):
    """The best of several starts, what it leaves over, and how many were tried."""

    best: _Rounds
    residual: Array
    done: Array


def _values(found: _Found, known: Known, settings: MapSettings) -> tuple[Array, ...]:
    """The four parameters of the solution."""
    point = [number.reshape(3) for number in found.at.point]
    leaves = []
    for name in ("ambient", "diffuse"):
        wanted = name in settings.names
        at = settings.columns.index(name) if wanted else 0
        leaves.append(point[at] if wanted else getattr(known, name))
    leaves.append(point[-1] if settings.shiny else known.specular)
    exponent = jnp.clip(jnp.exp(found.t), *settings.bound("shininess"))
    exponent = exponent.reshape(-1)
    leaves.append(exponent if settings.searched else known.shininess)
    return tuple(leaves)


def _leaves(
    errors: Errors, identified: Array, dtype: jnp.dtype, settings: MapSettings
) -> tuple[Array, Array, Array, Array]:
    """Errors in the order of the parameters: infinite where nothing is identified."""
    reflectances = errors.reflectances.reshape(3, -1)
    reflectances = jnp.where(identified, reflectances, jnp.inf)
    none = jnp.zeros((3,), dtype)
    leaves = [
        reflectances[:, settings.columns.index(name)]
        if name in settings.names
        else none
        for name in ("ambient", "diffuse")
    ]
    specular = reflectances[:, -1] if settings.shiny else none
    exponent = jnp.where(identified, errors.exponent, jnp.inf).reshape(-1)
    exponent = exponent if settings.searched else jnp.zeros_like(exponent)
    return leaves[0], leaves[1], specular, exponent
