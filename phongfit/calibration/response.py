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

of which E and a are found by linear least squares in light and the spline by Gauss and
Newton's method, with Tukey's biweight against what is not matte, or moved.

??? cite "Source"
    Mitsunaga and Nayar, *Radiometric self calibration*, CVPR 1999; Debevec and Malik,
    *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH 1997, for
    exposures. Grossberg and Nayar, *What can be known about the radiometric response
    from images?*, ECCV 2002: exposures have to be known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.calibration.spheres import Images, looked_at
from phongfit.codes import coded
from phongfit.edge import checked
from phongfit.rendering.film import ENCODINGS, NamedEncoding, decode
from phongfit.rendering.response import ResponseCurve
from phongfit.scene import Scene

SPLINES = 9
"""Numbers that the logarithm of the slope is made of."""

SMOOTH = 1.0
"""Standard deviation of its second differences: where nothing is seen the curve goes
on as it did. sRGB's have 0.5."""

SAMPLES = 257
"""Of the curve that is given back."""

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

TUKEY = 4.7
"""Residuals of so many standard deviations count no more."""

STIFF = 1e4
"""How much smoother a curve is to be to begin with."""

ROUNDS, STEPS = 10, 3
"""How often samples are weighed anew, and most steps of the solver in between."""

SMALL = 1e-6
"""A step that changes no slope of the curve by a larger share is the last."""

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
    return _Solver(samples).response()


