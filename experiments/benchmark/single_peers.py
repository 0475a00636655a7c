"""Fits of one image without JAX: by PyTorch's Adam and by lmfit.

They minimise phongfit's residuals, written here for NumPy and for PyTorch.
"""

import dataclasses
import importlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.special

from phongfit.fitting.problem.problem import Problem
from phongfit.maps.pixel.settings import MAP_PARAMETERS

ADAM_RATE, ADAM_MOST = 0.03, 4000
"""Learning rate of Adam, and its largest number of steps."""


@dataclasses.dataclass(frozen=True)
class WrittenOut:
    """The pixels of a fit that are used, and the layout of its vector of unknowns.

    - `ambient`, `diffuse`: basis images A and D, (3, pixels); `strength`: the specular
        light of the lamp at each pixel, (3, pixels);
    - `logarithm`: (pixels,), logarithm of the cosine of the angle from the highlight's
        centre;
    - `target`: the image, (3, pixels);
    - `sigma`: standard deviation of the noise; residuals are in units of it;
    - `places`: indices in the vector of unknowns, for each of `MAP_PARAMETERS`.
    """

    ambient: Any
    diffuse: Any
    strength: Any
    target: Any
    logarithm: Any
    sigma: float
    places: tuple[np.ndarray, ...]

    def light(self, xp: Any, y: Any) -> Any:
        """Linear light, (3, pixels), not clamped.

        **Arguments:** `xp`: NumPy or PyTorch; `y`: reflectances, and log f.
        """
        ambient, diffuse, specular, shininess = (y[place] for place in self.places)
        lobe = xp.exp(xp.exp(shininess) * self.logarithm)
        return (
            ambient[:, None] * self.ambient
            + diffuse[:, None] * self.diffuse
            + specular[:, None] * self.strength * lobe
        )

    def residual(self, xp: Any, y: Any, upper_tail: Callable[[Any], Any]) -> Any:
        """(model − image) / σ, (3, pixels).

        The model is the expectation of light plus noise after clipping to [0, 1]: see
        [`clipped_moments`][].

        **Arguments:** `xp`, `y`: as in `light`; `upper_tail`: function from z to the
        probability that a standard normal number exceeds z.
        """

        def beyond(z: Any) -> Any:
            """Expectation of max(n − z, 0) for a standard normal number n."""
            density = xp.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
            return density - z * upper_tail(z)

        light = self.light(xp, y)
        black, white = light / self.sigma, (1 - light) / self.sigma
        shown = light + self.sigma * (beyond(black) - beyond(white))
        return (shown - self.target) / self.sigma


def written_out(problem: Problem) -> WrittenOut:
    """The samples of a fit's problem as NumPy arrays of float64.

    **Arguments:** `problem`: of one image under one lamp, clamped, not rounded.
    """
    terms = problem.samples.channels.pixels.terms
    weight = np.asarray(problem.samples.weight)
    used = (weight > 0).all(axis=0)
    assert np.all(weight[:, used] == 1) and not np.any(weight[:, ~used])
    assert problem.clamp and problem.samples.step is None and terms.cosine.shape[1] == 1

    def kept(array: Any) -> np.ndarray:
        """The used pixels of an array with three channels, (3, pixels)."""
        return np.asarray(array, float).reshape(3, -1)[:, used]

    cosine = np.asarray(terms.cosine, float).ravel()[used]
    unknowns = problem.unknowns
    return WrittenOut(
        kept(terms.ambient),
        kept(terms.diffuse),
        kept(terms.strength),
        kept(problem.samples.target),
        np.log(np.maximum(cosine, 1e-30)),
        float(problem.sigma),
        tuple(np.flatnonzero(unknowns.y_parameter == name) for name in MAP_PARAMETERS),
    )


def torch_adam(
    problem: WrittenOut, start: np.ndarray, answer: np.ndarray
) -> Callable[[], tuple[np.ndarray, int]]:
    """A function that minimises the mean square by PyTorch's Adam, in float32.

    It ends when log f is within 1e-3 of that in `answer`, or after `ADAM_MOST` steps.

    **Arguments:** `start`: vector of unknowns to start from.

    **Returns:** the function, which returns unknowns and number of steps.
    """
    torch: Any = importlib.import_module("torch")
    names = ("ambient", "diffuse", "strength", "target", "logarithm")
    arrays = {
        name: torch.tensor(getattr(problem, name), dtype=torch.float32)
        for name in names
    }
    places = tuple(torch.tensor(place) for place in problem.places)
    samples = dataclasses.replace(problem, **arrays, places=places)
    # Index of log f.
    (f,) = problem.places[MAP_PARAMETERS.index("shininess")]

    def upper_tail(z: Any) -> Any:
        return torch.special.erfc(z / math.sqrt(2)) / 2

    def descend() -> tuple[np.ndarray, int]:
        y = torch.tensor(start, dtype=torch.float32, requires_grad=True)
        rule = torch.optim.Adam([y], lr=ADAM_RATE)
        count = 0
        while count < ADAM_MOST and abs(y[f].item() - answer[f]) > 1e-3:
            rule.zero_grad()
            residual = samples.residual(torch, y, upper_tail)
            torch.mean((residual * samples.sigma) ** 2).backward()
            rule.step()
            count += 1
        return y.detach().numpy(), count

    return descend


def lmfit_leastsq(
    problem: WrittenOut, start: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> Callable[[], tuple[np.ndarray, int]]:
    """A function that runs lmfit's `leastsq` with its defaults, errors included.

    **Arguments:** `start`, `lower`, `upper`: vectors of unknowns: first guess, bounds.

    **Returns:** the function, which returns unknowns and number of calls of residuals.
    """
    lmfit: Any = importlib.import_module("lmfit")
    parameters = lmfit.Parameters()
    for k, (value, low, high) in enumerate(zip(start, lower, upper, strict=True)):
        parameters.add(f"y{k}", value=float(value), min=float(low), max=float(high))

    def upper_tail(z: np.ndarray) -> np.ndarray:
        return scipy.special.ndtr(-z)

    def residual(parameters: Any) -> np.ndarray:
        y = np.array([parameter.value for parameter in parameters.values()])
        return problem.residual(np, y, upper_tail).ravel()

    def minimize() -> tuple[np.ndarray, int]:
        result = lmfit.minimize(residual, parameters, method="leastsq")
        values = [parameter.value for parameter in result.params.values()]
        return np.array(values), result.nfev

    return minimize
