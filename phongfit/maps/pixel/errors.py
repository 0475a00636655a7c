"""Standard errors of normals and materials from sums at the solution, and flags."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.fitting.uncertainty.identifiability import SEEN
from phongfit.maps.pixel.lighting import facing
from phongfit.maps.pixel.samples import Samples
from phongfit.maps.pixel.settings import Point, Unknowns
from phongfit.maps.pixel.small import (
    Numbers,
    Triangle,
    curvatures,
    dot,
    factorize,
    solve,
)
from phongfit.maps.pixel.starts import shown_by
from phongfit.maps.pixel.step import Edges, Free, reduce_sums
from phongfit.maps.pixel.sums import Sums

# Largest error of an identified normal, in degrees: the model is not linear beyond.
WIDEST = 20.0
# Standard errors of log f: from VAGUE on, the model is not linear within the error, and
# with an unknown normal from VAGUE_TURNED on; beyond LOST, f is not identified.
VAGUE, VAGUE_TURNED = 0.25, 0.08
LOST = 1.0
# Distance of the profile's exponents from the estimate, in standard errors.
FAR = 2.0
# Number of exponents over the whole range that are tried where f is not identified.
ANYWHERE = 6
# Squared fraction of the lights' vectors across a plane below which they lie in it.
FLAT = 3e-4
# A pixel is ambiguous if the cost of another normal is higher by less than this, which
# is two standard errors.
AS_GOOD = 4.0


class Errors(NamedTuple):
    """Standard errors of normals and materials; infinite if not identified.

    - `normal`: root mean square angle, in degrees.
    - `own`: of each channel's own reflectances, (channels, pixels) each.
    - `specular`: of a shared ρ_s, and `exponent`, of f.
    - `dim`, `degenerate`, `in_a_plane`, `ambiguous`, `at_bound`: see [`Flag`][].
    - `settled`: whether the fits of the profile have converged.
    """

    normal: Float[Array, " pixels"]
    own: Numbers
    specular: Float[Array, " pixels"]
    exponent: Float[Array, " pixels"]
    dim: Bool[Array, " pixels"]
    degenerate: Bool[Array, " pixels"]
    in_a_plane: Bool[Array, " pixels"]
    ambiguous: Bool[Array, " pixels"]
    at_bound: Bool[Array, " pixels"]
    settled: Bool[Array, " pixels"]


class Profile(NamedTuple):
    """The best points at other exponents: a lower one, a higher one, and any others.

    - `points`: with a new first axis; `rises`: their increase of the cost.
    - `settled`: whether the fits have converged.
    """

    points: Point
    rises: Float[Array, "exponents pixels"]
    settled: Bool[Array, " pixels"]


class Spread(NamedTuple):
    """Standard errors of own and of shared unknowns, in units of the noise."""

    own: Numbers
    shared: Numbers


def standard_errors(
    point: Point,
    sums: Sums,
    sigma: Float[Array, " pixels"],
    samples: Samples,
    rival: Float[Array, " pixels"],
    which: Unknowns,
    edges: Edges,
    follow: Callable[[Array, Array], Profile],
) -> Errors:
    r"""Errors from $\sigma^2 (J^\top W J)^{-1}$, with no unknown held by its bound.

    If the error of the exponent is large, the model is not linear within it. Errors
    then reach at least as far as the profile, for which all other unknowns are fitted
    at fixed exponents. If f is not identified and normals are known, errors of
    reflectances cover all exponents that the data allow.

    **Arguments:**

    - `point`, `sums`: the solution.
    - `sigma`: factor from the sums' unit of noise to the noise.
    - `rival`: by how much the cost of another normal is higher.
    - `follow`: function from log exponents, (exponents, pixels), and flags of pixels to
        the profile of these pixels.
    """
    pulls = Free(sums.pull_own, sums.pull_shared)
    everything = jax.tree.map(lambda pull: jnp.ones(pull.shape, bool), pulls)
    spread = _spread(sums, everything)
    dim = jnp.zeros(sigma.shape, bool)
    if which.exponent:
        # Without a highlight any exponent is possible: errors are then those at a fixed
        # exponent.
        shared = list(everything.shared)
        shared[which.place] = jnp.zeros_like(shared[which.place])
        apart = _spread(sums, everything._replace(shared=tuple(shared)))
        least, other = (_specular_error(each, sigma, which) for each in (spread, apart))
        seen = point.specular >= SEEN * jnp.minimum(least, other)
        dim = ~jnp.any(seen, axis=0)
        spread = jax.tree.map(
            lambda without, whole: jnp.where(dim, without, whole), apart, spread
        )
    normal = jnp.zeros_like(sigma)
    if which.normal:
        turn = jnp.sqrt(spread.shared[0] ** 2 + spread.shared[1] ** 2) * sigma
        normal = jnp.rad2deg(turn)
    own = tuple(sigma[None] * error for error in spread.own)
    specular = reach = log_error = jnp.zeros_like(sigma)
    open_ended, settled = jnp.zeros_like(dim), jnp.ones_like(dim)
    if which.one_specular:
        specular = sigma * spread.shared[-1]
    widths = _Widths(normal, own, specular, reach, open_ended)
    t = point.log_exponent
    if which.exponent:
        log_error = sigma * spread.shared[which.place]
        reach = jnp.exp(t) * log_error
        limit = VAGUE_TURNED if which.normal else VAGUE
        vague = ~dim & ~(log_error < limit)
        widths = widths._replace(exponent=reach)
        far = FAR * jnp.clip(jnp.where(vague, log_error, limit), 0, LOST)
        tried = jnp.clip(jnp.stack([t - far, t + far]), *edges.log_exponent)
        unclear, wanted = dim | ~(log_error <= LOST), vague
        if not which.normal:
            anywhere = jnp.linspace(*edges.log_exponent, ANYWHERE, dtype=t.dtype)
            every = jnp.broadcast_to(anywhere[:, None], (ANYWHERE, *t.shape))
            tried, wanted = jnp.concatenate([tried, every]), vague | unclear

        def widened() -> tuple[_Widths, Array]:
            profile = follow(tried, wanted)
            wide = _widened(point, profile, widths, sigma, vague, unclear, which, edges)
            return wide, profile.settled | ~vague

        widths, settled = jax.lax.cond(
            jnp.any(wanted), widened, lambda: (widths, jnp.ones_like(vague))
        )
        normal, specular, reach = widths.normal, widths.specular, widths.exponent
        open_ended = widths.open_ended
    in_a_plane = _in_a_plane(point, samples) & which.normal
    ambiguous = rival < AS_GOOD
    unknown = ~(normal <= WIDEST) | in_a_plane | ambiguous
    normal = jnp.where(unknown, jnp.inf, normal)

    def told(error: Array, edge: tuple[float, float]) -> Array:
        # Reflectances are identified only if the normal is.
        low, high = edge
        where = unknown.reshape((1,) * (error.ndim - 1) + unknown.shape)
        return jnp.where(where | ~(error <= high - low), jnp.inf, error)

    own = tuple(map(told, widths.own, edges.own))
    specular = told(specular, edges.specular)
    at_bound = jnp.zeros_like(dim)
    if which.exponent:
        low, high = edges.log_exponent
        at_bound = ~dim & ((t <= low) | (t >= high))
        lost = dim | at_bound | open_ended | unknown | ~(log_error <= LOST)
        reach = jnp.where(lost, jnp.inf, reach)
    blurred = jnp.any(~jnp.isfinite(jnp.stack(own)), axis=(0, 1))
    degenerate = unknown | blurred | ~jnp.isfinite(specular)
    degenerate |= ~jnp.isfinite(reach) & ~dim & ~at_bound
    for name, (low, high) in zip(which.own, edges.own, strict=True):
        value = getattr(point, name)
        at_bound |= jnp.any((value <= low) | (value >= high), axis=0)
    return Errors(
        normal,
        own,
        specular,
        reach,
        dim,
        degenerate,
        in_a_plane,
        ambiguous & ~in_a_plane,
        at_bound,
        settled,
    )


class _Widths(NamedTuple):
    """Errors of the normal in degrees, of ρ and of f; whether f has no upper limit."""

    normal: Array
    own: Numbers
    specular: Array
    exponent: Array
    open_ended: Array


def _widened(
    point: Point,
    profile: Profile,
    widths: _Widths,
    sigma: Array,
    vague: Array,
    unclear: Array,
    which: Unknowns,
    edges: Edges,
) -> _Widths:
    """Widen errors to those of a profile: its distance over the root of its rise.

    **Arguments:** `vague`: pixels in which the two nearest exponents count; `unclear`:
    those in which all that the data allow count, for reflectances.
    """
    rises = jnp.maximum(profile.rises, 0) / sigma[None] ** 2
    # A rise below a tenth of the expected one is clipped; f is then open-ended.
    share = 1 / jnp.sqrt(jnp.maximum(rises, FAR**2 / 10))
    beside = jnp.where(vague[None], share[:2], 0)
    allowed = jnp.where(unclear[None] & (rises < FAR**2), share, 0)
    shares = jnp.concatenate([jnp.maximum(beside, allowed[:2]), allowed[2:]])
    if which.normal:
        shares = beside

    def most(off: Array, shares: Array) -> Array:
        # A share that is NaN stays so, and makes the error infinite.
        return jnp.max(jnp.where(shares == 0, 0, off * shares), axis=0)

    def widest(name: str) -> Array:
        off = jnp.abs(getattr(profile.points, name) - getattr(point, name)[None])
        return most(off, shares[:, None])

    own = zip(which.own, widths.own, strict=True)
    turned = jnp.sum((profile.points.normal[:2] - point.normal[None]) ** 2, axis=1)
    there, (low, high) = profile.points.log_exponent[:2], edges.log_exponent
    off = jnp.abs(jnp.exp(there) - jnp.exp(point.log_exponent)[None])
    ends = ((there <= low) | (there >= high)) & (rises[:2] < FAR**2)
    flat = jnp.any(ends | (rises[:2] < FAR**2 / 10), axis=0)
    return _Widths(
        jnp.maximum(widths.normal, most(jnp.rad2deg(jnp.sqrt(turned)), beside)),
        tuple(jnp.maximum(error, widest(name)) for name, error in own),
        jnp.maximum(widths.specular, widest("specular")[0])
        if which.one_specular
        else widths.specular,
        jnp.maximum(widths.exponent, most(off, beside)),
        vague & flat,
    )


def _spread(sums: Sums, free: Free) -> Spread:
    """Square roots of the inverse's diagonal for free unknowns; infinite for others."""
    still = jnp.zeros(sums.cost.shape, sums.cost.dtype)
    reduced = reduce_sums(sums, still, free)
    shared = tuple(
        jnp.where(mine, _root_inverse(curvature), jnp.inf)
        for curvature, mine in zip(curvatures(reduced.shared), free.shared, strict=True)
    )
    alone = curvatures(sums.own)
    through = (jnp.zeros_like(alone[0]),) * len(alone)
    if reduced.shared:
        through = _through(reduced.shared, reduced.adapted)
    own = tuple(
        jnp.sqrt(_root_inverse(curvature) ** 2 + more)
        for curvature, more in zip(alone, through, strict=True)
    )
    return Spread(own, shared)


