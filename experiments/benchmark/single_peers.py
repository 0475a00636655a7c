"""The fit of one image without JAX: by PyTorch's Adam and by lmfit.

The residuals of phongfit, written for any array library.
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


@dataclasses.dataclass(frozen=True)
class WrittenOut:
    """Samples that are used, and where in the solver's vector each parameter is.

    - `ambient`, `diffuse`, `strength`, `target`: (3, samples).
    - `logarithm`: (samples,), of the cosine from the highlight's centre.
    - `sigma`: standard deviation of the noise; residuals are in units of it.
    - `places`: indices in the solver's vector, for each of `MAP_PARAMETERS`.
    """

    ambient: Any
    diffuse: Any
    strength: Any
    target: Any
    logarithm: Any
    sigma: float
    places: tuple[np.ndarray, ...]

    def light(self, xp: Any, y: Any) -> Any:
        """Linear light before the clamp, in NumPy or PyTorch."""
        ambient, diffuse, specular, shininess = (y[place] for place in self.places)
        lobe = xp.exp(xp.exp(shininess) * self.logarithm)
        return (
            ambient[:, None] * self.ambient
            + diffuse[:, None] * self.diffuse
            + specular[:, None] * self.strength * lobe
        )

    def residual(self, xp: Any, y: Any, upper_tail: Callable[[Any], Any]) -> Any:
        """(model − image) / σ, where the model is the mean of noisy, clamped light.

        See [`clipped_moments`][].

        **Arguments:** `upper_tail`: probability that a standard normal number is
        larger.
        """

        def beyond(z: Any) -> Any:
            density = xp.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
            return density - z * upper_tail(z)

        light = self.light(xp, y)
        black, white = light / self.sigma, (1 - light) / self.sigma
        shown = light + self.sigma * (beyond(black) - beyond(white))
        return (shown - self.target) / self.sigma


def written_out(problem: Problem) -> WrittenOut:
    """A problem of one image, one lamp and no rounding, as NumPy's doubles."""
    terms = problem.samples.channels.pixels.terms
    weight = np.asarray(problem.samples.weight)
    used = (weight > 0).all(axis=0)
    assert np.all(weight[:, used] == 1) and not np.any(weight[:, ~used])
    assert problem.clamp and problem.samples.step is None and terms.cosine.shape[1] == 1

    def kept(array: Any) -> np.ndarray:
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
    """A function that minimises the mean square by PyTorch's Adam, in float32."""
    torch: Any = importlib.import_module("torch")
    names = ("ambient", "diffuse", "strength", "target", "logarithm")
    arrays = {
        name: torch.tensor(getattr(problem, name), dtype=torch.float32)
        for name in names
    }
    places = tuple(torch.tensor(place) for place in problem.places)
    samples = dataclasses.replace(problem, **arrays, places=places)
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
    """A function that runs lmfit's `minimize` with its defaults, errors included."""
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
        found = lmfit.minimize(residual, parameters, method="leastsq")
        values = [parameter.value for parameter in found.params.values()]
        return np.array(values), found.nfev

    return minimize
