"""Pixels under many lights: their materials, with errors, and what is unidentified.

Pixels stand side by side, along the last axis. Nothing here branches on the numbers of
one, so that a pixel that fails costs no more than one that does not, and disturbs none.
Where a group of channels shares an exponent, it is all of them or each is one.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.losses import Huber
from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.uncertainty.misfit import SIGNIFICANT
from phongfit.maps.pixel.basis import Basis, make_basis
from phongfit.maps.pixel.columns import Columns, make_columns, mean_columns
from phongfit.maps.pixel.errors import VAGUE, Errors, standard_errors
from phongfit.maps.pixel.exponent import At, Box, evaluate
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.pixel.lighting import Lighting
from phongfit.maps.pixel.robust import loss_weights, widening
from phongfit.maps.pixel.samples import (
    Samples,
    Tile,
    differing_channels,
    measured,
    of_one_channel,
)
from phongfit.maps.pixel.search import (
    SHORTEST,
    Descent,
    Profile,
    best_candidate,
    refine_exponents,
    scan_exponents,
    survey,
)
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import (
    any_sample,
    channel_mean,
    in_groups,
    of_rank,
    sum_over_images,
)

# Steps on the mean of the channels, which are a third of the price, then on all; and of
# those at most, with more effort and with the most.
MEAN_STEPS = 2
STEPS = 2
MORE_STEPS = 4
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
# Degrees of freedom, and the t of Student that 95 % of the draws do not exceed.
STUDENT = {
    np.inf: 1.95996,
    20: 2.08596,
    10: 2.22814,
    8: 2.30600,
    6: 2.44691,
    5: 2.57058,
    4: 2.77645,
    3: 3.18245,
    2: 4.30265,
    1: 12.7062,
}
# Share of pixels from which on what they need is done for all beside them.
MANY = 0.5
# By how much channels may differ in how the lights share them, over their sum.
COLOURED = 0.1


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


class Outside(NamedTuple):
    """What all pixels share: lights, known parameters, and the noise level.

    `noise` is the standard deviation of a sample in linear light, 1 if
    `settings.weighted`; not read if `settings.noise_given` is false.
    """

    lighting: Lighting
    known: Known
    noise: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class _Job:
    """What pixels measure, and of what.

    - `target`: linear light of the unknowns; `share`: as in [`Samples`][], of one
        channel where all share it and their basis.
    - `box`: what bounds the unknowns.
    """

    target: Float[Array, "images channels pixels"]
    share: Float[Array, "images #channels pixels"]
    basis: Basis
    box: Box
    noise: Float[Array, ""]
    effort: Int[Array, ""]
    settings: MapSettings

    @property
    def thorough(self) -> Bool[Array, ""]:
        """Whether to do whatever helps."""
        return self.effort > 0

    @property
    def one_basis(self) -> bool:
        """Whether all channels have the same basis and weights."""
        return self.share.shape[1] < self.target.shape[1]

    @property
    def groups(self) -> int:
        """Of channels that share an exponent."""
        return 1 if self.settings.shared else self.target.shape[1]

    @property
    def fixed(self) -> tuple[Float[Array, "images #channels #pixels"], ...]:
        """The basis that no exponent changes."""
        return tuple(getattr(self.basis, name) for name in self.settings.columns)

    def columns(self, weight: Float[Array, "images #channels pixels"]) -> Columns:
        """Columns of all channels for such weights."""
        return make_columns(self.fixed, self.target, weight, self.basis.strength)

    def at(self, columns: Columns, t: Float[Array, "groups pixels"]) -> At:
        """The solution at t. A highlight that is known, or none, has 0 strength."""
        if not self.settings.shiny:
            cross, moments, squares = map(jnp.zeros_like, columns.rows)
            columns = columns._replace(cross=cross, moments=moments, squares=squares)
        lobes, angles = self.settings.lobes, self.basis.angles
        return evaluate(columns, lobes, angles, t, self.box)

    def residual(
        self, at: At, t: Float[Array, "groups pixels"]
    ) -> Float[Array, "images channels pixels"]:
        """(model − measured) · share."""
        return jax.lax.map(self._left(at, t), self._images)

    def squares(
        self, at: At, t: Float[Array, "groups pixels"]
    ) -> Float[Array, "groups pixels"]:
        """The sum of squares of [`residual`][], which are not kept."""
        left = self._left(at, t)

        def add(sum: Array, image: tuple) -> Array:
            return sum + left(image) ** 2

        none = jnp.zeros_like(self.target[0])
        return in_groups(sum_over_images(add, none, self._images), self.groups)

    @property
    def _images(self) -> tuple[Array, Array, Basis]:
        """What residuals are made from, image by image."""
        return self.share, self.target, self.basis

    def _left(
        self, at: At, t: Float[Array, "groups pixels"]
    ) -> Callable[[tuple], Array]:
        """The residuals of one of the images."""
        settings = self.settings
        lobes = settings.lobes if settings.shiny else None
        light = self.basis.light_of_image(settings.columns, at.point, lobes, t)

        def left(image: tuple) -> Array:
            share, target, basis = image
            return share * (light(basis) - target)

        return left

    def in_groups(
        self, values: Float[Array, "images channels pixels"]
    ) -> Float[Array, "groups pixels"]:
        """The sum over the images and each group's channels."""
        return in_groups(jnp.sum(values, axis=0), self.groups)

    def count(self) -> Float[Array, "groups pixels"]:
        """How many samples may be used."""
        used = self.in_groups((self.share > 0).astype(self.share.dtype))
        return used * (self.target.shape[1] // self.share.shape[1])

    def deviation(
        self, residual: Float[Array, "images channels pixels"]
    ) -> Float[Array, "groups pixels"]:
        """Standard deviations of the residuals, which outliers do not reach."""
        return self.each_group(median_deviation, residual)

    def each_group(
        self, function: Callable[[Array, Array], Array], residual: Array
    ) -> Float[Array, "groups pixels"]:
        """A function of residuals, and of where they count, for each group."""
        rows = len(residual), self.groups, -1, residual.shape[-1]
        parts = residual.reshape(rows), (self.share > 0).reshape(rows)
        return jax.vmap(jax.vmap(function, in_axes=-1), in_axes=1)(*parts)


class _SearchResult(NamedTuple):
    """The exponents of all groups, and everything else.

    - `columns`: of the samples as they were weighed at the end.
    - `squares`: of all residuals; `scale`: their size, which outliers do not reach.
    - `widening`: factor on the errors of samples so weighed.
    - `moved`: by how much the last weights moved the reflectances.
    - `unsettled`: whether the search for the exponent was cut short.
    - `profile`: of these columns, if the search made it.
    """

    at: At
    t: Array
    columns: Columns
    squares: Array
    scale: Array
    widening: Array
    moved: Array
    unsettled: Array
    profile: Profile | None = None


def fit_pixels(
    tile: Tile, outside: Outside, effort: Int[Array, ""], settings: MapSettings
) -> tuple[PixelFit, Bool[Array, " pixels"]]:
    """The materials of pixels, of each from its own samples alone.

    What a few pixels need all beside them pay for. So there are two ways, one short and
    one thorough, and a pixel that is settled by the short one gets the same from both.

    Both sum once what channels share that get the same light and use the same samples.
    The few pixels of a block whose channels do not go on to the thorough way; there, a
    block with any of them has sums for each channel.

    **Arguments:** `effort`: 0 for the short way, 1 for the thorough one, 2 for that
    with more steps, which one pixel in a hundred needs.

    **Returns:** the materials, whose leaves have the pixels as their first axis, and
    for which of them more effort is wanted.
    """
    samples, lost = measured(tile, outside.lighting, settings)

    def fit(samples: Samples) -> tuple[PixelFit, Array]:
        return _fit_samples(tile, samples, lost, outside, effort, settings)

    if not settings.shared or settings.loss.robust or outside.lighting.surrounds:
        return fit(samples)
    unlike = differing_channels(samples)

    def with_one_basis() -> tuple[PixelFit, Array]:
        found, wanted = fit(of_one_channel(samples))
        return found, wanted | unlike

    few = jnp.where(effort > 0, 0, MANY)
    alike = jnp.mean(unlike.astype(samples.target.dtype)) <= few
    return jax.lax.cond(alike, with_one_basis, lambda: fit(samples))


def _fit_samples(
    tile: Tile,
    samples: Samples,
    lost: Float[Array, "#images #pixels"],
    outside: Outside,
    effort: Int[Array, ""],
    settings: MapSettings,
) -> tuple[PixelFit, Bool[Array, " pixels"]]:
    """As [`fit_pixels`][]; channels that share light and samples may be one there."""
    basis, lit = make_basis(tile, outside.lighting, samples.lamps, settings)
    share = samples.share * lit[:, None]
    known = Known(*(leaf[:, None] for leaf in outside.known))
    target = _less_known(samples.target, basis, known, settings)
    noise = outside.noise
    job = _Job(target, share, basis, _box(settings), noise, effort, settings)
    found = _solve(job, known)

    share_of_group = job.count()
    total = in_groups(share_of_group, 1)[0]
    count, unknowns = total.astype(jnp.int32), settings.unknowns()
    enough = total > unknowns
    freedom = jnp.maximum(total - unknowns, 1)
    squares = found.squares
    if settings.loss.robust:
        # Each group's own scale, which outliers do not reach.
        squares = share_of_group * found.scale**2
    level = jnp.sqrt(in_groups(squares, 1)[0] / freedom)
    black = ~any_sample((share > 0) & (samples.target != 0))[0]
    identified = ~black & (enough | (settings.noise_given & (count >= unknowns)))

    misfit = jnp.zeros(level.shape, bool)
    # Of a normal distribution a median knows no more than a third of the samples.
    heard = freedom * (MEDIAN if settings.loss.robust else 1)
    if settings.noise_given:
        misfit = identified & enough & ((level / noise) ** 2 > most_by_chance(heard))
    wider = students_t(heard)[None]
    sigma = (found.scale if settings.loss.robust else level[None]) * wider
    if settings.noise_given:
        # What the model does not describe may pull as hard as it shows.
        sigma = jnp.where(misfit[None], level[None] * wider, noise)
    errors = standard_errors(
        found.at,
        found.columns,
        found.t,
        sigma * found.widening,
        found.moved,
        basis.angles,
        job.box,
        job.thorough,
        settings,
        found.profile,
    )

    def some(of_groups: Bool[Array, "groups pixels"]) -> Bool[Array, " pixels"]:
        return jnp.any(of_groups, axis=0)

    lost = any_sample(((lit > 0) & (lost > 0))[:, None])[0]
    flags = (
        jnp.where(black, Flag.BLACK, 0)
        | jnp.where(lost, Flag.NOT_FINITE, 0)
        | jnp.where(
            enough | settings.noise_given & (count >= unknowns), 0, Flag.TOO_FEW
        )
        | jnp.where(identified & some(errors.dim), Flag.NO_HIGHLIGHT, 0)
        | jnp.where(identified & some(errors.degenerate), Flag.DEGENERATE, 0)
        | jnp.where(identified & some(errors.at_bound), Flag.AT_BOUND, 0)
        | jnp.where(identified & some(errors.moving), Flag.NOT_CONVERGED, 0)
        | jnp.where(misfit, Flag.MISFIT, 0)
    )
    values = _values(found, known, settings)
    deviations = _leaves(errors, identified, settings)
    fit = PixelFit(*values, deviations, level, count, flags)
    unsettled = found.unsettled & (not settings.loss.robust)
    doubtful = found.unsettled | errors.vague | errors.moving
    wanted = some(jnp.where(job.thorough, unsettled, doubtful))
    return fit, identified & wanted


def students_t(freedom: Array) -> Array:
    """By how much intervals of 95 % are wider where residuals tell the noise.

    Student's t over the 1.96 of a normal distribution; between the entries of the
    table nearly linear in the inverse of the degrees of freedom.
    """
    known = [1 / n for n in STUDENT]
    factors = [t / STUDENT[np.inf] for t in STUDENT.values()]
    kind = freedom.dtype
    return jnp.interp(1 / freedom, jnp.asarray(known, kind), jnp.asarray(factors, kind))


def most_by_chance(freedom: Array) -> Array:
    """What χ² a degree of freedom hardly ever exceeds if there is noise alone.

    ??? cite "Source"
        Wilson and Hilferty, *The distribution of chi-square*, Proc. Natl. Acad. Sci.
        17, 1931.
    """
    spread = 2 / (9 * freedom)
    return (1 - spread + SIGNIFICANT * jnp.sqrt(spread)) ** 3


def _coloured(strength: Float[Array, "images lobes channels #pixels"]) -> Array:
    """Whether the lights differ in colour: then the channels' sum says little."""
    total = jnp.sum(strength, axis=(0, 1), keepdims=True)
    own, first = strength * total[:, :, :1], strength[:, :, :1] * total
    unlike = jnp.abs(own - first) > COLOURED * (own + first)
    return jnp.sum(unlike.astype(total.dtype), axis=(0, 1, 2)) > 0


def _box(settings: MapSettings) -> Box:
    edges = [settings.bound(name) for name in (*settings.columns, "specular")]
    low, high = zip(*edges, strict=True)
    return Box(low, high, *settings.log_bounds)


def _less_known(
    target: Array, basis: Basis, known: Known, settings: MapSettings
) -> Array:
    """The target without the light of parameters that are known."""
    if "ambient" not in settings.names:
        target = target - known.ambient[None] * basis.ambient
    if "diffuse" not in settings.names:
        target = target - known.diffuse[None] * basis.diffuse
    if not settings.shiny:
        light = basis.specular(settings.lobes, jnp.log(known.shininess))
        target = target - known.specular[None] * light
    return target


def _solve(job: _Job, known: Known) -> _SearchResult:
    """The exponents, then everything else."""
    settings, shape = job.settings, (job.groups, job.target.shape[-1])
    columns = job.columns(job.share**2)
    t = jnp.broadcast_to(jnp.log(known.shininess), shape)
    unsettled, profile = jnp.zeros(shape, bool), None
    if settings.searched:
        t, unsettled, profile = _search(job, columns, t)
    at = job.at(columns, t)
    if settings.loss.robust:
        found = _reweighted(job, at, t)
        return found._replace(unsettled=found.unsettled | unsettled)
    squares = job.squares(at, t)
    one, still = jnp.ones_like(t), jnp.zeros_like(jnp.stack(at.point))
    return _SearchResult(at, t, columns, squares, one, one, still, unsettled, profile)


def _search(
    job: _Job, columns: Columns, t: Array
) -> tuple[Array, Array, Profile | None]:
    """The exponents, whether the search was cut short, and the profile if it was made.

    Where channels share one, their mean is enough to start from, as if ρ were grey,
    where they have the same samples in the same light. Where they do not, or where the
    exponent stays vague, each of them is asked.
    """
    settings, box, noise = job.settings, job.box, job.noise
    lobes, angles, thorough = settings.lobes, job.basis.angles, job.thorough
    low, high = (jnp.full_like(t, edge) for edge in (box.lowest, box.highest))
    edges = low, high
    shared = settings.shared and job.target.shape[1] > 1

    def variance(value: Array) -> Array:
        return _variance(job, columns, value)

    def together() -> tuple[Array, Array, Array]:
        """From the mean of the channels; and for whom that is not enough."""
        mean = _averaged(job, columns) if shared else columns
        start, low, high = t, *edges
        if settings.scanned:
            start, low, high = scan_exponents(mean, lobes, angles, box, job.groups)
        start = jnp.clip(start, low, high)
        found = refine_exponents(mean, lobes, angles, start, low, high, box, MEAN_STEPS)
        if not shared:
            return found.t, found.bend, nobody
        level = noise**2 / job.target.shape[1] * jnp.ones_like(t)
        if not settings.noise_given:
            level = _variance(_one_channel(job), mean, found.value)
        return found.t, found.bend, _is_vague(found, level, box)

    nobody = unsettled = jnp.zeros(t.shape, bool)
    profile = None
    if settings.scanned and shared:
        # Whoever deserves more is asked channel by channel in any case.
        everybody = t, jnp.ones_like(t), ~nobody
        found, bend, vague = jax.lax.cond(thorough, lambda: everybody, together)
        unlike = nobody if job.one_basis else _unlike(job)
        wanted = unlike | vague
        # If most pixels beside this one have channels of their own, all do it at once.
        now = thorough | (jnp.mean(unlike.astype(t.dtype)) > MANY)
        unsettled, wanted = wanted & ~now, wanted & now

        def ask() -> Profile:
            return survey(columns, lobes, angles, box, job.groups)

        none = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(ask)
        )
        profile = jax.lax.cond(jnp.any(wanted), ask, lambda: none)
        found = jnp.where(wanted, best_candidate(profile, box).t, found)
        bend = jnp.where(wanted, 1, bend)
    else:
        found, bend, unsettled = together()
    steps = STEPS if shared else 0
    # Of all that a robust loss does with them these are the least.
    more = MOST_STEPS if settings.loss.robust else MORE_STEPS
    most = jnp.asarray([STEPS, more, MOST_STEPS], jnp.int32)[job.effort]
    end = refine_exponents(
        columns, lobes, angles, found, *edges, box, steps, bend, most, variance
    )
    return end.t, unsettled | ~end.ended, profile


