"""Scatter of fits by simulation, where formulas do not hold.

Without a highlight the exponent may end anywhere, and with it changes the part of the
light that the lobe replaces: near f = 1 it is nearly Lambert's. Errors at one exponent
are then too small.

??? cite "Source"
    Davies, *Hypothesis testing when a nuisance parameter is present only under the
    alternative*, Biometrika 64(2), 1977. Efron, *Bootstrap methods: another look at
    the jackknife*, Ann. Statist. 7(1), 1979: the parametric bootstrap.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.samples import Source, gather, seen_pixels
from phongfit.fitting.solve.solution import solve
from phongfit.fitting.solve.start import ROBUST_SUBSET, choose_few, scan
from phongfit.programs import program

# A standard deviation from this many draws is accurate to 4 %, unless a few deviate
# far.
DRAWS = 400
MAX_STEPS = 50


def scatter(
    problem: Problem, sources: list[Source], y: Float[Array, " n"]
) -> Float[np.ndarray, "draws entries"]:
    """Results of fits to simulated photographs, in the user's units.

    If there are many pixels, a few thousand represent all of them.

    **Arguments:**

    - `problem`: with the unknowns, noise and film; its samples are those of `sources`.
    - `y`: the truth.
    """
    seen = seen_pixels(sources)
    few = choose_few(sources, seen, most=ROBUST_SUBSET)
    used = seen if few is None else [np.unique(one) for one in few]
    alone = gather(sources, used)
    share = alone.weight
    if few is not None:
        stands = [_stands_for(*one) for one in zip(sources, seen, few, strict=True)]
        share = gather(stands, used).weight
    problem = dataclasses.replace(problem, samples=alone)
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return np.asarray(_ends(problem, share, y, keys), float)


def _stands_for(source: Source, seen: np.ndarray, few: np.ndarray) -> Source:
    """A source in which chosen pixels have the weights of all that they represent."""
    # The first half is spread evenly, the second is all pixels near a highlight.
    even, near = np.split(few, [len(few) // 2])
    even = np.setdiff1d(even, near)
    height, width, _ = source.weight.shape
    count = np.ones(height * width)
    count[even] = (len(seen) - len(near)) / max(len(even), 1)
    weight = np.asarray(source.weight) * count.reshape(height, width, 1)
    weight = jnp.asarray(weight.astype(source.weight.dtype))
    return dataclasses.replace(source, weight=weight)


@program()
def _ends(
    problem: Problem,
    weight: Float[Array, "3 samples"],
    y: Float[Array, " n"],
    keys: Array,
) -> Float[Array, "draws entries"]:
    """Fit as [`fit`][] does: a scan and a solve of a few pixels, then of all."""
    unknowns, used = problem.unknowns, problem.samples.weight > 0
    light, truth = problem.light(y), unknowns.entries(y)
    count = jnp.where(used, weight / jnp.where(used, problem.samples.weight, 1), 1)

    def photographed(noise: Array, weight: Array, known: Array) -> Problem:
        image = light + problem.deviation() * noise
        image = jnp.clip(image, 0, 1) if problem.clamp else image
        return eqx.tree_at(
            lambda p: (p.samples.target, p.samples.weight, p.unknowns.prior_mean),
            problem,
            (image, weight, known),
        )

    def end(key: Array) -> Float[Array, " entries"]:
        own, others, of_priors = jax.random.split(key, 3)
        own = jax.random.normal(own, light.shape, light.dtype)
        others = jax.random.normal(others, light.shape, light.dtype)
        # A prior is a measurement as well: its mean scatters about the truth.
        wanted = np.flatnonzero(np.array(unknowns.has_prior))
        drawn = jax.random.normal(of_priors, truth.shape, truth.dtype)[wanted]
        known = truth.at[wanted].add(jnp.linalg.pinv(unknowns.prior_root) @ drawn)
        few = photographed(own, problem.samples.weight, known)
        # The mean noise of a pixel and of those that it represents.
        mean = (own + jnp.sqrt(count - 1) * others) / count
        all_pixels = photographed(mean, weight, known)
        first = solve(few, scan(few, y), MAX_STEPS).y
        return unknowns.entries(solve(all_pixels, first, MAX_STEPS).y)

    return jax.lax.map(end, keys)
