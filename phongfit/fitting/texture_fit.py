r"""`fit_texture`: photographs and geometry in, texels with errors out.

For given exponents the light is linear in the texels and in what is shared by all of a
material. Gauss-Newton steps solve for all at once: the texels, which are many and
hardly coupled, are eliminated by a sparse solve, and what is left is a small dense
system of the shared numbers (a Schur complement), which also gives their errors.

??? cite "Source"
    Variable projection: Golub and Pereyra, *Separable nonlinear least squares*, Inverse
    Problems 19(2), 2003; the elimination is that of bundle adjustment, Triggs et al.,
    *Bundle adjustment: a modern synthesis*, 1999.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import sparse

from phongfit.checks import as_floats, untraced
from phongfit.codes import coded
from phongfit.edge import checked
from phongfit.fitting.problem.inputs import as_photographs, as_scenes
from phongfit.fitting.problem.losses import Linear
from phongfit.fitting.problem.noise import arithmetic_floor, find_film
from phongfit.fitting.texels.lit import BASIS, LitImage, basis, see, shown
from phongfit.fitting.texels.result import CHANNELS, Shared, TextureFit, as_textures
from phongfit.fitting.texels.solve import Preconditioned, inverse_diagonal, precondition
from phongfit.fitting.texels.sums import (
    Grid,
    Touched,
    as_matrix,
    smoothness_matrix,
)
from phongfit.fitting.uncertainty.misfit import Misfit, find_misfit
from phongfit.fitting.uncertainty.tiles import (
    Measured,
    Tiles,
    sum_over_tiles,
    tile_side,
)
from phongfit.fitting.uncertainty.warnings import misfit_words, spread_words
from phongfit.material import Material
from phongfit.programs import program
from phongfit.rendering.film import Film, as_films
from phongfit.scene import Scene
from phongfit.textures import Filter, Wrap

TEXTURED = ("ambient", "diffuse", "specular")
SHARED = (*TEXTURED, "shininess")

PRIOR = 0.5, 1.0
"""Mean and standard deviation of what is known of a reflectance before any image."""

EXPONENTS = 1.0, 1000.0
SCAN = np.geomspace(2.0, 700.0, 11)
"""Exponents among which a fit starts, each with the texels that suit it best."""

TOLERANCE = 1e-5
"""Of the sparse solves, relative to their right-hand sides."""

PROBES = 8
"""Random vectors that the trace of a large matrix is estimated from."""

LEAST = 1e-7
"""Eigenvalue of the shared numbers' scaled information that none is identified by."""


class Few(NamedTuple):
    """One number that all of a material shares: of one channel, or of all."""

    name: str
    material: int
    channel: int | None


class _State(NamedTuple):
    """Textures, (3, parameters · texels), and the materials' numbers."""

    texels: np.ndarray
    numbers: dict[str, np.ndarray]

    def value(self, one: Few) -> float:
        """A shared number as it stands; of several channels' one, the first's."""
        own = np.atleast_1d(self.numbers[one.name][one.material])
        return float(own[one.channel or 0])


@dataclasses.dataclass
class _Job:
    """What is asked, and of what."""

    images: list[LitImage]
    grid: Grid
    names: tuple[str, ...]
    few: list[Few]
    clamp: bool
    smoothness: sparse.csr_array | None
    floor: float

    @property
    def size(self) -> int:
        return len(self.names) * self.grid.texels

    def of_channel(self, channel: int) -> list[int]:
        """The shared numbers that light of a channel depends on."""
        return [k for k, one in enumerate(self.few) if one.channel in (None, channel)]