def _unlike(job: _Job) -> Array:
    """Whose channels do not have the same samples in the same light."""
    used = job.share > 0
    odd = any_sample(used != used[:, :1])
    return odd | _coloured(job.basis.strength)[None]


def _variance(job: _Job, columns: Columns, value: Array) -> Array:
    """Of a sample: as it was given, or from the squares that a value of φ leaves."""
    if job.settings.noise_given:
        return job.noise**2 * jnp.ones_like(value)
    groups = len(value)
    channels = job.target.shape[1] // groups
    unknowns = channels * (len(columns.start) + 1) + 1
    freedom = jnp.maximum(job.count() - unknowns, 1)
    return jnp.maximum(in_groups(columns.rest, groups) + value, 0) / freedom


def _is_vague(found: Descent, variance: Array, box: Box) -> Array:
    """Whether the model may bend within the error of the exponent, or at its bound."""
    # φ rises by the variance at one standard error.
    steep = found.curvature * VAGUE**2 / 2 >= variance
    return ~steep | (found.t <= box.lowest) | (found.t >= box.highest)


def _averaged(job: _Job, columns: Columns) -> Columns:
    """Columns of the channels' mean, as if ρ were grey: enough to start from."""
    target = channel_mean(job.target)
    if job.one_basis:
        return mean_columns(columns, job.fixed, target, job.share**2)
    basis = job.basis.grey()
    mean = dataclasses.replace(_one_channel(job), target=target, basis=basis)
    return mean.columns(mean.share**2)


