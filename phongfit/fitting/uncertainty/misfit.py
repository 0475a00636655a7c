r"""Test for lack of fit: sums of residuals that are too large for noise.

Independent residuals $z_i$ of mean 0, summed over a cell of pixels, give $T = \sum z_i
/ \sqrt{\sum \operatorname{var} z_i}$ of variance 1. A wrong model leaves residuals of
one sign where it is wrong: $T^2$ grows with the size of the cell, even if the
correlation of neighbours is small. So $T^2$ is tested in blocks of growing size, and in
groups of pixels with equal diffuse light or equal highlight. Its mean over all cells
shows a misfit that is spread out, its largest value one that is local.

??? cite "Source"
    Tests by grouping: Neill and Johnson, *Testing for lack of fit in regression: a
    review*, Commun. Stat. Theory Methods 13(4), 1984. A mean of $T^2$ is judged by
    Wilson and Hilferty, *The distribution of chi-square*, PNAS 17(12), 1931.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from phongfit.fitting.solve.jpeg import Drawn
from phongfit.fitting.uncertainty.tiles import Rounding, Tiles

# Significance of a misfit in standard deviations of a normal distribution. Some thirty
# tests are made; each is exceeded by chance once in 300 000 images.
SIGNIFICANT = 4.5
# Pixels along the side of the smallest tested block; samples of the smallest cell.
LEAST_SIDE, LEAST_SAMPLES = 4, 8
# Correlation of neighbours above which a warning is given.
CORRELATED = 0.1
# Number of groups by diffuse light, and by highlight.
BINS = 16
# Fraction of a deviation that shared rounding may have, above which neighbours and
# groups of equal light are not tested.
COARSE = 0.03


@dataclasses.dataclass(frozen=True, eq=False)
class Misfit:
    """Test of residuals for noise, and the place of the largest misfit.

    **Arguments:**

    - `neighbour_correlation`: correlation of residuals of adjacent pixels: 0 for noise.
    - `channel_correlation`: correlation of the three residuals of a pixel: 1 if all
        channels are equal.
    - `unequal`: significance of noise that differs between channels or with light, in
        standard deviations of a normal distribution.
    - `over_repeatability`: size of the residuals over that of their differences from
        pixel to pixel, in which the model cancels: near 1 for noise; NaN if residuals
        are rounding.
    - `significance`: significance of the largest misfit, in standard deviations of a
        normal distribution.
    - `inflation`: factor on all variances, at least 1: from the variance of sums of
        residuals over that of noise, or from the correlation of neighbours, and from
        all residuals over the given noise.
    - `along`: kind of cells with the largest misfit: `"blocks"`, `"diffuse"` or
        `"highlight"`.
    - `side`: pixels along the side of the blocks that show it best.
    - `image`, `row`, `column`: middle of the block with the largest sum, in pixels.
    - `maps`: for each image these blocks' sums in standard deviations, (rows, columns).
    """

    neighbour_correlation: float = 0.0
    channel_correlation: float = 0.0
    unequal: float = 0.0
    over_repeatability: float = math.nan
    significance: float = 0.0
    inflation: float = 1.0
    along: str = "blocks"
    side: int = LEAST_SIDE
    image: int = 0
    row: int = 0
    column: int = 0
    maps: tuple[np.ndarray, ...] = ()

    @property
    def significant(self) -> bool:
        """Whether the misfit is significant."""
        return self.significance > SIGNIFICANT

    @property
    def noise_differs(self) -> bool:
        """Whether noise differs between channels or with light, without a misfit."""
        return bool(self.unequal > SIGNIFICANT and not self.significant)


class _Blocks(NamedTuple):
    """Sums over blocks of one image, (…, 3, rows, columns).

    `sums` are those of [`Tiles`][]: residuals, their squares, their variance, and
    shared rounding of the arithmetic.
    """

    sums: np.ndarray
    rounding: Rounding | None
    drawn: Drawn | None


class _Verdict(NamedTuple):
    """Significance of a misfit, and its factor on variances."""

    significance: float
    inflation: float


# Sums over cells of pixels, (4, 4, cells). First axis: residuals, their squares, their
# variance, and its shared part. Second axis: three channels, and all together.
_Cells = np.ndarray
# One where a tile (row) belongs to a group of tiles with equal light (column).
_Members = np.ndarray


def find_misfit(
    images: Sequence[Tiles], side: int, drawn: Sequence[Drawn] | None = None
) -> Misfit:
    """Test the residuals of all images together.

    **Arguments:**

    - `side`: pixels along the side of a tile.
    - `drawn`: for each image simulated sums of the right model's residuals, if these
        are not independent from pixel to pixel.
    """
    each = [None] * len(images) if drawn is None else drawn
    blocks = [_as_blocks(*one) for one in zip(images, each, strict=True)]
    # (4, channels)
    sums = np.sum([one.sums.sum(axis=(2, 3)) for one in blocks], axis=0)
    _, left, expected, _ = sums.sum(axis=1)
    if not (expected > 0 and 0 < left < math.inf):
        return Misfit()
    # The noise of each channel is that of its residuals.
    scale = np.where(sums[1] > 0, sums[1], left) / np.maximum(sums[2], 1e-30)
    alone = all(_rounds_alone(one) for one in blocks)
    # With shared rounding, neighbours and groups of equal light are not tested. If it
    # was simulated, only the correlation of neighbours is not.
    groups = _lit_alike(images) if alone else {}
    correlation, channels, unequal, ratio = 0.0, 0.0, 0.0, math.nan
    if alone:
        unequal = _compare_noise(blocks, groups)
    if alone and drawn is None:
        correlation, ratio = _compare_neighbours(images)
        channels = _compare_channels(images)
    seen = _look(blocks, groups, side, scale, channels)
    if seen.significant and channels > 0:
        # A misfit correlates the channels, but is not shared noise.
        seen = _look(blocks, groups, side, scale, 0.0)
    return dataclasses.replace(
        seen,
        neighbour_correlation=correlation,
        channel_correlation=channels,
        unequal=unequal,
        over_repeatability=ratio,
        inflation=max(variance_inflation(correlation), seen.inflation),
    )


def _look(
    blocks: list[_Blocks],
    groups: Mapping[str, _Members],
    side: int,
    scale: np.ndarray,
    channels: float,
) -> Misfit:
    """The most significant misfit of blocks of all sizes and of groups of equal light.

    `inflation` is the largest of all that are significant. Correlations and noise are
    not judged.

    **Arguments:**

    - `groups`: groups of tiles with equal light: see [`_lit_alike`][].
    - `scale`: factor on each channel's variances.
    - `channels`: correlation of the noise of a pixel's channels.
    """
    asked: list[tuple[_Cells, str, int]] = []
    levels: dict[int, list[_Cells]] = {}
    for size, level in _pyramid(blocks, side):
        levels[size] = [_cells(one, scale, channels) for one in level]
        if size == side:
            asked += _along_the_model(levels[size], level, groups)
        if size >= LEAST_SIDE:
            asked.append((_joined(levels[size]), "blocks", size))
    found = [(_judge(cells), along, size) for cells, along, size in asked]
    found = found or [(_Verdict(0.0, 1.0), "blocks", side)]
    in_blocks = [one for one in found if one[1] == "blocks"]
    worst, along, _ = max(found, key=lambda one: one[0].significance)
    shown = side
    if in_blocks:
        shown = max(in_blocks, key=lambda one: one[0].significance)[2]
    significant = [v.inflation for v, *_ in found if v.significance > SIGNIFICANT]
    maps = tuple(_in_deviations(one) for one in levels[shown])
    image = int(np.argmax([np.abs(one).max() for one in maps]))
    row, column = np.unravel_index(np.argmax(np.abs(maps[image])), maps[image].shape)
    return Misfit(
        significance=worst.significance,
        inflation=max([1.0, *significant]),
        along=along,
        side=shown,
        image=image,
        row=int((row + 0.5) * shown),
        column=int((column + 0.5) * shown),
        maps=maps,
    )


def _as_blocks(tiles: Tiles, drawn: Drawn | None) -> _Blocks:
    # Simulated sums include the rounding.
    rounding = None if drawn is not None else tiles.rounding
    if rounding is not None:
        rounding = Rounding(*(np.asarray(part, float) for part in rounding))
    return _Blocks(np.array(tiles[:4], float), rounding, drawn)


def _rounds_alone(blocks: _Blocks) -> bool:
    """Whether equal samples round independently."""
    common = blocks.sums[3].sum()
    if blocks.rounding is not None:
        common += blocks.rounding.deviation.sum()
    return bool(common < COARSE * blocks.sums[2].sum())


def _compare_neighbours(images: Sequence[Tiles]) -> tuple[float, float]:
    """Correlation of adjacent residuals (0 if chance), and their size over change."""
    products, pairs, squares, count = (
        _over_all([one.neighbours.products for one in images]),
        _over_all([one.neighbours.pairs for one in images]),
        _over_all([one.squares for one in images]),
        _over_all([one.count for one in images]),
    )
    if pairs == 0 or squares == 0:
        return 0.0, math.nan
    correlation = min(max(products / pairs * count / squares, -1.0), 1.0)
    # Half the squared difference of neighbours, relative to the square, is 1 −
    # correlation.
    ratio = 1 / math.sqrt(max(1 - correlation, 1e-12))
    return correlation if abs(correlation) > 5 / math.sqrt(pairs) else 0.0, ratio


def _compare_channels(images: Sequence[Tiles]) -> float:
    """Correlation of the residuals of a pixel's channels; 0 if within chance."""
    squares = _over_all([one.squares for one in images])
    # The number of independent pairs is at most that of samples.
    pairs = _over_all([one.count for one in images])
    if not squares > 0:
        return 0.0
    correlation = _over_all([one.neighbours.channels for one in images]) / squares
    return min(correlation, 1.0) if correlation > 5 / math.sqrt(pairs) else 0.0


