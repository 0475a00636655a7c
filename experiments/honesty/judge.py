"""From the answers of many draws to a verdict.

- 95 % intervals must contain the truth in 92-98 % of the cases with a finite error and
  without a warning: over all parameters, and for each of them. In draws with an
  estimate at its bound, intervals of the other parameters must do so in 80 %.
- An estimate that is far off must come with a warning: in 99 % of such draws.
- With a right model, at most 1 % of the draws may have a warning of doubt.
- A parameter that the data do not identify must not have a small error.
- Where a situation names a warning, at most 1 % of the draws may lack it.

See `experiments/honesty/chance.py` for what few draws allow.
"""

import dataclasses
from typing import Literal

import numpy as np

from experiments.honesty.answers import Answers
from experiments.honesty.chance import Each, limits, share, too_many
from experiments.honesty.marks import FAR, Marks, look
from experiments.honesty.words import doubts, unknown_words

Kind = Literal["right", "open", "doubtful", "wrong"]
"""`right`: the model is; `open`: it is, and the data cannot identify something;
`doubtful`: an answer is to be right or to come with a warning; `wrong`: it is to come
with one wherever it misleads."""

RIGHT_KINDS = ("right", "open")
PROMISED = (0.92, 0.98)
BESIDE = (0.8, 1.0)
ALARMS = 0.01
MISLED = 0.01
# An error is small if its interval takes less than this share of the box.
SMALL = 0.25
# A right model of which more is said not to be identifiable was not fitted at all.
SILENT = 0.2


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Summary of the draws of one situation; NaN where nothing could be judged.

    - `coverage`: share of intervals that hold the truth; `at_bound` of what lies on a
        bound alone, `beside` of the rest of such draws;
    - `worst`, `worst_label`: that of the parameter with the least;
    - `pulls`: root mean square of (estimate − truth) / error, inside the box;
    - `doubted`: share of draws with a warning about the fit, or without an answer;
    - `far`: share of draws with an estimate far off, see `FAR`;
        `misled`: share of draws where it comes without a warning;
    - `silent`: share of numbers with an infinite error;
    - `faults`: what should hold and does not; `notes`: what else is to be seen;
    - `words`: warnings about the fit, and how many draws had each.
    """

    draws: int
    coverage: float
    at_bound: float
    beside: float
    worst: float
    worst_label: str
    pulls: float
    doubted: float
    far: float
    misled: float
    silent: float
    faults: tuple[str, ...]
    notes: tuple[str, ...]
    words: dict[str, int]


def judge(
    answers: Answers,
    kind: Kind,
    free: tuple[str, ...] = (),
    wide: bool = False,
    words: str = "",
) -> Verdict:
    """The verdict on one situation.

    **Arguments:**

    - `kind`: whether the model is right, doubtful or wrong in this situation.
    - `free`: parameters, or labels, that the data cannot identify.
    - `wide`: whether intervals may be too wide here.
    - `words`: part of a warning, such as a code, that every draw must come with.
    """
    marks, labels = look(answers), answers.labels
    too_wide = kind != "wrong" and _too_wide(marks)
    allowed = wide or bool(marks.bound.any())
    worst, worst_label = _worst(labels, marks)
    faults = [
        *(_intervals(labels, marks) if kind != "wrong" else ()),
        *(["intervals are too wide"] if too_wide and not allowed else ()),
        *_misleading(marks, kind),
        *(_alarms(marks, kind) if kind in RIGHT_KINDS else ()),
        *_small_errors(answers, free, ~marks.doubted),
        *_lacking(answers, words),
        *(f"a warning of unknown kind: {x}" for x in unknown_words(answers.warnings)),
    ]
    notes = [
        *(["wide"] if too_wide and allowed else ()),
        *(["harmless"] if kind == "wrong" and not marks.far.any() else ()),
    ]
    return Verdict(
        draws=len(marks.doubted),
        coverage=share(marks.inside, marks.trusted),
        at_bound=share(marks.inside, marks.bound),
        beside=share(marks.inside, marks.beside),
        worst=worst,
        worst_label=worst_label,
        pulls=_pulls(answers, marks.free),
        doubted=share(marks.doubted),
        far=share(marks.far),
        misled=share(marks.misled),
        silent=share(~marks.finite),
        faults=tuple(faults),
        notes=tuple(notes),
        words=doubts(answers.warnings),
    )


def _too_wide(marks: Marks) -> bool:
    most = limits(marks.inside, marks.trusted, PROMISED)[1]
    return share(marks.inside, marks.trusted) > most


def _alarms(marks: Marks, kind: Kind) -> list[str]:
    """Faults of right models: false alarms, or mostly infinite errors."""
    faults = []
    if too_many(marks.doubted.sum(), len(marks.doubted), ALARMS):
        faults.append(f"{marks.doubted.mean():.1%} of the draws are false alarms")
    if kind == "right" and share(~marks.finite) > SILENT:
        faults.append("much is said not to be identifiable")
    return faults


def _intervals(labels: tuple[str, ...], marks: Marks) -> list[str]:
    """Faults of intervals that contain the truth too rarely."""
    faults = []
    for where, counted, promised in (
        ("", marks.trusted, PROMISED),
        ("beside bounds ", marks.beside, BESIDE),
    ):
        held = share(marks.inside, counted)
        if held < limits(marks.inside, counted, promised)[0]:
            faults.append(f"{where}{held:.1%} of the intervals hold the truth")
    low = [
        f"{label} {share(inside, counted):.0%}"
        for label, inside, counted in zip(
            labels, marks.inside.T, marks.trusted.T, strict=True
        )
        if share(inside, counted)
        < limits(inside[:, None], counted[:, None], PROMISED)[0]
    ]
    return faults + ([f"too short alone: {', '.join(low)}"] if low else [])


def _misleading(marks: Marks, kind: Kind) -> list[str]:
    """Fault of too many draws that are far off and have no warning.

    The limit is a fraction of the draws that are far off for a wrong model, and of all
    draws for others.
    """
    among = marks.far.sum() if kind == "wrong" else len(marks.far)
    if marks.misled.sum() <= MISLED * among:
        return []
    return [
        f"{marks.misled.sum()} of {marks.far.sum()} draws that are more than {FAR:g} σ "
        "off come without a warning"
    ]


def _small_errors(
    answers: Answers, free: tuple[str, ...], trusted: np.ndarray
) -> list[str]:
    """Faults of parameters with small errors that the data do not identify."""
    width = answers.box[:, 1] - answers.box[:, 0]
    small = np.isfinite(answers.error) & (answers.high - answers.low < SMALL * width)
    small &= trusted[:, None]
    faults = []
    for name in free:
        own = [name in (label, label.partition(".")[0]) for label in answers.labels]
        count = small[:, own].any(axis=1).sum()
        if too_many(count, len(small), ALARMS):
            faults.append(
                f"{name} is not identifiable, yet {count} draws have a small error"
            )
    return faults


def _lacking(answers: Answers, words: str) -> list[str]:
    """Draws without the warning that must come with each."""
    lacking = sum(all(words not in one for one in said) for said in answers.warnings)
    if not words or lacking <= MISLED * len(answers.warnings):
        return []
    return [f"{lacking} draws come without {words!r} in a warning"]


def _worst(labels: tuple[str, ...], marks: Marks) -> tuple[float, str]:
    """The parameter whose intervals hold the truth least often."""
    # A fraction of few draws is too uncertain.
    enough = max(10, len(marks.doubted) // 10)
    shares = {
        label: share(marks.inside[:, k], marks.trusted[:, k])
        for k, label in enumerate(labels)
        if marks.trusted[:, k].sum() >= enough
    }
    label = min(shares, key=lambda one: shares[one], default="")
    return shares.get(label, np.nan), label


def _pulls(answers: Answers, counted: Each) -> float:
    if not counted.any():
        return np.nan
    off = (answers.estimate - answers.truth)[counted]
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean((off / answers.error[counted]) ** 2)))
