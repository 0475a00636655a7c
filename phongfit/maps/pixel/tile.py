"""Fits of a tile of pixels as a pure function from arrays to arrays.

It has no state and does not access files, so that a cluster can run it unchanged.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from phongfit.maps.pixel.samples import Tile
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import KEEP_BARRIERS

BLOCK = 512
"""Pixels of a block: few enough that its arrays stay in cache."""

T = TypeVar("T")


def in_two_passes(tile: Tile, fit: Callable[[Tile, Array], tuple[T, Array]]) -> T:
    """Fit all blocks of a tile quickly, then thoroughly the pixels that need it.

    The pixels of a block run in lock step, so one hard pixel slows all of them. Pixels
    that the first pass leaves unsettled are therefore gathered into separate blocks.

    **Arguments:** `fit`: from a block, and whether to be thorough, to its result and
    the pixels that need a thorough fit.

    **Returns:** the results, with the pixels as their first axis.
    """
    pixels = tile.normal.shape[0]
    # Jitted, so that it is traced once for `eval_shape` and for the loop.
    fit_block = jax.jit(fit)

    def work(state: _Work) -> _Work:
        start = state.block * BLOCK
        thorough = start >= pixels
        these = jax.lax.dynamic_slice_in_dim(state.queue, start, BLOCK)
        part = jax.lax.cond(
            thorough, lambda: tile.rows(these), lambda: tile.span(start, BLOCK)
        )
        result, unsettled = fit_block(part, thorough)
        (which,) = jnp.nonzero(unsettled & ~thorough, size=BLOCK, fill_value=BLOCK)
        more = jnp.take(these, which, mode="fill", fill_value=pixels)
        return _Work(
            state.block + 1,
            jax.tree.map(
                lambda all, some: all.at[these].set(some, mode="drop"),
                state.result,
                result,
            ),
            jax.lax.dynamic_update_slice_in_dim(state.queue, more, state.length, 0),
            state.length + jnp.sum(more < pixels),
        )

    zero = jnp.zeros((), int)
    span = tile.span(zero, BLOCK)
    shapes, _ = jax.eval_shape(fit_block, span, jnp.array(False))
    first = _Work(
        zero,
        jax.tree.map(
            lambda leaf: jnp.zeros((pixels, *leaf.shape[1:]), leaf.dtype), shapes
        ),
        jnp.minimum(jnp.arange(2 * pixels + BLOCK), pixels),
        zero + pixels,
    )
    return jax.lax.while_loop(lambda s: s.block * BLOCK < s.length, work, first).result


class _Work(NamedTuple):
    """State of [`in_two_passes`][].

    - `block`: number of the next block of the queue.
    - `result`: results so far of all pixels.
    - `queue`: all pixels, then those of the second pass; padded with the number of
        pixels.
    - `length`: length of the queue so far.
    """

    block: Array
    result: Any
    queue: Array
    length: Array


@functools.partial(
    jax.jit, static_argnames=("settings", "fit"), compiler_options=KEEP_BARRIERS
)
def run(
    tile: Tile, outside: Any, settings: MapSettings, fit: Callable[..., Any]
) -> dict[str, Array]:
    """The arrays of `fit(tile, outside, settings)`, by their names in files."""
    return fit(tile, outside, settings).arrays()
