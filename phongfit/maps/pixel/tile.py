"""A tile: many pixels at once. A pure function, arrays in and arrays out.

It holds no state and knows no disk: a cluster can run it as it is.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from phongfit.maps.pixel.pixel import Outside, PixelFit, fit_pixels
from phongfit.maps.pixel.samples import Tile
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import KEEP_BARRIERS

BLOCK = 512
"""Pixels that are worked on together: few enough for the numbers to stay in cache."""

MOST = 2
"""The most effort; less is for many, since a block takes as long as its last pixel."""

FEW = 4
"""So many blocks are not worth it to go through the efforts one by one."""

T = TypeVar("T")


def fit_tile(tile: Tile, outside: Outside, settings: MapSettings) -> PixelFit:
    """The material of every pixel of a tile, with as much effort as it takes.

    See [`fit_pixels`][].

    **Arguments:**

    - `tile`: a multiple of [`BLOCK`][] pixels.
    - `outside`, `settings`: the same for all tiles.

    **Returns:** a [`PixelFit`][] whose leaves have the pixels as their first axis.
    """
    return in_blocks(
        tile, lambda part, effort: fit_pixels(part, outside, effort, settings)
    )


def in_blocks(tile: Tile, fit: Callable[[Tile, Array], tuple[T, Array]]) -> T:
    """What `fit` makes of each block of a tile, with all pixels as the first axis.

    Block by block in short; the pixels for which that is not enough are gathered to
    blocks of their own, and worked on with more effort, and so on; where they fill no
    more than [`FEW`][] blocks, with the most at once.

    **Arguments:** `fit`: from a block and the effort, 0 to [`MOST`][], to what it
    finds, and to where more is wanted. With the most nothing is.
    """
    pixels = tile.normal.shape[0]
    room = (MOST + 1) * pixels
    # Traced once, though it is asked for its shapes first.
    fit_block = jax.jit(fit)

    def work(state: _Work) -> _Work:
        start = state.block * BLOCK
        these = jax.lax.dynamic_slice_in_dim(state.queue, start, BLOCK)
        part = jax.lax.cond(
            state.effort > 0,
            lambda: tile.rows(these),
            lambda: tile.span(start, BLOCK),
        )
        found, unsettled = fit_block(part, state.effort)
        unsettled &= (these < pixels) & (state.effort < MOST)
        (which,) = jnp.nonzero(unsettled, size=BLOCK, fill_value=BLOCK)
        more = jnp.take(these, which, mode="fill", fill_value=pixels)
        length = state.length + jnp.sum(unsettled).astype(state.length.dtype)
        # After the last of an effort the next one begins, in a block of its own.
        last = start + BLOCK == state.end
        full = -(-length // BLOCK) * BLOCK
        jump = jnp.where(full - state.end > FEW * BLOCK, 1, MOST - state.effort)
        return _Work(
            state.block + 1,
            jax.tree.map(lambda all, some: _put(all, some, start), state.found, found),
            _put(state.queue, more, state.length),
            jnp.where(last, full, length),
            jnp.where(last, full, state.end),
            jnp.where(last, state.effort + jump, state.effort),
        )

    zero = jnp.zeros((), int)
    shapes, _ = jax.eval_shape(fit_block, tile.span(zero, BLOCK), zero)
    order = jnp.arange(room + BLOCK)
    first = _Work(
        zero,
        jax.tree.map(
            lambda leaf: jnp.zeros((room, *leaf.shape[1:]), leaf.dtype), shapes
        ),
        jnp.minimum(order, pixels),
        zero + pixels,
        zero + pixels,
        zero,
    )
    last = jax.lax.while_loop(lambda s: s.block * BLOCK < s.end, work, first)
    # Where a pixel's last word stands.
    at = jnp.zeros(pixels, int).at[last.queue].max(order, mode="drop")
    return jax.tree.map(lambda leaf: leaf[at], last.found)


def _put(all: Array, some: Array, start: Array) -> Array:
    return jax.lax.dynamic_update_slice_in_dim(all, some, start, 0)


class _Work(NamedTuple):
    """Where the work on a tile stands.

    - `block`: the next, of the queue's pixels.
    - `found`: of all blocks, one after another.
    - `queue`: all pixels, then those that want more, each effort's from a multiple of
        [`BLOCK`][] on; the number of pixels where none is.
    - `length`: where the next that wants more goes.
    - `end`: of the pixels of this effort.
    - `effort`: of the next block.
    """

    block: Array
    found: Any
    queue: Array
    length: Array
    end: Array
    effort: Array


@functools.lru_cache(maxsize=16)
def compiled(settings: MapSettings, mesh: Mesh, fit: Callable[..., Any] = fit_tile):
    """[`fit_tile`][], or its like, with its pixels spread over a mesh's devices."""
    axis = mesh.axis_names[0]
    along = PartitionSpec(axis)

    def shares(tile: Tile) -> Tile:
        def unless_one(array: Array) -> PartitionSpec:
            return PartitionSpec() if array.shape[0] == 1 else along

        return Tile(
            PartitionSpec(None, axis),
            PartitionSpec(None, axis),
            along,
            unless_one(tile.position),
            unless_one(tile.to_viewer),
            None if tile.visibility is None else PartitionSpec(None, None, axis),
            None if tile.table is None else PartitionSpec(),
        )

    @functools.partial(jax.jit, compiler_options=KEEP_BARRIERS)
    def run(tile: Tile, outside: Any) -> Any:
        spread = jax.shard_map(
            lambda tile, outside: fit(tile, outside, settings),
            mesh=mesh,
            in_specs=(shares(tile), PartitionSpec()),
            out_specs=along,
            check_vma=False,
        )
        return spread(tile, outside)

    return run
