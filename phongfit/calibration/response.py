r"""`fit_response`: a camera's response curve, where it is neither linear nor sRGB's.

The light $g(M)$ that a number M stands for is a rising curve from 0 to 1. Its slope is
the exponential of a cubic spline in $\sqrt M$, so that it rises wherever it is, and is
smooth: gamma curves bend most where numbers are small. Two kinds of photographs tell
it:

- a matte surface of known shape under known lamps, whose light is $E \max(n \cdot l, 0)
  + a$ with an unknown strength E of each lamp and light a of the room;
- the same view at several exposures e, whose light is $e L$ with an unknown L in each
  pixel.

Either way light is $E q + a$, with q known and E the same for a group of samples, and a
number's error is

$$r = M - g^{-1}(E q + a),$$

of which E and a are found by linear least squares in light and the spline by nonlinear
ones, with Tukey's biweight against what is not matte, or moved.

??? cite "Source"
    Mitsunaga and Nayar, *Radiometric self calibration*, CVPR 1999; Debevec and Malik,
    *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH 1997, for
    exposures. Grossberg and Nayar, *What can be known about the radiometric response
    from images?*, ECCV 2002: exposures have to be known.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.calibration.least_squares import (
    TUKEY,
    differentiated,
    least_squares,
    robust_scale,
    summed_by_block,
    tukey_weight,
)
from phongfit.calibration.spheres import Images, looked_at
from phongfit.codes import coded
from phongfit.edge import checked
from phongfit.rendering.film import ENCODINGS, NamedEncoding, decode
from phongfit.rendering.jpeg import namespace
from phongfit.rendering.response import ResponseCurve
from phongfit.scene import Scene

SPLINES = 9
"""Numbers that the logarithm of the slope is made of."""

SMOOTH = 1.0
"""Standard deviation of its second differences: where nothing is seen the curve goes
on as it did. sRGB's have 0.5."""

NUMBERS = np.linspace(0, 1, 257)
"""Numbers at which the resulting curve is sampled."""

GRID = np.linspace(0, 1, 8 * (len(NUMBERS) - 1) + 1)
"""Numbers at which light is summed up from its slope."""

DARKEST, BRIGHTEST = 0.03, 0.98
"""Numbers that should lie outside may have been cut off."""

LIT = 0.1
"""Smallest n·l that is used, and of the side in shadow the largest −n·l: nearer to its
edge, shade is uncertain."""

FACING = 0.3
"""Smallest n·v that is used, since a rim's pixels hold many normals."""

MOST = 1500
"""Pixels that are looked at: more of them err alike."""

BLOCK = 16
"""Pixels up to this far apart, and JPEG's blocks, err together."""

STIFF = 1e4
"""How much smoother a curve is to be to begin with."""

ROUNDS = 10
"""Number of times that samples are weighed anew."""

FITS = 4.0
"""An encoding that is fewer standard deviations off fits."""

LEVEL = 1 / 255
"""So does one that is off by no more than a level of 8 bits."""


class Check(NamedTuple):
    """Whether an encoding explains the photographs.

    - `sigmas`: by how many standard deviations it explains them worse than the curve.
    - `off`: largest difference of its light from the curve's, as a share of white,
        over the numbers that were seen.
    """

    sigmas: float
    off: float

    @property
    def fits(self) -> bool:
        """Whether there is no reason to prefer the curve."""
        return self.sigmas < FITS or self.off < LEVEL

    def __str__(self) -> str:
        about = f"{self.sigmas:.1f}" if self.sigmas < 100 else "more than 100"
        word = "fits" if self.fits else "does not fit"
        return f"{word}: off by up to {self.off:.3f} of white, {about} σ"


