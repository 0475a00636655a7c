import re
from pathlib import Path

import pytest

import phongfit as pf
from experiments.honesty.words import SUBJECTS, WarningSubject, is_doubtful, subject_of
from phongfit.codes import REMEDIES, coded

SENTENCES = {
    coded("not-converged", "the solver did not converge"): WarningSubject.FIT,
    coded("lack-of-fit", "residuals are not noise"): WarningSubject.FIT,
    coded("rejected-highlight", "specular.red is not identifiable"): WarningSubject.FIT,
    coded("two-solutions", "another solution fits as well"): WarningSubject.FIT,
    coded("bound-decides", "shininess lies at its upper bound"): WarningSubject.FIT,
    coded("at-bound", "ambient.red lies at its lower bound"): WarningSubject.BOUND,
    coded("not-identifiable", "ambient.red is not identifiable"): WarningSubject.OPEN,
    coded("no-highlight", "shininess is not identifiable"): WarningSubject.OPEN,
    "flag: at bound": WarningSubject.BOUND,
    "flag: no highlight": WarningSubject.OPEN,
    "flag: not converged": WarningSubject.FIT,
    "refused: ties: diffuse.green is held at -0.3": WarningSubject.REFUSED,
    # Words alone say nothing, nor does a code of something else.
    "the solver did not converge": WarningSubject.UNKNOWN,
    coded("exif-broken", "a.jpg: its EXIF data is broken"): WarningSubject.UNKNOWN,
    "the moon is full [full-moon]": WarningSubject.UNKNOWN,
}


@pytest.mark.parametrize("sentence", SENTENCES)
def test_subjects(sentence):
    assert subject_of(sentence) is SENTENCES[sentence]
    doubts = (WarningSubject.FIT, WarningSubject.REFUSED)
    assert is_doubtful(sentence) == (SENTENCES[sentence] in doubts)


def test_every_code_of_a_fit_has_a_subject():
    package = Path(pf.__file__).parent
    fitting = "".join(p.read_text("utf-8") for p in (package / "fitting").rglob("*.py"))
    maps = (package / "maps/result.py").read_text("utf-8")
    codes = set(re.findall(r'"([a-z-]+)"', fitting)) & set(REMEDIES)
    codes |= set(re.findall(r'coded\("([a-z-]+)"', maps))
    assert codes == {key for key in SUBJECTS if not key.startswith("flag: ")}


def test_every_flag_that_has_a_subject_is_one():
    flags = {f"flag: {str(flag.name).lower().replace('_', ' ')}" for flag in pf.Flag}
    assert {key for key in SUBJECTS if key.startswith("flag: ")} <= flags
