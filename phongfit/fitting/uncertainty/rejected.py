"""Test whether a robust loss has rejected the highlight as outliers.

For a model without its highlight, the highlight's pixels are a small cluster that is
far too bright, which a robust loss rejects. On a real surface, which no model describes
exactly, this solution can even have the least cost. But real outliers do not gather at
the model's highlight.
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

# Exponents of the tested highlights; wider ones are not small clusters.
EXPONENTS = tuple(10.0 * 2**k for k in range(9))
# Weight of a sample below which it counts as rejected.
ACCEPTED = 0.25
# Largest fraction of the samples in a cluster, and least fraction of marked ones in it.
SMALL, MOST = 0.1, 0.5
# Probability that samples marked at random form such a cluster.
CHANCE = 1e-6


class _Counts(eqx.Module):
    """Numbers of samples, and of marked ones, near highlights and in all."""

    near: Float[Array, "exponents materials 3"]
    near_marked: Float[Array, "exponents materials 3"]
    all: Float[Array, "materials 3"]
    all_marked: Float[Array, "materials 3"]


def rejected_highlights(
    problem: Problem, y: Float[Array, " n"]
) -> Int[np.ndarray, "materials 3"]:
    """Numbers of rejected samples at highlights, by material and channel.

    **Returns:** 0 without such a cluster, and so always for least squares.
    """
    if not problem.loss.robust:
        return np.zeros((problem.unknowns.materials, 3), int)
    return gathered_at_highlights(problem, y, _rejected(problem, y))


def gathered_at_highlights(
    problem: Problem, y: Float[Array, " n"], marked: Bool[Array, "3 samples"]
) -> Int[np.ndarray, "materials 3"]:
    """Numbers of marked samples that gather at a highlight, by material and channel.

    **Returns:** 0 if that may be chance.
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
    r"""$D$ such that `share` or more of n samples are marked with $p \le e^{-n D}$.

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
    samples = problem.samples
    used, kind = samples.weight > 0, samples.weight.dtype
    member = problem.members().astype(kind)
    channels = problem.channels(problem.unknowns.entries(y))

    def count(which: Bool[Array, "3 samples"]) -> Float[Array, "materials 3"]:
        return member @ (used & which).astype(kind).T

    def light(exponent: Array) -> Float[Array, "3 images samples"]:
        # The samples of an image are contiguous, with equal numbers for all images.
        light = jnp.where(used, channels.basis(exponent)[:, 2], 0)
        return light.reshape(3, len(samples.views), -1)

    whole = light(jnp.zeros((), kind))

    def near(exponent: Array) -> tuple[Array, Array]:
        # Height of the lobe, divided by the light's strength.
        lobe = jnp.where(whole > 0, light(exponent) / jnp.where(whole > 0, whole, 1), 0)
        peak = jnp.max(lobe, axis=-1, keepdims=True)
        # An image may show no highlight: its maximum is then on a slope.
        there = (lobe > 0.5 * peak) & (peak > 0.5 * jnp.max(peak))
        there = there.reshape(used.shape)
        return count(there), count(there & marked)

    near_all, near_marked = jax.lax.map(near, jnp.asarray(EXPONENTS, kind))
    everywhere = jnp.ones_like(used)
    return _Counts(near_all, near_marked, count(everywhere), count(marked))


def without_rejected(
    estimated: Estimates, unknowns: Unknowns, rejected: Int[np.ndarray, "materials 3"]
) -> Estimates:
    """Estimates in which parameters of rejected highlights are not identified."""
    if not rejected.any():
        return estimated
    parameters, rows = unknowns.table.parameter, unknowns.table.row
    columns = unknowns.table.channel
    rows = np.where(np.isin(parameters, ("specular", "shininess")), rows, 0)
    here = np.where(
        columns < 0, rejected[rows].any(axis=1), rejected[rows, columns] > 0
    )
    here &= np.isin(parameters, ("specular", "shininess"))
    # An entry that is tied to an unidentified one is not identified either.
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