@checked
def fit_texture(
    scene: Scene | Sequence[Scene],
    image: Any,
    *,
    size: tuple[int, int],
    textures: Sequence[str] = ("diffuse",),
    unknowns: Sequence[str] = ("specular", "shininess"),
    per_channel: Sequence[str] = ("ambient", "diffuse", "specular"),
    known: Material | None = None,
    separate: bool = False,
    smoothness: float | None = None,
    filter: Filter = "bilinear",
    wrap: Wrap = "repeat",
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
    film: Film | Sequence[Film] | None = None,
    max_steps: int = 20,
) -> TextureFit:
    r"""Textures that explain photographs of a mesh, texel by texel, with errors.

    Minimises $\sum_i w_i (I_i - t_i)^2 / \sigma^2$ over the texels of the reflectances,
    within 0 … 1, and over what all points of a material share. The photographs may show
    the surface from any places, under any lamps.

    **Arguments:**

    - `scene`: one, or a sequence of scenes, of one [`Mesh`][] with uv. What it has of
        textures besides those that are sought is known, and multiplies as ever.
    - `image`: as of [`fit`][].
    - `size`: rows and columns of the textures that are sought.
    - `textures`: parameters with a number for each texel and channel: some of
        `"ambient"`, `"diffuse"` and `"specular"`.
    - `unknowns`: parameters with numbers of each material: some of these and
        `"shininess"`.
    - `per_channel`: those of `unknowns` with one for each of red, green and blue.
    - `known`: what is neither; default no reflectance and an exponent of 32. Of several
        materials parameters have shape (M, 3), (M, 1), or less.
    - `separate`: a texture for each material; default one that all lie on.
    - `smoothness`: standard deviation of what is expected between neighbouring texels;
        default no such expectation. It is a prior: sharp edges are drawn softer.
    - `filter`, `wrap`: how the textures are looked up: see [`Texture`][].
    - `mask`, `weights`, `noise`, `film`: as of [`fit`][].
    - `max_steps`: of Gauss and Newton's.

    Each texel has, besides, a prior of 0.5 ± 1, which counts only where the photographs
    tell next to nothing; a texel that is not known to better than ± 0.5 is not
    identified, and its error infinite. A mean over a pixel is no part of the model: a
    texture should not be finer than the photographs.

    **Returns:** a [`TextureFit`][].

    **Raises:** `ValueError` that names the argument.
    """
    untraced("fit outside", scene=scene, image=image, known=known, noise=noise)
    names, few_names = tuple(textures), tuple(unknowns)
    _check_names(names, few_names)
    scenes = as_scenes(scene)
    observed = as_photographs(
        scene if isinstance(scene, Scene) else scenes, image, mask, weights, noise
    )
    if film is None:
        films = (find_film([one.used() for one in observed]),) * len(observed)
    else:
        films = as_films(film, len(observed))
    if len({one.clamp for one in films}) > 1:
        raise ValueError("film: expected one clamp for all images, got both")
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"size: expected rows and columns, got {size}")
    if smoothness is not None and not 0 < smoothness < np.inf:
        raise ValueError(f"smoothness: expected a number > 0, got {smoothness}")
    materials = scenes[0].surface.materials
    grid = Grid(materials if separate else 1, *size, wrap)
    channels = {name: name in per_channel and name != "shininess" for name in few_names}
    few = [
        Few(name, material, channel)
        for name in few_names
        for material in range(materials)
        for channel in (range(3) if channels[name] else [None])
    ]
    job = _Job(
        [
            see(one, film, grid, filter, names)
            for one, film in zip(observed, films, strict=True)
        ],
        grid,
        names,
        few,
        films[0].clamp,
        None if smoothness is None else smoothness_matrix(grid, len(names), smoothness),
        # Residuals below it are rounding of the arithmetic, or of no matter.
        max(float(arithmetic_floor(jnp.asarray(one.used()))) for one in observed)
        if noise is None
        else 0.01,
    )
    if not sum(len(one.place) for one in job.images):
        raise ValueError("mask: it leaves no pixel that sees the surface")
    numbers = _numbers(known, materials)
    start, sigma = _scan(job, numbers, noise is not None)
    state, sigma, system, converged, steps = _solve(
        job, start, sigma, noise is not None, max_steps
    )
    return _finish(job, state, sigma, system, noise is not None, converged, steps)


