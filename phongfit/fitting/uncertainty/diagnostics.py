"""What is known of a fit only by solving it further: profiles, and its way down."""

import dataclasses
from collections.abc import Sequence

from phongfit.fitting.uncertainty.convergence import Convergence
from phongfit.fitting.uncertainty.profile import Profile

MOST_PROFILES = 3
# A profile goes through all samples about a hundred times; so does the way down.
MOST_SAMPLES = 1_000_000
# The first of these that are identified; then the others, one of each kind.
_FIRST = ("shininess", "specular", "diffuse")


@dataclasses.dataclass(frozen=True)
class Diagnostics:
    """What [`Fit`][]`.diagnose` gives.

    **Arguments:**

    - `chosen`: labels of the unknowns that are worth a profile, the exponent first.
    - `profiles`: of as many of these as samples allow in seconds.
    - `convergence`: the cost step by step; `None` of too many samples.
    """

    chosen: tuple[str, ...]
    profiles: tuple[Profile, ...]
    convergence: Convergence | None


def choose_profiles(labels: Sequence[str], free: Sequence[str]) -> tuple[str, ...]:
    """Which unknowns get a profile: a few, the exponent first, one of each kind.

    **Arguments:**

    - `labels`: of what is identified.
    - `free`: labels of the numbers that the solver finds; a direction has one twice.
    """
    labels = [label for label in labels if free.count(label) == 1]
    kinds = {label: label.partition(".")[0].partition("[")[0] for label in labels}

    def order(label: str) -> int:
        kind = kinds[label]
        return _FIRST.index(kind) if kind in _FIRST else len(_FIRST)

    ordered = sorted(labels, key=order)
    firsts = {kinds[label]: label for label in reversed(ordered)}.values()
    return tuple(label for label in ordered if label in firsts)[:MOST_PROFILES]
