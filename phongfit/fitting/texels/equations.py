"""Normal equations of texels and of the numbers that each material shares."""

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
"""For each pair of fields p ≤ q that samples couple: sums of products over samples."""


class ResidualSums(NamedTuple):
    """Sums of squared residuals of the photographs, in standard deviations.

    `cost` is the sum over all samples, `squares` the sum over samples that are not
    clipped, and `counted` their number. `around` is only there if each texel has an
    exponent: for each texel the sum over all samples that see it.
    """

    cost: float
    squares: float
    counted: int
    around: np.ndarray | None = None


class Sums(NamedTuple):
    """Normal equations of texels, of shared numbers, and of pairs of the two.

    - `blocks`, `right`: each system's matrix and right-hand side, for its texels.
    - `mixed`: products of each system's texels (rows) with shared numbers.
    - `dense`, `few_right`: matrix and right-hand side of the shared numbers.
    - `unit`: None, unless texels have exponents f. `blocks` are then derivatives by f,
        all other arrays derivatives by log f, and `unit` holds df / d log f for each
        unknown (1 for reflectances). A sample's f is the mean over its texels, as in
        rendering.

    Large arrays have the photographs' precision.
    """

    blocks: list[Blocks]
    right: list[np.ndarray]
    mixed: list[np.ndarray]
    dense: np.ndarray
    few_right: np.ndarray
    left: ResidualSums
    unit: np.ndarray | None


class Compared(NamedTuple):
    """One photograph compared with a state's light, in units of standard deviations.

    - `parts`: basis images of the samples.
    - `left`: residuals, photograph − model. `gain`: derivative of the model by light.
        Both are 0 for samples of weight 0.
    - `free`: marks samples of positive weight that are not clipped.
    """

    parts: Basis
    left: Float[np.ndarray, "n 3"]
    gain: Float[np.ndarray, "n 3"]
    free: Bool[np.ndarray, "n 3"]


def compare(
    job: Job, image: LitImage, state: State, touched: Touched, sigma: float
) -> Compared:
    """Compare a photograph with the film's response to the light of `state`."""
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
    """Each material's sum of squares, if each sample sees only the nearest texel."""
    total = np.zeros(len(state.numbers["shininess"]))
    for image in job.images:
        left = compare(job, image, state, _nearest(image.touched), sigma).left
        total += np.bincount(image.material, (left**2).sum(axis=1), len(total))
        del image, left
    return total


def sum_up(job: Job, state: State, sigma: float, nearest: bool = False) -> Sums:
    """The normal equations over all samples, linearised at `state`.

    **Arguments:** `nearest`: let each sample see only its nearest texel.
    """
    sums = _no_sums(job)
    for image in job.images:
        touched = _nearest(image.touched) if nearest else image.touched
        left = _add_image(sums, job, image, state, touched, sigma)
        sums = sums._replace(left=left)
        # Free the memory before the next image is traced.
        del image, touched
    if "shininess" not in job.names:
        return sums
    assert state.exponents is not None
    unit = np.concatenate([np.ones(state.texels.size), np.exp(state.exponents)])
    sums.right[0] *= unit
    sums.mixed[0] *= unit[:, None].astype(job.dtype)
    return sums._replace(unit=unit)


def _no_sums(job: Job) -> Sums:
    """Normal equations before any image is added."""
    texels, few = job.grid.texels, len(job.few)
    right = [np.zeros(len(fields) * texels) for fields in job.systems]
    # In column order, so that products over texels read contiguous memory.
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
    """Add one image's samples to the arrays of `sums`, and return the residual sums."""
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
    """Add one channel's samples to the sums of one system.

    **Arguments:** `columns`, `others`: derivatives of light by fields and by shared
    numbers; keys are their indices.
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
    """Basis images, and their sum weighted by the reflectances of `state`."""
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
    """The reflectance called `name`, at each sample."""
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
    """Derivative of a channel's light by a parameter.

    For an exponent it is by log f if a material shares one, by f if texels have their
    own.
    """
    if name != "shininess":
        return parts.light[BASIS.index(name)][:, channel]
    share = _share("specular", state, job, image, touched, channel)
    grown = share * parts.slope[:, channel]
    if state.exponents is None:
        return grown
    return grown / touched.mean(np.exp(state.exponents))


def is_like_last(sums: Sums, system: int) -> bool:
    """Whether a system's matrix for its texels equals the previous system's."""
    own, last = sums.blocks[system], sums.blocks[system - 1]
    # Row by row, since most systems that differ do so in the first row.
    return system > 0 and all(
        np.allclose(row, other, rtol=1e-6)
        for k in own
        for row, other in zip(own[k], last[k], strict=True)
    )


def make_matrix(
    job: Job, sums: Sums, system: int, damping: np.ndarray | None = None
) -> AbstractSystem:
    """The matrix of a system's texels with their prior, ready to be solved.

    **Arguments:** `damping`: added for each texel's exponent, relative to its diagonal.
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
    """Sums with the smoothness prior between neighbours (for exponents, on log f)."""
    smoothed, count = {}, job.grid.texels
    for (p, q), block in blocks.items():
        # Blocks have only their first row if each sample sees one texel.
        whole = np.zeros((job.grid.slots, count))
        if p == q:
            own = slice(p * count, (p + 1) * count)
            scale = np.ones(count) if unit is None else 1 / unit[own]
            whole = job.grid.differences(scale) * job.smoothness
        whole[: len(block)] += block
        smoothed[p, q] = whole
    return smoothed


def expected_differences(job: Job, texels: np.ndarray) -> np.ndarray | float:
    """Gradient of half the smoothness term, field by field."""
    if job.smoothness is None:
        return 0.0
    apart = texels.reshape(-1, job.grid.texels)
    each = [job.grid.from_neighbours(own) for own in apart]
    return job.smoothness * np.concatenate(each)


def right_sides(job: Job, sums: Sums, state: State) -> list[np.ndarray]:
    """The systems' right-hand sides, with ridge and smoothness prior."""
    each = zip(sums.right, job.vectors(state), job.expected(state), strict=True)
    return [
        right + (mean - own) * RIDGE - expected_differences(job, own)
        for right, own, mean in each
    ]


class Cost(NamedTuple):
    """The cost: squared residuals of the photographs and of the prior.

    - `whole`: the whole cost.
    - `around`: for each texel, squares of the samples that see it and of its prior.
    """

    whole: float
    around: Float[np.ndarray, " texels"]


def _around(touched: Touched, squares: np.ndarray, texels: int) -> np.ndarray:
    """For each texel the sum over all samples that see it, whatever their weights."""
    sees = (touched.weight > 0).astype(squares.dtype)
    return touched._replace(weight=sees).scattered(squares, texels)


def cost_of(job: Job, state: State, sigma: float) -> Cost:
    """The cost of a state, as a whole and for each texel."""
    whole, around = 0.0, np.zeros(job.grid.texels)
    for image in job.images:
        left = compare(job, image, state, image.touched, sigma).left
        squares = (left**2).sum(axis=1)
        whole += float(squares.sum())
        around += _around(image.touched, squares, job.grid.texels)
    return with_known(job, state, whole, around)


def with_known(job: Job, state: State, whole: float, around: np.ndarray) -> Cost:
    """Add the prior's squares to those of the photographs."""
    for own, mean in zip(job.vectors(state), job.expected(state), strict=True):
        known = (own - mean) ** 2 * RIDGE + own * expected_differences(job, own)
        whole += float(known.sum())
        around = around + known.reshape(-1, job.grid.texels).sum(axis=0)
    return Cost(whole, around)
