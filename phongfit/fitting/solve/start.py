r"""A starting point without a guess: for given f the best ρ is a small linear problem.

A scan over log f solves it in the box for each candidate, and takes the best. The
samples' A, D and S(f) enter only through their sums of products.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS, REFLECTANCES
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.samples import Source
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.box import minimize_in_box
from phongfit.programs import program
from phongfit.rendering.pixels import PixelTerms

CANDIDATES = 24
# Number of bands of exponents; a robust fit starts from the best of each.
BANDS = 6
SUBSET, ROBUST_SUBSET = 1024, 2048
# Fractions of the chosen samples near highlights. Outliers may lie there, which a
# robust loss can reject only if they are the smaller part.
NEAR, ROBUST_NEAR = 0.5, 0.25


def choose_few(
    sources: list[Source],
    seen: list[np.ndarray],
    robust: bool = False,
    bright: Sequence[Float[np.ndarray, " pixels"]] | None = None,
) -> list[np.ndarray] | None:
    """One or two thousand samples: evenly spread ones, and those nearest to highlights.

    A narrow highlight covers few pixels, but only these determine f.

    **Arguments:**

    - `seen`: for each image the pixels that may be chosen.
    - `robust`: whether the loss expects outliers.
    - `bright`: for each image a score of each pixel to show a highlight, if lights are
        unknown; default the nearness to the scene's highlights.

    **Returns:** for each image the chosen pixels; `None` if that would be all.
    """
    near, most = (ROBUST_NEAR, ROBUST_SUBSET) if robust else (NEAR, SUBSET)
    if sum(map(len, seen)) <= most:
        return None
    share = max(most // len(sources), 32)
    return [
        _few(
            source.pixels,
            pixels,
            share,
            int(near * share),
            None if bright is None else bright[k],
        )
        for k, (source, pixels) in enumerate(zip(sources, seen, strict=True))
    ]


def _few(
    view: PixelTerms,
    seen: np.ndarray,
    count: int,
    near: int,
    bright: Float[np.ndarray, " pixels"] | None,
) -> np.ndarray:
    if len(seen) <= count:
        return seen
    even = seen[np.linspace(0, len(seen) - 1, count - near).astype(int)]
    bright = _nearness(view) if bright is None else bright
    brightest = np.argpartition(bright[seen], -near)[-near:]
    return np.concatenate([even, seen[brightest]])


def _nearness(view: PixelTerms) -> np.ndarray:
    """Largest cosine from any highlight, pixel by pixel."""
    # If a lobe takes several numbers, the first is the cosine from its centre.
    cosine, *_ = jax.tree.leaves(view.terms.cosine)
    nearest = np.asarray(_nearest(cosine, view.terms.strength)).ravel()
    if view.interpolation is None:
        return nearest
    index = np.asarray(view.interpolation.index)
    return nearest[index.reshape(-1, index.shape[-1])].max(axis=-1)


@program()
def _nearest(cosine: Array, strength: Array) -> Array:
    lit = jnp.any(strength != 0, axis=-1)
    return jnp.max(jnp.where(lit, cosine, 0), axis=-1, initial=0)


@program()
def scan(
    problem: Problem, y: Float[Array, " n"], band: Float[Array, "2"] | None = None
) -> Float[Array, " n"]:
    """`y` with the best material for its scenes, over a grid of exponents.

    Where exponents differ between channels or materials, each takes its own best.

    **Arguments:** `band`: ends of the grid, as fractions of the range of the logarithm;
    default 0 and 1.
    """
    return choose(problem.unknowns, y, *_candidates(problem, y, band))


@program()
def scan_bands(problem: Problem, y: Float[Array, " n"]) -> Float[Array, "bands n"]:
    """As [`scan`][], with the best of each of several bands of exponents."""
    vectors, costs = _candidates(problem, y)
    bands = np.array_split(np.arange(len(vectors)), min(BANDS, len(vectors)))
    return jnp.stack(
        [choose(problem.unknowns, y, vectors[one], costs[one]) for one in bands]
    )


def _candidates(
    problem: Problem, y: Float[Array, " n"], band: Float[Array, "2"] | None = None
) -> tuple[Float[Array, "candidates n"], Float[Array, "candidates materials 3"]]:
    """The best vector for each exponent of a grid, and its costs."""
    unknowns = problem.unknowns
    entries = unknowns.entries(y)
    channels, exposure = problem.channels(entries), problem.exposure(entries)
    logarithm = unknowns.logarithmic
    if logarithm.any():
        first = int(np.argmax(logarithm))
        low, high = unknowns.lower[first], unknowns.upper[first]
        share = jnp.linspace(0, 1, CANDIDATES, dtype=low.dtype)
        share = share if band is None else band[0] + (band[1] - band[0]) * share
        grid = low + (high - low) * share
        exponents = jnp.exp(grid)
    else:
        grid = jnp.zeros((1,), y.dtype)
        exponents = unknowns.as_material(entries).shininess[None]

    def exposed(light: Float[Array, "3 samples"]) -> Float[Array, "3 samples"]:
        return light * exposure

    def at(exponent: Array) -> tuple[Array, Array]:
        basis = jax.vmap(exposed, in_axes=1, out_axes=1)(channels.basis(exponent))
        return _best_reflectances(problem, basis, exposed(channels.fog_light()))

    vectors, costs = jax.lax.map(at, exponents)
    return jnp.where(logarithm, grid[:, None], vectors), costs


def choose(
    unknowns: Unknowns,
    y: Float[Array, " n"],
    vectors: Float[Array, "candidates n"],
    costs: Float[Array, "candidates materials 3"],
) -> Float[Array, " n"]:
    """`y` with the material of the vectors with the least cost.

    Where exponents differ between channels or materials, each takes its own best.
    """
    costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
    own = jnp.argmin(costs, axis=0)
    common = jnp.argmin(jnp.sum(costs, axis=-1), axis=0)
    logarithm = unknowns.logarithmic
    alone = (unknowns.y_channel >= 0) & bool((unknowns.y_channel[logarithm] >= 0).any())
    chosen = jnp.where(
        alone, own[unknowns.y_material, unknowns.y_channel], common[unknowns.y_material]
    )
    found = vectors[chosen, np.arange(len(chosen))]
    found = jnp.where(np.isin(unknowns.y_parameter, MATERIAL_PARAMETERS), found, y)
    return jnp.clip(found, unknowns.lower, unknowns.upper)


def _best_reflectances(
    problem: Problem, basis: Float[Array, "3 4 samples"], fog: Float[Array, "3 samples"]
) -> tuple[Float[Array, " n"], Float[Array, "materials 3"]]:
    """For one exponent: the best vector, and the cost of each material and channel.

    **Arguments:** `basis`, `fog`: light of the samples, exposure included.
    """
    samples, unknowns = problem.samples, problem.unknowns
    clamp, robust = problem.clamp, problem.loss.robust
    target = samples.target - fog
    material_of, members = samples.material_index(), problem.members()
    select, offset = _selection(unknowns)
    white = samples.target >= 1
    # A clipped sample only shows that the light is at least white: it is left out
    # first, then it counts if the model is below white.
    weight = jnp.where(white & clamp, 0, samples.weight)

    def step(weight: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        sums = _sums(basis, target, weight, members)
        y = _solve(*sums, select, offset, unknowns)
        light = jnp.einsum("mck,ckn->mcn", offset + select @ y, basis)
        # Of the light of all materials, take that of the material of each sample.
        own = material_of[None, None]
        light = light if len(light) == 1 else jnp.take_along_axis(light, own, axis=0)
        light = light[0]
        beyond = white & clamp & (light >= target)
        weight = jnp.where(beyond, 0, samples.weight)
        if robust:
            weight = weight / _absolute(light - target)
        return weight, (y, light)

    # Absolute deviations, which are robust to outliers, need more iterations.
    length = 6 if robust else 2 if clamp else 1
    _, (vectors, lights) = jax.lax.scan(step, weight, length=length)
    shown = lights[-1] + (samples.target - target)
    shown = jnp.clip(shown, 0, 1) if clamp else shown
    difference = shown - samples.target
    left = samples.weight * (_absolute(difference) if robust else difference**2)
    return vectors[-1], members.astype(left.dtype) @ left.T


def _absolute(difference: Array) -> Array:
    """Absolute values, smoothed below a hundredth of white."""
    return jnp.sqrt(difference**2 + 1e-4)


def _selection(unknowns: Unknowns) -> tuple[Array, Array]:
    """Linear map from a vector to reflectances (M, 3, 4): `offset + select @ y`.

    The columns are those of `REFLECTANCES`.
    """
    indices, numbers = [], []
    for entry, name in enumerate(unknowns.table.parameter):
        if name in REFLECTANCES:
            column = unknowns.table.channel[entry]
            for channel in range(3) if column < 0 else [column]:
                where = (unknowns.table.row[entry], channel, REFLECTANCES.index(name))
                indices.append((*where, unknowns.y_index[unknowns.source[entry]]))
                numbers.append(entry)
    wanted = np.array([name in unknowns.names for name in REFLECTANCES])
    known = [_rows(getattr(unknowns.known, name), unknowns) for name in REFLECTANCES]
    offset = jnp.where(wanted, 0, jnp.stack(known, axis=-1))
    size = (unknowns.materials, 3, len(REFLECTANCES), unknowns.lower.size)
    select = jnp.zeros(size, unknowns.lower.dtype)
    if numbers:
        material, channel, column, index = np.array(indices).T
        entry = np.array(numbers)
        share = (unknowns.factor * unknowns.scale)[entry]
        select = select.at[material, channel, column, index].add(share)
        offset = offset.at[material, channel, column].add(unknowns.offset[entry])
    return select, offset


def _rows(
    known: Float[Array, "..."], unknowns: Unknowns
) -> Float[Array, "materials 3"]:
    """A known parameter, for each material and channel."""
    known = known.reshape((1,) * (2 - known.ndim) + known.shape)
    return jnp.broadcast_to(known, (unknowns.materials, 3))


def _sums(
    basis: Float[Array, "3 4 samples"],
    target: Float[Array, "3 samples"],
    weight: Float[Array, "3 samples"],
    members: Bool[Array, "materials samples"],
) -> tuple[Float[Array, "materials 3 4 4"], Float[Array, "materials 3 4"]]:
    """Sums of products of the basis, and with the target, for each material."""
    exact = jax.lax.Precision.HIGHEST

    def of(member: Bool[Array, " samples"]) -> tuple[Array, Array]:
        weighted = basis * jnp.where(member[None], weight, 0)[:, None]
        gram = jnp.einsum("ckn,cln->ckl", weighted, basis, precision=exact)
        moment = jnp.einsum("ckn,cn->ck", weighted, target, precision=exact)
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
    # A tiny ridge, for columns that are zero or equal.
    ridge = 1e-6 * jnp.max(jnp.diag(hessian))
    ridge = jnp.where(ridge > 0, ridge, 1) * jnp.eye(len(gradient), dtype=gram.dtype)
    return minimize_in_box(hessian + ridge, gradient, unknowns.lower, unknowns.upper)