class _Samples(NamedTuple):
    """Numbers M with what is known of their light, E q + a.

    - `number`: M.
    - `share`: q.
    - `group`: which E.
    - `block`: of those that err together.
    - `room`: whether there is light of the room, a.

    What is black or white is among them: which samples are used is told by what their
    numbers should be, since noise would choose among those that are.
    """

    number: Float[np.ndarray, " n"]
    share: Float[np.ndarray, " n"]
    group: Int[np.ndarray, " n"]
    block: Int[np.ndarray, " n"]
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
    block, every = _blocks(used), np.arange(numbers.size).reshape(numbers.shape)
    photograph, pixel, channel = np.unravel_index(every, numbers.shape)
    good = np.broadcast_to((np.abs(cosines) > LIT)[..., None], numbers.shape)
    lit = (cosines[..., None] > LIT) & (numbers > DARKEST) & (numbers < BRIGHTEST)
    if lit.sum() < 50 * SPLINES:
        raise ValueError(
            "photographs: too little is seen of a lit surface that is neither black "
            "nor white; is the surface where the scenes have it?"
        )
    # A strength for each photograph and channel; a block has all channels.
    return _Samples(
        numbers[good],
        shares[good],
        (3 * photograph + channel)[good],
        (photograph * (block.max() + 1) + block[pixel])[good],
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
    block, every = _blocks(used), np.arange(numbers.size).reshape(numbers.shape)
    photograph, pixel, channel = np.unravel_index(every, numbers.shape)
    seen = (numbers > DARKEST) & (numbers < BRIGHTEST)
    # A pixel that one photograph alone shows says nothing.
    several = seen.sum(axis=0) > 1
    good = np.broadcast_to(several, numbers.shape)
    if seen[good].sum() < 50 * SPLINES:
        raise ValueError(
            "photographs: too few pixels are neither black nor white in two of them: "
            "bracket by one or two stops"
        )
    return _Samples(
        numbers[good],
        exposures[photograph[good]],
        np.unique((3 * pixel + channel)[good], return_inverse=True)[1],
        block[pixel[good]],
        False,
    )


def _as_mask(mask: Any, size: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    found = np.asarray(mask, bool)
    if found.shape != tuple(size):
        raise ValueError(f"mask: expected shape {tuple(size)}, got {found.shape}")
    return found


def _raised(number: np.ndarray, sigma: float) -> np.ndarray:
    """By how much black, which cuts noise off, raises the mean of numbers."""
    from scipy.special import ndtr

    at = number / sigma
    density = np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    return sigma * (density - at * ndtr(-at))


class _Solver:
    """The least-squares problem; unknowns are the spline's numbers."""

    def __init__(self, samples: _Samples):
        from scipy.interpolate import BSpline

        # In the order of their numbers, in which they are looked up several times
        # faster.
        order = np.argsort(samples.number)
        self.samples = samples = samples._replace(
            number=samples.number[order],
            share=samples.share[order],
            group=samples.group[order],
            block=samples.block[order],
        )
        number = samples.number
        self.grid = np.linspace(0, 1, 8 * (SAMPLES - 1) + 1)
        inner = np.linspace(0, 1, SPLINES - 2)
        knots = np.concatenate([[0] * 3, inner, [1] * 3])
        self.basis = BSpline.design_matrix(np.sqrt(self.grid), knots, 3).toarray()
        bends = np.diff(np.eye(SPLINES), 2, axis=0) / SMOOTH
        # What they have in common does not change the curve: it is held near 0.
        self.smooth = np.concatenate([bends, np.ones((1, SPLINES))])
        # What the curve so far says of the samples; to begin with, they are it.
        self.used = ((number > DARKEST) & (number < BRIGHTEST)).astype(float)
        self.used[samples.share == 0] = 1
        self.rise = np.ones(len(number))
        self.sigma, self.stiff = 0.01, 1.0
        # Numbers without what black cuts off, which raises their mean.
        self.number = number

    def curve(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Light and its slope on the grid."""
        log_slope = self.basis @ theta
        slope = np.exp(np.clip(log_slope - log_slope.max(), -40, 0))
        steps = (slope[1:] + slope[:-1]) / 2 * np.diff(self.grid)
        light = np.concatenate([[0], np.cumsum(steps)])
        return light / light[-1], slope / light[-1]

    def errors(
        self, light: np.ndarray, least_room: float = 0.0
    ) -> Float[np.ndarray, " n"]:
        """Of numbers, for the light of a curve and of a room with at least this."""
        samples, q = self.samples, self.samples.share
        # Below black it goes on straight: corrected numbers lie there.
        first = light[1] / self.grid[1]
        found = np.interp(self.number, self.grid, light)
        found = found + np.minimum(self.number, 0) * first
        weight = self.used / self.rise**2

        def sums(values: np.ndarray) -> np.ndarray:
            return np.bincount(samples.group, values)

        squares = np.maximum(sums(weight * q * q), 1e-300)
        products, room = sums(weight * q * found), 0.0
        if samples.room:
            # The room's light, once strengths follow it.
            crossed = sums(weight * q)
            top = np.sum(weight * found) - np.sum(products * crossed / squares)
            bottom = np.sum(weight) - np.sum(crossed**2 / squares)
            room = max(top / bottom, least_room) if bottom > 0 else 0.0
            products = products - room * crossed
        told = (products / squares)[samples.group] * q + room
        expected = np.interp(told, light, self.grid) + np.minimum(told, 0) / first
        return self.number - expected

    def response(self) -> Response:
        """The curve that explains the samples best, and what is known of it."""
        theta = self._solve()
        rest = self.errors(self.curve(theta)[0])
        # A room without light has an uncertain light, too: no bound at 0 here.
        free = self.errors(self.curve(theta)[0], -np.inf)
        jacobian = self._jacobian(theta, free, -np.inf)
        lit = self._lit(self.number - rest)
        count, freedom = np.count_nonzero(lit), self._freedom(lit) - SPLINES
        u = rest / (TUKEY * self.sigma)
        scores = self.used * rest
        slope = np.where(lit & (np.abs(u) < 1), (1 - u**2) * (1 - 5 * u**2), 0)
        # Huber, *Robust statistics*, 1981, section 7.6: what weights cost.
        variance = np.sum(scores**2) / freedom / (np.sum(slope) / count) ** 2
        data = jacobian.T @ (self.used[:, None] * jacobian)
        known = np.linalg.solve(data + self._held(), data)
        # Neighbours err together: by how much more scores of blocks vary.
        _, block = np.unique(self.samples.block, return_inverse=True)
        each = scores[:, None] * jacobian
        together = np.zeros((block.max() + 1, SPLINES))
        np.add.at(together, block, each)
        bread = known @ np.linalg.inv(data + self._held())
        alone = np.trace(bread @ each.T @ each)
        inflation = float(np.trace(bread @ together.T @ together) / alone)
        weight = np.sum(self.used) / count
        variance = weight * variance * max(inflation, 1.0)
        covariance = np.linalg.inv(
            data / variance + self.stiff * self.smooth.T @ self.smooth
        )
        return self._result(theta, variance, covariance, float(np.trace(known)))

    def _result(
        self, theta: np.ndarray, variance: float, covariance: np.ndarray, freedom: float
    ) -> Response:
        light, _ = self.curve(theta)
        numbers = np.linspace(0, 1, SAMPLES)
        # What lies flat to the last digit still rises.
        samples = np.interp(numbers, self.grid, light) + 1e-9 * numbers
        samples = samples / samples[-1]
        lit = (self.used > 0) & (self.samples.share > 0)
        low, high = np.percentile(self.samples.number[lit], (0.5, 99.5))
        seen = (float(low), float(high))

        def shape(at: np.ndarray) -> np.ndarray:
            """Of a curve, since how bright all light is does not matter."""
            other = self.curve(at)[0]
            at_high = np.interp(high, self.grid, other)
            return np.interp(numbers, self.grid, other) / at_high

        moved = [shape(theta + step) - shape(theta) for step in 1e-4 * np.eye(SPLINES)]
        slopes = np.array(moved).T / 1e-4
        error = np.sqrt(np.einsum("ni,ij,nj->n", slopes, covariance, slopes))
        best = float(np.sum(self.used * self.errors(light) ** 2))
        checks = {
            name: self._check(name, best, variance, max(freedom, 1.0), light, seen)
            for name in ENCODINGS
        }
        curve = ResponseCurve(samples.tolist())
        return Response(curve, error, seen, checks, self._warnings(*seen))

    def _solve(self) -> np.ndarray:
        """The spline's numbers; which samples count, and how they err, on the way."""
        theta = self._start()
        for number in range(ROUNDS):
            # At first stiff: else it bends below the darkest number that is seen, where
            # a step in light and light of the room look alike.
            self.stiff = max(STIFF / 4**number, 1.0)
            for _ in range(STEPS):
                before, theta = theta, self._step(theta)
                if np.abs(theta - before).max() < SMALL:
                    break
            light, slope = self.curve(theta)
            rest = self.errors(light)
            told = self.number - rest
            lit = self._lit(told)
            # Of shadows black may have cut half off.
            typical = np.median(np.abs(rest[lit & (self.samples.share > 0)]))
            lost = np.sqrt(np.count_nonzero(lit) / self._freedom(lit))
            self.sigma = max(1.4826 * float(typical * lost), 1e-5)
            self.number = self.samples.number - _raised(told, self.sigma)
            rest = self.number - told
            tukey = np.clip(1 - (rest / (TUKEY * self.sigma)) ** 2, 0, None) ** 2
            # At first no curve is near enough to say what is an outlier.
            self.used = np.where(lit, tukey if number >= ROUNDS // 2 else 1.0, 0)
            self.rise = np.interp(np.maximum(told, DARKEST), self.grid, slope)
        return theta

    def _lit(self, told: np.ndarray) -> np.ndarray:
        """Samples that count: shadows, and what is neither black nor white."""
        return self._inside(told) | (self.samples.share == 0)

    def _freedom(self, lit: np.ndarray) -> int:
        """Samples that count, less the strengths found from them; 1 at the least."""
        strengths = np.unique(self.samples.group[lit & (self.samples.share > 0)])
        return max(int(np.count_nonzero(lit)) - len(strengths) - self.samples.room, 1)

    def _inside(self, told: np.ndarray) -> np.ndarray:
        """Which samples are neither black nor white.

        Where noise might have made a number so, what it should be decides.
        """
        number, near = self.samples.number, min(5 * self.sigma, 0.1)
        dark = np.where(number < DARKEST + near, told, number) < DARKEST
        bright = np.where(number > BRIGHTEST - near, told, number) > BRIGHTEST
        return ~dark & ~bright

    def _start(self) -> np.ndarray:
        """The encoding with a name that is nearer."""
        starts = []
        for name in ENCODINGS:
            light = np.asarray(decode(self.grid, name))
            log_slope = np.log(np.gradient(light, self.grid))
            theta = np.linalg.lstsq(self.basis, log_slope, rcond=None)[0]
            rest = np.abs(self.errors(light)[self.used > 0])
            starts.append((float(np.median(rest)), theta))
        return min(starts, key=lambda start: start[0])[1]

    def _jacobian(
        self, theta: np.ndarray, here: np.ndarray, least_room: float = 0.0
    ) -> np.ndarray:
        """Of errors that are `here` at these numbers."""
        step = 1e-4
        moved = [
            self.errors(self.curve(theta + one)[0], least_room)
            for one in step * np.eye(SPLINES)
        ]
        return (np.array(moved) - here).T / step

    def _held(self) -> np.ndarray:
        return self.stiff * self.sigma**2 * self.smooth.T @ self.smooth

    def _step(self, theta: np.ndarray) -> np.ndarray:
        """A step of Gauss and Newton's, halved until it leads downwards."""

        def cost(at: np.ndarray, rest: np.ndarray) -> float:
            return float(np.sum(self.used * rest**2) + at @ self._held() @ at)

        rest = self.errors(self.curve(theta)[0])
        rows = self._jacobian(theta, rest)
        weighted = self.used[:, None] * rows
        right = weighted.T @ rest + self._held() @ theta
        step = -np.linalg.solve(rows.T @ weighted + self._held(), right)
        step = step / max(np.abs(step).max(), 1)
        before = cost(theta, rest)
        for _ in range(10):
            there = theta + step
            if cost(there, self.errors(self.curve(there)[0])) <= before:
                return there
            step = step / 2
        return theta

    def _check(
        self,
        name: NamedEncoding,
        best: float,
        variance: float,
        freedom: float,
        light: np.ndarray,
        seen: tuple[float, float],
    ) -> Check:
        from scipy import stats

        other = np.asarray(decode(self.grid, name))
        rest = self.errors(other)
        more = max((float(np.sum(self.used * rest**2)) - best) / variance, 0.0)
        chance = float(stats.chi2.sf(more, freedom))
        # Far out the tail's probability is less than any number.
        sigmas = stats.norm.isf(chance / 2) if chance > 1e-300 else np.sqrt(more)
        shown = (self.grid >= seen[0]) & (self.grid <= seen[1])
        one, two = other[shown], light[shown]
        scale = one @ two / (two @ two)
        return Check(float(sigmas), float(np.abs(one - scale * two).max()))

    def _warnings(self, low: float, high: float) -> tuple[str, ...]:
        found = []
        if high < 0.7 or low > 0.4:
            words = (
                f"only numbers from {low:.2f} to {high:.2f} are seen: beyond them the "
                "curve is extrapolated"
            )
            found.append(coded("range-unseen", words))
        if self.sigma > 0.02:
            words = f"numbers are {self.sigma:.3f} from the curve (standard deviation)"
            found.append(coded("not-one-curve", words))
        return tuple(found)
