r"""A starting point without a guess: for given f the best ρ is a tiny linear problem.

A scan over log f solves it for each candidate, in the box, and takes the best. Three
numbers a sample (A, D and S(f)) enter only through their sums of products.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.fitting.box import minimize_in_box
from phongfit.fitting.samples import Samples
from phongfit.fitting.unknowns import REFLECTANCES, Unknowns
from phongfit.material import Material

CANDIDATES = 48
SUBSET = 4096


def choose_subset(samples: Samples) -> Int[Array, " m"]:
    """Indices of a few thousand samples: evenly spread, and the nearest to highlights.

    A narrow highlight covers few pixels, but only these know f.
    """
    weight = np.asarray(samples.weight).any(axis=-1)
    present = np.flatnonzero(weight)
    if len(present) <= SUBSET:
        return jnp.asarray(np.resize(present, _round_up(len(present))))
    even = present[np.linspace(0, len(present) - 1, SUBSET // 2).astype(int)]
    cosine = np.asarray(samples.terms.cosine)
    lit = np.asarray(samples.terms.strength).any(axis=-1)
    nearest = np.where(lit, cosine, 0).max(axis=-1, initial=0)[present]
    bright = present[np.argpartition(nearest, -SUBSET // 2)[-SUBSET // 2 :]]
    return jnp.asarray(np.concatenate([even, bright]))


def _round_up(count: int) -> int:
    """A size out of a short series, at least `count`."""
    return min(SUBSET, 2 ** (max(count - 1, 255)).bit_length())


@eqx.filter_jit
def scan(samples: Samples, unknowns: Unknowns, clamp: bool) -> Float[Array, " n"]:
    """The best starting vector for the solver, over a grid of exponents.

    Where exponents differ between channels, each takes its own best.
    """
    wanted = "shininess" in unknowns.names
    known = unknowns.known.shininess
    if wanted:
        low, high = (
            unknowns.parts(edge)["shininess"]
            for edge in (unknowns.lower, unknowns.upper)
        )
        share = jnp.linspace(0, 1, CANDIDATES, dtype=low.dtype)
        grid = low[0] + (high[0] - low[0]) * share
        exponents = jnp.exp(grid)
    else:
        grid = jnp.zeros((1,), known.dtype)
        exponents = known[None]

    def at(exponent: Array) -> tuple[Array, Array]:
        return _best_reflectances(samples, unknowns, exponent, clamp)

    vectors, costs = jax.lax.map(at, exponents)
    costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
    vectors = jax.vmap(lambda v, g: _with_exponent(unknowns, v, g))(vectors, grid)
    best = jnp.argmin(jnp.sum(costs, axis=-1))
    y = vectors[best]
    if wanted and unknowns.parts(y)["shininess"].shape == (3,):
        own = jnp.argmin(costs, axis=0)
        y = _with_exponent(unknowns, y, grid[own])
    return jnp.clip(y, unknowns.lower, unknowns.upper)


def _with_exponent(
    unknowns: Unknowns, y: Float[Array, " n"], exponent: Float[Array, "..."]
) -> Float[Array, " n"]:
    parts = unknowns.parts(y)
    if "shininess" in parts:
        parts["shininess"] = jnp.broadcast_to(exponent, parts["shininess"].shape)
    return jnp.concatenate([parts[name] for name in unknowns.names])


def _best_reflectances(
    samples: Samples, unknowns: Unknowns, exponent: Float[Array, "..."], clamp: bool
) -> tuple[Float[Array, " n"], Float[Array, "3"]]:
    """For one exponent: the best vector, and what is left over in each channel."""
    terms = samples.terms
    basis = jnp.stack(
        [
            terms.ambient,
            terms.diffuse,
            terms.specular(exponent),
            jnp.ones_like(terms.diffuse),
        ],
        axis=-1,
    )
    select, offset = _selection(unknowns)
    white = samples.target >= 1
    # What was clipped says only that the light is no less than white: at first it is
    # left out, then it counts where the model falls short of white.
    weight = jnp.where(white & clamp, 0, samples.weight)

    def step(weight: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        y = _solve(basis, samples.target, weight, select, offset, unknowns)
        light = jnp.einsum("nck,ck->nc", basis, offset + select @ y)
        beyond = white & clamp & (light >= 1)
        return jnp.where(beyond, 0, samples.weight), (y, light)

    _, (vectors, lights) = jax.lax.scan(step, weight, length=3 if clamp else 1)
    y, light = vectors[-1], lights[-1]
    shown = jnp.clip(light, 0, 1) if clamp else light
    left = jnp.sum(samples.weight * (shown - samples.target) ** 2, axis=0)
    return y, left


def _selection(unknowns: Unknowns) -> tuple[Array, Array]:
    """How a vector makes the reflectances (3, 4): `offset + select @ y`.

    The channels are rows; the columns are those of `REFLECTANCES`.
    """
    dtype = unknowns.lower.dtype
    select = np.zeros((3, len(REFLECTANCES), unknowns.lower.size))
    offset = jnp.stack(
        [_channels(unknowns.known, name) for name in REFLECTANCES], axis=-1
    )
    wanted = np.zeros(len(REFLECTANCES), bool)
    for name, entries in unknowns.parts(np.arange(unknowns.lower.size)).items():
        if name in REFLECTANCES:
            column = REFLECTANCES.index(name)
            select[range(3), column, np.broadcast_to(entries, 3)] = 1
            wanted[column] = True
    return jnp.asarray(select, dtype), jnp.where(wanted[None], 0, offset)


def _channels(material: Material, name: str) -> Float[Array, "3"]:
    leaf = getattr(material, name)
    return jnp.broadcast_to(leaf.reshape(-1), (3,))


def _solve(
    basis: Float[Array, "samples 3 4"],
    target: Float[Array, "samples 3"],
    weight: Float[Array, "samples 3"],
    select: Float[Array, "3 4 n"],
    offset: Float[Array, "3 4"],
    unknowns: Unknowns,
) -> Float[Array, " n"]:
    """Bounded linear least squares for the reflectances, from sums of products."""
    weighted = basis * weight[..., None]
    exact = jax.lax.Precision.HIGHEST
    gram = jnp.einsum("nck,ncl->ckl", weighted, basis, precision=exact)
    moment = jnp.einsum("nck,nc->ck", weighted, target, precision=exact)
    moment = moment - jnp.einsum("ckl,cl->ck", gram, offset)
    hessian = jnp.einsum("cki,ckl,clj->ij", select, gram, select)
    gradient = -jnp.einsum("cki,ck->i", select, moment)
    # A ridge far below any measurement, for columns that are zero or alike.
    diagonal = jnp.diag(hessian)
    ridge = 1e-6 * jnp.maximum(diagonal, jnp.max(diagonal))
    ridge = jnp.where(ridge > 0, ridge, 1)
    return minimize_in_box(
        hessian + jnp.diag(ridge), gradient, unknowns.lower, unknowns.upper
    )