def _one_channel(job: _Job) -> _Job:
    """The same of the first alone."""
    return dataclasses.replace(job, target=job.target[:, :1], share=job.share[:, :1])


def _reweighted(job: _Job, at: At, t: Array) -> _SearchResult:
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
    settings, box, noise, thorough = job.settings, job.box, job.noise, job.thorough
    lobes, angles, loss = settings.lobes, job.basis.angles, settings.loss
    low, high = (jnp.full_like(t, edge) for edge in (box.lowest, box.highest))
    whole = job.share**2

    def relative(at: At, t: Array) -> tuple[Array, Array]:
        residual = job.residual(at, t)
        scale = job.deviation(residual)
        return residual / (noise if settings.noise_given else scale[None]), scale

    def step(state: _Rounds) -> _Rounds:
        residual, _ = relative(state.at, state.t)
        # A convex loss leads to where one that rejects outliers sees them.
        weight = jnp.where(
            (state.done < CONVEX)[None],
            loss_weights(Huber(), residual),
            loss_weights(loss, residual),
        )
        columns = job.columns(weight * whole)
        t, bend = state.t, state.bend
        if settings.searched:
            found = refine_exponents(
                columns, lobes, angles, t, low, high, box, REWEIGHTED_STEPS, bend
            )
            t, bend = found.t, found.bend
        ended = jnp.abs(t - state.t) <= SHORTEST
        return _Rounds(job.at(columns, t), t, bend, ended, state.done + 1)

    most = jnp.where(thorough, MOST_REWEIGHTED, REWEIGHTED)

    def unfinished(state: _Rounds) -> Array:
        return (state.done < REWEIGHTED) | (~state.ended & (state.done < most))

    def go_on(state: _Rounds) -> _Rounds:
        return _chosen(unfinished(state), step(state), state)

    def begin(left: Array) -> tuple[At, Array]:
        """Where all samples but some lead to."""
        columns = job.columns(whole * left)
        begun = t
        if settings.scanned:
            begun = scan_exponents(columns, lobes, angles, box, job.groups).t
        return job.at(columns, begun), begun

    def attempt(state: _Attempts) -> _Attempts:
        left = (_group(job) != state.done - 1).astype(t.dtype)
        start = jax.lax.cond(state.done > 0, lambda: begin(left), lambda: (at, t))
        last = jax.lax.while_loop(
            lambda state: jnp.any(unfinished(state)), go_on, _before_rounds(*start)
        )
        residual = job.residual(last.at, last.t)
        better = (state.done == 0) | _is_better(job, residual, state.residual)
        best = _chosen(better, last, state.best)
        residual = jnp.where(better[None], residual, state.residual)
        return _Attempts(best, residual, state.done + 1)

    none = jnp.zeros_like(job.target)
    first = _Attempts(_before_rounds(at, t), none, jnp.zeros((), int))
    wanted = jnp.where(thorough, 1 + GROUPS, 1)
    last = jax.lax.while_loop(lambda s: s.done < wanted, attempt, first).best
    at, t = last.at, last.t
    residual, scale = relative(at, t)
    weight = loss_weights(loss, residual) * whole
    columns = job.columns(weight)
    at = job.at(columns, t)
    moved = [abs(x - y) for x, y in zip(at.point, last.at.point, strict=True)]
    count = job.count()
    kept = job.in_groups(jnp.where(job.share > 0, weight / whole, 0))
    channels = job.target.shape[1] // job.groups
    unknowns = settings.unknowns(channels=channels)

    def widened(residual: Array, used: Array) -> Array:
        return widening(loss, residual, used, unknowns)

    wider = job.each_group(widened, residual)
    if settings.noise_given:
        # No loss says more of noise that is known than least squares.
        wider = jnp.maximum(wider, 1)
    wider = wider * jnp.sqrt(kept / jnp.maximum(count, 1))
    squares = job.squares(at, t)
    doubtful = ~last.ended | _is_doubtful(job, weight, t)
    if settings.noise_given:
        doubtful |= scale > LARGER * noise
    return _SearchResult(
        at, t, columns, squares, scale, wider, jnp.stack(moved), doubtful
    )


