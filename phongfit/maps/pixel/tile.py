"""A tile: many pixels at once. A pure function, arrays in and arrays out.

It holds no state and knows no disk: a cluster can run it as it is.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int, Shaped

from phongfit.cache import keep_compiled
from phongfit.maps.pixel.lighting import Lighting
from phongfit.maps.pixel.pixel import BESIDE, Known, PixelFit, fit_pixel
from phongfit.maps.pixel.samples import PixelSamples
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import optimization_barrier

BLOCK = 512
"""Pixels that are worked on together: few enough for the numbers to stay in cache."""


class Tile(NamedTuple):
    """Geometry and measured light of pixels; of padding nothing is used.

    - `target`: (images, pixels, 3), in the order of the lighting's rows.
    - `used`: the same or (1, pixels, 3) or (1, pixels, 1): which samples count, or how
        much: see [`PixelSamples`][].
    - `normal`: (pixels, 3).
    - `position`, `to_viewer`: (pixels, 3), or (1, 3) where they are the same for all.
    - `visibility`: (images, lobes, pixels), or `None` without shadows.
    """

    target: Float[Any, "images pixels 3"]
    used: Shaped[Any, "some_images pixels some_channels"]
    normal: Float[Any, "pixels 3"]
    position: Float[Any, "some_pixels 3"]
    to_viewer: Float[Any, "some_pixels 3"]
    visibility: Any = None

    def parts(self, size: int) -> "list[Tile]":
        """The tile in parts of `size` pixels, without copies."""

        def rows(table: Any, part: slice) -> Any:
            return table if len(table) == 1 else table[part]

        return [
            Tile(
                self.target[:, part],
                self.used[:, part],
                self.normal[part],
                rows(self.position, part),
                rows(self.to_viewer, part),
                None if self.visibility is None else self.visibility[..., part],
            )
            for start in range(0, len(self.normal), size)
            for part in [slice(start, start + size)]
        ]

    def rows(self, rows: Int[Array, " n"]) -> "Tile":
        """Some pixels of a tile whose arrays are those of JAX."""

        def taken(array: Array, axis: int = 0) -> Array:
            return jnp.take(array, rows, axis, mode="clip")

        def unless_one(array: Array) -> Array:
            return array if array.shape[0] == 1 else taken(array)

        return Tile(
            taken(self.target, 1),
            taken(self.used, 1),
            taken(self.normal),
            unless_one(self.position),
            unless_one(self.to_viewer),
            None if self.visibility is None else taken(self.visibility, 2),
        )


class Outside(NamedTuple):
    """What all tiles share: lights, known parameters, and the noise level."""

    lighting: Lighting
    known: Known
    noise: Float[Array, ""]


def fit_tile(tile: Tile, outside: Outside, settings: MapSettings) -> PixelFit:
    """The material of every pixel of a tile.

    Block by block in short; the few pixels for which that is not enough are gathered to
    blocks of their own, and worked on thoroughly: see [`fit_pixel`][].

    **Arguments:**

    - `tile`: a multiple of [`BLOCK`][] pixels.
    - `outside`, `settings`: the same for all tiles.

    **Returns:** a [`PixelFit`][] whose leaves have the pixels as their first axis.
    """
    pixels = tile.normal.shape[0]
    blocks, along = pixels // BLOCK, jnp.arange(BLOCK)

    # Traced once, though it is asked for its shapes first.
    @jax.jit
    def fit_block(rows: Array, thorough: Array) -> tuple[PixelFit, Array]:
        return _fit_block(tile.rows(rows), outside, thorough, settings)

    def unfinished(state: _Work) -> Array:
        return (state.block < blocks) | ((state.block - blocks) * BLOCK < state.n_left)

    def work(state: _Work) -> _Work:
        again = state.block >= blocks
        start = jnp.where(again, (state.block - blocks) * BLOCK, 0)
        # What stands beyond the end of those left is worked on, and never read.
        left = jax.lax.dynamic_slice_in_dim(state.left, start, BLOCK)
        rows = jnp.where(again, left, state.block * BLOCK + along)
        found, unsettled = fit_block(rows, again)
        unsettled &= ~again
        (which,) = jnp.nonzero(unsettled, size=BLOCK, fill_value=0)
        longer = _put(state.left, rows[which], state.n_left)
        return _Work(
            state.block + 1,
            jax.tree.map(
                lambda all, some: _put(all, some, state.block * BLOCK),
                state.found,
                found,
            ),
            jnp.where(again, state.left, longer),
            state.n_left + jnp.sum(unsettled).astype(state.n_left.dtype),
        )

    shapes, _ = jax.eval_shape(fit_block, along, jnp.zeros((), bool))
    zero = jnp.zeros((), along.dtype)
    first = _Work(
        zero,
        jax.tree.map(
            lambda leaf: jnp.zeros((2 * pixels, *leaf.shape[1:]), leaf.dtype), shapes
        ),
        jnp.zeros(pixels + BLOCK, along.dtype),
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
    found: PixelFit
    left: Array
    n_left: Array


def _fit_block(
    tile: Tile, outside: Outside, thorough: Array, settings: MapSettings
) -> tuple[PixelFit, Array]:
    """All pixels of a tile side by side, and which of them are not settled."""

    def pixel(
        target: Array,
        used: Array,
        normal: Array,
        position: Array,
        to_viewer: Array,
        visibility: Array | None,
    ) -> tuple[PixelFit, Array]:
        basis = outside.lighting.basis(
            position, normal, to_viewer, visibility, settings.min_cosine
        )
        basis = optimization_barrier(basis)
        samples = PixelSamples(
            target,
            jnp.broadcast_to(used * basis.lit[None, :], target.shape),
            basis.ambient,
            basis.diffuse,
            basis.strength,
            basis.angles,
            basis.veil,
        )
        return fit_pixel(samples, outside.known, outside.noise, thorough, settings)

    def axis(array: Array) -> int | None:
        return None if array.shape[0] == 1 else 0

    def squeezed(array: Array) -> Array:
        return array[0] if array.shape[0] == 1 else array

    batched = jax.vmap(
        pixel,
        in_axes=(
            0,
            0,
            0,
            axis(tile.position),
            axis(tile.to_viewer),
            None if tile.visibility is None else 2,
        ),
        axis_name=BESIDE,
    )
    target, used = optimization_barrier(
        (
            _channels_first(tile.target),
            _channels_first(tile.used.astype(tile.target.dtype)),
        )
    )
    return batched(
        target,
        used,
        tile.normal,
        squeezed(tile.position),
        squeezed(tile.to_viewer),
        tile.visibility,
    )


def _channels_first(values: Array) -> Array:
    """(images, pixels, channels) as (pixels, channels, images), in that order."""
    # Not a mere transposition: the compiler would keep the old order in memory.
    channels = [values[..., k].T for k in range(values.shape[-1])]
    return jnp.stack(channels, axis=1)


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