def _through(matrix: Triangle, adapted: tuple[Numbers, ...]) -> Numbers:
    """Variances of reflectances that come from the shared unknowns."""
    factors = factorize(matrix)
    flat = jax.tree.map(lambda f: f[None], factors)
    found = []
    for k in range(len(adapted[0])):
        column = tuple(row[k] for row in adapted)
        found.append(dot(column, solve(flat, column)))
    return tuple(jnp.maximum(variance, 0) for variance in found)


def _specular_error(spread: Spread, sigma: Array, which: Unknowns) -> Array:
    if which.one_specular:
        return (sigma * spread.shared[-1])[None]
    return sigma[None] * spread.own[which.own.index("specular")]


def _root_inverse(curvature: Array) -> Array:
    positive = curvature > 0
    root = jax.lax.rsqrt(jnp.where(positive, curvature, 1))
    return jnp.where(positive, root, jnp.inf)


def _in_a_plane(point: Point, samples: Samples) -> Bool[Array, " pixels"]:
    """True if the lights that reach a pixel lie in one plane with it.

    Diffuse light then determines only the component of the normal in that plane, and
    the mirror image of the normal in the plane gives equal samples.
    """
    lights = facing(samples.lamps)
    row = [lights[:, k] for k in range(3)]
    lit = (shown_by(point.normal, lights) > 0) & jnp.any(samples.share > 0, axis=1)
    length = jnp.sqrt(jnp.sum(lights**2, axis=1))
    weight = jnp.where(lit, 1 / jnp.where(length > 0, length, 1) ** 2, 0)
    xx, yy, zz, xy, xz, yz = (
        jnp.sum(weight * row[i] * row[j], axis=0)
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    trace = xx + yy + zz
    pairs = xx * yy + xx * zz + yy * zz - xy**2 - xz**2 - yz**2
    det = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    # The least of three eigenvalues, where it is far below the others.
    return ~(det > FLAT * trace * pairs)
