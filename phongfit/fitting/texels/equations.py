"""Normal equations of texels and of what a material shares, summed over all samples."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.fitting.texels.job import RIDGE, Job, State
from phongfit.fitting.texels.lit import BASIS, Basis, LitImage, basis, film_response
from phongfit.fitting.texels.solve import (
    DIRECT,
    AbstractSystem,
    precondition,
    rescale,
)
from phongfit.fitting.texels.stencil import make_stencil
from phongfit.fitting.texels.sums import Touched

Blocks = dict[tuple[int, int], np.ndarray]
"""Sums of samples' products for each pair of fields p ≤ q that they couple."""


class ResidualSums(NamedTuple):
    """What the light of a state leaves of the photographs, in standard deviations.

    `cost` is the sum of squares, `squares` that of the samples that are not clipped,
    and `counted` how many these are. `around` is the sum of squares of the samples that
    see a texel, where texels have exponents of their own.
    """

    cost: float
    squares: float
    counted: int
    around: np.ndarray | None = None


class Sums(NamedTuple):
    """Normal equations: of each system's texels, of the few, and of both.

    What is large has the precision of the photographs. `blocks` of exponents are of f,
    all else is of log f: `unit` is what log f is multiplied by, field by field, where
    there are any. A sample's f is the mean of its texels', as in a render.
    """

    blocks: list[Blocks]
    right: list[np.ndarray]
    mixed: list[np.ndarray]
    dense: np.ndarray
    few_right: np.ndarray
    left: ResidualSums
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
    film = film_response(light, deviation, job.clamp, image.ends)
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
        del image, left
    return total


def sum_up(job: Job, state: State, sigma: float, nearest: bool = False) -> Sums:
    """Of all samples, where the light of `state` is what the film shows.

    **Arguments:** `nearest`: as if each sample saw one texel, the nearest.
    """
    sums = _no_sums(job)
    for image in job.images:
        touched = _nearest(image.touched) if nearest else image.touched
        left = _add_image(sums, job, image, state, touched, sigma)
        sums = sums._replace(left=left)
        # It goes before the next one is traced.
        del image, touched
    if "shininess" not in job.names:
        return sums
    assert state.exponents is not None
    unit = np.concatenate([np.ones(state.texels.size), np.exp(state.exponents)])
    sums.right[0] *= unit
    sums.mixed[0] *= unit[:, None].astype(job.dtype)
    return sums._replace(unit=unit)


def _no_sums(job: Job) -> Sums:
    """Of no image yet."""
    texels, few = job.grid.texels, len(job.few)
    right = [np.zeros(len(fields) * texels) for fields in job.systems]
    # Columns: rows of a few numbers each would be gathered for every product.
    mixed = [
        np.zeros((len(own), len(job.of_system(s))), job.dtype, "F")
        for s, own in enumerate(right)
    ]
    around = np.zeros(texels) if "shininess" in job.names else None
    return Sums(
        [{} for _ in job.systems],
        right,
        mixed,
        np.zeros((few, few)),
        np.zeros(few),
        ResidualSums(0.0, 0.0, 0, around),
        None,
    )


def _add_image(
    sums: Sums, job: Job, image: LitImage, state: State, touched: Touched, sigma: float
) -> ResidualSums:
    """Add one image's samples to arrays in their place; what is left of all so far."""
    parts, left, gain, free = compare(job, image, state, touched, sigma)
    for c in range(3):
        at = parts, state, job, image, touched, c
        others = {}
        for k in job.of_channel(c):
            own = image.material == job.few[k].material
            others[k] = np.where(own, _growth(job.few[k].name, *at), 0) * gain[:, c]
        for k, other in others.items():
            sums.few_right[k] += other @ left[:, c]
            for m, beside in others.items():
                sums.dense[k, m] += other @ beside
        if not job.systems:
            continue
        s = job.system_of(c)
        columns = {
            p: _growth(field.name, *at) * gain[:, c]
            for p, field in enumerate(job.systems[s])
            if field.channel in (None, c)
        }
        _add_texels(sums, job, s, touched, columns, left[:, c], others)
    before, squares = sums.left, left**2
    if before.around is not None:
        before.around[:] += _around(touched, squares.sum(axis=1), job.grid.texels)
    return ResidualSums(
        before.cost + float(squares.sum()),
        before.squares + float(squares[free].sum()),
        before.counted + int(np.count_nonzero(free)),
        before.around,
    )


