"""Unknowns that the data do not identify, by rank and by highlights, with warnings."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from phongfit.codes import coded
from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS, REFLECTANCES
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.uncertainty.quantiles import chi_squared_reach
from phongfit.fitting.uncertainty.sandwich import (
    Sandwich,
    as_quadratic,
    threshold,
    unit_diagonal,
)

# Standard errors above which a highlight counts as seen. More than 3, since its
# exponent is chosen to fit best.
SEEN = 4.0
# Standard errors of a highlight below which noise may have determined its exponent.
PLAIN = SEEN + 2


def unfelt(
    bread: np.ndarray, unknowns: Unknowns, position: np.ndarray, resolution: float
) -> np.ndarray:
    """Unknowns on which no sample depends.

    The derivative in a logarithm is relative to the light, which may be far less than
    white. So it is compared with relative changes of the reflectances.
    """
    diagonal = np.diag(bread)
    largest = np.full(len(diagonal), max(diagonal.max(), 1e-300))
    reflectances = np.isin(unknowns.y_parameter, REFLECTANCES)
    if reflectances.any():
        shares = diagonal[reflectances] * np.minimum(position[reflectances] ** 2, 1)
        largest[unknowns.logarithmic] = max(shares.max(), 1e-300)
    return diagonal <= threshold(resolution) * largest


# Reasons why no sample depends on a parameter, and remedies.
_SILENT = {
    "ambient": (
        "no ambient light falls on a pixel that is used",
        "Leave ambient out of unknowns, or give the scene its ambient light",
    ),
    "diffuse": (
        "no light falls on a pixel that is used, or all of these are white",
        "Use pixels that are lit and not white: another mask, exposure or light",
    ),
    "specular": (
        "no pixel that is used sees a highlight",
        "Move a light or the camera so that one is seen, or leave specular and "
        "shininess out of unknowns",
    ),
    "emission": ("all pixels that are used are white", "Expose less"),
}


def find_unidentified(
    bread: np.ndarray, unknowns: Unknowns, position: np.ndarray, resolution: float
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Unknowns that the Jacobian does not determine, and warnings with the reasons."""
    labels = np.array(unknowns.free_labels)
    parameters = unknowns.y_parameter
    silent = unfelt(bread, unknowns, position, resolution) & ~unknowns.y_nuisance
    reasons = [
        _silent(kind, labels[silent & (parameters == kind)])
        for kind in unknowns.sought
        if (silent & (parameters == kind)).any()
    ]
    unidentified = silent.copy()
    heard = np.flatnonzero(~silent)
    if len(heard):
        scaled, _ = unit_diagonal(bread[np.ix_(heard, heard)])
        values, vectors = np.linalg.eigh(scaled)
        null = vectors[:, values <= threshold(resolution)]
        # Vectors of a null space are not unique, but the projection onto it is.
        part = null @ null.T
        mixed = np.diag(part) > 1e-4
        unidentified[heard[mixed]] = True
        for group in linked_groups(np.abs(part) > 1e-4, mixed):
            names = _listed(labels[heard[group]])
            if "," not in names:
                names += ": its two angles"
            words = f"{names} are degenerate: they change the image in the same way"
            reasons.append(coded("degenerate", words))
    return unidentified, tuple(reasons)


def _silent(kind: str, labels: np.ndarray) -> str:
    """Warning on numbers of a parameter on which no sample depends."""
    if kind == "shininess":
        why = "there is no highlight: specular is 0, or no pixel sees it"
        return coded("no-highlight", f"{not_identifiable(labels)}: {why}")
    why, remedy = _SILENT.get(kind, ("no pixel that is used depends on it", None))
    return coded("not-identifiable", f"{not_identifiable(labels)}: {why}", remedy)


def not_identifiable(labels: np.ndarray | Sequence[str]) -> str:
    """`a is not identifiable`, or `a, b are not identifiable`."""
    names = _listed(labels)
    return f"{names} {'are' if ',' in names else 'is'} not identifiable"


