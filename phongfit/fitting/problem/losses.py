r"""Loss functions of residuals in standard deviations.

A loss is $\rho(z)$ with $z = (r/\sigma)^2$ and $\rho(z) \approx z$ for small $z$. The
constants give 95 % efficiency on Gaussian noise.

??? cite "Source"
    Holland and Welsch, *Robust regression using iteratively reweighted least-squares*,
    Commun. Stat. Theory Methods 6(9), 1977; Huber, *Robust statistics*, 1981.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.edge import is_number, shown

Values = Float[Array, "..."]


class AbstractLoss(eqx.Module):
    r"""A loss, written as the root $\tilde r = r \sqrt{\rho(r^2) / r^2}$.

    The sum of $\tilde r^2$ is the robust cost, so that a plain least-squares solver
    minimises it. `robust` is true for losses that expect outliers.
    """

    robust: ClassVar[bool]

    @abc.abstractmethod
    def ratio(self, z: Values) -> Values:
        r"""$\rho(z) / z$ for $z > 0$: 1 for small $z$, falling."""

    def root(self, residual: Values) -> Values:
        r"""$\tilde r$ for residuals in standard deviations, elementwise."""
        z = residual**2
        # For z below rounding the ratio is 1; computing it would be 0 / 0.
        large = z > jnp.finfo(z.dtype).eps
        ratio = jnp.where(large, self.ratio(jnp.where(large, z, 1)), 1)
        return residual * jnp.sqrt(ratio)

    def score(self, residual: Values) -> tuple[Values, Values]:
        r"""$\psi(r) = \tfrac12 \frac{d}{dr} \rho(r^2)$ and its slope, elementwise."""

        def psi(residual: Values) -> Values:
            return jax.grad(lambda r: jnp.sum(self.root(r) ** 2) / 2)(residual)

        return jax.jvp(psi, (residual,), (jnp.ones_like(residual),))

    def weight(self, residual: Values) -> Values:
        r"""Weight of a sample: $\psi(r) / r = \rho'(r^2)$.

        1 for small residuals (in standard deviations), 0 for rejected samples. A
        weighted least-squares fit with these weights has the same solution.
        """
        score, _ = self.score(residual)
        zero = residual == 0
        return jnp.where(zero, 1, score / jnp.where(zero, 1, residual))


def _tuning(default: float) -> Any:
    """Field for the tuning constant k of a loss, in standard deviations, checked."""
    return eqx.field(static=True, default=default, converter=_as_tuning)


def _as_tuning(value: Any) -> float:
    # Its square must neither underflow nor overflow in single precision.
    low, high = 1e-6, 1e6
    if not is_number(value) or not low <= value <= high:
        raise ValueError(
            f"k: expected a number from {low:g} to {high:g}, got {shown(value)}"
        )
    return float(value)


class Linear(AbstractLoss):
    r"""Least squares: $\rho(z) = z$."""

    robust: ClassVar[bool] = False

    def ratio(self, z: Values) -> Values:
        return jnp.ones_like(z)

    def score(self, residual: Values) -> tuple[Values, Values]:
        return residual, jnp.ones_like(residual)


class Huber(AbstractLoss):
    r"""$z$ up to $k^2$, then $2 k \sqrt z - k^2$: outliers have a limited influence."""

    robust: ClassVar[bool] = True
    k: float = _tuning(1.345)

    def ratio(self, z: Values) -> Values:
        outer = jnp.maximum(z, self.k**2)
        return jnp.where(z <= self.k**2, 1, (2 * self.k * outer**0.5 - self.k**2) / z)


class SoftL1(AbstractLoss):
    r"""$2 k^2 (\sqrt{1 + z/k^2} - 1)$: Huber's loss without the corner."""

    robust: ClassVar[bool] = True
    k: float = _tuning(1.345)

    def ratio(self, z: Values) -> Values:
        # (√(1+x) − 1) / x, in the form that does not cancel for small x.
        return 2 / (jnp.sqrt(1 + z / self.k**2) + 1)


class Cauchy(AbstractLoss):
    r"""$k^2 \ln(1 + z/k^2)$: the influence decreases for large residuals."""

    robust: ClassVar[bool] = True
    k: float = _tuning(2.385)

    def ratio(self, z: Values) -> Values:
        x = z / self.k**2
        return jnp.log1p(x) / x


class Tukey(AbstractLoss):
    r"""$\tfrac{k^2}{3} (1 - (1 - z/k^2)^3)$, then constant: outliers have no influence.

    It needs a good starting point, which [`fit`][] provides.
    """

    robust: ClassVar[bool] = True
    k: float = _tuning(4.685)

    def ratio(self, z: Values) -> Values:
        inside = jnp.minimum(z / self.k**2, 1)
        # (1 − (1−x)³) / 3 = x − x² + x³/3, divided by z = k² x where x < 1.
        return (inside - inside**2 + inside**3 / 3) * self.k**2 / z


LOSSES: dict[str, AbstractLoss] = {
    "linear": Linear(),
    "huber": Huber(),
    "soft_l1": SoftL1(),
    "cauchy": Cauchy(),
    "tukey": Tukey(),
}


def as_loss(value: str | AbstractLoss) -> AbstractLoss:
    """A loss from its name, or the loss itself; `ValueError` for anything else."""
    if isinstance(value, AbstractLoss):
        return value
    if not isinstance(value, str) or value not in LOSSES:
        names = ", ".join(LOSSES)
        raise ValueError(f"loss: expected one of {names}, got {shown(value)}")
    return LOSSES[value]
