"""Quantiles for intervals; SciPy is imported at their first use."""

import math


def student_reach(level: float, freedom: int) -> float:
    """Half width of the interval that contains Student's t with probability `level`.

    **Arguments:** `freedom`: degrees of freedom; fewer than 1 count as 1.
    """
    from scipy.special import stdtrit

    return float(stdtrit(max(freedom, 1), (1 + level) / 2))


def chi_squared_reach(deviations: float, count: int) -> float:
    r"""Level that $\chi^2$ of `count` numbers exceeds as rarely as one `deviations`.

    ??? cite "Source"
        Wilson and Hilferty, *The distribution of chi-square*, Proc. Natl. Acad. Sci.
        17, 1931. The approximation is too large: for three numbers by 5 % at 4
        deviations and 12 % at 6, for ten by 4 % at 6.
    """
    if count == 1:
        return deviations**2
    spread = 2 / (9 * count)
    return count * (1 - spread + deviations * spread**0.5) ** 3


def two_for_one(level: float) -> float:
    r"""Level of $\chi^2$ of two numbers with the tail probability of `level` for one.

    With the normal distribution's tail $Q$ it is $-2 \ln 2 Q(\sqrt l)$.
    """
    tail = math.erfc(math.sqrt(level / 2))
    # If the tail underflows, the two levels are nearly equal.
    return -2 * math.log(tail) if tail > 1e-300 else level


def fisher_quantile(level: float, count: int, freedom: int) -> float:
    """Quantile at `level` of Fisher's F with `count` and `freedom` degrees."""
    from scipy.special import fdtri

    return float(fdtri(count, max(freedom, 1), level))
