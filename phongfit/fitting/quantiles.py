"""Quantiles that intervals rest on; SciPy is imported by who asks for one."""


def student_reach(level: float, freedom: int) -> float:
    """Half width of the interval that holds Student's t with a chance of `level`.

    **Arguments:** `freedom`: degrees of freedom; fewer than 1 count as 1.
    """
    from scipy.special import stdtrit

    return float(stdtrit(max(freedom, 1), (1 + level) / 2))


def fisher_quantile(level: float, count: int, freedom: int) -> float:
    """What Fisher's F with `count` and `freedom` degrees stays below by `level`."""
    from scipy.special import fdtri

    return float(fdtri(count, max(freedom, 1), level))
