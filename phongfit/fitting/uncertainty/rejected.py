"""Has a robust loss taken the highlight for outliers?

To a model without its highlight, the highlight's pixels are a small cluster that is far
too bright: what a robust loss is made to reject. On a real surface, which no model
describes exactly, that can even cost the least. But outliers that have nothing to do
with the model do not gather where it has its highlight.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.codes import coded
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.uncertainty.estimate import Estimates
from phongfit.fitting.uncertainty.identifiability import not_identifiable
from phongfit.programs import program

# Exponents of the highlights that are looked for; wider ones are no small cluster.
EXPONENTS = tuple(10.0 * 2**k for k in range(9))
# A sample is rejected where the loss accepts less of it than this share.
ACCEPTED = 0.25
# A cluster holds at most this share of the samples, and more marked ones than not.
SMALL, MOST = 0.1, 0.5
# Chance that samples which are marked anywhere make such a cluster.
CHANCE = 1e-6


class _Counts(eqx.Module):
    """Samples near highlights of several widths, and in all; the marked of them."""

    near: Float[Array, "exponents materials 3"]
    near_marked: Float[Array, "exponents materials 3"]
    all: Float[Array, "materials 3"]
    all_marked: Float[Array, "materials 3"]


def rejected_highlights(
    problem: Problem, y: Float[Array, " n"]
) -> Int[np.ndarray, "materials 3"]:
    """How many samples of its highlight were rejected, by material and channel.

    **Returns:** 0 where there is no such cluster; so always for least squares.
    """
    if not problem.loss.robust:
        return np.zeros((problem.unknowns.materials, 3), int)
    return gathered_at_highlights(problem, y, _rejected(problem, y))


def gathered_at_highlights(
    problem: Problem, y: Float[Array, " n"], marked: Bool[Array, "3 samples"]
) -> Int[np.ndarray, "materials 3"]:
    """How many of the marked samples gather at a highlight, by material and channel.

    **Returns:** 0 where chance may have put them there.
    """
    if not {"specular", "shininess"} & set(problem.unknowns.names):
        return np.zeros((problem.unknowns.materials, 3), int)
    counts = _count(problem, y, marked)
    counts = jax.tree.map(lambda part: np.asarray(part, float), counts)
    elsewhere = counts.all - counts.near
    usual = (counts.all_marked - counts.near_marked + 1) / (elsewhere + 2)
    share = counts.near_marked / np.maximum(counts.near, 1)
    cluster = (counts.near <= SMALL * counts.all) & (share > np.maximum(MOST, usual))
    cluster &= counts.near * _divergence(share, usual) > -np.log(CHANCE)
    return np.max(np.where(cluster, counts.near_marked, 0), axis=0).astype(int)


def _divergence(share: np.ndarray, usual: np.ndarray) -> np.ndarray:
    r"""$D$ such that chance makes a share, or more, of n with $p \le e^{-n D}$.

    ??? cite "Source"
        Hoeffding, *Probability inequalities for sums of bounded random variables*,
        J. Am. Stat. Assoc. 58, 1963, theorem 1.
    """
    rest, tiny = 1 - share, np.finfo(float).tiny
    below = rest * np.log(np.maximum(rest, tiny) / (1 - usual))
    return share * np.log(np.maximum(share, tiny) / usual) + below


@program()
def _rejected(problem: Problem, y: Float[Array, " n"]) -> Bool[Array, "3 samples"]:
    """Samples that the loss rejects, and that are brighter than the model."""
    residual = problem.residual(y)
    return (residual < 0) & (problem.loss.weight(residual) < ACCEPTED)


@program()
def _count(
    problem: Problem, y: Float[Array, " n"], marked: Bool[Array, "3 samples"]
) -> _Counts:
    samples, unknowns = problem.samples, problem.unknowns
    used, kind = samples.weight > 0, samples.weight.dtype
    rows = jnp.arange(unknowns.materials, dtype=samples.image.dtype)
    member = (samples.material_index()[None] == rows[:, None]).astype(kind)
    channels = problem.channels(unknowns.entries(y))

    def count(which: Bool[Array, "3 samples"]) -> Float[Array, "materials 3"]:
        return member @ (used & which).astype(kind).T

    def light(exponent: Array) -> Float[Array, "3 images samples"]:
        # The samples of an image come one after another, equally many of each.
        light = jnp.where(used, channels.basis(exponent)[:, 2], 0)
        return light.reshape(3, len(samples.views), -1)

    whole = light(jnp.zeros((), kind))

    def near(exponent: Array) -> tuple[Array, Array]:
        # Its height, whatever the light's strength.
        lobe = jnp.where(whole > 0, light(exponent) / jnp.where(whole > 0, whole, 1), 0)
        peak = jnp.max(lobe, axis=-1, keepdims=True)
        # An image may show none: its highest place is then a slope.
        there = (lobe > 0.5 * peak) & (peak > 0.5 * jnp.max(peak))
        there = there.reshape(used.shape)
        return count(there), count(there & marked)

    near_all, near_marked = jax.lax.map(near, jnp.asarray(EXPONENTS, kind))
    everywhere = jnp.ones_like(used)
    return _Counts(near_all, near_marked, count(everywhere), count(marked))


def without_rejected(
    estimated: Estimates, unknowns: Unknowns, rejected: Int[np.ndarray, "materials 3"]
) -> Estimates:
    """The same, with all that a rejected highlight alone could identify left open."""
    if not rejected.any():
        return estimated
    parameters, rows = unknowns.entry_parameter, unknowns.entry_row
    columns = unknowns.entry_channel
    rows = np.where(np.isin(parameters, ("specular", "shininess")), rows, 0)
    here = np.where(
        columns < 0, rejected[rows].any(axis=1), rejected[rows, columns] > 0
    )
    here &= np.isin(parameters, ("specular", "shininess"))
    # A tied entry is as little identified as the one that it follows.
    here = (here | here[np.array(unknowns.source)])[unknowns.reported]
    covariance = estimated.covariance.copy()
    covariance[here, :] = covariance[:, here] = np.nan
    covariance[here, here] = np.inf
    words = not_identifiable(np.array(unknowns.labels)[here])
    words += (
        ": the loss took the highlight for outliers. A compact "
        f"cluster of {rejected.sum()} samples that it rejects, brighter than the fit, "
        "lies where the model has its highlight"
    )
    return dataclasses.replace(
        estimated,
        errors=np.where(here, np.inf, estimated.errors),
        covariance=covariance,
        at_bound=estimated.at_bound & ~here,
        unidentified=estimated.unidentified | here,
        reasons=(*estimated.reasons, coded("rejected-highlight", words)),
    )