def _check_names(names: tuple[str, ...], few: tuple[str, ...]) -> None:
    for argument, given, known in (
        ("textures", names, TEXTURED),
        ("unknowns", few, SHARED),
    ):
        for name in given:
            if name not in known:
                wanted = ", ".join(known)
                raise ValueError(f"{argument}: expected some of {wanted}, got {name!r}")
        if len(set(given)) < len(given):
            raise ValueError(f"{argument}: expected each name once, got {given}")
    if not names:
        raise ValueError("textures: expected at least one, got none")
    for name in names:
        if name in few:
            raise ValueError(
                f"unknowns: {name} has a texture; expected it in one of the two"
            )


def _numbers(known: Material | None, materials: int) -> dict[str, np.ndarray]:
    """The materials' numbers, (M, 3), and exponents, (M,)."""
    if known is None:
        known = Material(0.0, 0.0, 32.0, 0.0)
    numbers = {}
    for name in (*BASIS, "shininess"):
        leaf = np.asarray(as_floats(name, getattr(known, name)), float)
        if leaf.ndim > 2 or (leaf.ndim == 2 and len(leaf) not in (1, materials)):
            raise ValueError(f"known: {name} has shape {leaf.shape}")
        numbers[name] = np.broadcast_to(leaf, (materials, 3)).copy()
    exponents = numbers["shininess"]
    if np.ptp(exponents, axis=1).any():
        raise ValueError("known: expected one exponent for all channels")
    numbers["shininess"] = exponents[:, 0].copy()
    return numbers


class _Sums(NamedTuple):
    """Normal equations: of each channel's texels, of the few, and of both.

    `cost` is the sum of squares of each material, `residual` that of the samples that
    are not clipped, and `counted` how many these are.
    """

    blocks: list[dict[tuple[int, int], np.ndarray]]
    right: np.ndarray
    mixed: list[np.ndarray]
    dense: np.ndarray
    few_right: np.ndarray
    cost: np.ndarray
    residual: float
    counted: int


def _sum_up(job: _Job, state: _State, sigma: float, nearest: bool = False) -> _Sums:
    """Of all samples, where the light of `state` is what the film shows.

    **Arguments:** `nearest`: as if each sample saw one texel, the nearest.
    """
    grid, names, few = job.grid, job.names, job.few
    blocks: list[dict[tuple[int, int], np.ndarray]] = [{} for _ in range(3)]
    right = np.zeros((3, job.size))
    mixed = [np.zeros((job.size, len(job.of_channel(c)))) for c in range(3)]
    dense, few_right = np.zeros((len(few), len(few))), np.zeros(len(few))
    cost = np.zeros(len(state.numbers["shininess"]))
    residual, count = 0.0, 0
    for image in job.images:
        touched = _nearest(image.touched) if nearest else image.touched
        parts, light = _light(job, image, state, touched)
        deviation = sigma / np.sqrt(np.where(image.weight > 0, image.weight, 1))
        film = shown(light, deviation, job.clamp)
        used = image.weight > 0
        left = np.where(used, (image.target - film.mean) / deviation, 0)
        gain = np.where(used, film.slope / deviation, 0)
        cost += np.bincount(image.material, (left**2).sum(axis=1), len(cost))
        free = used
        if job.clamp:
            free = used & (image.target > 0) & (image.target < 1)
        residual += float((left**2)[free].sum())
        count += int(np.count_nonzero(free))
        for c in range(3):
            columns = [
                parts.light[BASIS.index(name)][:, c] * gain[:, c] for name in names
            ]
            shared = job.of_channel(c)
            others = [
                _column(few[k], parts, state, job, image, touched, c) * gain[:, c]
                for k in shared
            ]
            for p, column in enumerate(columns):
                span = slice(p * grid.texels, (p + 1) * grid.texels)
                right[c, span] += touched.scattered(column * left[:, c], grid.texels)
                for k, other in enumerate(others):
                    mixed[c][span, k] += touched.scattered(column * other, grid.texels)
                for q in range(p, len(names)):
                    products = touched.products(column * columns[q], grid.texels)
                    blocks[c][p, q] = blocks[c].get((p, q), 0) + products
            for i, k in enumerate(shared):
                few_right[k] += others[i] @ left[:, c]
                for j, m in enumerate(shared):
                    dense[k, m] += others[i] @ others[j]
    return _Sums(blocks, right, mixed, dense, few_right, cost, residual, count)