def _over_all(parts: Sequence[np.ndarray | Array]) -> float:
    return sum(float(np.sum(part, dtype=float)) for part in parts)


def variance_inflation(correlation: float) -> float:
    r"""Factor on variances if neighbours correlate: $(\frac{1+c}{1-c})^2$, at least 1.

    Correlated pixels count as fewer independent ones. The factor is that of a
    first-order autoregressive process along each image axis.

    ??? cite "Source"
        Bayley and Hammersley, *The effective number of independent observations in an
        autocorrelated time series*, J. R. Stat. Soc. Suppl. 8(2), 1946.
    """
    c = min(max(correlation, 0.0), 0.99)
    return ((1 + c) / (1 - c)) ** 2


def _pyramid(blocks: list[_Blocks], side: int) -> Iterator[tuple[int, list[_Blocks]]]:
    """Blocks of growing size, up to whole images."""
    yield side, blocks
    while any(one.sums.shape[-2:] != (1, 1) for one in blocks):
        blocks, side = [_halved(one) for one in blocks], 2 * side
        yield side, blocks


def _halved(blocks: _Blocks) -> _Blocks:
    """Merge blocks two by two."""
    rounding = blocks.rounding
    if rounding is not None:
        rounding = Rounding(
            _merged(rounding.deviation, np.add, 0),
            _merged(rounding.low, np.minimum, np.inf),
            _merged(rounding.high, np.maximum, -np.inf),
        )
    drawn = None if blocks.drawn is None else _merged(blocks.drawn, np.add, 0)
    return _Blocks(_merged(blocks.sums, np.add, 0), rounding, drawn)