def _chosen(which: Array, new: "_Rounds", old: "_Rounds") -> "_Rounds":
    """The new where it is wanted: leaves of channels, or of groups of them."""
    return jax.tree.map(lambda one, other: jnp.where(which, one, other), new, old)


def _is_doubtful(job: _Job, weight: Array, t: Array) -> Array:
    """Whether a loss rejects much of what shows a channel's highlight."""
    height = job.basis.specular(job.settings.lobes, t) ** 2
    whole, kept = (jnp.sum(w * height, axis=0) for w in (job.share**2, weight))
    rejects = (kept < KEPT * whole).astype(t.dtype)
    return in_groups(rejects, job.groups) > 0


def _group(job: _Job) -> Array:
    """Samples in groups of which each has a share of every channel's lights."""
    images, channels, _ = job.target.shape
    number = np.arange(channels) + np.arange(images)[:, None]
    return jnp.asarray(number % GROUPS)[..., None]


def _is_better(job: _Job, residual: Array, other: Array) -> Array:
    """Whether a loss finds less left over, at the smaller of both scales."""
    scale = job.noise
    if not job.settings.noise_given:
        scale = jnp.minimum(job.deviation(residual), job.deviation(other))

    def cost(residual: Array) -> Array:
        root = job.settings.loss.root(residual / of_rank(scale, 3))
        return job.in_groups(jnp.where(job.share > 0, root**2, 0))

    return cost(residual) < cost(other)


