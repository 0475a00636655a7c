"""Normal equations of texels and of what a material shares, summed over all samples."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from phongfit.fitting.texels.job import PRIOR, Job, State
from phongfit.fitting.texels.lit import BASIS, Basis, LitImage, basis, shown
from phongfit.fitting.texels.solve import Preconditioned, precondition, rescale
from phongfit.fitting.texels.sums import Touched


class Left(NamedTuple):
    """What the light of a state leaves of the photographs, in standard deviations.

    `cost` is the sum of squares, `squares` that of the samples that are not clipped,
    and `counted` how many these are.
    """

    cost: float
    squares: float
    counted: int


class Sums(NamedTuple):
    """Normal equations: of each system's texels, of the few, and of both.

    What is large has the precision of the photographs. `blocks` of exponents are of f,
    all else is of log f: `unit` is what log f is multiplied by, field by field, where
    there are any. A sample's f is the mean of its texels', as in a render.
    """

    blocks: list[dict[tuple[int, int], np.ndarray]]
    right: list[np.ndarray]
    mixed: list[np.ndarray]
    dense: np.ndarray
    few_right: np.ndarray
    left: Left
    unit: np.ndarray | None


class Compared(NamedTuple):
    """One photograph beside a state's light, in standard deviations of its samples.

    - `parts`: basis images of its samples.
    - `left`: what is left of it; `gain`: how the model grows with its light. Both are 0
        where a sample does not count.
    - `free`: samples that count and are not clipped.
    """

    parts: Basis
    left: Float[np.ndarray, "n 3"]
    gain: Float[np.ndarray, "n 3"]
    free: Bool[np.ndarray, "n 3"]


def compare(
    job: Job, image: LitImage, state: State, touched: Touched, sigma: float
) -> Compared:
    """A photograph with what the film shows of the light of `state`."""
    parts, light = light_of(job, image, state, touched)
    deviation = sigma / np.sqrt(np.where(image.weight > 0, image.weight, 1))
    film = shown(light, deviation, job.clamp)
    used = image.weight > 0
    left = np.where(used, (image.target - film.mean) / deviation, 0)
    gain = np.where(used, film.slope / deviation, 0)
    if job.clamp:
        used = used & (image.target > 0) & (image.target < 1)
    return Compared(parts, left, gain, used)


def costs(job: Job, state: State, sigma: float) -> Float[np.ndarray, " materials"]:
    """Sums of squares of each material, where samples see the nearest texel alone."""
    total = np.zeros(len(state.numbers["shininess"]))
    for image in job.images:
        left = compare(job, image, state, _nearest(image.touched), sigma).left
        total += np.bincount(image.material, (left**2).sum(axis=1), len(total))
    return total


def sum_up(job: Job, state: State, sigma: float, nearest: bool = False) -> Sums:
    """Of all samples, where the light of `state` is what the film shows.

    **Arguments:** `nearest`: as if each sample saw one texel, the nearest.
    """
    texels, systems, few = job.grid.texels, job.systems, job.few
    blocks: list[dict[tuple[int, int], np.ndarray]] = [{} for _ in systems]
    right = [np.zeros(len(fields) * texels) for fields in systems]
    # Columns: rows of a few numbers each would be gathered for every product.
    mixed = [
        np.zeros((len(own), len(job.of_system(s))), job.dtype, "F")
        for s, own in enumerate(right)
    ]
    dense, few_right = np.zeros((len(few), len(few))), np.zeros(len(few))
    cost, squares, count = 0.0, 0.0, 0
    for image in job.images:
        touched = _nearest(image.touched) if nearest else image.touched
        parts, left, gain, free = compare(job, image, state, touched, sigma)
        cost += float((left**2).sum())
        squares += float((left**2)[free].sum())
        count += int(np.count_nonzero(free))
        for c in range(3):
            at = parts, state, job, image, touched, c
            others = {}
            for k in job.of_channel(c):
                own = image.material == few[k].material
                others[k] = np.where(own, _growth(few[k].name, *at), 0) * gain[:, c]
            for k, other in others.items():
                few_right[k] += other @ left[:, c]
                for m, beside in others.items():
                    dense[k, m] += other @ beside
            if not systems:
                continue
            s = job.system_of(c)
            shared = job.of_system(s)
            columns = {
                p: _growth(field.name, *at) * gain[:, c]
                for p, field in enumerate(systems[s])
                if field.channel in (None, c)
            }
            for p, column in columns.items():
                span = slice(p * texels, (p + 1) * texels)
                right[s][span] += touched.scattered(column * left[:, c], texels)
                for k, other in others.items():
                    products = touched.scattered(column * other, texels)
                    mixed[s][span, shared.index(k)] += products
                for q, beside in columns.items():
                    if q < p:
                        continue
                    if (p, q) not in blocks[s]:
                        blocks[s][p, q] = np.zeros((touched.offsets, texels), job.dtype)
                    touched.add_products(column * beside, blocks[s][p, q])
    unit = None
    if "shininess" in job.names:
        assert state.exponents is not None
        unit = np.concatenate([np.ones(state.texels.size), np.exp(state.exponents)])
        right[0] *= unit
        mixed[0] *= unit[:, None].astype(job.dtype)
    left = Left(cost, squares, count)
    return Sums(blocks, right, mixed, dense, few_right, left, unit)


def _nearest(touched: Touched) -> Touched:
    best = touched.weight.argmax(axis=1)[:, None]
    index = np.take_along_axis(touched.number, best, axis=1)
    return Touched(index, np.ones(index.shape, touched.weight.dtype))


def light_of(
    job: Job, image: LitImage, state: State, touched: Touched
) -> tuple[Basis, np.ndarray]:
    """Basis images, and the light that the state makes of them."""
    own = None if state.exponents is None else touched.mean(np.exp(state.exponents))
    parts = basis(image, state.numbers["shininess"], own)
    light = parts.fog.astype(float)
    for number, name in enumerate(BASIS):
        each = [_share(name, state, job, image, touched, c) for c in range(3)]
        light += np.stack(each, axis=1) * parts.light[number]
    return parts, light


def _share(
    name: str, state: State, job: Job, image: LitImage, touched: Touched, channel: int
) -> np.ndarray:
    """A reflectance at each sample."""
    if name not in job.names:
        return state.numbers[name][image.material, channel]
    at = job.coloured.index(name) * job.grid.texels
    return touched.mean(state.texels[channel, at : at + job.grid.texels])


def _growth(
    name: str,
    parts: Basis,
    state: State,
    job: Job,
    image: LitImage,
    touched: Touched,
    channel: int,
) -> np.ndarray:
    """How a channel's light grows with a parameter.

    With log f of an exponent that all of a material share; with f of texels' own.
    """
    if name != "shininess":
        return parts.light[BASIS.index(name)][:, channel]
    share = _share("specular", state, job, image, touched, channel)
    grown = share * parts.slope[:, channel]
    if state.exponents is None:
        return grown
    return grown / touched.mean(np.exp(state.exponents))


def is_like_last(sums: Sums, system: int) -> bool:
    """Whether a system's texels have the matrix of the system before."""
    own, last = sums.blocks[system], sums.blocks[system - 1]
    return system > 0 and all(np.allclose(own[k], last[k], rtol=1e-6) for k in own)