def _merged(values: np.ndarray, two: np.ufunc, empty: float) -> np.ndarray:
    rows, columns = values.shape[-2:]
    if rows % 2 or columns % 2:
        beyond = [(0, 0)] * (values.ndim - 2) + [(0, rows % 2), (0, columns % 2)]
        values = np.pad(values, beyond, constant_values=empty)
    values = two(values[..., ::2, :], values[..., 1::2, :])
    return two(values[..., ::2], values[..., 1::2])


def _cells(blocks: _Blocks, scale: np.ndarray, channels: float) -> _Cells:
    """Cells of one image, (4, 4, cells), with variances scaled to the residuals.

    **Arguments:** `channels`: correlation of the noise of a pixel's channels.
    """
    cells = blocks.sums.copy()
    cells[2] *= scale[:, None, None]
    cells[3] **= 2
    if blocks.rounding is not None:
        deviation, low, high = blocks.rounding
        # Samples of different levels round independently.
        levels = 1 + np.where(deviation > 0, high, 0) - np.where(deviation > 0, low, 0)
        cells[3] += deviation**2 / levels
    cells = _with_all(cells)
    # With a correlation ρ of channels, the variance of their sum grows by 1 + 2ρ.
    cells[1:3, 3] *= 1 + 2 * channels
    if blocks.drawn is not None:
        cells[3] = np.maximum(cells[3], _beyond(blocks.drawn, cells[2]))
    return cells


def _with_all(parts: np.ndarray) -> np.ndarray:
    """Append a fourth channel, the sum of all three: (…, 4, …)."""
    return np.concatenate([parts, parts.sum(axis=1, keepdims=True)], axis=1)


