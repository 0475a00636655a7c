"""Materials of pixels with given normals under many lights, with standard errors.

Pixels are the last axis, and no branch depends on the values of one pixel: a pixel
that cannot be fitted does not affect the others. Channels form groups that share an
exponent: one group of all channels, or one group for each channel.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.losses import Huber
from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.uncertainty.misfit import SIGNIFICANT
from phongfit.maps.pixel.basis import Basis, make_basis
from phongfit.maps.pixel.columns import Columns, make_columns
from phongfit.maps.pixel.errors import Errors, standard_errors
from phongfit.maps.pixel.exponent import At, Box, evaluate
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.pixel.lighting import Lighting
from phongfit.maps.pixel.robust import loss_weights, widening
from phongfit.maps.pixel.samples import Tile, measured
from phongfit.maps.pixel.search import (
    SHORTEST,
    Profile,
    best_candidate,
    refine_exponents,
    survey,
)
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import (
    any_sample,
    in_groups,
    of_rank,
    sum_over_images,
)

# Least and largest number of steps of the search for an exponent.
STEPS, MOST_STEPS = 2, 16
# Least and largest number of reweightings of a robust loss.
REWEIGHTED, MOST_REWEIGHTED = 10, 40
# The first reweightings use Huber's loss, which has no false minimum in reflectances.
CONVEX = 5
# Steps of the exponent in each reweighting.
REWEIGHTED_STEPS = 2
# Groups of samples: each start of a robust loss but the first leaves out one of them.
GROUPS = 3
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


class PixelFit(NamedTuple):
    """Fits of pixels, which are the first axis.

    - `ambient`, `diffuse`, `specular`: reflectances; `shininess`: exponents, one for
        each channel or one for all.
    - `stderr`: standard errors of these four by name, infinite if not identified and 0
        if known.
    - `noise`: root mean square of the residuals per degree of freedom, in linear light,
        or in standard deviations of the samples.
    - `samples`: number of samples in use.
    - `flags`: bits of [`Flag`][].
    - `normals`, `normals_stderr`: if fitted, unit vectors in world axes and their
        errors in degrees.
    - `weights`: if pixels share materials, probability of each material.
    """

    ambient: Float[Array, "pixels 3"]
    diffuse: Float[Array, "pixels 3"]
    specular: Float[Array, "pixels 3"]
    shininess: Float[Array, "pixels exponents"]
    stderr: dict[str, Array]
    noise: Float[Array, " pixels"]
    samples: Int[Array, " pixels"]
    flags: Int[Array, " pixels"]
    normals: Float[Array, "pixels 3"] | None = None
    normals_stderr: Float[Array, " pixels"] | None = None
    weights: Float[Array, "pixels materials"] | None = None

    def arrays(self) -> dict[str, Array]:
        """All arrays, by their names in files of maps."""
        named: dict[str, Any] = self._asdict()
        errors = {f"stderr_{name}": e for name, e in named.pop("stderr").items()}
        return {name: a for name, a in named.items() if a is not None} | errors


class Known(NamedTuple):
    """Known parameters of the material, and the start value of the exponent.

    (3,) each, and (1,) for a shared exponent.
    """

    ambient: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    shininess: Float[Array, " exponents"]


class Outside(NamedTuple):
    """Values that all pixels share: lights, known parameters, and the noise level.

    `noise` is the standard deviation of a sample in linear light, 1 if
    `settings.weighted`; not read if `settings.noise_given` is false.
    """

    lighting: Lighting
    known: Known
    noise: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class _Job:
    """Data and basis of pixels.

    - `target`: linear light less that of known parameters.
    - `share`: as in [`Samples`][phongfit.maps.pixel.samples.Samples].
    - `box`: bounds of the unknowns.
    """

    target: Float[Array, "images channels pixels"]
    share: Float[Array, "images channels pixels"]
    basis: Basis
    box: Box
    noise: Float[Array, ""]
    settings: MapSettings

    @property
    def groups(self) -> int:
        """Number of groups of channels that share an exponent."""
        return 1 if self.settings.shared else self.target.shape[1]

    @property
    def fixed(self) -> tuple[Float[Array, "images #channels #pixels"], ...]:
        """Basis images that do not depend on the exponent."""
        return tuple(getattr(self.basis, name) for name in self.settings.columns)

    def columns(self, weight: Float[Array, "images #channels pixels"]) -> Columns:
        """Columns of all channels for given weights of the samples."""
        return make_columns(self.fixed, self.target, weight, self.basis.strength)

    def at(self, columns: Columns, t: Float[Array, "groups pixels"]) -> At:
        """Best reflectances at log exponents t; strength 0 if ρ_s is not unknown."""
        if not self.settings.shiny:
            cross, moments, squares = map(jnp.zeros_like, columns.rows)
            columns = columns._replace(cross=cross, moments=moments, squares=squares)
        lobes, angles = self.settings.lobes, self.basis.angles
        return evaluate(columns, lobes, angles, t, self.box)

    def residual(
        self, at: At, t: Float[Array, "groups pixels"]
    ) -> Float[Array, "images channels pixels"]:
        """Residuals (model − measured) · share."""
        return jax.lax.map(self._left(at, t), self._images)

    def squares(
        self, at: At, t: Float[Array, "groups pixels"]
    ) -> Float[Array, "groups pixels"]:
        """Sum of squares of [`residual`][], computed without storing the residuals."""
        left = self._left(at, t)

        def add(sum: Array, image: tuple) -> Array:
            return sum + left(image) ** 2

        none = jnp.zeros_like(self.target[0])
        return in_groups(sum_over_images(add, none, self._images), self.groups)

    @property
    def _images(self) -> tuple[Array, Array, Basis]:
        """Arrays from which residuals are computed, with images as the first axis."""
        return self.share, self.target, self.basis

    def _left(
        self, at: At, t: Float[Array, "groups pixels"]
    ) -> Callable[[tuple], Array]:
        """A function that computes the residuals of one image."""
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
        """Sum over the images and over each group's channels."""
        return in_groups(jnp.sum(values, axis=0), self.groups)

    def count(self) -> Float[Array, "groups pixels"]:
        """Number of samples in use."""
        return self.in_groups((self.share > 0).astype(self.share.dtype))

    def deviation(
        self, residual: Float[Array, "images channels pixels"]
    ) -> Float[Array, "groups pixels"]:
        """Robust standard deviations of the residuals."""
        return self.each_group(median_deviation, residual)

    def each_group(
        self, function: Callable[[Array, Array], Array], residual: Array
    ) -> Float[Array, "groups pixels"]:
        """`function(residuals, used)` of each group's samples."""
        rows = len(residual), self.groups, -1, residual.shape[-1]
        parts = residual.reshape(rows), (self.share > 0).reshape(rows)
        return jax.vmap(jax.vmap(function, in_axes=-1), in_axes=1)(*parts)


