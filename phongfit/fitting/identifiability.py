"""Which unknowns the data leave open, from the Jacobian alone, and why, in words."""

import numpy as np

from phongfit.fitting.leaves import REFLECTANCES
from phongfit.fitting.unknowns import Unknowns


def unit_diagonal(bread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A matrix with a unit diagonal, and the roots of the old one (1 for 0)."""
    root = np.sqrt(np.diag(bread))
    root = np.where(root > 0, root, 1)
    return bread / np.outer(root, root), root


def threshold(resolution: float) -> float:
    """Eigenvalue of a normalised JᵀJ below which a direction is rounding alone."""
    return max((32 * resolution) ** 2, 1e-14)


def unfelt(
    bread: np.ndarray, unknowns: Unknowns, position: np.ndarray, resolution: float
) -> np.ndarray:
    """Unknowns that the samples do not feel.

    A logarithm moves light by shares of what there is, which may be far less than
    white: so it is compared with what the reflectances' own shares would move.
    """
    diagonal = np.diag(bread)
    largest = np.full(len(diagonal), max(diagonal.max(), 1e-300))
    reflectances = np.isin(unknowns.kinds, REFLECTANCES)
    if reflectances.any():
        shares = diagonal[reflectances] * np.minimum(position[reflectances] ** 2, 1)
        largest[unknowns.logarithmic] = max(shares.max(), 1e-300)
    return diagonal <= threshold(resolution) * largest


_SILENT = {
    "ambient": "no ambient light falls on a pixel that is used",
    "diffuse": "no light falls on a pixel that is used, or all of these are white",
    "specular": "no pixel that is used sees a highlight",
    "shininess": "there is no highlight: specular is 0, or no pixel sees it",
    "emission": "all pixels that are used are white",
}


def unidentified(
    bread: np.ndarray, unknowns: Unknowns, position: np.ndarray, resolution: float
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which unknowns the Jacobian leaves open, and why, in words."""
    labels = np.array(unknowns.y_labels)
    kinds = unknowns.kinds
    silent = unfelt(bread, unknowns, position, resolution)
    reasons = [
        f"{_listed(labels[silent & (kinds == kind)])} cannot be told: "
        + _SILENT.get(kind, "no pixel that is used depends on it")
        for kind in unknowns.names
        if (silent & (kinds == kind)).any()
    ]
    untold = silent.copy()
    heard = np.flatnonzero(~silent)
    if len(heard):
        scaled, _ = unit_diagonal(bread[np.ix_(heard, heard)])
        values, vectors = np.linalg.eigh(scaled)
        null = vectors[:, values <= threshold(resolution)]
        # Vectors of one null space mix: the projection tells who takes part.
        part = null @ null.T
        mixed = np.diag(part) > 1e-4
        untold[heard[mixed]] = True
        for group in linked_groups(np.abs(part) > 1e-4, mixed):
            names = _listed(labels[heard[group]])
            if "," not in names:
                names += ": its two angles"
            reasons.append(f"{names} cannot be told apart: they change the image alike")
    return untold, tuple(reasons)


def _listed(labels: np.ndarray) -> str:
    """Names, each once."""
    return ", ".join(dict.fromkeys(labels.tolist()))


def linked_groups(linked: np.ndarray, members: np.ndarray) -> list[np.ndarray]:
    """Connected groups among the members of a symmetric relation."""
    left = set(np.flatnonzero(members).tolist())
    groups = []
    while left:
        group, frontier = set(), {min(left)}
        while frontier:
            group |= frontier
            near = {int(j) for i in frontier for j in np.flatnonzero(linked[i])}
            frontier = (near & left) - group
        left -= group
        groups.append(np.array(sorted(group)))
    return groups
