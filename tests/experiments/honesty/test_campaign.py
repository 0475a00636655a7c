import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from experiments.honesty import __main__ as campaign_command
from experiments.honesty.__main__ import main, select
from experiments.honesty.campaign import (
    OtherPrecision,
    Row,
    count_false_alarms,
    own_bits,
    pooled_faults,
    row_from_json,
    run_situation,
)
from experiments.honesty.judge import judge
from experiments.honesty.situations import all_situations
from experiments.honesty.situations.base import Situation
from experiments.honesty.table import cells, summary
from phongfit.plain import plain
from tests.experiments.honesty.made_up import made_up

# They share what is compiled: one scene, one size, one kind of file.
FEW = ("one lamp", "noise 0.05", "no ambient", "f = 1.2", "lamp 2° off", "no highlight")


@pytest.fixture(scope="module")
def situations():
    return {one.name: one for one in all_situations()}


def row(name="a", kind: Any = "right", bits=32, answers=None, **changes: Any) -> Row:
    verdict = judge(made_up() if answers is None else answers, kind)
    return Row(name, kind, bits, 1.5, dataclasses.replace(verdict, **changes))


@pytest.mark.extended
def test_a_small_campaign(tmp_path, capsys):
    numbers = tmp_path / "new" / "honesty.json"
    bits = f"{own_bits()}"
    status = main(draws=6, only=FEW, precision=bits, json=numbers)  # pyright: ignore
    printed = capsys.readouterr().out
    assert status == 0, printed
    assert f"float{bits}: 6 situations" in printed and "lamp 2° off" in printed
    rows = json.loads(numbers.read_text())["rows"]
    verdicts = {one["name"]: one["verdict"] for one in rows}
    assert verdicts.keys() == set(FEW)
    assert verdicts["one lamp"]["warned"] == 0 == verdicts["one lamp"]["infinite"]
    assert verdicts["lamp 2° off"]["warned"] == 1
    assert verdicts["no highlight"]["infinite"] >= 0.1


@pytest.mark.extended
def test_a_broken_promise_is_told(monkeypatch, capsys):
    lying = Situation("a lie", "right", lambda draws: made_up(len(draws), stated=0.3))
    monkeypatch.setattr(campaign_command, "all_situations", lambda: [lying])
    assert main(precision=f"{own_bits()}") == 1  # pyright: ignore
    printed = capsys.readouterr().out
    assert "RED" in printed and f"! float{own_bits()}, a lie: " in printed


@pytest.mark.extended
def test_draws_are_the_same_each_time(situations):
    one, other = (run_situation(situations["one lamp"], 3, 1) for _ in range(2))
    assert one.verdict == other.verdict
    assert run_situation(situations["one lamp"], 3, 2).verdict != one.verdict


def test_situations(situations):
    assert len(situations) == len(all_situations()) >= 40
    assert {one.kind for one in situations.values()} == {
        "right",
        "open",
        "doubtful",
        "wrong",
    }
    assert all(one.unidentifiable for one in situations.values() if one.kind == "open")


def test_select(situations):
    every = list(situations.values())
    assert select(every, ()) == every
    assert [one.name for one in select(every, ("maps",))] == ["maps"]
    some = select(every, ("8 bits", "a prior 25"))
    assert [one.name for one in some] == ["8 bits", "a prior 25 σ off"]
    assert len(select(every, ("JPEG",))) == 13
    with pytest.raises(ValueError, match="only: no situation's name holds 'moon'"):
        select(every, ("moon",))


def test_draws_below_one():
    with pytest.raises(ValueError, match="draws: expected a whole number ≥ 1"):
        main(draws=0)


def test_a_share_of_the_draws():
    draws_seen = []

    def answer(draws):
        draws_seen.append(len(draws))
        return made_up(len(draws))

    for draws, draw_fraction in ((100, 0.5), (3, 0.1), (1, 0.1)):
        run_situation(
            Situation("a", "right", answer, draw_fraction=draw_fraction), draws, 0
        )
    assert draws_seen == [50, 2, 1]


def test_rows_as_json():
    one = row(coverage=np.nan, codes={"residuals": 3}, faults=("a", "b"))
    again = row_from_json(json.loads(json.dumps(plain(dataclasses.asdict(one)))))
    assert str(again) == str(one)


def test_false_alarms_of_all_together():
    passed = [row(f"{k}", warned=0.01) for k in range(10)]
    loud = [row(f"{k}", "open", warned=0.05) for k in range(10)]
    wrong = [row("a", "wrong", warned=1.0), row("maps, a", warned=1.0)]
    assert count_false_alarms([*passed, *wrong], 32) == (10, 1000)
    assert pooled_faults([*passed, *wrong]) == ()
    assert "50 false alarms in 1000 draws" in pooled_faults([*loud, *wrong])[0]
    assert count_false_alarms(passed, 64) == (0, 0)


def test_what_is_shown():
    good, bad = row(), row("b", faults=("it is off",), notes=("wide",))
    assert cells(good)[:2] == ("a", "right") and cells(good)[-1] == "ok"
    assert cells(bad)[-1] == "RED" and cells(row(notes=("wide",)))[-1] == "wide"
    lines = summary([good, bad])
    assert lines[0] == "  ! float32, b: it is off"
    assert "2 situations in 3 s, 1 red" in lines[-1]


@pytest.mark.extended
def test_a_process_that_fails():
    other = 32 if own_bits() == 64 else 64
    with OtherPrecision(other, ("moon",), 1, 0) as elsewhere:
        with pytest.raises(RuntimeError, match="no situation's name holds 'moon'"):
            elsewhere.rows()


@pytest.mark.slow
def test_both_precisions(capsys):
    assert main(draws=2, only=("one lamp",)) == 0
    printed = capsys.readouterr().out
    assert "float32: 1 situations" in printed and "float64: 1 situations" in printed