class _SearchResult(NamedTuple):
    """Exponents of all groups, reflectances, and the inputs of their errors.

    - `columns`: with the final weights of the samples.
    - `squares`: sum of squared residuals; `scale`: their robust standard deviation.
    - `widening`: factor on the standard errors, for these weights.
    - `moved`: last change of the reflectances by reweighting.
    - `profile`: of these columns; `None` if the search did not need it.
    """

    at: At
    t: Array
    columns: Columns
    squares: Array
    scale: Array
    widening: Array
    moved: Array
    profile: Profile | None = None


def fit_pixels(tile: Tile, outside: Outside, settings: MapSettings) -> PixelFit:
    """Fit the materials of pixels, each from its own samples alone.

    **Returns:** a [`PixelFit`][] whose arrays have the pixels as their first axis.
    """
    samples, lost = measured(tile, outside.lighting, settings)
    basis, lit = make_basis(tile, outside.lighting, samples.lamps, settings)
    share = samples.share * lit[:, None]
    known = Known(*(leaf[:, None] for leaf in outside.known))
    target = _less_known(samples.target, basis, known, settings)
    noise = outside.noise
    job = _Job(target, share, basis, _box(settings), noise, settings)
    found = _solve(job, known)

    share_of_group = job.count()
    total = in_groups(share_of_group, 1)[0]
    count, unknowns = total.astype(jnp.int32), settings.unknowns()
    enough = total > unknowns
    freedom = jnp.maximum(total - unknowns, 1)
    squares = found.squares
    if settings.loss.robust:
        # With a robust loss, outliers must not raise the noise level.
        squares = share_of_group * found.scale**2
    level = jnp.sqrt(in_groups(squares, 1)[0] / freedom)
    black = ~any_sample((share > 0) & (samples.target != 0))[0]
    identified = ~black & (enough | (settings.noise_given & (count >= unknowns)))

    misfit = jnp.zeros(level.shape, bool)
    # A median is as precise as a mean square of about a third of the samples.
    heard = freedom * (MEDIAN if settings.loss.robust else 1)
    if settings.noise_given:
        misfit = identified & enough & ((level / noise) ** 2 > most_by_chance(heard))
    wider = students_t(heard)[None]
    sigma = (found.scale if settings.loss.robust else level[None]) * wider
    if settings.noise_given:
        # Lack of fit biases the estimates: widen their errors by its size.
        sigma = jnp.where(misfit[None], level[None] * wider, noise)
    errors = standard_errors(
        found.at,
        found.columns,
        found.t,
        sigma * found.widening,
        found.moved,
        basis.angles,
        job.box,
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
    deviations = _by_name(errors, identified, settings)
    return PixelFit(*values, deviations, level, count, flags)


def students_t(freedom: Array) -> Array:
    """Factor on 95 % intervals if the noise is estimated from the residuals.

    Student's t over the 1.96 of a normal distribution, interpolated between the entries
    of the table, where it is nearly linear in the inverse of the degrees of freedom.
    """
    known = [1 / n for n in STUDENT]
    factors = [t / STUDENT[np.inf] for t in STUDENT.values()]
    kind = freedom.dtype
    return jnp.interp(1 / freedom, jnp.asarray(known, kind), jnp.asarray(factors, kind))


def most_by_chance(freedom: Array) -> Array:
    """Upper limit of χ² per degree of freedom if the residuals are noise alone.

    ??? cite "Source"
        Wilson and Hilferty, *The distribution of chi-square*, Proc. Natl. Acad. Sci.
        17, 1931.
    """
    spread = 2 / (9 * freedom)
    return (1 - spread + SIGNIFICANT * jnp.sqrt(spread)) ** 3


def _box(settings: MapSettings) -> Box:
    edges = [settings.bound(name) for name in (*settings.columns, "specular")]
    low, high = zip(*edges, strict=True)
    return Box(low, high, *settings.log_bounds)


def _less_known(
    target: Array, basis: Basis, known: Known, settings: MapSettings
) -> Array:
    """Target minus the light of known parameters."""
    if "ambient" not in settings.names:
        target = target - known.ambient[None] * basis.ambient
    if "diffuse" not in settings.names:
        target = target - known.diffuse[None] * basis.diffuse
    if not settings.shiny:
        light = basis.specular(settings.lobes, jnp.log(known.shininess))
        target = target - known.specular[None] * light
    return target


def _solve(job: _Job, known: Known) -> _SearchResult:
    """Fit the exponents, then the reflectances, and reweight for a robust loss."""
    settings, shape = job.settings, (job.groups, job.target.shape[-1])
    columns = job.columns(job.share**2)
    t, profile = jnp.broadcast_to(jnp.log(known.shininess), shape), None
    if settings.searched:
        t, profile = _search(job, columns, t)
    at = job.at(columns, t)
    if settings.loss.robust:
        return _reweighted(job, at, t)
    squares = job.squares(at, t)
    one, still = jnp.ones_like(t), jnp.zeros_like(jnp.stack(at.point))
    return _SearchResult(at, t, columns, squares, one, one, still, profile)


def _search(job: _Job, columns: Columns, t: Array) -> tuple[Array, Profile | None]:
    """Find the best exponents, and return their profile if it was computed.

    The search starts from the best exponent of a scan over the whole range, or from the
    known exponent if `settings.scanned` is false.
    """
    box, lobes, angles = job.box, job.settings.lobes, job.basis.angles
    profile = None
    if job.settings.scanned:
        profile = survey(columns, lobes, angles, box, job.groups)
        t = best_candidate(profile, box)

    def variance(value: Array) -> Array:
        return _variance(job, columns, value)

    start = jnp.clip(t, box.lowest, box.highest)
    end = refine_exponents(
        columns, lobes, angles, start, box, STEPS, 1.0, MOST_STEPS, variance
    )
    return end.t, profile


def _variance(job: _Job, columns: Columns, value: Array) -> Array:
    """Variance of a sample: given, or estimated from the residuals at a value of φ."""
    if job.settings.noise_given:
        return job.noise**2 * jnp.ones_like(value)
    groups = len(value)
    channels = job.target.shape[1] // groups
    unknowns = channels * (len(columns.start) + 1) + 1
    freedom = jnp.maximum(job.count() - unknowns, 1)
    return jnp.maximum(in_groups(columns.rest, groups) + value, 0) / freedom


def _reweighted(job: _Job, at: At, t: Array) -> _SearchResult:
    r"""Fit by iteratively reweighted least squares, starting from least squares.

    Errors are those of least squares with the final weights w, held, and with
    $\sigma^2$ times the mean of w and the square of [`widening`][]: rejected samples do
    not count as information on the exponent.

    There are several starts, each but the first without a group of samples, since an
    outlier in the highlight may attract the least-squares solution. The result of
    lowest loss is returned.

    ??? cite "Source"
        Rousseeuw and Van Driessen, *Computing LTS regression for large data sets*, Data
        Min. Knowl. Discov. 12, 2006: starts from subsets.
    """
    settings, box, noise = job.settings, job.box, job.noise
    lobes, angles, loss = settings.lobes, job.basis.angles, settings.loss
    whole = job.share**2

    def relative(at: At, t: Array) -> tuple[Array, Array]:
        residual = job.residual(at, t)
        scale = job.deviation(residual)
        return residual / (noise if settings.noise_given else scale[None]), scale

    def step(state: _Rounds) -> _Rounds:
        residual, _ = relative(state.at, state.t)
        weight = jnp.where(
            (state.done < CONVEX)[None],
            loss_weights(Huber(), residual),
            loss_weights(loss, residual),
        )
        columns = job.columns(weight * whole)
        t, bend = state.t, state.bend
        if settings.searched:
            found = refine_exponents(
                columns, lobes, angles, t, box, REWEIGHTED_STEPS, bend
            )
            t, bend = found.t, found.bend
        ended = jnp.abs(t - state.t) <= SHORTEST
        return _Rounds(job.at(columns, t), t, bend, ended, state.done + 1)

    def unfinished(state: _Rounds) -> Array:
        goes_on = ~state.ended & (state.done < MOST_REWEIGHTED)
        return (state.done < REWEIGHTED) | goes_on

    def go_on(state: _Rounds) -> _Rounds:
        return _chosen(unfinished(state), step(state), state)

    def begin(left: Array) -> tuple[At, Array]:
        """Solution without the samples of one group."""
        columns = job.columns(whole * left)
        begun = t
        if settings.scanned:
            profile = survey(columns, lobes, angles, box, job.groups)
            begun = best_candidate(profile, box)
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
    last = jax.lax.fori_loop(0, 1 + GROUPS, lambda _, state: attempt(state), first).best
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
        # If the noise is known, no loss gives smaller errors than least squares.
        wider = jnp.maximum(wider, 1)
    wider = wider * jnp.sqrt(kept / jnp.maximum(count, 1))
    squares = job.squares(at, t)
    return _SearchResult(at, t, columns, squares, scale, wider, jnp.stack(moved))


def _chosen(which: Array, new: "_Rounds", old: "_Rounds") -> "_Rounds":
    """`new` where `which` is true, else `old`, for each channel or group."""
    return jax.tree.map(lambda one, other: jnp.where(which, one, other), new, old)


def _group(job: _Job) -> Array:
    """Group number of each sample: every group has samples of every channel."""
    images, channels, _ = job.target.shape
    number = np.arange(channels) + np.arange(images)[:, None]
    return jnp.asarray(number % GROUPS)[..., None]


def _is_better(job: _Job, residual: Array, other: Array) -> Array:
    """True where `residual` has a lower loss than `other`, at the smaller scale."""
    scale = job.noise
    if not job.settings.noise_given:
        scale = jnp.minimum(job.deviation(residual), job.deviation(other))

    def cost(residual: Array) -> Array:
        root = job.settings.loss.root(residual / of_rank(scale, 3))
        return job.in_groups(jnp.where(job.share > 0, root**2, 0))

    return cost(residual) < cost(other)


class _Rounds(NamedTuple):
    """State of the reweighting: the solution, and whether the exponent has settled."""

    at: At
    t: Array
    bend: Array
    ended: Array
    done: Array


def _before_rounds(at: At, t: Array) -> _Rounds:
    none = jnp.zeros(t.shape, bool)
    return _Rounds(at, t, jnp.ones_like(t), none, jnp.zeros(t.shape, int))


class _Attempts(NamedTuple):
    """Best result of several starts, its residuals, and the number of starts tried."""

    best: _Rounds
    residual: Array
    done: Array


def _values(
    found: _SearchResult, known: Known, settings: MapSettings
) -> tuple[Array, Array, Array, Array]:
    """The four parameters of the solution; shape (pixels, channels)."""
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


def _by_name(
    errors: Errors, identified: Array, settings: MapSettings
) -> dict[str, Array]:
    """Standard errors by parameter; infinite where nothing is identified."""
    reflectances = jnp.where(identified[None, None], errors.reflectances, jnp.inf)
    exponent = jnp.where(identified[None], errors.exponent, jnp.inf).T
    none = jnp.zeros_like(reflectances[-1].T)
    found = {
        name: reflectances[settings.columns.index(name)].T
        if name in settings.names
        else none
        for name in ("ambient", "diffuse")
    }
    found["specular"] = reflectances[-1].T if settings.shiny else none
    found["shininess"] = exponent if settings.searched else jnp.zeros_like(exponent)
    return found
