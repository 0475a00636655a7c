"""Start values of materials: groups of pixels that agree on an exponent and a ρ_s.

The costs of all pixels at a series of exponents form a table. Groups are found in it as
by k-means, from many starts.

??? cite "Source"
    Lloyd, *Least squares quantization in PCM*, IEEE Trans. Inf. Theory 28(2), 1982;
    Arthur and Vassilvitskii, *k-means++: the advantages of careful seeding*, 2007.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Largest increase of a pixel's cost: pixels further from every group are outliers.
FARTHEST = 30.0
BEGINNINGS = 12
ROUNDS = 20
# Quantiles of the pixels' ρ_s that are tried as start values.
QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)


class Table(NamedTuple):
    r"""Costs $c + h (\rho_s - \hat\rho_s)^2$ of pixels at each exponent.

    - `log_exponents`: (exponents,).
    - `cost` $c$, `strength` $\hat\rho_s$, `curvature` $h$: (exponents, pixels).
    """

    log_exponents: Float[np.ndarray, " exponents"]
    cost: Float[np.ndarray, "exponents pixels"]
    strength: Float[np.ndarray, "exponents pixels"]
    curvature: Float[np.ndarray, "exponents pixels"]

    def under(
        self, exponent: np.ndarray, strength: np.ndarray
    ) -> Float[np.ndarray, "groups pixels"]:
        """Increase of the pixels' costs from their lowest, under some materials.

        **Arguments:** `exponent`: row numbers; `strength`: ρ_s; both (groups,).
        """
        off = strength[:, None] - self.strength[exponent]
        cost = self.cost[exponent] + self.curvature[exponent] * off**2
        return np.minimum(cost - self.cost.min(axis=0), FARTHEST)


class Groups(NamedTuple):
    """Materials as rows of a [`Table`][] and ρ_s, with the total cost of all pixels."""

    exponent: np.ndarray
    strength: np.ndarray
    cost: float


def group(table: Table, count: int, highest: float) -> Groups:
    """The best of several groupings of the pixels into `count` groups.

    **Arguments:** `highest`: upper bound of ρ_s.
    """
    rng = np.random.default_rng(count)
    tried = [
        _settle(table, _begin(table, count, highest, rng, greedy=k == 0), highest)
        for k in range(BEGINNINGS if count > 1 else 1)
    ]
    return min(tried, key=lambda groups: groups.cost)


def _begin(
    table: Table, count: int, highest: float, rng: np.random.Generator, greedy: bool
) -> Groups:
    """Start groups, chosen one by one: the one that lowers the cost most, or at random.

    The probability of a random choice is proportional to the squared decrease.
    """
    levels = np.quantile(table.strength, QUANTILES, axis=1).T.clip(0, highest)
    levels = np.concatenate([levels, np.zeros((len(levels), 1))], axis=1)
    exponent = np.repeat(np.arange(len(levels)), levels.shape[1])
    strength = levels.ravel()
    costs = table.under(exponent, strength)
    chosen: list[int] = []
    current = np.full(costs.shape[1], FARTHEST)
    for _ in range(count):
        gain = np.maximum(current - costs, 0).sum(axis=1)
        if greedy or gain.sum() == 0:
            best = int(gain.argmax())
        else:
            best = int(rng.choice(len(gain), p=gain**2 / (gain**2).sum()))
        chosen.append(best)
        current = np.minimum(current, costs[best])
    return Groups(exponent[chosen], strength[chosen], np.inf)


def _settle(table: Table, groups: Groups, highest: float) -> Groups:
    """Alternate between assigning pixels to groups and refitting the groups."""
    for _ in range(ROUNDS):
        costs = table.under(groups.exponent, groups.strength)
        nearest, total = costs.argmin(axis=0), float(costs.min(axis=0).sum())
        if not total < groups.cost * (1 - 1e-6):
            break
        exponent, strength = groups.exponent.copy(), groups.strength.copy()
        for k in range(len(exponent)):
            # Outliers must not move a group.
            members = (nearest == k) & (costs[k] < FARTHEST)
            if members.any():
                exponent[k], strength[k] = _middle(table, members, highest)
        groups = Groups(exponent, strength, total)
    return groups


def _middle(table: Table, members: np.ndarray, highest: float) -> tuple[int, float]:
    """The exponent's row and the ρ_s of lowest total cost for some pixels."""
    h, s = table.curvature[:, members], table.strength[:, members]
    weight = h.sum(axis=1)
    mean = (h * s).sum(axis=1) / np.where(weight > 0, weight, 1)
    mean = mean.clip(0, highest)
    cost = table.cost[:, members] + h * (mean[:, None] - s) ** 2
    least = table.cost[:, members].min(axis=0)
    total = np.minimum(cost - least, FARTHEST).sum(axis=1)
    best = int(total.argmin())
    return best, float(mean[best])
