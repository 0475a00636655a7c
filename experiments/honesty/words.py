"""Subjects of warnings, by their code: the fit, a bound, or an open parameter."""

import collections
import enum
import re
from collections.abc import Sequence

import phongfit as pf
from experiments.honesty.answers import REFUSED

FLAG = "flag: "
"""Beginning of the sentence for a pixel's flag."""


class WarningSubject(enum.Enum):
    """Subject of a warning: the numbers on which it casts doubt."""

    FIT = "the model, the noise or the residuals: no number is to be trusted"
    BOUND = "an estimate at its bound: its own error is one-sided"
    OPEN = "what is not identifiable: its error is infinite"
    REFUSED = "no answer was given"
    UNKNOWN = "a code that is not in SUBJECTS"


SUBJECTS = {
    "not-converged": WarningSubject.FIT,
    "lack-of-fit": WarningSubject.FIT,
    "jpeg-blocks": WarningSubject.FIT,
    "coarse-jpeg": WarningSubject.FIT,
    "jpeg-texels": WarningSubject.FIT,
    "noise-level": WarningSubject.FIT,
    "low-white": WarningSubject.FIT,
    "encoding-doubtful": WarningSubject.FIT,
    "few-unclipped": WarningSubject.FIT,
    "outliers": WarningSubject.FIT,
    "prior-conflict": WarningSubject.FIT,
    "moving-edge": WarningSubject.FIT,
    "bound-decides": WarningSubject.FIT,
    "two-solutions": WarningSubject.FIT,
    # A rejected highlight casts doubt on the fit; it is not a gap in the data.
    "rejected-highlight": WarningSubject.FIT,
    "bulging-normals": WarningSubject.FIT,
    "broad-highlights": WarningSubject.FIT,
    "pixels-misplaced": WarningSubject.FIT,
    "materials-run-out": WarningSubject.FIT,
    "strengths-doubtful": WarningSubject.FIT,
    "at-bound": WarningSubject.BOUND,
    "not-identifiable": WarningSubject.OPEN,
    "no-highlight": WarningSubject.OPEN,
    "degenerate": WarningSubject.OPEN,
    "all-white": WarningSubject.OPEN,
    # Flags of a map's pixels.
    f"{FLAG}misfit": WarningSubject.FIT,
    f"{FLAG}not converged": WarningSubject.FIT,
    f"{FLAG}at bound": WarningSubject.BOUND,
    f"{FLAG}degenerate": WarningSubject.OPEN,
    f"{FLAG}no highlight": WarningSubject.OPEN,
    f"{FLAG}too few": WarningSubject.OPEN,
    f"{FLAG}black": WarningSubject.OPEN,
}

Warnings = Sequence[tuple[str, ...]]
"""For each draw, its warnings as sentences."""


def subject_of(warning: str) -> WarningSubject:
    """The subject of a sentence of `fit.warnings`, or of a pixel's flag."""
    if warning.startswith(REFUSED):
        return WarningSubject.REFUSED
    return SUBJECTS.get(_key(warning), WarningSubject.UNKNOWN)


def is_doubtful(warning: str) -> bool:
    """Whether a warning casts doubt on all numbers of a fit, or replaces its answer."""
    return subject_of(warning) in (WarningSubject.FIT, WarningSubject.REFUSED)


def count_doubts(warnings: Warnings, most: int = 5) -> dict[str, int]:
    """Codes of warnings that cast doubt on a draw, and how many draws had each.

    Only the `most` frequent ones.
    """
    count = collections.Counter(
        key
        for sentences in warnings
        for key in {_key(one) for one in sentences if is_doubtful(one)}
    )
    return dict(count.most_common(most))


def unknown_warnings(warnings: Warnings, most: int = 3) -> list[str]:
    """Warnings whose code is not in `SUBJECTS`, each once, and at most `most`."""
    distinct = {one for sentences in set(warnings) for one in sentences}
    unknown = {one for one in distinct if subject_of(one) is WarningSubject.UNKNOWN}
    return sorted({_without_numbers(one) for one in unknown})[:most]


def _key(warning: str) -> str:
    """A warning's code; if it has none, the sentence with "#" for every number."""
    return pf.warning_code(warning) or _without_numbers(warning)


def _without_numbers(sentence: str) -> str:
    """The sentence with "#" for each whole number, so that draws give the same one."""
    return re.sub(r"\d+", "#", sentence)
