import dataclasses

import numpy as np
import pytest

from experiments.honesty.judge import judge
from phongfit.codes import coded
from tests.experiments.honesty.made_up import made_up, with_errors

LACK = coded("lack-of-fit", "residuals are not noise")
REFUSED = "refused: unknowns: it has no derivative"
BOUND = coded("at-bound", "diffuse.red lies at its bound: its error is one-sided")


def warned(answers, draws, words=LACK):
    """Answers with a warning in the first draws."""
    sentences = tuple(
        (words,) if k < draws else () for k in range(len(answers.warnings))
    )
    return dataclasses.replace(answers, warnings=sentences)


def off(answers, draws, by):
    """The same, with one estimate off by so many errors in the first draws."""
    estimate = answers.estimate.copy()
    estimate[:draws, 2] = answers.truth[:draws, 2] + by * answers.error[:draws, 2]
    return with_errors(answers.truth, estimate, answers.error)


@pytest.mark.parametrize("kind", ["right", "open", "doubtful", "wrong"])
@pytest.mark.parametrize("seed", range(5))
def test_right_answers(kind, seed):
    verdict = judge(made_up(seed=seed), kind)
    assert verdict.faults == ()
    assert 0.92 < verdict.coverage < 0.98 and verdict.misled == verdict.warned == 0
    assert verdict.pulls == pytest.approx(1, abs=0.15)
    assert verdict.notes == (("harmless",) if kind == "wrong" else ())


@pytest.mark.parametrize("stated", [0.5, 0.7])
def test_errors_that_are_too_small(stated):
    verdict = judge(made_up(stated=stated), "right")
    assert "of the intervals hold the truth" in verdict.faults[0]
    assert verdict.pulls == pytest.approx(1 / stated, rel=0.15)


def test_errors_that_are_too_large():
    answers = made_up(stated=3.0)
    assert "too wide" in judge(answers, "right").faults[0]
    assert judge(answers, "right", wide=True).faults == ()
    assert judge(answers, "right", wide=True).notes == ("wide",)
    bound = dataclasses.replace(answers, at_bound=np.arange(4) == [[2]] * 100)
    assert judge(bound, "right").notes == ("wide",)


def test_one_parameter_that_is_wrong():
    answers = made_up()
    error = answers.error * [1, 1, 1, 0.5]
    verdict = judge(with_errors(answers.truth, answers.estimate, error), "doubtful")
    assert verdict.worst_label == "shininess" and verdict.worst < 0.8
    assert any(
        fault.startswith("too short alone: shininess") for fault in verdict.faults
    )


@pytest.mark.parametrize("kind", ["right", "open", "doubtful", "wrong"])
def test_a_confident_wrong_answer(kind):
    for draws, red in ((1, kind == "wrong"), (2, True), (100, True)):
        faults = judge(off(made_up(), draws, 7), kind).faults
        silent = [one for one in faults if "come without a warning" in one]
        assert bool(silent) == red
        assert all(f"{draws} of {draws} draws" in one for one in silent)


@pytest.mark.parametrize("words", [LACK, REFUSED])
def test_a_wrong_answer_with_a_warning(words):
    verdict = judge(warned(off(made_up(), 100, 30), 100, words), "wrong")
    assert verdict.faults == () and verdict.notes == ()
    assert verdict.far == verdict.warned == 1 and verdict.misled == 0
    # One in a hundred may come without.
    assert judge(warned(off(made_up(), 100, 30), 99), "wrong").faults == ()
    assert judge(warned(off(made_up(), 100, 30), 98), "wrong").faults


def test_a_warning_of_something_else_is_none():
    said = (coded("no-highlight", "shininess is not identifiable"), BOUND)
    answers = dataclasses.replace(off(made_up(), 100, 7), warnings=(said,) * 100)
    assert "100 of 100 draws" in judge(answers, "wrong").faults[0]


def test_a_false_alarm():
    for kind in ("right", "open"):
        assert judge(warned(made_up(), 5), kind).faults == ()
        assert "false alarms" in judge(warned(made_up(), 20), kind).faults[0]
    assert judge(warned(made_up(), 20), "doubtful").faults == ()
    assert judge(warned(made_up(), 20), "wrong").codes == {"lack-of-fit": 20}


def test_what_is_not_identified():
    answers = made_up()
    error = np.where(np.arange(4) == 3, np.inf, answers.error)
    unknown = with_errors(answers.truth, answers.estimate, error)
    verdict = judge(unknown, "open", unidentifiable=("shininess",))
    assert verdict.faults == () and verdict.infinite == 0.25
    claimed = judge(answers, "open", unidentifiable=("shininess", "diffuse.green"))
    assert [one.split()[0] for one in claimed.faults] == ["shininess", "diffuse.green"]
    # With a right model whose parameters are identifiable, infinite errors are a fault.
    assert "infinite error" in judge(unknown, "right").faults[0]


def test_estimates_on_their_bound():
    answers = made_up()
    shape = answers.truth.shape
    truth = np.where(np.arange(4) == 0, 0.0, 0.5) + np.zeros(shape)
    estimate = np.clip(truth + answers.estimate - 0.5, 0, 1)
    at_bound = estimate == 0
    found = with_errors(truth, estimate, answers.error)
    found = dataclasses.replace(found, at_bound=at_bound)
    verdict = judge(found, "right")
    assert verdict.faults == () and verdict.at_bound == 1
    assert 0.85 < verdict.beside_bound < 1
    # Beside a bound that binds others are off.
    shifted = estimate + 0.03 * (at_bound[:, :1] & ~at_bound)
    wrong = dataclasses.replace(
        with_errors(truth, shifted, answers.error), at_bound=at_bound
    )
    assert any("beside bounds" in fault for fault in judge(wrong, "right").faults)


def test_a_bound_that_keeps_from_the_truth():
    """Its own estimate says so; the others have no excuse."""
    answers = made_up()
    truth = answers.truth + [0, 0, 0, 5]
    estimate = np.where(np.arange(4) == 3, 1.0, answers.estimate)
    at_bound = np.broadcast_to(np.arange(4) == 3, truth.shape)
    kept = with_errors(truth, estimate, answers.error)
    kept = dataclasses.replace(kept, at_bound=at_bound)
    assert judge(kept, "wrong").far == 0
    assert judge(dataclasses.replace(kept, at_bound=~at_bound), "wrong").far == 1


def test_a_warning_that_nobody_knows():
    verdict = judge(warned(made_up(), 100, "the moon is full (7)"), "doubtful")
    assert verdict.faults == ("a warning of unknown kind: the moon is full (#)",)
    assert verdict.warned == 0


def test_numbers_that_are_none():
    answers = made_up()
    estimate = np.where(np.arange(4) == 1, np.nan, answers.estimate)
    broken = with_errors(answers.truth, estimate, answers.error)
    assert judge(broken, "doubtful").misled == 1


def test_all_refused():
    answers = made_up()
    nothing = with_errors(
        *(np.full(answers.truth.shape, x) for x in (np.nan, np.nan, np.inf))
    )
    verdict = judge(warned(nothing, 100, REFUSED), "doubtful")
    assert verdict.faults == () and np.isnan(verdict.coverage)
    assert judge(warned(nothing, 100, REFUSED), "right").faults


def test_a_warning_that_must_come():
    answers = warned(made_up(), 80)
    assert judge(answers, "doubtful", required_warning="[lack-of-fit]").faults == (
        "20 draws come without '[lack-of-fit]' in a warning",
    )
    assert (
        judge(warned(made_up(), 99), "doubtful", required_warning="not noise").faults
        == ()
    )