class _Rounds(NamedTuple):
    """Where reweighting stands: the solution, and whether it has come to rest."""

    at: At
    t: Array
    bend: Array
    ended: Array
    done: Array


def _before_rounds(at: At, t: Array) -> _Rounds:
    none = jnp.zeros(t.shape, bool)
    return _Rounds(at, t, jnp.ones_like(t), none, jnp.zeros(t.shape, int))


class _Attempts(NamedTuple):
    """The best of several starts, what it leaves over, and how many were tried."""

    best: _Rounds
    residual: Array
    done: Array


def _values(
    found: _SearchResult, known: Known, settings: MapSettings
) -> tuple[Array, Array, Array, Array]:
    """The four parameters of the solution, (pixels, channels) each."""
    shape = found.at.point[-1].shape

    def leaf(name: str) -> Array:
        if name in settings.columns:
            return found.at.point[settings.columns.index(name)].T
        if name == "specular" and settings.shiny:
            return found.at.point[-1].T
        return jnp.broadcast_to(getattr(known, name), shape).T

    exponent = jnp.broadcast_to(known.shininess, found.t.shape)
    if settings.searched:
        exponent = jnp.clip(jnp.exp(found.t), *settings.bound("shininess"))
    return leaf("ambient"), leaf("diffuse"), leaf("specular"), exponent.T


def _leaves(
    errors: Errors, identified: Array, settings: MapSettings
) -> tuple[Array, Array, Array, Array]:
    """Errors in the order of the parameters: infinite where nothing is identified."""
    reflectances = jnp.where(identified[None, None], errors.reflectances, jnp.inf)
    none = jnp.zeros_like(reflectances[-1].T)
    leaves = [
        reflectances[settings.columns.index(name)].T if name in settings.names else none
        for name in ("ambient", "diffuse")
    ]
    specular = reflectances[-1].T if settings.shiny else none
    exponent = jnp.where(identified[None], errors.exponent, jnp.inf).T
    exponent = exponent if settings.searched else jnp.zeros_like(exponent)
    return leaves[0], leaves[1], specular, exponent
