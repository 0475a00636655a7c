"""Diagnostics that need further solves of a fit: profiles, and its convergence."""

import dataclasses
from collections.abc import Sequence

from phongfit.fitting.uncertainty.convergence import Convergence
from phongfit.fitting.uncertainty.profile import Profile

MOST_PROFILES = 3
# A profile evaluates all samples about a hundred times, and so does the convergence.
MOST_SAMPLES = 1_000_000
# Parameters in the order in which they get a profile, before all others.
_FIRST = ("shininess", "specular", "diffuse")


@dataclasses.dataclass(frozen=True)
class Diagnostics:
    """The result of [`Fit`][]`.diagnose`.

    **Arguments:**

    - `chosen`: labels of the unknowns that are worth a profile, the exponent first.
    - `profiles`: profiles of as many of these as can be computed in seconds.
    - `convergence`: the cost step by step; `None` if there are too many samples.
    """

    chosen: tuple[str, ...]
    profiles: tuple[Profile, ...]
    convergence: Convergence | None


def choose_profiles(labels: Sequence[str], free: Sequence[str]) -> tuple[str, ...]:
    """Choose unknowns for profiles: a few, the exponent first, one of each kind.

    **Arguments:**

    - `labels`: labels of the identified unknowns.
    - `free`: labels of the solver's numbers; that of a direction occurs twice.
    """
    labels = [label for label in labels if free.count(label) == 1]
    kinds = {label: label.partition(".")[0].partition("[")[0] for label in labels}

    def order(label: str) -> int:
        kind = kinds[label]
        return _FIRST.index(kind) if kind in _FIRST else len(_FIRST)

    ordered = sorted(labels, key=order)
    firsts = {kinds[label]: label for label in reversed(ordered)}.values()
    return tuple(label for label in ordered if label in firsts)[:MOST_PROFILES]
