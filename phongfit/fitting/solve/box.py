"""Minimisation of a convex quadratic in a box, for bounded least-squares steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def minimize_in_box(
    hessian: Float[Array, "n n"],
    gradient: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, " n"]:
    r"""The $p$ in $[l, u]$ that minimises $g \cdot p + \tfrac12 p^\top H p$.

    A primal active-set method: take the Newton step of the free entries up to the first
    bound, and hold that entry there. If no bound is met, free the held entry whose
    multiplier has the wrong sign and is largest. It ends after finitely many steps,
    mostly as many as there are active bounds.

    **Arguments:**

    - `hessian`: symmetric, positive semidefinite, with a positive diagonal.
    - `gradient`: at $p = 0$.
    - `lower`, `upper`: the box; may be infinite.

    **Returns:** $p$, in the box to the last bit.

    ??? cite "Source"
        Nocedal and Wright, *Numerical optimization*, 2nd ed., algorithm 16.3.
    """
    return _active_set(_HessianForm(hessian, gradient), lower, upper)


def least_squares_in_box(
    matrix: Float[Array, "m n"],
    residual: Float[Array, " m"],
    damping: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, " n"]:
    r"""The $p$ in $[l, u]$ that minimises $\|A p + r\|^2 + \|d \odot p\|^2$.

    As [`minimize_in_box`][], but by QR factors: $A^\top A$, which would lose half of
    the digits, is not formed.

    **Arguments:**

    - `matrix`, `residual`: $A$ and $r$.
    - `damping`: $d$, not negative; positive where a column of $A$ is zero.
    - `lower`, `upper`: the box; may be infinite.

    **Returns:** $p$, in the box to the last bit.
    """
    return _active_set(_SquaresForm(matrix, residual, damping), lower, upper)


class _HessianForm(eqx.Module):
    """A convex quadratic by its Hessian, and its gradient at 0."""

    hessian: Float[Array, "n n"]
    gradient: Float[Array, " n"]

    def slope(self, point: Float[Array, " n"]) -> Float[Array, " n"]:
        """Gradient."""
        return self.gradient + self.hessian @ point

    def newton(
        self, point: Float[Array, " n"], free: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        """Step of the free entries to their minimum; the others stay."""
        slope, both = self.slope(point), free[:, None] & free[None, :]
        identity = jnp.eye(slope.shape[0], dtype=slope.dtype)
        # Scaled to a unit diagonal, so that units do not decide what counts as
        # singular.
        scale = jax.lax.rsqrt(jnp.diag(self.hessian))
        scaled = self.hessian * scale[:, None] * scale[None, :]
        scaled = jnp.where(both, scaled, identity)
        wanted = jnp.where(free, slope * scale, 0)

        def solve(ridge: float) -> Float[Array, " n"]:
            factor = jax.scipy.linalg.cho_factor(scaled + ridge * identity)
            step = -jax.scipy.linalg.cho_solve(factor, wanted) * scale
            return jnp.where(free, step, 0)

        # Rounding can make a singular matrix indefinite: then a larger ridge is used.
        step = solve(8 * slope.shape[0] * float(jnp.finfo(slope.dtype).eps))
        sound = jnp.all(jnp.isfinite(step))
        return jax.lax.cond(sound, lambda: step, lambda: solve(1e-3))


class _SquaresForm(eqx.Module):
    """A convex quadratic as half of a damped sum of squares, with the same methods."""

    matrix: Float[Array, "m n"]
    residual: Float[Array, " m"]
    damping: Float[Array, " n"]

    def slope(self, point: Float[Array, " n"]) -> Float[Array, " n"]:
        left = self.matrix @ point + self.residual
        return self.matrix.T @ left + self.damping * (self.damping * point)

    def newton(
        self, point: Float[Array, " n"], free: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        n = point.size
        norm = jnp.sqrt(jnp.sum(self.matrix**2, axis=0) + self.damping**2)
        # A unit for each entry, so that units do not decide what counts as singular.
        unit = jnp.where(free & (norm > 0), 1 / jnp.where(norm > 0, norm, 1), 0)
        ridge = n * jnp.finfo(point.dtype).eps
        below = jnp.diag(jnp.where(free, jnp.hypot(self.damping * unit, ridge), 1))
        rows = jnp.concatenate([self.matrix * unit[None, :], below])
        left = self.matrix @ point + self.residual
        right = jnp.concatenate([left, jnp.where(free, self.damping * point, 0)])
        # The last column of the triangle is Qᵀ times the right-hand side.
        triangle = jnp.linalg.qr(jnp.column_stack([rows, right]), mode="r")
        step = jax.scipy.linalg.solve_triangular(triangle[:n, :n], triangle[:n, n])
        return -unit * step


class _State(eqx.Module):
    point: Float[Array, " n"]
    free: Bool[Array, " n"]
    done: Bool[Array, ""]
    steps: Int[Array, ""]


def _active_set(
    quadratic: _HessianForm | _SquaresForm,
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, " n"]:
    size = lower.size
    # Its slope is a sum of absolute summands, which determines a slope's rounding.
    absolute = jax.tree.map(jnp.abs, quadratic)
    start = jnp.clip(jnp.zeros_like(lower), lower, upper)
    # A multiplier this small is rounding; freeing its entry could cycle.
    small = 8 * jnp.finfo(lower.dtype).eps

    def step(state: _State) -> _State:
        newton = quadratic.newton(state.point, state.free)
        limit = jnp.where(newton > 0, upper, lower) - state.point
        moving = state.free & (newton != 0)
        fraction = jnp.where(moving, limit / jnp.where(moving, newton, 1), jnp.inf)
        blocking = jnp.argmin(fraction)
        blocked = fraction[blocking] < 1
        moved = state.point + jnp.minimum(fraction[blocking], 1) * newton
        moved = jnp.clip(moved, lower, upper)
        is_blocking = blocked & (jnp.arange(size) == blocking)
        at = jnp.where(newton > 0, upper, lower)
        moved = jnp.where(is_blocking, at, moved)

        # All free entries are optimal: does a multiplier of a held one have the wrong
        # sign?
        slope, noise = quadratic.slope(moved), small * absolute.slope(jnp.abs(moved))
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
