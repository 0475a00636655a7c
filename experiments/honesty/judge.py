"""Verdict on a situation, from the answers of its draws.

- Unless the model is wrong: 95 % intervals must contain the truth in at least 92 % of
  the cases with a finite error and without a warning about the fit: over all
  parameters, and for each of them. Over all it must also be at most 98 %, unless the
  situation allows wide intervals or an estimate lies on its bound. In draws with an
  estimate at its bound, intervals of the other parameters must contain it in 80 %.
- At most 1 % of the draws may have an estimate that is far off and no warning about the
  fit: of all draws, or for a wrong model of those that are far off.
- With a right model, at most 1 % of the draws may have a warning about the fit; and if
  all parameters are identifiable, at most 20 % of the errors may be infinite.
- In at most 1 % of the draws, a parameter that the data do not identify may have a
  small error.
- Where a situation names a warning, at most 1 % of the draws may lack it.

For intervals, false alarms and small errors the limits are wider if there are few
draws, by the sampling error of a fraction: see `experiments/honesty/chance.py`.
"""

import dataclasses
from typing import Literal

import numpy as np

from experiments.honesty.answers import Answers
from experiments.honesty.chance import Each, coverage_limits, fraction, too_many
from experiments.honesty.marks import FAR, Marks, compare
from experiments.honesty.words import count_doubts, unknown_warnings

Kind = Literal["right", "open", "doubtful", "wrong"]
"""What is expected of the fits of a situation.

- `right`: the model is right, so answers are right and have no warning;
- `open`: the model is right, and the data cannot identify some parameter;
- `doubtful`: an answer is right or has a warning;
- `wrong`: the model is wrong, and an answer that is far off has a warning."""

