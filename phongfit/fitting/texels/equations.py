"""Normal equations of texels and of what a material shares, summed over all samples."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from phongfit.fitting.texels.job import PRIOR, Few, Job, State
from phongfit.fitting.texels.lit import BASIS, Basis, LitImage, basis, shown
from phongfit.fitting.texels.solve import Preconditioned, precondition
from phongfit.fitting.texels.sums import Touched, as_matrix


class Left(NamedTuple):
    """What the light of a state leaves of the photographs, in standard deviations.

    `cost` is the sum of squares, `squares` that of the samples that are not clipped,
    and `counted` how many these are.
    """

    cost: float
    squares: float
    counted: int


class Sums(NamedTuple):
    """Normal equations: of each channel's texels, of the few, and of both.

    What is large has the precision of the photographs.
    """

    blocks: list[dict[tuple[int, int], np.ndarray]]
    right: np.ndarray
    mixed: list[np.ndarray]
    dense: np.ndarray
    few_right: np.ndarray
    left: Left


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
    grid, names, few = job.grid, job.names, job.few
    blocks: list[dict[tuple[int, int], np.ndarray]] = [{} for _ in range(3)]
    right = np.zeros((3, job.size))
    # Columns: rows of a few numbers each would be gathered for every product.
    mixed = [
        np.zeros((job.size, len(job.of_channel(c))), job.dtype, "F") for c in range(3)
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
                    if (p, q) not in blocks[c]:
                        shape = touched.offsets, grid.texels
                        blocks[c][p, q] = np.zeros(shape, job.dtype)
                    touched.add_products(column * columns[q], blocks[c][p, q])
            for i, k in enumerate(shared):
                few_right[k] += others[i] @ left[:, c]
                for j, m in enumerate(shared):
                    dense[k, m] += others[i] @ others[j]
    return Sums(blocks, right, mixed, dense, few_right, Left(cost, squares, count))


def _nearest(touched: Touched) -> Touched:
    best = touched.weight.argmax(axis=1)[:, None]
    index = np.take_along_axis(touched.number, best, axis=1)
    return Touched(index, np.ones(index.shape, touched.weight.dtype))


def light_of(
    job: Job, image: LitImage, state: State, touched: Touched
) -> tuple[Basis, np.ndarray]:
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


def _texture(job: Job, state: State, name: str, channel: int) -> np.ndarray:
    at = job.names.index(name) * job.grid.texels
    return state.texels[channel, at : at + job.grid.texels]


def _column(
    one: Few,
    parts: Basis,
    state: State,
    job: Job,
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


def is_like_last(sums: Sums, channel: int) -> bool:
    """Whether a channel's texels have the matrix of the channel before."""
    own, last = sums.blocks[channel], sums.blocks[channel - 1]
    return channel > 0 and all(np.allclose(own[k], last[k], rtol=1e-6) for k in own)


def make_matrix(job: Job, sums: Sums, channel: int) -> Preconditioned:
    """A channel's texels' matrix with their prior, ready to be solved."""
    names, prior = len(job.names), 1 / PRIOR[1] ** 2
    matrix = as_matrix(job.grid, sums.blocks[channel], names, prior)
    if job.smoothness is not None:
        matrix = sparse.csr_array(matrix + job.smoothness)
    return precondition(matrix)


def right_side(job: Job, sums: Sums, state: State) -> Float[np.ndarray, "3 n"]:
    """The texels' right-hand sides, with what is known before."""
    mean, deviation = PRIOR
    right = sums.right + (mean - state.texels) / deviation**2
    if job.smoothness is not None:
        right -= (job.smoothness @ state.texels.T).T
    return right
