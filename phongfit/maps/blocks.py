"""Maps in blocks, each of which is read, fitted and written separately.

A block is a rectangle of the image and one chunk of every array of the output. For
workers the job is in the output's store as well, so that one needs only the path of the
store and the number of a block.
"""

import contextlib
import dataclasses
import functools
import hashlib
import math
import os
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from phongfit.files.zarrs import (
    keep_array,
    open_array,
    open_group,
    store_of,
    writable,
)
from phongfit.geometry.surfaces import NormalMap
from phongfit.maps.ahead import ahead
from phongfit.maps.job import Job
from phongfit.maps.materials.finding import Materials
from phongfit.maps.result import WEIGHTS, Layer, Maps, layers_of
from phongfit.maps.stacks import AbstractStack, ZarrStack, identify_stack
from phongfit.maps.store import DIGEST, GIVEN, PLAN, BlockStore, alone_at, open_store
from phongfit.maps.stored import STORE_FORMAT, make_head, maps_of
from phongfit.maps.tiles import Team, as_team, bar, fit_job, tile_size, versions

if TYPE_CHECKING:
    from phongfit.files.zarrs import Group

BLOCK_BYTES = 2**26
"""Maximum bytes of stored image samples in a block by default."""

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Kept:
    """A store that keeps finished blocks.

    - `output`: path or URL of the store; `identity`: of the job.
    - `block`: rows and columns of a block.
    """

    output: str
    identity: dict[str, str]
    block: tuple[int, int]

    def inside(self, name: str) -> "Kept":
        """A store inside this one, of an earlier pass."""
        return dataclasses.replace(self, output=f"{self.output}/{name}")


@contextlib.contextmanager
def kept_at(
    output: str | os.PathLike[str], job: Job, block: tuple[int, int], **asked: Any
) -> Iterator[Kept]:
    """A store for the blocks of a job, into which no other run writes meanwhile.

    **Arguments:** `asked`: further options of the fit, which identify it.

    **Raises:** as [`alone_at`][] and [`open_store`][].
    """
    with alone_at(output, source_of(job.stack)) as place:
        identity = job.identify() | {name: str(value) for name, value in asked.items()}
        identity |= {
            "images": identify_stack(job.stack),
            "block": f"{block[0]} × {block[1]} pixels",
            "versions": versions(),
        }
        open_store(place, {"format": STORE_FORMAT, "job": identity})
        yield Kept(place, identity, block)


def source_of(stack: AbstractStack) -> str | None:
    """Path or URL of the store of images, if they are in one."""
    return store_of(stack.array) if isinstance(stack, ZarrStack) else None


@dataclass(frozen=True)
class Blocks:
    """A job whose blocks are fitted separately, and written into a store.

    - `job`: of all pixels; `shared`: the materials that they share.
    - `block`: rows and columns of a block.
    - `head`: attributes of the store, which are needed to read its arrays.
    - `identity`: of the job, for the checksums of blocks.
    """

    job: Job
    shared: Materials | None
    block: tuple[int, int]
    head: dict[str, Any]
    identity: dict[str, str]

    def store(self, group: "Group") -> BlockStore:
        """The blocks of the output."""
        return BlockStore(group, self.identity, tuple(self.head["size"]), self.block)

    def fit(self, group: "Group", number: int, team: Team, threads: int = 1) -> Arrays:
        """Fit and write a block, unless it is finished.

        **Arguments:** `threads`: number of threads that fit it.

        **Returns:** its arrays over the pixels, by their names in the store.

        **Raises:** `ValueError` or `OSError` that names what cannot be read or written.
        """
        store, names = self.store(group), self.head["arrays"]
        found = store.load(number, names)
        if found is not None:
            return found
        size = tile_size(math.prod(self.block), len(self.job.scenes), None, team)
        # Each block begins with another device, since blocks may have one tile.
        first = number % len(team.devices)
        team = Team([*team.devices[first:], *team.devices[:first]], threads)
        maps = fit_job(self.job.part(store.window(number)), size, team, self.shared)
        arrays = maps.pixel_arrays() | maps.whole_arrays()
        arrays = {name: arrays[name] for name in names}
        store.save(number, arrays)
        return arrays

    def counts(self, arrays: Arrays) -> dict[str, int]:
        """Counts of the pixels of a block."""
        return maps_of(arrays, self.head).counts()


def make_blocks(
    job: Job, kept: Kept, shared: Materials | None = None
) -> "tuple[Blocks, Group]":
    """The blocks of a job, and the group of their store with all arrays.

    **Raises:** as [`open_store`][] does.
    """
    layers = layers_of(1 if job.settings.shared else 3)
    if job.noise.varies:
        layers["noise_given"] = Layer((), 0)
    if shared is not None:
        layers[WEIGHTS] = Layer((len(shared.bases.shares),), 0)
    head = make_head(job, kept.identity, layers)
    # A pass may have other scenes than the job that identifies the store.
    identity = kept.identity | job.identify()
    blocks = Blocks(job, shared, kept.block, head, identity)
    group = open_store(kept.output, head)
    blocks.store(group).make(layers, head["precision"])
    return blocks, group


