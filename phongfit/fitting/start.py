r"""A starting point without a guess: for given f the best ρ is a tiny linear problem.

A scan over log f solves it for each candidate, in the box, and takes the best. Three
numbers a sample (A, D and S(f)) enter only through their sums of products.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.fitting.box import minimize_in_box
from phongfit.fitting.samples import Samples
from phongfit.fitting.unknowns import REFLECTANCES, Unknowns
from phongfit.rendering.pixels import PixelTerms

CANDIDATES = 48
SUBSET = 4096


def choose_few(samples: Samples) -> Samples:
    """A few thousand samples: evenly spread ones, and the nearest to highlights.

    A narrow highlight covers few pixels, but only these know f.
    """
    present = np.flatnonzero(np.asarray(samples.weight).any(axis=-1))
    if len(present) <= SUBSET:
        return samples
    even = present[np.linspace(0, len(present) - 1, SUBSET // 2).astype(int)]
    nearest = _nearness(samples.pixels)[present]
    bright = present[np.argpartition(nearest, -SUBSET // 2)[-SUBSET // 2 :]]
    return samples.take(np.concatenate([even, bright]))


def _nearness(pixels: PixelTerms) -> np.ndarray:
    """Largest cosine from any highlight, pixel by pixel."""
    lit = np.asarray(pixels.terms.strength).any(axis=-1)
    nearest = np.where(lit, np.asarray(pixels.terms.cosine), 0).max(axis=-1, initial=0)
    if pixels.interpolation is None:
        return nearest
    return nearest[np.asarray(pixels.interpolation.index)].max(axis=-1)


@eqx.filter_jit
def scan(samples: Samples, unknowns: Unknowns, clamp: bool) -> Float[Array, " n"]:
    """The best starting vector for the solver, over a grid of exponents.

    Where exponents differ between channels or materials, each takes its own best.
    """
    wanted = "shininess" in unknowns.names
    if wanted:
        low, high = (
            unknowns.parts(edge)["shininess"][0]
            for edge in (unknowns.lower, unknowns.upper)
        )
        grid = low + (high - low) * jnp.linspace(0, 1, CANDIDATES, dtype=low.dtype)
        exponents = jnp.exp(grid)
    else:
        grid = jnp.zeros((1,), unknowns.lower.dtype)
        exponents = unknowns.known.shininess[None]

    def at(exponent: Array) -> tuple[Array, Array]:
        return _best_reflectances(samples, unknowns, exponent, clamp)

    vectors, costs = jax.lax.map(at, exponents)
    costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
    own = jnp.argmin(costs, axis=0)
    common = jnp.argmin(jnp.sum(costs, axis=-1), axis=0)
    per_channel = wanted and unknowns.channels[unknowns.names.index("shininess")] > 1
    alone = (unknowns.columns >= 0) & per_channel
    chosen = jnp.where(
        alone, own[unknowns.owners, unknowns.columns], common[unknowns.owners]
    )
    y = vectors[chosen, np.arange(len(chosen))]
    y = jnp.where(unknowns.logarithmic, grid[chosen], y)
    return jnp.clip(y, unknowns.lower, unknowns.upper)


def _best_reflectances(
    samples: Samples, unknowns: Unknowns, exponent: Float[Array, "..."], clamp: bool
) -> tuple[Float[Array, " n"], Float[Array, "materials 3"]]:
    """For one exponent: the best vector, and what each material's channels leave."""
    basis = samples.pixels.basis(exponent)
    target = samples.target - samples.pixels.fog_light()
    owner = samples.pixels.material_index()
    owner = jnp.zeros(target.shape[0], int) if owner is None else owner
    rows = jnp.arange(unknowns.materials, dtype=owner.dtype)
    members = owner[None] == rows[:, None]
    select, offset = _selection(unknowns)
    white = samples.target >= 1
    # What was clipped says only that the light is no less than white: at first it is
    # left out, then it counts where the model falls short of white.
    weight = jnp.where(white & clamp, 0, samples.weight)

    def step(weight: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        sums = _sums(basis, target, weight, members)
        y = _solve(*sums, select, offset, unknowns)
        reflectances = (offset + select @ y)[owner]
        light = jnp.einsum("nck,nck->nc", basis, reflectances)
        beyond = white & clamp & (light >= target)
        return jnp.where(beyond, 0, samples.weight), (y, light)

    _, (vectors, lights) = jax.lax.scan(step, weight, length=3 if clamp else 1)
    shown = lights[-1] + (samples.target - target)
    shown = jnp.clip(shown, 0, 1) if clamp else shown
    left = samples.weight * (shown - samples.target) ** 2
    return vectors[-1], members.astype(left.dtype) @ left


def _selection(unknowns: Unknowns) -> tuple[Array, Array]:
    """How a vector makes reflectances (M, 3, 4): `offset + select @ y`.

    The columns are those of `REFLECTANCES`.
    """
    size = unknowns.lower.size
    select = np.zeros((unknowns.materials, 3, len(REFLECTANCES), size))
    wanted = np.array([name in unknowns.names for name in REFLECTANCES])
    for entry, (kind, owner, column) in enumerate(
        zip(unknowns.kinds, unknowns.owners, unknowns.columns, strict=True)
    ):
        if kind in REFLECTANCES:
            channels = range(3) if column < 0 else [column]
            select[owner, channels, REFLECTANCES.index(kind), entry] = 1
    leaves = [_rows(getattr(unknowns.known, name), unknowns) for name in REFLECTANCES]
    offset = jnp.where(wanted, 0, jnp.stack(leaves, axis=-1))
    return jnp.asarray(select, unknowns.lower.dtype), offset


def _rows(leaf: Float[Array, "..."], unknowns: Unknowns) -> Float[Array, "materials 3"]:
    """A known leaf, for each material and channel."""
    leaf = leaf.reshape((1,) * (2 - leaf.ndim) + leaf.shape)
    return jnp.broadcast_to(leaf, (unknowns.materials, 3))


def _sums(
    basis: Float[Array, "samples 3 4"],
    target: Float[Array, "samples 3"],
    weight: Float[Array, "samples 3"],
    members: Bool[Array, "materials samples"],
) -> tuple[Float[Array, "materials 3 4 4"], Float[Array, "materials 3 4"]]:
    """Sums of products of the basis, and with the target, for each material."""
    exact = jax.lax.Precision.HIGHEST

    def of(member: Bool[Array, " samples"]) -> tuple[Array, Array]:
        weighted = basis * jnp.where(member[:, None], weight, 0)[..., None]
        gram = jnp.einsum("nck,ncl->ckl", weighted, basis, precision=exact)
        moment = jnp.einsum("nck,nc->ck", weighted, target, precision=exact)
        return gram, moment

    return jax.lax.map(of, members)


def _solve(
    gram: Float[Array, "materials 3 4 4"],
    moment: Float[Array, "materials 3 4"],
    select: Float[Array, "materials 3 4 n"],
    offset: Float[Array, "materials 3 4"],
    unknowns: Unknowns,
) -> Float[Array, " n"]:
    """Bounded linear least squares for the reflectances, from sums of products."""
    moment = moment - jnp.einsum("mckl,mcl->mck", gram, offset)
    hessian = jnp.einsum("mcki,mckl,mclj->ij", select, gram, select)
    gradient = -jnp.einsum("mcki,mck->i", select, moment)
    # A ridge far below any measurement, for columns that are zero or alike.
    ridge = 1e-6 * jnp.max(jnp.diag(hessian))
    ridge = jnp.where(ridge > 0, ridge, 1) * jnp.eye(len(gradient), dtype=gram.dtype)
    return minimize_in_box(hessian + ridge, gradient, unknowns.lower, unknowns.upper)
