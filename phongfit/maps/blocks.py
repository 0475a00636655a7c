"""Maps in blocks, each of which is read, fitted and written separately by any worker.

A block is a rectangle of the image and one chunk of every array of the output. The plan
with the inputs of all blocks is in the output's store, so that a worker needs only the
path of the store and the number of a block.
"""

import dataclasses
import functools
import hashlib
import math
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from phongfit.files.zarrs import (
    keep_array,
    open_array,
    open_group,
    place_of,
    read_window,
    writable,
)
from phongfit.geometry.cameras import WindowCamera
from phongfit.geometry.surfaces import AbstractSurface, NormalMap
from phongfit.maps.job import (
    Job,
    check_scenes,
    check_sizes,
    identify,
    make_job,
    settle,
)
from phongfit.maps.layers import Layers, Noise, mask_layers
from phongfit.maps.pixel.settings import MAP_PARAMETERS
from phongfit.maps.result import Layer, layers_of, view_of
from phongfit.maps.run import Team, as_team, fit_job, tile_size, versions
from phongfit.maps.stacks import (
    AbstractStack,
    ArrayStack,
    ZarrStack,
    identify_stack,
    read_rectangle,
)
from phongfit.maps.store import DIGEST, GIVEN, PLAN, BlockStore, open_store
from phongfit.maps.stored import STORE_FORMAT, STORE_VERSION, maps_of
from phongfit.rendering.film import Encoding
from phongfit.scene import Scene

if TYPE_CHECKING:
    from phongfit.files.zarrs import Group

BLOCK_BYTES = 2**26
"""Maximum bytes of stored image samples in a block by default."""

Counts = dict[str, int]


@dataclass(frozen=True)
class Stored:
    """Name of an input array in the output's store."""

    name: str


@dataclass(frozen=True)
class Plan:
    """Inputs that all blocks share, which workers read from the output's store.

    - `images`: path or URL of the images; `encoding`: their encoding. `None` for images
        that only this process reads.
    - `size`: rows and columns of the image; `block`: of a block.
    - `scenes`: all share a surface; arrays over its pixels are [`Stored`][].
    - `mask`, `noise`: as for [`make_job`][]; arrays are [`Stored`][].
    - `options`: the other arguments of [`make_job`][].
    - `head`: attributes of the output, which are needed to read its arrays.
    """

    images: str | None
    encoding: Encoding | None
    size: tuple[int, int]
    block: tuple[int, int]
    scenes: tuple[Scene, ...]
    mask: Any
    noise: Any
    options: dict[str, Any]
    head: dict[str, Any]

    def store(self, group: "Group") -> BlockStore:
        """The blocks of the output."""
        return BlockStore(group, self.head["job"], self.size, self.block)

    def job(self, group: "Group", number: int, stack: AbstractStack | None) -> Job:
        """The job of a block.

        **Arguments:** `stack`: the images; `None` for those that the plan names.
        """
        window = rows, columns = self.store(group).window(number)
        size = rows.stop - rows.start, columns.stop - columns.start

        def read(leaf: Any) -> Any:
            if not isinstance(leaf, Stored):
                return leaf
            return read_window(writable(group, f"{GIVEN}/{leaf.name}"), window)

        first = self.scenes[0]
        camera = WindowCamera(first.camera, columns.start, rows.start, size[1], size[0])
        # Without normalising again, which would change the normals' last bit.
        surface = jax.tree.map(read, first.surface)
        if isinstance(surface, NormalMap) and surface.mask.shape == (1, 1):
            normals = np.broadcast_to(np.asarray(surface.normals), (*size, 3))
            surface = NormalMap(normals)
        scenes = [
            dataclasses.replace(scene, surface=surface, camera=camera)
            for scene in self.scenes
        ]
        if stack is None:
            assert self.images is not None
            stack = ZarrStack(self.images, self.encoding)
        return make_job(
            scenes,
            ArrayStack(read_rectangle(stack, window)),
            mask=jax.tree.map(read, self.mask),
            noise=jax.tree.map(read, self.noise),
            **self.options,
        )


class Place(NamedTuple):
    """Address of a plan, which workers get together with the number of a block.

    - `output`: the store of the maps.
    - `digest`: checksum of the plan in it, so that no other plan is run.
    - `versions`: versions of the packages that made the plan.
    """

    output: str
    digest: bytes
    versions: str


def fit_block(
    place: Place, number: int, stack: AbstractStack | None = None, threads: int = 1
) -> tuple[Counts, bool]:
    """Fit and write a block, unless it is finished.

    **Arguments:**

    - `stack`: images that this process reads; `None` for those that the plan names.
    - `threads`: number of threads that fit it.

    **Returns:** counts of its pixels, and whether it was fitted.

    **Raises:** `ValueError` or `OSError` that names what cannot be read or written.
    """
    plan, group = _plan(place), open_group(place.output, "r+")
    store = plan.store(group)
    found = store.load(number, plan.head["arrays"])
    if found is not None:
        return _counts(found, plan), False
    job = plan.job(group, number, stack)
    team = as_team()
    size = tile_size(math.prod(plan.block), len(plan.scenes), None, team)
    # Each block begins with another device, since blocks may have one tile.
    first = number % len(team.devices)
    devices = [*team.devices[first:], *team.devices[:first]]
    arrays = fit_job(job, size, Team(devices, threads)).pixel_arrays()
    store.save(number, arrays)
    return _counts(arrays, plan), True