def _listed(labels: np.ndarray | Sequence[str]) -> str:
    """Names without duplicates, separated by commas."""
    return ", ".join(dict.fromkeys(map(str, labels)))


def linked_groups(linked: np.ndarray, members: np.ndarray) -> list[np.ndarray]:
    """Connected groups among the members of a symmetric relation."""
    # Imported here, since SciPy takes long to import and few fits need it.
    from scipy.sparse.csgraph import connected_components

    own = np.flatnonzero(members)
    count, group = connected_components(linked[np.ix_(own, own)], directed=False)
    return [own[group == k] for k in range(count)]


def doubtful_exponents(
    unknowns: Unknowns, position: Float[np.ndarray, " n"], sandwich: Sandwich
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Exponents of highlights that are not seen, and of those that are faint.

    For each material the ρ_s of its colours are tested, each alone and all together. A
    specular model's parameters count as exponents of all materials.

    **Arguments:** `position`, `sandwich`: the solution, and the sums there.
    """
    parameters, materials = unknowns.y_parameter, unknowns.y_material
    unseen, faint = np.zeros((2, len(position)), bool)
    hidden, plain = [], False
    specular = parameters == "specular"
    if not specular.any() or not unknowns.shapes.any():
        return unseen, faint
    # An unknown light scales a highlight, but does not create one.
    felt = ~unfelt(sandwich.inside, unknowns, position, sandwich.resolution)
    group = np.flatnonzero(np.isin(parameters, MATERIAL_PARAMETERS) & felt)
    part = sandwich.part(group)
    covariance = part.covariance()
    for material in np.unique(materials[specular]):
        own = materials == material
        colours = np.flatnonzero(specular[group] & own[group])
        height = position[group[colours]]
        exponents = own & (parameters == "shininess")
        together = covariance[np.ix_(colours, colours)]
        if stands_out(height, together, PLAIN):
            plain = True
            continue
        if stands_out(height, together, SEEN) or _cannot_be_none(
            unknowns, position, part, group, colours
        ):
            faint |= exponents
        else:
            unseen |= exponents
            hidden.append(material)
    # Parameters that shape the highlights of all materials need one visible highlight.
    shared = unknowns.shapes & ~unknowns.logarithmic
    if len(hidden) == len(np.unique(materials[specular])):
        unseen |= shared
    elif not plain:
        faint |= shared
    return unseen, faint


def stands_out(
    height: Float[np.ndarray, " k"],
    covariance: Float[np.ndarray, "k k"],
    deviations: float,
    chosen: int = 0,
) -> bool:
    """Whether one height, or all together, exceed so many standard errors.

    The threshold for all together is exceeded by chance as rarely as that for one.

    **Arguments:** `chosen`: number of other unknowns that were fitted to maximise them.
    """
    if not len(height):
        return False
    error = np.sqrt(np.maximum(np.diag(covariance), 0))
    if not chosen and np.any(height >= deviations * error):
        return True
    distance = height @ np.linalg.pinv(covariance, hermitian=True) @ height
    return bool(distance >= chi_squared_reach(deviations, len(height) + chosen))


def _cannot_be_none(
    unknowns: Unknowns,
    position: Float[np.ndarray, " n"],
    part: Sandwich,
    group: np.ndarray,
    colours: np.ndarray,
) -> bool:
    """Whether any ρ_s cannot be 0, with the other unknowns within their bounds."""
    here = position[group]
    lower, upper = (
        np.asarray(edge, float)[group] - here
        for edge in (unknowns.lower, unknowns.upper)
    )
    lower[colours] = -np.inf
    along = np.eye(len(group))[colours]
    low = as_quadratic(part, lower, upper).ends(along, SEEN**2)[:, 0]
    return bool(np.any(here[colours] + low >= 0))