def _nearest(touched: Touched) -> Touched:
    best = touched.weight.argmax(axis=1)[:, None]
    index = np.take_along_axis(touched.number, best, axis=1)
    return Touched(index, np.ones(index.shape, touched.weight.dtype))


def _light(
    job: _Job, image: LitImage, state: _State, touched: Touched
) -> tuple[Any, np.ndarray]:
    """Basis images, and the light that the state makes of them."""
    parts = basis(image, state.numbers["shininess"])
    light = parts.fog.astype(float)
    for number, name in enumerate(BASIS):
        if name in job.names:
            share = np.stack(
                [touched.mean(_texture(job, state, name, c)) for c in range(3)], axis=1
            )
        else:
            share = state.numbers[name][image.material]
        light += share * parts.light[number]
    return parts, light


def _texture(job: _Job, state: _State, name: str, channel: int) -> np.ndarray:
    at = job.names.index(name) * job.grid.texels
    return state.texels[channel, at : at + job.grid.texels]


def _column(
    one: Few,
    parts: Any,
    state: _State,
    job: _Job,
    image: LitImage,
    touched: Touched,
    channel: int,
) -> np.ndarray:
    """How a channel's light grows with a shared number; of an exponent, its log."""
    own = image.material == one.material
    if one.name != "shininess":
        return np.where(own, parts.light[BASIS.index(one.name)][:, channel], 0)
    if "specular" in job.names:
        share = touched.mean(_texture(job, state, "specular", channel))
    else:
        share = state.numbers["specular"][image.material, channel]
    return np.where(own, share * parts.slope[:, channel], 0)


def _systems(job: _Job, sums: _Sums, state: _State) -> tuple[list[Any], np.ndarray]:
    """The texels' matrices with their priors, and the right-hand sides with them."""
    mean, deviation = PRIOR
    right = sums.right + (mean - state.texels) / deviation**2
    matrices: list[Any] = []
    for c in range(3):
        alike = c and all(
            np.allclose(sums.blocks[c][at], sums.blocks[0][at], rtol=1e-6)
            for at in sums.blocks[0]
        )
        if alike and matrices:
            matrices.append(matrices[0])
        else:
            matrix = as_matrix(job.grid, sums.blocks[c], len(job.names))
            matrix = matrix + sparse.eye_array(job.size) / deviation**2
            if job.smoothness is not None:
                matrix = matrix + job.smoothness
            matrices.append(precondition(sparse.csr_array(matrix)))
        if job.smoothness is not None:
            right[c] -= job.smoothness @ state.texels[c]
    return matrices, right


def _scan(
    job: _Job, numbers: dict[str, np.ndarray], noise_given: bool
) -> tuple[_State, float]:
    """Where to start: the best of some exponents, each material on its own.

    Each sample sees the nearest texel alone, which is then solved for at once.
    """
    sigma = 1.0 if noise_given else 0.02
    seek = any(one.name == "shininess" for one in job.few)
    linear = dataclasses.replace(
        job, few=[one for one in job.few if one.name != "shininess"]
    )
    best_cost = np.full(len(numbers["shininess"]), np.inf)
    best = numbers["shininess"].copy()
    texels = np.full((3, job.size), PRIOR[0])
    state = _State(texels, numbers)
    for f in SCAN if seek else ():
        tried = _State(
            texels, numbers | {"shininess": np.full_like(numbers["shininess"], f)}
        )
        stepped, _ = _step(linear, tried, sigma, nearest=True)
        cost = _sum_up(linear, stepped, sigma, nearest=True).cost
        better = cost < best_cost
        best, best_cost = np.where(better, f, best), np.where(better, cost, best_cost)
    state = _State(texels, numbers | {"shininess": best})
    state, _ = _step(linear, state, sigma)
    return state, sigma


