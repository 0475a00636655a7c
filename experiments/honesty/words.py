"""The subject of each warning, by its code."""

import collections
import enum
import re
from collections.abc import Sequence

import phongfit as pf
from experiments.honesty.answers import REFUSED

FLAG = "flag: "


class Subject(enum.Enum):
    """Subject of a warning."""

    FIT = "the model, the noise or the residuals: no number is to be trusted"
    BOUND = "an estimate at its bound: its own error is one-sided"
    OPEN = "what is not identifiable: its error is infinite"
    REFUSED = "no answer was given"
    UNKNOWN = "nobody has said"


SUBJECTS = {
    "not-converged": Subject.FIT,
    "lack-of-fit": Subject.FIT,
    "jpeg-blocks": Subject.FIT,
    "coarse-jpeg": Subject.FIT,
    "jpeg-texels": Subject.FIT,
    "noise-level": Subject.FIT,
    "low-white": Subject.FIT,
    "encoding-doubtful": Subject.FIT,
    "few-unclipped": Subject.FIT,
    "outliers": Subject.FIT,
    "prior-conflict": Subject.FIT,
    "moving-edge": Subject.FIT,
    "bound-decides": Subject.FIT,
    "two-solutions": Subject.FIT,
    # A rejected highlight casts doubt on the fit; it is not a gap in the data.
    "rejected-highlight": Subject.FIT,
    "bulging-normals": Subject.FIT,
    "broad-highlights": Subject.FIT,
    "pixels-misplaced": Subject.FIT,
    "materials-run-out": Subject.FIT,
    "strengths-doubtful": Subject.FIT,
    "at-bound": Subject.BOUND,
    "not-identifiable": Subject.OPEN,
    "no-highlight": Subject.OPEN,
    "degenerate": Subject.OPEN,
    "all-white": Subject.OPEN,
    "drawn-errors": Subject.OPEN,
    # Flags of a map's pixels.
    f"{FLAG}misfit": Subject.FIT,
    f"{FLAG}not converged": Subject.FIT,
    f"{FLAG}at bound": Subject.BOUND,
    f"{FLAG}degenerate": Subject.OPEN,
    f"{FLAG}no highlight": Subject.OPEN,
    f"{FLAG}too few": Subject.OPEN,
    f"{FLAG}black": Subject.OPEN,
}

Warnings = Sequence[tuple[str, ...]]
"""The sentences of every draw."""


def subject_of(warning: str) -> Subject:
    """The subject of a sentence of `fit.warnings`, or of a pixel's flag."""
    if warning.startswith(REFUSED):
        return Subject.REFUSED
    return SUBJECTS.get(_key(warning), Subject.UNKNOWN)


def is_doubtful(warning: str) -> bool:
    """Whether a warning casts doubt on all numbers of a fit."""
    return subject_of(warning) in (Subject.FIT, Subject.REFUSED)


def doubts(warnings: Warnings, most: int = 5) -> dict[str, int]:
    """Codes of warnings that cast doubt on a draw, and how many draws had each."""
    count = collections.Counter(
        key
        for said in warnings
        for key in {_key(one) for one in said if is_doubtful(one)}
    )
    return dict(count.most_common(most))


def unknown_words(warnings: Warnings, most: int = 3) -> list[str]:
    """Warnings whose code is not in `SUBJECTS`, each once."""
    found = {one for said in set(warnings) for one in said}
    unknown = {one for one in found if subject_of(one) is Subject.UNKNOWN}
    return sorted({_without_numbers(one) for one in unknown})[:most]


def _key(warning: str) -> str:
    """A warning's code; without one the sentence with its numbers replaced."""
    return pf.warning_code(warning) or _without_numbers(warning)


def _without_numbers(words: str) -> str:
    return re.sub(r"\d+", "#", words)