# Kinds with a right model, in which a warning about the fit is a false alarm.
RIGHT_KINDS = ("right", "open")
# Range of the fraction of 95 % intervals that contain the truth: in general, and for
# parameters beside another one that is on its bound.
COVERAGE = (0.92, 0.98)
COVERAGE_BESIDE_BOUND = (0.8, 1.0)
# Largest fraction of the draws of a right model that may have a warning about the fit.
MAX_FALSE_ALARMS = 0.01
# Largest fraction of draws that may mislead, or lack a warning that is required.
MAX_MISSING_WARNINGS = 0.01
# An error is small if the interval takes less than this fraction of the range between
# the parameter's bounds.
SMALL_INTERVAL = 0.25
# Largest fraction of infinite errors where all parameters are identifiable.
MAX_INFINITE = 0.2


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Summary of the draws of one situation; NaN where nothing could be judged.

    - `coverage`: fraction of the intervals that contain the truth, in draws without a
        warning about the fit: over all parameters; `at_bound`: over those on a bound;
        `beside_bound`: over the other parameters of such draws;
    - `worst`, `worst_label`: coverage and label of the parameter with the lowest one;
    - `pulls`: root mean square of (estimate − truth) / error, away from the bounds;
    - `warned`: fraction of draws with a warning about the fit, or without an answer;
    - `far`: fraction of draws with an estimate far off, see `FAR`;
        `misled`: fraction of draws that are, and have no warning about the fit;
    - `infinite`: fraction of the standard errors that are infinite;
    - `faults`: criteria that are not met, as sentences; `notes`: remarks;
    - `codes`: codes of warnings about the fit, and how many draws had each.
    """

    draws: int
    coverage: float
    at_bound: float
    beside_bound: float
    worst: float
    worst_label: str
    pulls: float
    warned: float
    far: float
    misled: float
    infinite: float
    faults: tuple[str, ...]
    notes: tuple[str, ...]
    codes: dict[str, int]


def judge(
    answers: Answers,
    kind: Kind,
    unidentifiable: tuple[str, ...] = (),
    wide: bool = False,
    required_warning: str = "",
) -> Verdict:
    """The verdict on one situation.

    **Arguments:**

    - `kind`: what is expected of the fits, see [`Kind`][].
    - `unidentifiable`: parameters that the data cannot identify: labels, or names such
        as `"specular"` for all channels.
    - `wide`: whether intervals may contain the truth too often here.
    - `required_warning`: part of a warning, such as a code, that every draw must have.
    """
    marks, labels = compare(answers), answers.labels
    too_wide = kind != "wrong" and _too_wide(marks)
    allowed = wide or bool(marks.on_bound.any())
    worst, worst_label = _lowest_coverage(labels, marks)
    faults = [
        *(_short_intervals(labels, marks) if kind != "wrong" else ()),
        *(["intervals are too wide"] if too_wide and not allowed else ()),
        *_missing_warnings(marks, kind),
        *(_false_alarms(marks, kind) if kind in RIGHT_KINDS else ()),
        *_overconfident_errors(answers, unidentifiable, ~marks.warned),
        *_missing_required(answers, required_warning),
        *(
            f"a warning of unknown kind: {sentence}"
            for sentence in unknown_warnings(answers.warnings)
        ),
    ]
    notes = [
        *(["wide"] if too_wide and allowed else ()),
        *(["harmless"] if kind == "wrong" and not marks.far.any() else ()),
    ]
    return Verdict(
        draws=len(marks.warned),
        coverage=fraction(marks.covered, marks.trusted),
        at_bound=fraction(marks.covered, marks.on_bound),
        beside_bound=fraction(marks.covered, marks.beside_bound),
        worst=worst,
        worst_label=worst_label,
        pulls=_pulls(answers, marks.interior),
        warned=fraction(marks.warned),
        far=fraction(marks.far),
        misled=fraction(marks.misled),
        infinite=fraction(~marks.finite),
        faults=tuple(faults),
        notes=tuple(notes),
        codes=count_doubts(answers.warnings),
    )


def _too_wide(marks: Marks) -> bool:
    """Whether intervals contain the truth more often than they should."""
    _, upper = coverage_limits(marks.covered, marks.trusted, COVERAGE)
    return fraction(marks.covered, marks.trusted) > upper


def _false_alarms(marks: Marks, kind: Kind) -> list[str]:
    """Faults of right models: false alarms, or mostly infinite errors."""
    faults = []
    if too_many(marks.warned.sum(), len(marks.warned), MAX_FALSE_ALARMS):
        faults.append(f"{marks.warned.mean():.1%} of the draws are false alarms")
    if kind == "right" and fraction(~marks.finite) > MAX_INFINITE:
        faults.append("too many parameters have an infinite error")
    return faults


def _short_intervals(labels: tuple[str, ...], marks: Marks) -> list[str]:
    """Faults of intervals that contain the truth too rarely."""
    faults = []
    for where, counted, nominal in (
        ("", marks.trusted, COVERAGE),
        ("beside bounds ", marks.beside_bound, COVERAGE_BESIDE_BOUND),
    ):
        coverage = fraction(marks.covered, counted)
        if coverage < coverage_limits(marks.covered, counted, nominal)[0]:
            faults.append(f"{where}{coverage:.1%} of the intervals hold the truth")
    low = [
        f"{label} {fraction(covered, counted):.0%}"
        for label, covered, counted in zip(
            labels, marks.covered.T, marks.trusted.T, strict=True
        )
        if fraction(covered, counted)
        < coverage_limits(covered[:, None], counted[:, None], COVERAGE)[0]
    ]
    return faults + ([f"too short alone: {', '.join(low)}"] if low else [])


def _missing_warnings(marks: Marks, kind: Kind) -> list[str]:
    """Fault of too many draws that are far off and have no warning about the fit.

    The limit is a fraction of the draws that are far off for a wrong model, and of all
    draws for others.
    """
    total = marks.far.sum() if kind == "wrong" else len(marks.far)
    if marks.misled.sum() <= MAX_MISSING_WARNINGS * total:
        return []
    return [
        f"{marks.misled.sum()} of {marks.far.sum()} draws that are more than {FAR:g} σ "
        "off come without a warning"
    ]


def _overconfident_errors(
    answers: Answers, unidentifiable: tuple[str, ...], trusted: np.ndarray
) -> list[str]:
    """Faults of parameters that the data cannot identify, yet have small errors.

    **Arguments:**

    - `unidentifiable`: labels of parameters, or names such as `"specular"`, which stand
        for all channels.
    - `trusted`: (draws,), draws without a warning about the fit. Only they count.
    """
    widest = SMALL_INTERVAL * (answers.bounds[:, 1] - answers.bounds[:, 0])
    small = np.isfinite(answers.error) & (answers.high - answers.low < widest)
    small &= trusted[:, None]
    faults = []
    for name in unidentifiable:
        columns = [name in (label, label.partition(".")[0]) for label in answers.labels]
        count = small[:, columns].any(axis=1).sum()
        if too_many(count, len(small), MAX_FALSE_ALARMS):
            faults.append(
                f"{name} is not identifiable, yet {count} draws have a small error"
            )
    return faults


def _missing_required(answers: Answers, required: str) -> list[str]:
    """Fault of draws that lack the required warning; none if `required` is ""."""
    count = sum(
        all(required not in sentence for sentence in sentences)
        for sentences in answers.warnings
    )
    if not required or count <= MAX_MISSING_WARNINGS * len(answers.warnings):
        return []
    return [f"{count} draws come without {required!r} in a warning"]


def _lowest_coverage(labels: tuple[str, ...], marks: Marks) -> tuple[float, str]:
    """Lowest coverage of any parameter, and that parameter's label; else NaN and ""."""
    # Parameters with few intervals are left out: their coverage is too uncertain.
    fewest = max(10, len(marks.warned) // 10)
    coverage = {
        label: fraction(marks.covered[:, k], marks.trusted[:, k])
        for k, label in enumerate(labels)
        if marks.trusted[:, k].sum() >= fewest
    }
    lowest = min(coverage, key=lambda label: coverage[label], default="")
    return coverage.get(lowest, np.nan), lowest


def _pulls(answers: Answers, counted: Each) -> float:
    """Root mean square of (estimate − truth) / error over the counted entries."""
    if not counted.any():
        return np.nan
    deviation = (answers.estimate - answers.truth)[counted]
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean((deviation / answers.error[counted]) ** 2)))