def _beyond(drawn: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Variance of simulated sums beyond that of independent samples.

    There are few draws, so a cell's variance is at least the mean one of its channel.
    """
    own = (_with_all(drawn) ** 2).sum(axis=0)
    cells = tuple(range(1, own.ndim))
    whole = variance.sum(axis=cells, keepdims=True)
    usual = own.sum(axis=cells, keepdims=True) / np.where(whole > 0, whole, 1)
    return np.maximum(np.maximum(own, usual * variance) - variance, 0)


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Cells of all images, one after another."""
    flat = [one.reshape(*one.shape[:2], -1) for one in parts]
    return flat[0] if len(flat) == 1 else np.concatenate(flat, axis=-1)


def _in_deviations(cells: _Cells) -> np.ndarray:
    """Each cell's sum over its channels, in standard deviations; 0 if empty."""
    total, _, variance, common = cells[:, 3]
    whole = variance + common
    return np.where(whole > 0, total / np.sqrt(np.where(whole > 0, whole, 1)), 0)


def _lit_alike(images: Sequence[Tiles]) -> dict[str, _Members]:
    """Groups of tiles with equal diffuse light, and with equal highlight."""
    members = {}
    for name, group in (("diffuse", _equal_light), ("highlight", _equal_angle)):
        parts = [np.asarray(getattr(one, name), float).ravel() for one in images]
        bins = group(np.concatenate(parts))
        # As a matrix of ones, since a matrix product is the fastest way to sum.
        members[name] = (bins[:, None] == np.arange(BINS)).astype(float)
    return members


def _along_the_model(
    cells: Sequence[_Cells], blocks: Sequence[_Blocks], groups: Mapping[str, _Members]
) -> Iterator[tuple[_Cells, str, int]]:
    """Sums over groups of tiles with equal light."""
    joined = _joined(cells)
    drawn = [one.drawn for one in blocks if one.drawn is not None]
    for name, member in groups.items():
        together = joined @ member
        if drawn:
            shared = _beyond(_joined(drawn) @ member, together[2])
            together[3] = np.maximum(together[3], shared)
        yield together, name, 0


def _compare_noise(blocks: Sequence[_Blocks], groups: Mapping[str, _Members]) -> float:
    """Significance of noise that differs between channels or with light.

    An analysis of variance of the mean squares of tiles, between groups of equal light
    and within them, which does not depend on the noise's distribution.

    ??? cite "Source"
        Scheffé, *The Analysis of Variance*, 1959, chapter 3. F as a normal deviate:
        Paulson, *An approximate normalization of the analysis of variance
        distribution*, Ann. Math. Stat. 13(2), 1942.
    """
    joined = _joined([one.sums for one in blocks])
    found = 0.0
    for member in groups.values():
        together = joined @ member
        each, whole = _squares_over(joined), _squares_over(together)
        mean = together[1].sum() ** 2 / together[2].sum()
        between, freedom = whole.sum() - mean, np.count_nonzero(whole) - 1
        within, rest = each.sum() - whole.sum(), np.count_nonzero(each) - freedom - 1
        if min(freedom, rest) < 1 or not within > 0:
            continue
        ratio = (between / freedom) / (within / rest)
        above, below = 2 / (9 * freedom), 2 / (9 * rest)
        root = max(ratio, 0.0) ** (1 / 3)
        deviate = (1 - below) * root - (1 - above)
        found = max(found, deviate / math.sqrt(below * root**2 + above))
    return found


def _squares_over(sums: np.ndarray) -> np.ndarray:
    """Square of each cell's sum of squares over its variance; 0 if it has none."""
    variance = sums[2]
    varies = variance > 0
    return np.where(varies, sums[1] ** 2 / np.where(varies, variance, 1), 0)


def _equal_light(light: np.ndarray) -> np.ndarray:
    share = light / max(float(light.max()), 1e-300)
    return np.clip(BINS * share, 0, BINS - 1).astype(int)


def _equal_angle(light: np.ndarray) -> np.ndarray:
    """Groups by the logarithm of a highlight, which falls with the squared angle."""
    share = np.maximum(light / max(float(light.max()), 1e-300), 1e-30)
    return np.clip(-2 * np.log(share), 0, BINS - 1).astype(int)


def _judge(cells: _Cells) -> _Verdict:
    """Verdict for one kind of cells: the worse of the channels and all together."""
    total, squares, variance, common = cells
    judged = variance >= LEAST_SAMPLES
    variance = np.where(judged, variance, 1)
    square = np.where(judged, total**2 / (variance + common), 0)
    # Noise that is larger in some cells than in others makes T² vary more.
    local = np.where(judged, np.maximum(squares / variance, 1), 0)
    highest = (square / np.maximum(local, 1)).max(axis=-1)
    count, whole, spread = (part.sum(axis=-1) for part in (judged, square, local**2))
    apart = count[:3].sum(), whole[:3].sum(), spread[:3].sum(), highest[:3].max()
    together = count[3], whole[3], spread[3], highest[3]
    return max(_judge_sums(*map(float, sums)) for sums in (apart, together))


def _judge_sums(count: float, square: float, local: float, highest: float) -> _Verdict:
    """Verdict from the mean of T² and from its largest value."""
    if count < 3:
        return _Verdict(0.0, 1.0)
    mean, spread = square / count, 2 * local / (9 * count**2)
    spread_out = (mean ** (1 / 3) - (1 - spread)) / math.sqrt(spread)
    # Corrected for the number of cells.
    alone = highest - 2 * math.log(count)
    return _Verdict(max(spread_out, math.sqrt(max(alone, 0))), max(mean, 1.0))