@dataclass(frozen=True, eq=False)
class Response:
    """What [`fit_response`][] found.

    - `curve`: to be given wherever an encoding is asked for.
    - `error`: standard errors of its samples over the light of the largest number that
        was seen, since how bright all light is does not matter.
    - `seen`: smallest and largest number that the photographs show; beyond them the
        curve only goes on smoothly.
    - `checks`: of the encodings that have a name.
    - `warnings`: what to know before it is trusted.
    """

    curve: ResponseCurve
    error: Float[np.ndarray, " samples"]
    seen: tuple[float, float]
    checks: Mapping[str, Check]
    warnings: tuple[str, ...]

    @property
    def encoding(self) -> Any:
        """The one with a name that fits best, if any does; else the curve."""
        fitting = [name for name, check in self.checks.items() if check.fits]
        if not fitting:
            return self.curve
        return min(fitting, key=lambda name: self.checks[name].sigmas)

    def __str__(self) -> str:
        lines = [f"{name:<7} {check}" for name, check in self.checks.items()]
        low, high = self.seen
        lines += ["", f"number   light ± error, of that of {high:.3f}"]
        numbers = np.linspace(0, 1, len(self.error))
        light = np.asarray(self.curve.light)
        light = light / np.interp(high, numbers, light)
        for at in np.linspace(0, len(numbers) - 1, 11).round().astype(int)[1:]:
            note = "" if low <= numbers[at] <= high else "  (not seen)"
            lines.append(
                f"{numbers[at]:6.3f}  {light[at]:.4f} ± {self.error[at]:.4f}{note}"
            )
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


@checked
def fit_response(
    photographs: Images,
    *,
    scenes: Sequence[Scene] | None = None,
    exposures: Sequence[float] | None = None,
    mask: Bool[np.ndarray, "height width"] | None = None,
    names: Sequence[str] | None = None,
) -> Response:
    """The camera's response, from a matte surface or from several exposures.

        stored = pf.ResponseCurve((0.0, 1.0))  # numbers as they stand in the file
        images = [pf.read_image(path, stored) for path in paths]
        found = pf.fit_response(images, exposures=(1, 2, 4, 8))
        fit = pf.fit(scene, pf.read_image("ball.jpg", found.curve))

    **Arguments:**

    - `photographs`: their numbers, (height, width, 3) in [0, 1], all of one size, of a
        camera that stands still.
    - `scenes`: of a matte surface, one for each photograph, with its lamp; how strong
        lamps are does not matter.
    - `exposures`: or how much light each photograph got, next to the others. As good as
        the curve is to be: of exposures that are all wrong by a power the curve is.
    - `mask`: which pixels may be used.
    - `names`: of the photographs, for messages.

    **Returns:** a [`Response`][].

    **Raises:** `ValueError` that names the argument, or says that too little is seen.
    """
    count = len(photographs)
    if (scenes is None) == (exposures is None):
        raise ValueError(
            "scenes: expected it or exposures, got "
            + ("neither" if scenes is None else "both")
        )
    names = names or [f"photograph {number}" for number in range(1, count + 1)]
    given = scenes if scenes is not None else exposures
    assert given is not None
    if len(given) != count or count == 0:
        what = "scenes" if scenes is not None else "exposures"
        raise ValueError(
            f"{what}: expected {count}, one a photograph, got {len(given)}"
        )
    if scenes is not None:
        samples = _of_surface(photographs, names, scenes, mask)
    else:
        samples = _of_exposures(photographs, names, _positive(exposures), mask)
    return _fit(samples)


class _Samples(NamedTuple):
    """Numbers M with what is known of their light, E q + a: one row for each E.

    - `number`: M.
    - `share`: q.
    - `block`: of those whose errors are correlated.
    - `sound`: which may be used. Black and white numbers are included: the expected
        number decides on them, since the number itself would select by noise.
    - `room`: whether there is light of the room, a.
    """

    number: Float[np.ndarray, "groups members"]
    share: Float[np.ndarray, "groups members"]
    block: Int[np.ndarray, "groups members"]
    sound: Bool[np.ndarray, "groups members"]
    room: bool