@functools.lru_cache(maxsize=2)
def _plan(place: Place) -> Plan:
    """Read the plan of a place.

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
    plan: Plan = pickle.loads(kept)
    precision = str(jnp.result_type(float))
    if plan.head["precision"] != precision:
        raise ValueError(
            f"client: expected workers that compute in {plan.head['precision']}, as "
            f"this process does, got {precision} (JAX_ENABLE_X64 sets it)"
        )
    return plan


def _counts(arrays: Mapping[str, np.ndarray], plan: Plan) -> Counts:
    return maps_of(arrays, plan.head).counts()


def make_place(
    scenes: Any,
    stack: AbstractStack,
    output: str,
    block: tuple[int, int] | None,
    *,
    mask: Any = None,
    noise: Any = None,
    **options: Any,
) -> tuple[Place, int]:
    """Make a plan, check it, and write it into the output's store.

    **Arguments:** as for [`fit_stored_maps`][].

    **Returns:** where the plan is, and the number of blocks.

    **Raises:** `ValueError` that names the argument, or a store of another job;
    `OSError` if the output cannot be written.
    """
    import cloudpickle

    scenes = check_scenes(scenes)
    check_sizes(scenes, stack.shape)
    levels, masks = Noise(noise, stack.shape), mask_layers(mask, stack.shape)
    settings, outside = settle(scenes, levels, **options)
    if settings.materials is not None:
        raise ValueError(
            "materials: expected none: they are found from a sample of all pixels, "
            "which fit_maps draws, and no block has"
        )
    start = options.get("start")
    # Only the material of a fit is used, so that the plan is small.
    options["start"] = getattr(start, "material", start)
    size, block = stack.shape[1:], block_size(stack, block)
    first = scenes[0]
    surface, mask, noise, given = _apart(first.surface, masks, levels, size)
    layers = layers_of(1 if settings.shared else 3)
    if levels.varies:
        layers["noise_given"] = Layer((), 0)
    ambient = np.asarray(first.ambient).tolist()
    shadows = [scene.shadows for scene in scenes]
    place = first.surface, first.camera, shadows, first.local_viewer
    head = {
        "format": STORE_FORMAT,
        "version": STORE_VERSION,
        "job": identify(settings, outside, place, masks, levels)
        | {
            "unknowns": ", ".join(options.get("unknowns", MAP_PARAMETERS)),
            "images": identify_stack(stack),
            "block": f"{block[0]} × {block[1]} pixels",
            "versions": versions(),
        },
        "size": list(size),
        "unknowns": list(settings.names),
        "noise_given": None if levels.varies else levels.given(),
        "view": view_of(first.camera, first.specular_model, ambient),
        "precision": str(jnp.result_type(float)),
        "arrays": [*layers],
    }
    stored = stack if isinstance(stack, ZarrStack) else None
    plan = Plan(
        None if stored is None else place_of(stored.array),
        None if stored is None else stored.encoding,
        size,
        block,
        tuple(dataclasses.replace(scene, surface=surface) for scene in scenes),
        mask,
        noise,
        options,
        head,
    )
    group = open_store(output, head)
    store = plan.store(group)
    store.make(layers, head["precision"])
    for name, array in given.items():
        keep_array(group, f"{GIVEN}/{name}", array, block)
    # Cloudpickle, since the plan may contain functions that the user defined.
    packed = np.frombuffer(cloudpickle.dumps(plan), np.uint8)
    keep_array(group, PLAN, packed, packed.shape)
    digest = hashlib.blake2b(packed.tobytes(), digest_size=DIGEST).digest()
    return Place(output, digest, versions()), math.prod(store.grid)


def _apart(
    surface: AbstractSurface, masks: Layers, noise: Noise, size: tuple[int, int]
) -> tuple[AbstractSurface, Any, Any, dict[str, np.ndarray]]:
    """Surface, mask and noise with [`Stored`][] for arrays over pixels; the arrays."""
    if isinstance(surface, NormalMap) and surface.mask.shape not in ((1, 1), size):
        raise ValueError(
            f"scenes: expected a normal map of {size} pixels, as the images have, got "
            f"{surface.mask.shape}"
        )
    arrays: dict[str, np.ndarray] = {}

    def apart(leaf: Any) -> Any:
        if np.shape(leaf)[:2] != size:
            return leaf
        name = f"{len(arrays):04d}"
        arrays[name] = np.asarray(leaf)
        return Stored(name)

    if isinstance(surface, NormalMap):
        surface = jax.tree.map(apart, surface)
    mask, level = jax.tree.map(apart, (masks.arrays, noise.arrays))
    return surface, mask, level, arrays


def block_size(stack: AbstractStack, wanted: tuple[int, int] | None) -> tuple[int, int]:
    """Rows and columns of a block.

    By default a block is made of shards of the images, of chunks if there are no
    shards, or of rows of photographs. It holds as many as fit into [`BLOCK_BYTES`][],
    or a part of one that is larger.
    """
    count, height, width = stack.shape
    if wanted is not None:
        rows, columns = wanted
        if rows < 1 or columns < 1:
            raise ValueError(f"block: expected rows and columns ≥ 1, got {wanted}")
        return min(rows, height), min(columns, width)
    sides = [1, width]
    if isinstance(stack, ZarrStack):
        array = stack.array
        _, *sides, _ = array.chunks if array.shards is None else array.shards
    rows, columns = min(sides[0], height), min(sides[1], width)
    most = max(BLOCK_BYTES // (3 * count * stack.itemsize), 1)
    while rows * columns > most and rows > 1:
        rows = -(-rows // 2)
    while rows * columns > most and columns > 1:
        columns = -(-columns // 2)
    while columns < width and 2 * rows * columns <= most:
        columns *= 2
    while rows < height and 2 * rows * columns <= most:
        rows *= 2
    return min(rows, height), min(columns, width)
