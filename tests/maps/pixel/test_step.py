"""Steps are the least of the quadratic that sums describe, within the box."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.settings import MapSettings, Point, unknowns_of
from phongfit.maps.pixel.step import (
    Free,
    Move,
    adapt_own,
    edges_of,
    make_move,
    respond,
    steadied,
)
from phongfit.maps.pixel.sums import Sums
from tests.maps.synthetic import dtype

SETTINGS = MapSettings(names=("diffuse", "specular", "shininess"), normals="fit")
WHICH = unknowns_of(SETTINGS)
EDGES = edges_of(SETTINGS, WHICH)
CHANNELS, PIXELS, OWN, SHARED = 3, 5, 2, 3


@dataclasses.dataclass(frozen=True)
class Linear:
    """A model that is linear: columns and residuals of 20 images.

    - `columns`: (images, own and shared, channels, pixels).
    """

    columns: np.ndarray
    residual: np.ndarray

    def sums(self) -> Sums:
        """What `gather` makes of it."""
        columns, residual = self.columns, self.residual
        whole = np.einsum("iacp,ibcp->abcp", columns, columns).astype(dtype())
        pull = np.einsum("iacp,icp->acp", columns, residual).astype(dtype())
        cost = np.einsum("icp,icp->p", residual, residual).astype(dtype())
        shared = jnp.asarray(whole[OWN:, OWN:].sum(axis=2))
        own, pulls = jnp.asarray(whole[:, :OWN]), jnp.asarray(pull)
        return Sums(
            tuple(tuple(own[i, j] for j in range(i + 1)) for i in range(OWN)),
            tuple(tuple(own[OWN + i]) for i in range(SHARED)),
            tuple(tuple(shared[i, j] for j in range(i + 1)) for i in range(SHARED)),
            tuple(pulls[:OWN]),
            tuple(jnp.sum(pulls[OWN:], axis=1)),
            jnp.asarray(cost),
        )

    def cost(self, move: Move) -> np.ndarray:
        """What the residuals come to after a move."""
        own = np.stack(move.own)
        shared = np.broadcast_to(
            np.stack(move.shared)[:, None], (SHARED, *own.shape[1:])
        )
        steps = np.concatenate([own, shared])
        left = self.residual - np.einsum("iacp,acp->icp", self.columns, steps)
        return np.einsum("icp,icp->p", left, left)


@pytest.fixture(scope="module")
def model() -> Linear:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(20, OWN + SHARED, CHANNELS, PIXELS))
    return Linear(columns, 0.5 * rng.normal(size=(20, CHANNELS, PIXELS)))


def at(value: float) -> Point:
    """A point whose reflectances are all alike."""
    all_alike = jnp.full((CHANNELS, PIXELS), value, dtype())
    normal = jnp.zeros((3, PIXELS), dtype()).at[2].set(1)
    t = jnp.full(PIXELS, 3.0, dtype())
    return Point(normal, t, all_alike, all_alike, all_alike)


def free() -> Free:
    def yes(count: int, *shape: int) -> tuple[jax.Array, ...]:
        return (jnp.ones(shape, bool),) * count

    return Free(yes(OWN, CHANNELS, PIXELS), yes(SHARED, PIXELS))


@pytest.mark.parametrize("value", [0.5, 0.01, 0.0])
def test_what_reflectances_give_alone_is_exact_in_the_box(model, value):
    sums = model.sums()
    move = jax.jit(lambda point: adapt_own(point, sums, WHICH, EDGES))(at(value))
    values = value + np.stack(move.own)
    assert (values >= 0).all() and (values <= 1).all()
    assert not np.stack(move.shared).any()
    gain = np.asarray(sums.cost) - model.cost(move)
    np.testing.assert_allclose(move.decrement, gain, rtol=1e-3, atol=1e-4)
    assert (np.asarray(move.decrement) >= 0).all() and gain.max() > 0.1


def test_all_else_follows_the_exponent(model):
    """No other move with the same step of log f costs less."""
    sums = model.sums()
    follow = jax.jit(lambda: respond(sums, free(), WHICH.place))()
    best = jax.jit(lambda: make_move(sums, jnp.zeros(PIXELS, dtype()), free()))()
    there = 0.2

    def off(move: Move) -> Move:
        shared = list(move.shared)
        shared[WHICH.place] = jnp.full(PIXELS, 1.0, dtype())
        own = tuple(there * x for x in move.own)
        return Move(own, tuple(there * x for x in shared), move.decrement)

    def added(first: Move, second: Move) -> Move:
        own, shared = jax.tree.map(jnp.add, first[:2], second[:2])
        return Move(own, shared, first.decrement)

    cost = model.cost(added(best, off(follow)))
    rng = np.random.default_rng(1)
    for _ in range(4):
        shaken = follow._replace(
            own=tuple(x + 0.1 * rng.normal(size=x.shape) for x in follow.own)
        )
        assert (model.cost(added(best, off(shaken))) > cost).all()


def test_what_samples_hardly_tell_stays(model):
    """A highlight that no lamp shows: rounding is no reason for ρ_s to move."""
    columns = model.columns.copy()
    columns[:, 1] *= 1e-4
    dark = dataclasses.replace(model, columns=columns)
    sums = dark.sums()
    point, still = at(0.5), jnp.zeros(PIXELS, dtype())

    @jax.jit
    def steps(sums: Sums) -> list[jax.Array]:
        """Of ρ_s: as it is, steadied, and of reflectances alone."""
        told = steadied(sums, WHICH, EDGES)
        moves = [make_move(one, still, free()) for one in (sums, told)]
        return [move.own[1] for move in (*moves, adapt_own(point, told, WHICH, EDGES))]

    moved = [np.abs(step).max() for step in steps(sums)]
    assert moved[0] > 10 and max(moved[1:]) < 0.01