def fit_whole(
    job: Job, kept: Kept, shared: Materials | None, team: Team, progress: bool
) -> Maps:
    """Fit the maps of a job block by block, with geometry and maps in memory.

    **Arguments:** `shared`: as for [`fit_job`][].
    """
    job = dataclasses.replace(job, traced=job.geometry)
    blocks, group = make_blocks(job, kept, shared)
    store, single = blocks.store(group), Team(team.devices, 1)
    count, whole = math.prod(store.grid), {}
    done = ahead(lambda k: blocks.fit(group, k, single), count, team.threads)
    for number, arrays in bar(done, count, progress, "blocks"):
        for name, values in arrays.items():
            if name not in whole:
                kind = writable(group, name).dtype
                whole[name] = np.empty((*store.size, *values.shape[2:]), kind)
            whole[name][store.window(number)] = values
    weights, scene = whole.pop(WEIGHTS, None), job.scenes[0]
    return dataclasses.replace(
        maps_of(whole, blocks.head),
        camera=scene.camera,
        specular_model=scene.specular_model,
        materials=None if shared is None else shared.basis(job.settings, weights),
    )


class Place(NamedTuple):
    """Address of blocks, which workers get together with the number of one.

    - `output`: the store of the maps.
    - `digest`: checksum of the plan in it, so that no other plan is run.
    - `versions`: versions of the packages that made the plan.
    """

    output: str
    digest: bytes
    versions: str


def fit_block(place: Place, number: int) -> dict[str, int]:
    """Fit and write a block, unless it is finished; returns the counts of its pixels.

    **Raises:** as [`Blocks.fit`][] does.
    """
    blocks = _plan(place)
    return blocks.counts(blocks.fit(open_group(place.output, "r+"), number, as_team()))


@functools.lru_cache(maxsize=2)
def _plan(place: Place) -> Blocks:
    """Read the blocks of a place.

    **Raises:** `ValueError` if this process cannot give bit-identical results.
    """
    if place.versions != versions():
        raise ValueError(
            f"client: expected workers with {place.versions}, got {versions()}"
        )
    kept = np.asarray(open_array(place.output, PLAN)).tobytes()
    # The digest is checked first, since a pickle can run code.
    if hashlib.blake2b(kept, digest_size=DIGEST).digest() != place.digest:
        raise ValueError(
            f"{place.output}: another run has started there meanwhile; it goes on"
        )
    blocks: Blocks = pickle.loads(kept)
    precision = str(jnp.result_type(float))
    if blocks.head["precision"] != precision:
        raise ValueError(
            f"client: expected workers that compute in {blocks.head['precision']}, as "
            f"this process does, got {precision} (JAX_ENABLE_X64 sets it)"
        )
    return blocks


def make_place(blocks: Blocks, group: "Group", output: str) -> Place:
    """Write blocks into their store, for workers; arrays over pixels separately.

    **Raises:** `OSError` if the output cannot be written.
    """
    import cloudpickle

    size, names = tuple(blocks.head["size"]), iter(range(10_000))

    def apart(leaf: Any) -> Any:
        if np.shape(leaf)[:2] != size:
            return leaf
        name = f"{GIVEN}/{next(names):04d}"
        keep_array(group, name, np.asarray(leaf), blocks.block)
        return open_array(output, name)

    job = blocks.job
    surface = job.scenes[0].surface
    if isinstance(surface, NormalMap):
        surface = jax.tree.map(apart, surface)
    job = dataclasses.replace(
        job,
        scenes=tuple(dataclasses.replace(x, surface=surface) for x in job.scenes),
        masks=job.masks.each(apart),
        noise=job.noise.each(apart),
    )
    # Cloudpickle, since the plan may contain functions that the user defined.
    packed = cloudpickle.dumps(dataclasses.replace(blocks, job=job))
    plan = np.frombuffer(packed, np.uint8)
    keep_array(group, PLAN, plan, plan.shape)
    digest = hashlib.blake2b(packed, digest_size=DIGEST).digest()
    return Place(output, digest, versions())


def block_size(
    stack: AbstractStack, wanted: tuple[int, int] | None, most: int | None = None
) -> tuple[int, int]:
    """Rows and columns of a block.

    By default a block is made of shards of the images, of chunks if there are no
    shards, or of rows of photographs. It holds as many as fit into `most` pixels, or a
    part of one that is larger.

    **Arguments:** `most`: default: as many as fit into [`BLOCK_BYTES`][].
    """
    count, height, width = stack.shape
    if wanted is not None:
        rows, columns = wanted
        if rows < 1 or columns < 1:
            raise ValueError(f"block: expected rows and columns ≥ 1, got {wanted}")
        return min(rows, height), min(columns, width)
    if most is None:
        most = max(BLOCK_BYTES // (3 * count * stack.itemsize), 1)
    # Photographs are read in rows, of which all blocks have about equally many.
    sides = [-(-height // -(-height * width // most)), width]
    if isinstance(stack, ZarrStack):
        array = stack.array
        _, *sides, _ = array.chunks if array.shards is None else array.shards
    rows, columns = min(sides[0], height), min(sides[1], width)
    while rows * columns > most and rows > 1:
        rows = -(-rows // 2)
    while rows * columns > most and columns > 1:
        columns = -(-columns // 2)
    while columns < width and 2 * rows * columns <= most:
        columns *= 2
    while rows < height and 2 * rows * columns <= most:
        rows *= 2
    return min(rows, height), min(columns, width)
