"""Marks of every number of the draws, such as far off, and of every draw."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from experiments.honesty.answers import Answers
from experiments.honesty.chance import Each
from experiments.honesty.words import is_doubtful

FAR = 5.0
"""An estimate is far off if it is more than this many standard errors from the truth.
At a bound the error is one-sided and may have an exponential tail, so the limit there
is the square of this."""

# Standard deviations of a normal distribution that a 95 % interval reaches.
REACH = 1.96
# Relative deviations below this are rounding errors.
ROUNDING = 1e-12


@dataclasses.dataclass(frozen=True)
class Marks:
    """Marks that compare estimates with the truth.

    Of each estimate:

    - `finite`: it has a finite error;
    - `trusted`: its error is finite and its draw has no warning about the fit;
    - `covered`: its interval contains the truth;
    - `on_bound`: it is trusted and lies on its bound;
    - `off`: it is far from the truth, see `FAR`.

    Of each draw, `warned`: it has a warning about the fit, or no answer.
    """

    finite: Each
    trusted: Each
    covered: Each
    on_bound: Each
    off: Each
    warned: Bool[np.ndarray, " draws"]

    @property
    def interior(self) -> Each:
        """Estimates that are trusted and not on a bound."""
        return self.trusted & ~self.on_bound

    @property
    def beside_bound(self) -> Each:
        """Estimates of `interior`, in draws where another one lies on its bound."""
        return self.interior & self.on_bound.any(axis=1, keepdims=True)

    @property
    def far(self) -> Bool[np.ndarray, " draws"]:
        """Draws in which an estimate with a finite error is far off."""
        return np.any(self.off & self.finite, axis=1)

    @property
    def misled(self) -> Bool[np.ndarray, " draws"]:
        """Draws of `far` without a warning about the fit."""
        return self.far & ~self.warned


def compare(answers: Answers) -> Marks:
    """Compare answers with the truth, and classify their warnings."""
    warned = np.array([any(map(is_doubtful, words)) for words in answers.warnings])
    finite = np.isfinite(answers.error)
    truth, deviation = answers.truth, np.abs(answers.estimate - answers.truth)
    rounding = ROUNDING * np.abs(truth)
    trusted = finite & ~warned[:, None]
    # An interval may be asymmetric: the error is at least that of its side towards the
    # truth. `fmax` ignores an interval that is NaN.
    side = np.where(truth > answers.estimate, answers.high, answers.low)
    error = np.fmax(answers.error, np.abs(side - answers.estimate) / REACH)
    reach = np.where(answers.at_bound, FAR**2, FAR) * error
    # If the truth is outside the bounds, an estimate at its bound is not off.
    outside = (truth < answers.bounds[:, 0]) | (truth > answers.bounds[:, 1])
    return Marks(
        finite=finite,
        trusted=trusted,
        covered=(answers.low <= truth + rounding) & (truth - rounding <= answers.high),
        on_bound=trusted & answers.at_bound,
        # Negated, so that an estimate of NaN is far off.
        off=~(deviation <= reach + rounding) & ~(outside & answers.at_bound),
        warned=warned,
    )
