"""What a warning is about, found from its words: the one place that knows them."""

import collections
import enum
import functools
import re
from collections.abc import Sequence

from experiments.honesty.answers import REFUSED


class Subject(enum.Enum):
    """What a warning is about."""

    FIT = "the model, the noise or the residuals: no number is to be trusted"
    BOUND = "an estimate at its bound: its own error is one-sided"
    OPEN = "what is not identifiable: its error is infinite"
    REFUSED = "no answer was given"
    UNKNOWN = "nobody has said"


# The first that is found in a sentence decides.
_WORDS = (
    (Subject.REFUSED, f"^{REFUSED}"),
    # A highlight thrown away is no gap in the data, but a doubt about the fit.
    (Subject.FIT, r"highlight for outliers"),
    (
        Subject.OPEN,
        r"not identif|nothing is identif|degenerate|(may|can|could) be any"
        r"|^flag: (degenerate|no highlight|too few|black)",
    ),
    (Subject.FIT, r"\bbound\b.* decides"),
    (Subject.BOUND, r"\bat (its|the|a)\b.*\bbound\b|^flag: at bound"),
    (
        Subject.FIT,
        r"not converge|not noise|not describe|lack of fit|misfit"
        r"|noise .*(wrong|too|larger|smaller)|errors are (too small|widened)"
        r"|outlier|reject|jpeg|prior|saturat|clipped|white|^flag: not converged",
    ),
)
_PATTERNS = [(subject, re.compile(words, re.IGNORECASE)) for subject, words in _WORDS]

Warnings = Sequence[tuple[str, ...]]
"""The sentences of every draw."""


@functools.lru_cache(2**16)
def subject_of(warning: str) -> Subject:
    """What one sentence of `fit.warnings` is about."""
    for subject, pattern in _PATTERNS:
        if pattern.search(warning):
            return subject
    return Subject.UNKNOWN


def is_doubtful(warning: str) -> bool:
    """Whether a sentence says that the numbers as a whole are not to be trusted."""
    return subject_of(warning) in (Subject.FIT, Subject.REFUSED)


def doubts(warnings: Warnings, most: int = 5) -> dict[str, int]:
    """Sentences that doubt a draw, numbers left out, and how many draws had each."""
    count = collections.Counter(
        words
        for said in warnings
        for words in {_without_numbers(one) for one in said if is_doubtful(one)}
    )
    return dict(count.most_common(most))


def unknown_words(warnings: Warnings, most: int = 3) -> list[str]:
    """Sentences that no pattern knows, each once."""
    found = {one for said in set(warnings) for one in said}
    unknown = {one for one in found if subject_of(one) is Subject.UNKNOWN}
    return sorted({_without_numbers(one) for one in unknown})[:most]


def _without_numbers(words: str) -> str:
    return re.sub(r"\d+", "#", words)
