"""Normal equations of texels and of what a material shares, summed over all samples."""

from typing import NamedTuple

import numpy as np
from scipy import sparse

from phongfit.fitting.texels.job import PRIOR, Few, Job, State
from phongfit.fitting.texels.lit import BASIS, Basis, LitImage, basis, shown
from phongfit.fitting.texels.solve import Preconditioned, precondition
from phongfit.fitting.texels.sums import Touched, as_matrix


class Sums(NamedTuple):
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


def sum_up(job: Job, state: State, sigma: float, nearest: bool = False) -> Sums:
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
        parts, light = light_of(job, image, state, touched)
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
    return Sums(blocks, right, mixed, dense, few_right, cost, residual, count)


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


def make_systems(
    job: Job, sums: Sums, state: State
) -> tuple[list[Preconditioned], np.ndarray]:
    """The texels' matrices with their priors, and the right-hand sides with them."""
    mean, deviation = PRIOR
    right = sums.right + (mean - state.texels) / deviation**2
    matrices: list[Preconditioned] = []
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