class _System(NamedTuple):
    """The last step's equations: what errors are made of."""

    sums: _Sums
    matrices: list[Preconditioned]
    eliminated: list[np.ndarray]
    information: np.ndarray


def _step(
    job: _Job, state: _State, sigma: float, nearest: bool = False
) -> tuple[_State, _System]:
    """One step of Gauss and Newton's, within the bounds."""
    sums = _sum_up(job, state, sigma, nearest)
    matrices, right = _systems(job, sums, state)
    information, few_right = sums.dense.copy(), sums.few_right.copy()
    solutions, eliminated = [], []
    for c, matrix in enumerate(matrices):
        at_low = (state.texels[c] <= 0) & (right[c] < 0)
        at_high = (state.texels[c] >= 1) & (right[c] > 0)
        free = ~(at_low | at_high)
        both = np.column_stack([right[c], sums.mixed[c]])
        solved = matrix.solve(both, TOLERANCE, free)
        shared = job.of_channel(c)
        known = (sums.mixed[c] * free[:, None]).T @ solved[:, 1:]
        information[np.ix_(shared, shared)] -= known
        few_right[shared] -= solved[:, 1:].T @ right[c]
        solutions.append(solved[:, 0])
        eliminated.append(solved[:, 1:])
    information = (information + information.T) / 2
    change = _few_change(job, state, information, few_right)
    texels = state.texels.copy()
    for c, solution in enumerate(solutions):
        moved = solution - eliminated[c] @ change[job.of_channel(c)]
        texels[c] = np.clip(texels[c] + moved, 0, 1)
    numbers = {name: value.copy() for name, value in state.numbers.items()}
    for one, by in zip(job.few, change, strict=True):
        value = numbers[one.name]
        if one.name == "shininess":
            low, high = np.log(EXPONENTS)
            moved = np.clip(np.log(value[one.material]) + by, low, high)
            value[one.material] = np.exp(moved)
        else:
            at = slice(None) if one.channel is None else one.channel
            value[one.material, at] = np.clip(value[one.material, at] + by, 0, 1)
    return _State(texels, numbers), _System(sums, matrices, eliminated, information)


