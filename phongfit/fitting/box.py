"""A quadratic in a box: the small problem inside every bounded least-squares step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class _State(eqx.Module):
    point: Float[Array, " n"]
    free: Bool[Array, " n"]
    done: Bool[Array, ""]
    steps: Int[Array, ""]


def minimize_in_box(
    hessian: Float[Array, "n n"],
    gradient: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, " n"]:
    r"""The $p$ in $[l, u]$ that minimises $g \cdot p + \tfrac12 p^\top H p$.

    A primal active-set method: solve for the free entries, walk until one meets a
    bound, hold it there; where all is well, let go the entry that most wants to leave
    its bound. It ends after finitely many steps, mostly as many as bounds that bind.

    **Arguments:**

    - `hessian`: symmetric, positive semidefinite, with a positive diagonal.
    - `gradient`: at $p = 0$.
    - `lower`, `upper`: the box; may be infinite.

    **Returns:** $p$, in the box to the last bit.

    ??? cite "Source"
        Nocedal and Wright, *Numerical optimization*, 2nd ed., algorithm 16.3.
    """
    size = gradient.shape[0]
    start = jnp.clip(jnp.zeros_like(gradient), lower, upper)
    # A multiplier this small is rounding: letting go for it would go round in circles.
    small = 8 * jnp.finfo(gradient.dtype).eps

    def step(state: _State) -> _State:
        slope = gradient + hessian @ state.point
        newton = _solve_free(hessian, slope, state.free)
        limit = jnp.where(newton > 0, upper, lower) - state.point
        moving = state.free & (newton != 0)
        share = jnp.where(moving, limit / jnp.where(moving, newton, 1), jnp.inf)
        blocking = jnp.argmin(share)
        blocked = share[blocking] < 1
        moved = state.point + jnp.minimum(share[blocking], 1) * newton
        moved = jnp.clip(moved, lower, upper)
        is_blocking = blocked & (jnp.arange(size) == blocking)
        at = jnp.where(newton > 0, upper, lower)
        moved = jnp.where(is_blocking, at, moved)

        # All free entries are at their best: does a held one want to leave its bound?
        slope = gradient + hessian @ moved
        noise = small * (jnp.abs(gradient) + jnp.abs(hessian) @ jnp.abs(moved))
        inwards = jnp.where(moved <= lower, -slope, slope)
        wish = jnp.where(~state.free & (lower < upper), inwards - noise, -jnp.inf)
        eager = jnp.argmax(wish)
        leaves = ~blocked & (wish[eager] > 0)
        is_leaving = leaves & (jnp.arange(size) == eager)
        free = (state.free & ~is_blocking) | is_leaving
        return _State(moved, free, ~blocked & ~leaves, state.steps + 1)

    def unfinished(state: _State) -> Bool[Array, ""]:
        return ~state.done & (state.steps < 4 * size + 8)

    first = _State(start, lower < upper, jnp.array(False), jnp.array(0))
    return jax.lax.while_loop(unfinished, step, first).point


def _solve_free(
    hessian: Float[Array, "n n"], slope: Float[Array, " n"], free: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Newton step of the free entries; the others stay."""
    both = free[:, None] & free[None, :]
    identity = jnp.eye(slope.shape[0], dtype=slope.dtype)
    # Scaled to a unit diagonal, so that units do not decide what counts as singular.
    scale = jax.lax.rsqrt(jnp.diag(hessian))
    scaled = jnp.where(both, hessian * scale[:, None] * scale[None, :], identity)
    wanted = jnp.where(free, slope * scale, 0)

    def solve(ridge: float) -> Float[Array, " n"]:
        factor = jax.scipy.linalg.cho_factor(scaled + ridge * identity)
        return jnp.where(free, -jax.scipy.linalg.cho_solve(factor, wanted) * scale, 0)

    # Rounding can make a singular matrix indefinite: then a shorter step must do.
    step = solve(8 * slope.shape[0] * float(jnp.finfo(slope.dtype).eps))
    return jnp.where(jnp.all(jnp.isfinite(step)), step, solve(1e-3))
