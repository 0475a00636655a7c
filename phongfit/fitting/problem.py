"""The least-squares problem: residuals in standard deviations, and how it is solved."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from phongfit.fitting.losses import AbstractLoss
from phongfit.fitting.noise import clipped_mean, clipped_variance_share
from phongfit.fitting.samples import Samples
from phongfit.fitting.solver import BoundedLevenbergMarquardt
from phongfit.fitting.unknowns import Unknowns


class Problem(eqx.Module):
    """Samples, unknowns, and how much each sample's residual counts."""

    samples: Samples
    unknowns: Unknowns
    sigma: Float[Array, ""]
    loss: AbstractLoss
    clamp: bool = eqx.field(static=True)

    def noise(self) -> Float[Array, "n 3"]:
        """Standard deviation of each sample before rounding; 1 where it is left out."""
        used = self.samples.weight > 0
        return jnp.where(
            used, self.sigma / jnp.sqrt(jnp.where(used, self.samples.weight, 1)), 1
        )

    def predict(self, y: Float[Array, " n"]) -> Float[Array, "samples 3"]:
        """Mean of what the film shows of each sample."""
        light = self.samples.light(self.unknowns.material(y))
        return clipped_mean(light, self.noise()) if self.clamp else light

    def deviation(self) -> Float[Array, "samples 3"]:
        """Standard deviation of each sample, rounding included."""
        return jnp.sqrt(self.noise() ** 2 + self.samples.step**2 / 12)

    def residual(self, y: Float[Array, " n"]) -> Float[Array, "samples 3"]:
        """(model − image) in standard deviations; 0 where a sample is left out."""
        difference = (self.predict(y) - self.samples.target) / self.deviation()
        return jnp.where(self.samples.weight > 0, difference, 0)


class Solution(eqx.Module):
    """Where the solver stopped, and why."""

    y: Float[Array, " n"]
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Array


@eqx.filter_jit
def solve(problem: Problem, start: Float[Array, " n"], max_steps: int) -> Solution:
    """Bounded Levenberg-Marquardt from `start`; failure is data, not an exception."""

    def residual(y: Array, args: None) -> Array:
        del args
        return problem.loss.root(problem.residual(y))

    resolution = float(jnp.finfo(start.dtype).eps)
    tolerance = max(resolution**0.7, 1e-8)
    solver = BoundedLevenbergMarquardt(
        rtol=tolerance,
        # In standard deviations: below the rounding of the prediction nothing counts.
        atol=tolerance + 8 * resolution / problem.sigma,
        lower=problem.unknowns.lower,
        upper=problem.unknowns.upper,
    )
    solution = optx.least_squares(
        residual, solver, start, max_steps=max_steps, throw=False
    )
    cost = 2 * solution.state.f_info.as_min()
    done = solution.result == optx.RESULTS.successful
    return Solution(
        solution.value, cost, solution.stats["num_steps"], done & jnp.isfinite(cost)
    )


class Evaluation(eqx.Module):
    """What is left over at a point, sample by sample."""

    difference: Float[Array, "samples 3"]
    residual: Float[Array, "samples 3"]
    noise: Float[Array, "samples 3"]
    deviation: Float[Array, "samples 3"]
    variance_share: Float[Array, "samples 3"]


Evaluation.__init__.__doc__ = """**Arguments:**

- `difference`: model − image in linear light; 0 where a sample is left out.
- `residual`: the same in standard deviations.
- `noise`, `deviation`: standard deviations before and after rounding.
- `variance_share`: what clipping leaves of the noise's variance, 0 … 1.
"""


@eqx.filter_jit
def evaluate(problem: Problem, y: Float[Array, " n"]) -> Evaluation:
    """Differences between model and image, and what noise they are measured by."""
    used = problem.samples.weight > 0
    noise = problem.noise()
    light = problem.samples.light(problem.unknowns.material(y))
    share = jnp.ones_like(light)
    if problem.clamp:
        share = clipped_variance_share(light, noise)
    return Evaluation(
        jnp.where(used, problem.predict(y) - problem.samples.target, 0),
        problem.residual(y),
        noise,
        problem.deviation(),
        jnp.where(used, share, 0),
    )


@eqx.filter_jit
def linearize(
    problem: Problem, y: Float[Array, " n"]
) -> tuple[Float[Array, "unknowns samples 3"], Array, Array]:
    r"""The Jacobian of the residuals, and the loss's $\psi$ and $\psi'$ there."""
    residual, derivative = jax.linearize(problem.residual, y)
    jacobian = jax.vmap(derivative)(jnp.eye(y.size, dtype=y.dtype))

    def psi(r: Array) -> Array:
        return jax.grad(lambda r: jnp.sum(problem.loss.root(r) ** 2) / 2)(r)

    score, slope = jax.jvp(psi, (residual,), (jnp.ones_like(residual),))
    return jacobian, score, slope