def _add_texels(
    sums: Sums,
    job: Job,
    system: int,
    touched: Touched,
    columns: dict[int, np.ndarray],
    left: np.ndarray,
    others: dict[int, np.ndarray],
) -> None:
    """Add one channel's samples to a system's sums.

    **Arguments:** how light grows with fields (`columns`) and with shared numbers
    (`others`), by their numbers.
    """
    texels, shared, blocks = job.grid.texels, job.of_system(system), sums.blocks[system]
    for p, column in columns.items():
        span = slice(p * texels, (p + 1) * texels)
        sums.right[system][span] += touched.scattered(column * left, texels)
        for k, other in others.items():
            products = touched.scattered(column * other, texels)
            sums.mixed[system][span, shared.index(k)] += products
        for q, beside in columns.items():
            if q < p:
                continue
            if (p, q) not in blocks:
                blocks[p, q] = np.zeros((touched.offsets, texels), job.dtype)
            touched.add_products(column * beside, blocks[p, q])


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
    # Row by row: most systems differ in the first, and the others need not be compared.
    return system > 0 and all(
        np.allclose(row, other, rtol=1e-6)
        for k in own
        for row, other in zip(own[k], last[k], strict=True)
    )


def make_matrix(
    job: Job, sums: Sums, system: int, damping: np.ndarray | None = None
) -> AbstractSystem:
    """A system's texels' matrix with their prior, ready to be solved.

    **Arguments:** `damping`: of each texel's exponent, relative to its information.
    """
    fields, known = len(job.systems[system]), RIDGE
    blocks, unit = sums.blocks[system], sums.unit
    if unit is not None:
        known = RIDGE / unit**2
        if damping is not None:
            own = slice((fields - 1) * job.grid.texels, None)
            known[own] += damping * (blocks[fields - 1, fields - 1][0] + known[own])
    if job.smoothness is not None:
        blocks = _smoothed(job, blocks, unit)
    if job.grid.regular and fields * job.grid.texels > DIRECT:
        return make_stencil(blocks, job.grid.shape, known, unit)
    matrix = job.grid.matrix(blocks, fields, known)
    if unit is not None:
        rescale(matrix, unit)
    return precondition(matrix)


def _smoothed(job: Job, blocks: Blocks, unit: np.ndarray | None) -> Blocks:
    """Sums with what is expected between neighbours, which is of log f."""
    smoothed, count = {}, job.grid.texels
    for (p, q), block in blocks.items():
        # Where each sample sees one texel, there are no sums of neighbours yet.
        whole = np.zeros((job.grid.slots, count))
        if p == q:
            own = slice(p * count, (p + 1) * count)
            scale = np.ones(count) if unit is None else 1 / unit[own]
            whole = job.grid.differences(scale) * job.smoothness
        whole[: len(block)] += block
        smoothed[p, q] = whole
    return smoothed


def expected_differences(job: Job, texels: np.ndarray) -> np.ndarray | float:
    """The gradient of half of what smoothness asks, field by field."""
    if job.smoothness is None:
        return 0.0
    apart = texels.reshape(-1, job.grid.texels)
    each = [job.grid.from_neighbours(own) for own in apart]
    return job.smoothness * np.concatenate(each)


def right_sides(job: Job, sums: Sums, state: State) -> list[np.ndarray]:
    """The systems' right-hand sides, with what is known before."""
    each = zip(sums.right, job.vectors(state), job.expected(state), strict=True)
    return [
        right + (mean - own) * RIDGE - expected_differences(job, own)
        for right, own, mean in each
    ]


class Cost(NamedTuple):
    """What is minimised: squares of the photographs, and of what is known before.

    - `whole`: of all.
    - `around`: of the samples that see a texel, and of itself, texel by texel.
    """

    whole: float
    around: Float[np.ndarray, " texels"]


def _around(touched: Touched, squares: np.ndarray, texels: int) -> np.ndarray:
    """Sums of the samples that see each texel, however little of it."""
    sees = (touched.weight > 0).astype(squares.dtype)
    return touched._replace(weight=sees).scattered(squares, texels)


def cost_of(job: Job, state: State, sigma: float) -> Cost:
    """What is minimised, as a whole and texel by texel."""
    whole, around = 0.0, np.zeros(job.grid.texels)
    for image in job.images:
        left = compare(job, image, state, image.touched, sigma).left
        squares = (left**2).sum(axis=1)
        whole += float(squares.sum())
        around += _around(image.touched, squares, job.grid.texels)
    return with_known(job, state, whole, around)


def with_known(job: Job, state: State, whole: float, around: np.ndarray) -> Cost:
    """Squares of the photographs, with those of what is known before."""
    for own, mean in zip(job.vectors(state), job.expected(state), strict=True):
        known = (own - mean) ** 2 * RIDGE + own * expected_differences(job, own)
        whole += float(known.sum())
        around = around + known.reshape(-1, job.grid.texels).sum(axis=0)
    return Cost(whole, around)