def _few_change(
    job: _Job, state: _State, information: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """The step of the shared numbers; none for those at a bound that push outwards."""
    free = np.diag(information) > 0
    for k, one in enumerate(job.few):
        value = state.value(one)
        low, high = EXPONENTS if one.name == "shininess" else (0.0, 1.0)
        if (value <= low and right[k] < 0) or (value >= high and right[k] > 0):
            free[k] = False
    change = np.zeros(len(job.few))
    at = np.flatnonzero(free)
    if at.size:
        scale = np.sqrt(np.diag(information)[at])
        scaled = information[np.ix_(at, at)] / np.outer(scale, scale)
        # What the photographs do not tell apart stays where it is.
        inverse = np.linalg.pinv(scaled, rcond=LEAST, hermitian=True)
        change[at] = inverse @ (right[at] / scale) / scale
    for k, one in enumerate(job.few):
        if one.name == "shininess":
            change[k] = np.clip(change[k], -1, 1)
    return change


def _solve(
    job: _Job, state: _State, sigma: float, noise_given: bool, max_steps: int
) -> tuple[_State, float, _System, bool, int]:
    """Steps until nothing changes, with the noise that is found on the way."""
    state, system = _step(job, state, sigma)
    cost, converged, steps = np.inf, False, 1
    while steps < max_steps and not converged:
        if not noise_given:
            sigma = _noise(job, system.sums, sigma)
        following, system = _step(job, state, sigma)
        now = float(system.sums.cost.sum()) * sigma**2
        least = 1e-5 * max(now, system.sums.counted * job.floor**2)
        converged = abs(cost - now) < least and _moved(state, following) < 1e-3
        state, cost, steps = following, now, steps + 1
    if not noise_given:
        sigma = _noise(job, system.sums, sigma)
    # Where it stands now, with the noise as it is.
    system = _step(job, state, sigma)[1]
    if not noise_given:
        found = sigma * np.sqrt(system.sums.residual / _freedom(job, system))
        sigma = max(float(found), job.floor)
        system = _step(job, state, sigma)[1]
    return state, sigma, system, converged, steps


def _moved(one: _State, other: _State) -> float:
    """The largest change of a material's number, relative to it."""
    return max(
        float(abs(np.log(other.numbers[name] + 1e-3) - np.log(value + 1e-3)).max())
        for name, value in one.numbers.items()
    )


def _noise(job: _Job, sums: _Sums, sigma: float) -> float:
    """A first estimate: a texel takes a sample away where it has one."""
    ridge = 1 / PRIOR[1] ** 2
    taken = sum(
        float((blocks[p, p][0] / (blocks[p, p][0] + ridge)).sum())
        for blocks in sums.blocks
        for p in range(len(job.names))
    )
    freedom = max(sums.counted - taken - len(job.few), 0.1 * sums.counted, 1.0)
    return max(sigma * float(np.sqrt(sums.residual / freedom)), job.floor)


def _freedom(job: _Job, system: _System) -> float:
    """Samples less the numbers that they determine: the trace of the hat matrix.

    ??? cite "Source"
        Hutchinson, *A stochastic estimator of the trace of the influence matrix*,
        Commun. Stat. Simul. Comput. 19(2), 1990.
    """
    random = np.random.default_rng(1)
    taken, known = float(len(job.few)), {}
    for matrix in system.matrices:
        if id(matrix) not in known:
            probes = random.choice([-1.0, 1.0], (job.size, PROBES))
            solved = matrix.solve(probes, 1e-3)
            prior = probes / PRIOR[1] ** 2
            if job.smoothness is not None:
                prior = prior + job.smoothness @ probes
            known[id(matrix)] = job.size - float((prior * solved).sum()) / PROBES
        taken += known[id(matrix)]
    return max(system.sums.counted - taken, 1.0)


def _finish(
    job: _Job,
    state: _State,
    sigma: float,
    system: _System,
    noise_given: bool,
    converged: bool,
    steps: int,
) -> TextureFit:
    """Errors, lack of fit, warnings."""
    covariance, told = _few_covariance(system.information)
    variances, known = np.empty((3, job.size)), {}
    for c, matrix in enumerate(system.matrices):
        if id(matrix) not in known:
            known[id(matrix)] = inverse_diagonal(matrix, job.grid, len(job.names))
        shared = job.of_channel(c)
        part = np.where(told, covariance, 0)[np.ix_(shared, shared)]
        moved = system.eliminated[c]
        variances[c] = known[id(matrix)] + ((moved @ part) * moved).sum(axis=1)
    freedom = _freedom(job, system)
    images = [_image(job, one, state, sigma) for one in job.images]
    side = max(tile_side(*one.image.shape[:2]) for one in job.images)
    misfit = find_misfit([one.tiles for one in images], side)
    spread = 1.0
    if noise_given:
        over = system.sums.residual / freedom
        spread = float(np.sqrt(over)) if over > 1 + 5 * np.sqrt(2 / freedom) else 1.0
    inflation = max(misfit.inflation, spread**2)
    identified = variances < (PRIOR[1] / 2) ** 2
    seen = _times_seen(job)
    errors = np.sqrt(np.where(identified, variances * inflation, np.inf))
    few_errors = np.sqrt(np.where(np.diag(told), np.diag(covariance), np.inf))
    few_errors = few_errors * np.sqrt(inflation)
    numbers = {name: value.copy() for name, value in state.numbers.items()}
    for name in job.names:
        numbers[name][:] = 1
    shared = []
    for k, one in enumerate(job.few):
        value = state.value(one)
        # Found as a logarithm.
        error = few_errors[k] * (value if one.name == "shininess" else 1)
        shared.append(Shared(_label(job, one), value, float(error)))
    return TextureFit(
        as_textures(job, state.texels),
        as_textures(job, np.where(identified, errors, np.inf)),
        seen,
        Material(
            **{name: numbers[name] for name in BASIS},
            shininess=numbers["shininess"][:, None],
        ),
        tuple(shared),
        covariance * inflation,
        job.names,
        sigma if not noise_given else 1.0,
        int(system.sums.counted),
        tuple(one.residual for one in images),
        misfit,
        converged,
        steps,
        tuple(_warnings(job, misfit, spread, converged, shared, freedom, noise_given)),
        job.grid.wrap,
    )


def _few_covariance(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse, and which pairs of the shared numbers are identified."""
    diagonal = np.diag(information)
    there = diagonal > 0
    scale = np.sqrt(np.where(there, diagonal, 1))
    scaled = information / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(np.where(np.outer(there, there), scaled, 0))
    vague = values < LEAST
    lost = (vectors[:, vague] ** 2).sum(axis=1) > 0.01
    inverse = (vectors / np.where(vague, np.inf, values)) @ vectors.T
    told = ~lost & there
    return inverse / np.outer(scale, scale), np.outer(told, told)


def _label(job: _Job, one: Few) -> str:
    several = max(k.material for k in job.few) > 0
    number = f"[{one.material}]" if several else ""
    return f"{one.name}{number}" + (
        "" if one.channel is None else f".{CHANNELS[one.channel]}"
    )


def _times_seen(job: _Job) -> np.ndarray:
    """How often each texel is seen: pixels, as much as they look at it."""
    total = np.zeros(job.grid.texels)
    for image in job.images:
        used = (image.weight > 0).any(axis=1)
        total += image.touched.scattered(used.astype(float), job.grid.texels)
    return total.reshape(job.grid.layers, job.grid.rows, job.grid.columns)


class _Shown(NamedTuple):
    residual: np.ndarray
    tiles: Tiles


def _image(job: _Job, image: LitImage, state: _State, sigma: float) -> _Shown:
    """Residuals of one image, and their sums over tiles."""
    parts, light = _light(job, image, state, image.touched)
    whole = np.zeros((4, image.image.size // 3, 3), image.image.dtype)
    whole[0, image.place] = light
    whole[1, image.place] = parts.light[1]
    whole[2, image.place] = parts.light[2]
    whole[3, image.place] = image.weight
    light, diffuse, highlight, weight = whole.reshape(4, *image.image.shape)
    side = tile_side(*image.image.shape[:2])
    step = None if image.step is None else jnp.asarray(image.step)
    deviation = jnp.asarray(sigma, light.dtype)
    measured = Measured(jnp.asarray(image.image), jnp.asarray(weight), step, deviation)
    tiles = _tiles(measured, light, diffuse, highlight, job.clamp, side)
    fitted = np.clip(light, 0, 1) if job.clamp else light
    return _Shown(np.where(weight > 0, image.image - fitted, 0), tiles)


@program("clamp", "side")
def _tiles(
    measured: Measured,
    light: Array,
    diffuse: Array,
    highlight: Array,
    clamp: bool,
    side: int,
) -> Tiles:
    return sum_over_tiles(measured, light, diffuse, highlight, Linear(), clamp, side)


def _warnings(
    job: _Job,
    misfit: Misfit,
    spread: float,
    converged: bool,
    shared: list[Shared],
    freedom: float,
    noise_given: bool,
) -> list[str]:
    words = []
    if not converged:
        words.append(
            coded(
                "not-converged",
                "did not converge",
                "Raise max_steps, or ask for fewer unknowns",
            )
        )
    lost = [one.label for one in shared if not np.isfinite(one.stderr)]
    if lost:
        words.append(
            coded(
                "not-identifiable",
                f"{', '.join(lost)}: not identifiable from these photographs",
                "Give it as known, or photographs under other lamps",
            )
        )
    total = sum(int(np.count_nonzero(one.weight > 0)) for one in job.images)
    if not noise_given and freedom < 0.1 * total:
        words.append(
            coded(
                "noise-level",
                f"{total:,} samples leave {freedom:,.0f} to estimate the noise from",
                "Give noise, or a smaller size",
            )
        )
    words += spread_words(spread)
    return [*words, *misfit_words(misfit, len(job.images))]