def _positive(exposures: Any) -> Float[np.ndarray, " n"]:
    found = np.asarray(exposures, float)
    if not (np.isfinite(found).all() and (found > 0).all()):
        raise ValueError(f"exposures: expected numbers > 0, got {exposures!r}")
    if len(found) < 2 or found.max() < 1.1 * found.min():
        raise ValueError(
            "exposures: expected several that differ, since alike ones tell nothing of "
            f"a response, got {', '.join(f'{one:g}' for one in found)}"
        )
    return found / found.mean()


def _thinned(mask: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """Some of the pixels, evenly."""
    stride = max(1, round(np.sqrt(mask.sum() / MOST)))
    kept = np.zeros_like(mask)
    kept[stride // 2 :: stride, stride // 2 :: stride] = True
    return mask & kept


def _blocks(mask: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, " pixels"]:
    rows, columns = np.nonzero(mask)
    return (rows // BLOCK) * (mask.shape[1] // BLOCK + 1) + columns // BLOCK


def _numbers(
    photographs: Images, names: Sequence[str], mask: Any, size: tuple[int, int]
) -> Float[np.ndarray, "count pixels 3"]:
    found = []
    for image, name in zip(looked_at(photographs, names), names, strict=True):
        if image.shape[:2] != size:
            raise ValueError(
                f"{name}: expected {size[1]} × {size[0]} pixels, as mask and scenes "
                f"have, got {image.shape[1]} × {image.shape[0]}"
            )
        found.append(np.asarray(image[mask], float))
    return np.stack(found)


def _of_surface(
    photographs: Images,
    names: Sequence[str],
    scenes: Sequence[Scene],
    mask: Bool[np.ndarray, "height width"] | None,
) -> _Samples:
    for number, scene in enumerate(scenes):
        if len(scene.lights) != 1:
            raise ValueError(
                f"scenes[{number}]: expected one lamp, got {len(scene.lights)}"
            )
        if not scene.lights[0].directed:
            raise ValueError(
                f"scenes[{number}]: expected a lamp, got light from all around"
            )
    seen = scenes[0].trace()
    facing = np.sum(np.asarray(seen.normal) * np.asarray(seen.to_viewer), axis=-1)
    used = np.asarray(seen.mask) & (facing > FACING)
    if mask is not None:
        used &= _as_mask(mask, used.shape)
    used = _thinned(used)
    numbers = _numbers(photographs, names, used, used.shape)
    normals, points = np.asarray(seen.normal)[used], np.asarray(seen.position)[used]
    cosines = np.zeros(numbers.shape[:2])
    shares = np.zeros(numbers.shape)
    for number, scene in enumerate(scenes):
        light = jax.vmap(scene.lights[0].illuminate)(jnp.asarray(points))
        cosines[number] = np.sum(normals * np.asarray(light.to_light), axis=-1)
        strength = np.asarray(light.intensity)
        shares[number] = np.maximum(cosines[number], 0)[:, None] * strength
    block = _blocks(used)
    block = np.arange(len(numbers))[:, None] * (block.max() + 1) + block
    lit = (cosines[..., None] > LIT) & (numbers > DARKEST) & (numbers < BRIGHTEST)
    if lit.sum() < 50 * SPLINES:
        raise ValueError(
            "photographs: too little is seen of a lit surface that is neither black "
            "nor white; is the surface where the scenes have it?"
        )

    def rows(values: np.ndarray) -> np.ndarray:
        """A strength for each photograph and channel."""
        every = np.broadcast_to(values, numbers.shape)
        return np.moveaxis(every, 2, 1).reshape(-1, every.shape[1])

    sound = np.abs(cosines) > LIT
    return _Samples(
        rows(numbers),
        rows(shares),
        rows(block[..., None]),
        rows(sound[..., None]),
        True,
    )


def _of_exposures(
    photographs: Images,
    names: Sequence[str],
    exposures: Float[np.ndarray, " n"],
    mask: Bool[np.ndarray, "height width"] | None,
) -> _Samples:
    size = np.shape(photographs[0])[:2]
    used = np.ones(size, bool) if mask is None else _as_mask(mask, size)
    used = _thinned(used)
    numbers = _numbers(photographs, names, used, (size[0], size[1]))
    seen = (numbers > DARKEST) & (numbers < BRIGHTEST)
    # A pixel that one photograph alone shows has no information.
    several = seen.sum(axis=0) > 1
    if seen[:, several].sum() < 50 * SPLINES:
        raise ValueError(
            "photographs: too few pixels are neither black nor white in two of them: "
            "bracket by one or two stops"
        )
    pixel, _ = np.nonzero(several)
    number = numbers[:, several].T
    share = np.broadcast_to(exposures, number.shape)
    block = np.broadcast_to(_blocks(used)[pixel, None], number.shape)
    return _Samples(number, share, block, np.ones(number.shape, bool), False)


def _as_mask(mask: Any, size: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    found = np.asarray(mask, bool)
    if found.shape != tuple(size):
        raise ValueError(f"mask: expected shape {tuple(size)}, got {found.shape}")
    return found


def _raised(number: np.ndarray, sigma: float) -> np.ndarray:
    """Increase of the mean of numbers by the clamp at black, which cuts off noise."""
    from scipy.special import ndtr

    at = number / sigma
    density = np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    return sigma * (density - at * ndtr(-at))


@functools.cache
def _basis() -> tuple[np.ndarray, np.ndarray]:
    """The spline's basis on the grid, and rows that keep its coefficients smooth."""
    from scipy.interpolate import BSpline

    knots = np.concatenate([[0] * 3, np.linspace(0, 1, SPLINES - 2), [1] * 3])
    basis = BSpline.design_matrix(np.sqrt(GRID), knots, 3).toarray()
    bends = np.diff(np.eye(SPLINES), 2, axis=0) / SMOOTH
    # A common factor of the slope does not change the curve: it is held near 1.
    return basis, np.concatenate([bends, np.ones((1, SPLINES))])


class _Weights(NamedTuple):
    """Weights of the samples, as the last curve gives them.

    - `number`: numbers without the clamp's increase of their mean.
    - `used`: by Tukey's biweight; 0 for what is black or white.
    - `rise`: slope of the curve at the sample.
    - `sigma`: standard deviation of numbers.
    - `stiff`: how much smoother than in the end the curve is held.
    """

    number: Any
    used: Any
    rise: Any
    sigma: Any
    stiff: Any


def _light(theta: Any) -> Any:
    """Light on the grid, in arrays of JAX or NumPy."""
    xp = namespace(theta)
    log_slope = _basis()[0] @ theta
    slope = xp.exp(xp.clip(log_slope - log_slope.max(), -40, 0))
    steps = (slope[1:] + slope[:-1]) / 2 * np.diff(GRID)
    light = xp.concatenate([xp.zeros(1), xp.cumsum(steps)])
    return light / light[-1]


def _errors(light: Any, samples: Any, weights: Any, least_room: Any) -> Any:
    """Errors of numbers under a curve, whose room has at least some light.

    Strengths and the light of the room are the best ones, by linear least squares.
    Beyond black and white the curve goes on straight: corrected numbers lie there.
    """
    xp = namespace(light)
    q, number, last = samples.share, weights.number, len(GRID) - 1
    below = xp.clip(number * last, 0, last - 1).astype(int)
    light_below, step = light[below], xp.diff(light)
    found = light_below + (number * last - below) * step[below]
    weight = weights.used / weights.rise**2

    def sums(values: Any) -> Any:
        return xp.sum(values, axis=1, keepdims=True)

    squares = xp.maximum(sums(weight * q * q), 1e-300)
    products, crossed = sums(weight * q * found), sums(weight * q)
    # The room's light, once strengths follow it.
    top = xp.sum(weight * found) - xp.sum(products * crossed / squares)
    bottom = xp.sum(weight) - xp.sum(crossed**2 / squares)
    some = samples.room & (bottom > 0)
    best = xp.maximum(top / xp.where(some, bottom, 1), least_room)
    room = xp.where(some, best, 0)
    shown = (products - room * crossed) / squares * q + room
    below = xp.clip(xp.searchsorted(light, shown) - 1, 0, last - 1)
    return number - (below + (shown - light[below]) / step[below]) / last


def _residual(theta: Any, samples: Any, weights: Any, least_room: Any) -> Any:
    """Weighted errors of numbers, and bends of the curve."""
    errors = _errors(_light(theta), samples, weights, least_room)
    bends = jnp.sqrt(weights.stiff) * weights.sigma * (_basis()[1] @ theta)
    return jnp.concatenate([jnp.ravel(jnp.sqrt(weights.used) * errors), bends])


def _fit(samples: _Samples) -> Response:
    """The curve that explains the samples best, and its errors."""
    residual = differentiated(_residual)
    theta, weights = _solve(samples, residual)
    light, slopes = differentiated(_light)(theta)
    rest = _errors(light, samples, weights, 0.0)
    lit = _lit(samples, weights.number - rest, weights.sigma)
    count, freedom = np.count_nonzero(lit), _freedom(samples, lit) - SPLINES
    # The light of a dark room is uncertain: no bound at 0 here.
    jacobian = residual(theta, samples, weights, -np.inf)[1][: rest.size]
    root = np.sqrt(weights.used)
    u = rest / (TUKEY * weights.sigma)
    slope = np.where(lit & (np.abs(u) < 1), (1 - u**2) * (1 - 5 * u**2), 0)
    # Huber, *Robust statistics*, 1981, section 7.6: what weights cost.
    scores = weights.used * rest
    variance = np.sum(scores**2) / freedom / (np.sum(slope) / count) ** 2
    data, smooth = jacobian.T @ jacobian, _basis()[1].T @ _basis()[1]
    held = np.linalg.inv(data + weights.stiff * weights.sigma**2 * smooth)
    known = held @ data
    # Neighbours err together: by how much more scores of blocks vary.
    each = (root * rest).reshape(-1, 1) * jacobian
    together = summed_by_block(each, samples.block.ravel())
    bread = known @ held
    inflation = np.trace(bread @ together.T @ together) / np.trace(
        bread @ each.T @ each
    )
    variance *= np.sum(weights.used) / count * max(float(inflation), 1.0)
    covariance = np.linalg.inv(data / variance + weights.stiff * smooth)

    shown = (weights.used > 0) & (samples.share > 0)
    low, high = np.percentile(samples.number[shown], (0.5, 99.5)).tolist()
    # Of the curve over its light at the largest number, since scale does not matter.
    at_high = np.interp(high, GRID, light)
    by_high = [np.interp(high, GRID, column) for column in slopes.T]
    slopes = (slopes - np.outer(light / at_high, by_high)) / at_high
    slopes = slopes[:: (len(GRID) - 1) // (len(NUMBERS) - 1)]
    best = float(np.sum(weights.used * rest**2))

    def check(name: NamedEncoding) -> Check:
        other = np.asarray(decode(GRID, name))
        off = _errors(other, samples, weights, 0.0)
        more = (float(np.sum(weights.used * off**2)) - best) / variance
        freedom = max(float(np.trace(known)), 1.0)
        return _checked(light, other, max(more, 0.0), freedom, (low, high))

    # Rounding could make parts flat, which a response curve may not be.
    curve = np.interp(NUMBERS, GRID, light) + 1e-9 * NUMBERS
    return Response(
        ResponseCurve((curve / curve[-1]).tolist()),
        np.sqrt(np.einsum("ni,ij,nj->n", slopes, covariance, slopes)),
        (low, high),
        {name: check(name) for name in ENCODINGS},
        _warnings(low, high, weights.sigma),
    )


def _solve(
    samples: _Samples, residual: Callable[..., Any]
) -> tuple[np.ndarray, _Weights]:
    """The spline's coefficients, and the weights of samples that they lead to."""
    number = samples.number
    used = ((number > DARKEST) & (number < BRIGHTEST)).astype(float)
    used = np.where(samples.share == 0, 1.0, used) * samples.sound
    weights = _Weights(number, used, np.ones(number.shape), 0.01, 1.0)
    starts = []
    for name in ENCODINGS:
        light = np.asarray(decode(GRID, name))
        log_slope = np.log(np.gradient(light, GRID))
        rest = _errors(light, samples, weights, 0.0)[used > 0]
        near = np.linalg.lstsq(_basis()[0], log_slope, rcond=None)[0]
        starts.append((float(np.median(np.abs(rest))), near))
    theta = min(starts, key=lambda start: start[0])[1]
    for step in range(ROUNDS):
        # At first stiff: else it bends below the darkest number that is seen, where
        # a step in light and light of the room look alike.
        weights = weights._replace(stiff=max(STIFF / 4**step, 1.0))
        theta = least_squares(residual, theta, samples, weights, 0.0).values
        light = _light(theta)
        rest = _errors(light, samples, weights, 0.0)
        expected = weights.number - rest
        lit = _lit(samples, expected, weights.sigma)
        # Of shadows black may have cut half off.
        lost = np.sqrt(np.count_nonzero(lit) / _freedom(samples, lit))
        sigma = max(robust_scale(rest[lit & (samples.share > 0)]) * lost, 1e-5)
        number = samples.number - _raised(expected, sigma)
        # The first curves are too far off to identify outliers.
        tukey = tukey_weight(number - expected, sigma) if step >= ROUNDS // 2 else 1.0
        rise = np.interp(np.maximum(expected, DARKEST), GRID, np.gradient(light, GRID))
        used = np.where(lit, tukey, 0.0)
        weights = _Weights(number, used, rise, sigma, weights.stiff)
    return theta, weights


def _lit(samples: _Samples, expected: np.ndarray, sigma: float) -> np.ndarray:
    """Samples that count: shadows, and what is neither black nor white.

    The expected number decides if noise might have made the number black or white.
    """
    number, near = samples.number, min(5 * sigma, 0.1)
    dark = np.where(number < DARKEST + near, expected, number) < DARKEST
    bright = np.where(number > BRIGHTEST - near, expected, number) > BRIGHTEST
    return samples.sound & (~dark & ~bright | (samples.share == 0))


def _freedom(samples: _Samples, lit: np.ndarray) -> int:
    """Number of samples that count less that of strengths found; at least 1."""
    strengths = np.count_nonzero((lit & (samples.share > 0)).any(axis=1))
    return max(int(np.count_nonzero(lit) - strengths) - samples.room, 1)


def _checked(
    light: np.ndarray,
    other: np.ndarray,
    more: float,
    freedom: float,
    seen: tuple[float, float],
) -> Check:
    """Compare an encoding's light with the curve's; `more` is its excess of χ²."""
    from scipy import stats

    chance = float(stats.chi2.sf(more, freedom))
    # Far out the tail's probability is less than any number.
    sigmas = stats.norm.isf(chance / 2) if chance > 1e-300 else np.sqrt(more)
    shown = (GRID >= seen[0]) & (GRID <= seen[1])
    one, two = other[shown], light[shown]
    scale = one @ two / (two @ two)
    return Check(float(sigmas), float(np.abs(one - scale * two).max()))


def _warnings(low: float, high: float, sigma: float) -> tuple[str, ...]:
    found = []
    if high < 0.7 or low > 0.4:
        words = (
            f"only numbers from {low:.2f} to {high:.2f} are seen: beyond them the "
            "curve is extrapolated"
        )
        found.append(coded("range-unseen", words))
    if sigma > 0.02:
        words = f"numbers are {sigma:.3f} from the curve (standard deviation)"
        found.append(coded("not-one-curve", words))
    return tuple(found)
