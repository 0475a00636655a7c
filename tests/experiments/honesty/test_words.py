import pytest

from experiments.honesty.words import Subject, is_doubtful, subject_of

SENTENCES = {
    "the solver did not converge": Subject.FIT,
    "residuals are not noise: neighbouring pixels correlate by 0.24. The model does "
    "not describe the image fully; errors are widened 1.7 times": Subject.FIT,
    "the model does not describe the image": Subject.FIT,
    "residuals are 2.0 times as large as the noise that was given: the noise or the "
    "model is wrong, errors are too small": Subject.FIT,
    "3 % of the samples are outliers": Subject.FIT,
    "specular.red is not identifiable: the loss took the highlight for outliers": (
        Subject.FIT
    ),
    "90 of 100 samples are clipped: the noise is estimated": Subject.FIT,
    "the image has the blocks of a JPEG file": Subject.FIT,
    "its prior is 25 standard deviations off": Subject.FIT,
    "shininess lies at its bound of 1000, which decides the others": Subject.FIT,
    "ambient.red lies at its bound: its error is one-sided": Subject.BOUND,
    "flag: at bound": Subject.BOUND,
    "ambient.red is not identifiable: its error is wider than its bounds": Subject.OPEN,
    "diffuse.red is not identifiable: no light falls on a pixel that is used, or all "
    "of these are white": Subject.OPEN,
    "shininess is not identifiable: no pixel sees a highlight": Subject.OPEN,
    "the exponent may be any: the other errors are those of drawn fits": Subject.OPEN,
    "flag: no highlight": Subject.OPEN,
    "flag: not converged": Subject.FIT,
    "refused: ties: diffuse.green is held at -0.3": Subject.REFUSED,
    "the moon is full": Subject.UNKNOWN,
}


@pytest.mark.parametrize("sentence", SENTENCES)
def test_subjects(sentence):
    assert subject_of(sentence) is SENTENCES[sentence]
    doubts = (Subject.FIT, Subject.REFUSED)
    assert is_doubtful(sentence) == (SENTENCES[sentence] in doubts)