def make_matrix(
    job: Job, sums: Sums, system: int, damping: np.ndarray | None = None
) -> Preconditioned:
    """A system's texels' matrix with their prior, ready to be solved.

    **Arguments:** `damping`: of each texel's exponent, relative to its information.
    """
    fields, prior = len(job.systems[system]), 1 / PRIOR[1] ** 2
    if sums.unit is None:
        matrix = job.grid.matrix(sums.blocks[system], fields, prior)
    else:
        known = prior / sums.unit**2
        if damping is not None:
            own = slice((fields - 1) * job.grid.texels, None)
            known[own] += damping * (
                sums.blocks[0][fields - 1, fields - 1][0] + known[own]
            )
        matrix = job.grid.matrix(sums.blocks[system], fields, known)
        rescale(matrix, sums.unit)
    if job.smoothness is not None:
        smooth = sparse.block_diag([job.smoothness] * fields)
        matrix = sparse.csr_array(matrix + smooth)
    return precondition(matrix)


def expected_differences(job: Job, texels: np.ndarray) -> np.ndarray | float:
    """The gradient of half of what smoothness asks, field by field."""
    if job.smoothness is None:
        return 0.0
    apart = texels.reshape(-1, job.grid.texels)
    return (job.smoothness @ apart.T).T.ravel()


def right_sides(job: Job, sums: Sums, state: State) -> list[np.ndarray]:
    """The systems' right-hand sides, with what is known before."""
    each = zip(sums.right, job.vectors(state), job.expected(state), strict=True)
    return [
        right + (mean - own) / PRIOR[1] ** 2 - expected_differences(job, own)
        for right, own, mean in each
    ]


class Cost(NamedTuple):
    """What is minimised: squares of the photographs, and of what is known before.

    - `whole`: of all.
    - `around`: of the samples that see a texel, and of itself, texel by texel.
    """

    whole: float
    around: Float[np.ndarray, " texels"]


def cost_of(job: Job, state: State, sigma: float) -> Cost:
    """What is minimised, as a whole and texel by texel."""
    count = job.grid.texels
    whole, around = 0.0, np.zeros(count)
    for image in job.images:
        left = compare(job, image, state, image.touched, sigma).left
        squares = (left**2).sum(axis=1)
        whole += float(squares.sum())
        sees = (image.touched.weight > 0).astype(squares.dtype)
        around += image.touched._replace(weight=sees).scattered(squares, count)
    for own, mean in zip(job.vectors(state), job.expected(state), strict=True):
        known = ((own - mean) / PRIOR[1]) ** 2 + own * expected_differences(job, own)
        whole += float(known.sum())
        around += known.reshape(-1, count).sum(axis=0)
    return Cost(whole, around)
