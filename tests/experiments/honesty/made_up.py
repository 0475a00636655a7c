"""Answers that nobody fitted, for what judges them."""

import numpy as np

from experiments.honesty.answers import Answers

LABELS = ("diffuse.red", "diffuse.green", "specular.red", "shininess")


def made_up(draws: int = 100, seed: int = 0, stated: float = 1.0) -> Answers:
    """Right answers: they scatter by 0.01, and by `stated` times that they say."""
    rng = np.random.default_rng(seed)
    shape = (draws, len(LABELS))
    truth = np.full(shape, 0.5)
    estimate = truth + 0.01 * rng.normal(size=shape)
    error = np.full(shape, 0.01 * stated)
    return with_errors(truth, estimate, error)


def with_errors(truth: np.ndarray, estimate: np.ndarray, error: np.ndarray) -> Answers:
    """Answers inside a box of 0 … 1, without a warning."""
    return Answers(
        labels=LABELS,
        truth=truth,
        estimate=estimate,
        error=error,
        low=np.clip(estimate - 1.96 * error, 0, 1),
        high=np.clip(estimate + 1.96 * error, 0, 1),
        at_bound=np.zeros(truth.shape, bool),
        bounds=np.array([[0.0, 1.0]] * len(LABELS)),
        warnings=((),) * len(truth),
    )
