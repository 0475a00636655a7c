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

from phongfit.cache import keep_compiled
from phongfit.maps.pixel.pixel import Outside, PixelFit, fit_pixels
from phongfit.maps.pixel.samples import Tile
from phongfit.maps.pixel.settings import MapSettings

BLOCK = 512
"""Pixels that are worked on together: few enough for the numbers to stay in cache."""


T = TypeVar("T")


def fit_tile(tile: Tile, outside: Outside, settings: MapSettings) -> PixelFit:
    """The material of every pixel of a tile, in short or thoroughly: [`fit_pixels`][].

    **Arguments:**

    - `tile`: a multiple of [`BLOCK`][] pixels.
    - `outside`, `settings`: the same for all tiles.

    **Returns:** a [`PixelFit`][] whose leaves have the pixels as their first axis.
    """
    return in_blocks(
        tile, lambda part, thorough: fit_pixels(part, outside, thorough, settings)
    )


def in_blocks(tile: Tile, fit: Callable[[Tile, Array], tuple[T, Array]]) -> T:
    """What `fit` makes of each block of a tile, with all pixels as the first axis.

    Block by block in short; the few pixels for which that is not enough are gathered to
    blocks of their own, and worked on thoroughly.

    **Arguments:** `fit`: from a block, and whether to be thorough, to what it finds,
    and to where that is wanted.
    """
    pixels = tile.normal.shape[0]
    blocks = pixels // BLOCK
    # Traced once, though it is asked for its shapes first.
    fit_block = jax.jit(fit)

    def unfinished(state: _Work) -> Array:
        return (state.block < blocks) | ((state.block - blocks) * BLOCK < state.n_left)

    def work(state: _Work) -> _Work:
        again = state.block >= blocks
        start = state.block * BLOCK
        # What stands beyond the end of those left is worked on, and never read.
        left = jax.lax.dynamic_slice_in_dim(state.left, start - pixels, BLOCK)
        part = jax.lax.cond(
            again, lambda: tile.rows(left), lambda: tile.span(start, BLOCK)
        )
        found, unsettled = fit_block(part, again)
        unsettled &= ~again
        (which,) = jnp.nonzero(unsettled, size=BLOCK, fill_value=0)
        longer = _put(state.left, start + which, state.n_left)
        return _Work(
            state.block + 1,
            jax.tree.map(
                lambda all, some: _put(all, some, start),
                state.found,
                found,
            ),
            jnp.where(again, state.left, longer),
            state.n_left + jnp.sum(unsettled).astype(state.n_left.dtype),
        )

    zero = jnp.zeros((), int)
    whole = tile.span(zero, BLOCK)
    shapes, _ = jax.eval_shape(fit_block, whole, jnp.zeros((), bool))
    first = _Work(
        zero,
        jax.tree.map(
            lambda leaf: jnp.zeros((2 * pixels, *leaf.shape[1:]), leaf.dtype), shapes
        ),
        jnp.zeros(pixels + BLOCK, zero.dtype),
        zero,
    )
    last = jax.lax.while_loop(unfinished, work, first)
    # Where a pixel's last word stands.
    order = jnp.arange(pixels)
    at = jnp.where(order < last.n_left, last.left[:pixels], pixels)
    at = order.at[at].set(pixels + order, mode="drop")
    return jax.tree.map(lambda leaf: leaf[at], last.found)


def _put(all: Array, some: Array, start: Array) -> Array:
    return jax.lax.dynamic_update_slice_in_dim(all, some, start, 0)


class _Work(NamedTuple):
    """Where the work on a tile stands.

    - `block`: the next; those after the tile's own are of pixels that were left.
    - `found`: of all blocks, one after another.
    - `left`, `n_left`: the pixels that were left, and how many.
    """

    block: Array
    found: Any
    left: Array
    n_left: Array


# On a CPU, XLA removes barriers before it fuses: then they would be in vain.
SETTLED = {"xla_disable_hlo_passes": "cse_barrier_expander"}


@functools.lru_cache(maxsize=16)
def compiled(settings: MapSettings, mesh: Mesh, fit: Callable[..., Any] = fit_tile):
    """[`fit_tile`][], or its like, with its pixels spread over a mesh's devices."""
    keep_compiled()
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
        )

    @functools.partial(jax.jit, compiler_options=SETTLED)
    def run(tile: Tile, outside: Outside) -> Any:
        spread = jax.shard_map(
            lambda tile, outside: fit(tile, outside, settings),
            mesh=mesh,
            in_specs=(shares(tile), PartitionSpec()),
            out_specs=along,
            check_vma=False,
        )
        return spread(tile, outside)

    return run
