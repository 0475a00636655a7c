"""A map in blocks: each is read, fitted and written by itself, by whoever has the time.

A block is a rectangle of the image and one chunk of every array of the output. What is
known of all blocks lies beside the maps in the output's store, so that a worker is told
no more than where that is, and the number of a block. There, too, is the ledger: of
every finished block a checksum of its maps, written after them. Who is asked for a
block that is finished, and whose maps are those of the checksum, does nothing.
"""

import dataclasses
import functools
import hashlib
import json
import math
import pickle
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from phongfit.files.zarrs import (
    Window,
    attributes,
    holds,
    keep_array,
    make_array,
    open_array,
    open_group,
    place_of,
    read_window,
    writable,
    write_attributes,
    write_window,
)
from phongfit.geometry.cameras import WindowCamera
from phongfit.geometry.surfaces import AbstractSurface, NormalMap
from phongfit.maps.job import (
    Job,
    check_scenes,
    check_sizes,
    identify_lights,
    make_job,
    settle,
)
from phongfit.maps.layers import Masks, Noise
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.pixel.settings import MAP_PARAMETERS, MapSettings
from phongfit.maps.result import view_of
from phongfit.maps.run import as_mesh, fit_job, tile_size, versions
from phongfit.maps.stacks import (
    AbstractStack,
    RectangleStack,
    ZarrStack,
    identify_stack,
    read_rectangle,
)
from phongfit.maps.store import check_job
from phongfit.maps.stored import (
    GIVEN,
    LEDGER,
    PLAN,
    STORE_FORMAT,
    STORE_VERSION,
    maps_of,
)
from phongfit.rendering.film import Encoding
from phongfit.scene import Scene

if TYPE_CHECKING:
    from phongfit.files.zarrs import Array, Group

BLOCK_BYTES = 2**26
"""How much a block holds of the images, as they have it, unless told otherwise."""

DIGEST = 16

Counts = dict[str, int]


class Stored(NamedTuple):
    """An array that was given, by its name in the output's store."""

    name: str

    def read(self, group: "Group", window: Window, size: tuple[int, int]) -> np.ndarray:
        """A rectangle of it."""
        return read_window(writable(group, f"{GIVEN}/{self.name}"), window, size)


@dataclasses.dataclass(frozen=True)
class Plan:
    """What all blocks share, and any worker reads.

    - `images`: where they are; `encoding`: what their numbers are. `None` for those
        that this process alone reads.
    - `size`: rows and columns of the image; `block`: of a block.
    - `scenes`: a normal map of theirs has but one pixel: `surface` has the others.
    - `surface`: normals, mask and perhaps positions; `None` for another surface.
    - `layers`: mask and noise: a number, `None`, or one or several of [`Stored`][].
    - `options`: the other arguments of [`make_job`][].
    - `head`: attributes of the output: how its arrays are read.
    """

    images: str | None
    encoding: Encoding | None
    size: tuple[int, int]
    block: tuple[int, int]
    scenes: tuple[Scene, ...]
    surface: dict[str, Stored] | None
    layers: dict[str, Any]
    options: dict[str, Any]
    head: dict[str, Any]

    @property
    def grid(self) -> tuple[int, int]:
        """How many blocks there are from top to bottom, and from left to right."""
        (height, width), (rows, columns) = self.size, self.block
        return -(-height // rows), -(-width // columns)

    def window(self, number: int) -> Window:
        """Rows and columns of a block that the image has."""
        first = np.multiply(np.unravel_index(number, self.grid), self.block)
        last = np.minimum(first + self.block, self.size)
        rows, columns = map(slice, first.tolist(), last.tolist())
        return rows, columns

    def job(self, group: "Group", number: int, stack: AbstractStack | None) -> Job:
        """The job of a block, with padding that no sample is used of.

        **Arguments:** `stack`: the images; `None` for those that the plan names.
        """
        window, size = self.window(number), self.block
        rows, columns = window

        def layer(given: Any) -> Any:
            if isinstance(given, Stored):
                return given.read(group, window, size)
            return [layer(one) for one in given] if isinstance(given, list) else given

        inside = np.zeros(size, bool)
        inside[: rows.stop - rows.start, : columns.stop - columns.start] = True

        def used(mask: Any) -> Any:
            if isinstance(mask, list):
                return [used(one) for one in mask]
            deeper = inside[..., None] if np.ndim(mask) == 3 else inside
            return inside if mask is None else (mask != 0) & deeper

        def known(noise: Any) -> Any:
            if isinstance(noise, list):
                return [known(one) for one in noise]
            # No pixel of the padding counts, but its noise has to be some.
            return np.where(noise > 0, noise, 1) if np.ndim(noise) else noise

        first = self.scenes[0]
        camera = WindowCamera(first.camera, columns.start, rows.start, size[1], size[0])
        surface = first.surface
        if self.surface is not None:
            # As it was: normalised again, its normals would be others in the last bit.
            parts = {k: jnp.asarray(layer(v)) for k, v in self.surface.items()}
            surface = eqx.tree_at(
                lambda s: [getattr(s, name) for name in parts],
                surface,
                [*parts.values()],
            )
        elif isinstance(surface, NormalMap):
            normals = np.broadcast_to(np.asarray(surface.normals), (*size, 3))
            surface = NormalMap(normals)
        scenes = [
            dataclasses.replace(scene, surface=surface, camera=camera)
            for scene in self.scenes
        ]
        if stack is None:
            assert self.images is not None
            stack = ZarrStack(self.images, self.encoding)
        images = read_rectangle(stack, window, size)
        return make_job(
            scenes,
            RectangleStack(images),
            mask=used(layer(self.layers["mask"])),
            noise=known(layer(self.layers["noise"])),
            **self.options,
        )


class Place(NamedTuple):
    """All that a worker is told besides a block's number.

    - `output`: the store of the maps.
    - `digest`: of the plan in it, so that nobody else's is run.
    - `versions`: of the programs that planned.
    """

    output: str
    digest: bytes
    versions: str


def fit_block(
    place: Place, number: int, stack: AbstractStack | None = None, threads: int = 1
) -> tuple[Counts, bool]:
    """See to it that a block is finished.

    **Arguments:**

    - `stack`: images that this process reads; else the plan says where they are.
    - `threads`: how many work on it.

    **Returns:** counts of its pixels, and whether it had to be fitted.

    **Raises:** `ValueError` or `OSError` that names what cannot be read or written.
    """
    group = open_group(place.output, "r+")
    plan = _plan(place)
    ledger = writable(group, LEDGER)
    at = np.unravel_index(number, plan.grid)
    window, entry = (
        plan.window(number),
        (slice(at[0], at[0] + 1), slice(at[1], at[1] + 1)),
    )
    noted = _noted(ledger, entry)
    if noted is not None:
        found = _kept(group, plan, window)
        if found is not None and _checksum(plan, number, found) == noted:
            return _counts(found, plan), False
    job = plan.job(group, number, stack)
    mesh, count = as_mesh(None), len(plan.scenes)
    size, part = tile_size(math.prod(plan.block), count, None, mesh)
    maps = fit_job(job, mesh, size if threads > 1 else part, part, threads)
    rows, columns = (side.stop - side.start for side in window)
    arrays = {
        name: np.ascontiguousarray(array[:rows, :columns])
        for name, array in maps.pixel_arrays().items()
    }
    for name, array in arrays.items():
        write_window(writable(group, name), window, array)
    digest = _checksum(plan, number, arrays)
    write_window(ledger, entry, np.frombuffer(digest, np.uint8).reshape(1, 1, DIGEST))
    return _counts(arrays, plan), True


@functools.lru_cache(maxsize=2)
def _plan(place: Place) -> Plan:
    """The plan that a place speaks of.

    **Raises:** `ValueError` if this process cannot carry it out to the same bits.
    """
    if place.versions != versions():
        raise ValueError(
            f"client: expected workers with {place.versions}, got {versions()}"
        )
    kept = np.asarray(open_array(place.output, PLAN)).tobytes()
    # It is run as it is found.
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


def _noted(ledger: "Array", entry: Window) -> bytes | None:
    """The checksum of a block in the ledger, if there is one."""
    try:
        noted = read_window(ledger, entry, (1, 1)).tobytes()
    except ValueError:
        # Broken by something else than an interrupt: done again.
        return None
    return noted if any(noted) else None


def _kept(group: "Group", plan: Plan, window: Window) -> dict[str, np.ndarray] | None:
    """A block's maps in the store, if they can be read."""
    rows, columns = (side.stop - side.start for side in window)
    try:
        return {
            name: read_window(writable(group, name), window, (rows, columns))
            for name in plan.head["arrays"]
        }
    except ValueError:
        # As above.
        return None


def _checksum(plan: Plan, number: int, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Of the job, the block's number and its maps: no other block will do."""
    job = json.dumps(plan.head["job"], sort_keys=True)
    # Processors have instructions for this one.
    found = hashlib.sha256(f"{job} {number}".encode())
    for name in sorted(arrays):
        array = arrays[name]
        found.update(f"{name} {array.dtype.str} {array.shape}".encode())
        found.update(np.ascontiguousarray(array).data.cast("B"))
    return found.digest()[:DIGEST]


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
) -> tuple[Place, Plan]:
    """A plan, checked, and written into the output's store.

    **Arguments:** as [`fit_stored_maps`][] has them.

    **Raises:** `ValueError` that names the argument, or a store of another job;
    `OSError` if the output cannot be written.
    """
    import cloudpickle

    scenes = check_scenes(scenes)
    check_sizes(scenes, stack.shape)
    levels, masks = Noise(noise, stack.shape), Masks(mask, stack.shape)
    settings, outside = settle(scenes, levels, **options)
    if settings.materials is not None:
        raise ValueError(
            "materials: expected none: they are found from a sample of all pixels, "
            "which fit_maps draws, and no block has"
        )
    start = options.get("start")
    # Of a fit no more than its material is asked.
    options["start"] = getattr(start, "material", start)
    size, block = stack.shape[1:], block_size(stack, block)
    given = _Given()
    small, surface = _apart(scenes[0].surface, given, size)
    layers = {"mask": given.layers("mask", mask), "noise": given.layers("noise", noise)}
    first = scenes[0]
    ambient = np.asarray(first.ambient).tolist()
    head = {
        "format": STORE_FORMAT,
        "version": STORE_VERSION,
        "job": {
            "settings": repr(settings),
            "lights": identify_lights(outside),
            "surface": _identify((first.surface, first.camera), masks),
            "noise": _identify((), levels),
            "images": identify_stack(stack),
            "block": f"{block[0]} × {block[1]} pixels",
            "versions": versions(),
        },
        "size": list(size),
        "unknowns": list(settings.names),
        "noise_given": None if levels.varies else levels.given(),
        "view": view_of(first.camera, first.specular_model, ambient),
        "precision": str(jnp.result_type(float)),
        "arrays": [],
    }
    scenes = tuple(dataclasses.replace(scene, surface=small) for scene in scenes)
    stored = stack if isinstance(stack, ZarrStack) else None
    plan = Plan(
        None if stored is None else place_of(stored.array),
        None if stored is None else stored.encoding,
        size,
        block,
        scenes,
        surface,
        layers,
        options,
        head,
    )
    group = _open_output(output, head["job"])
    _make_arrays(group, plan, settings, levels.varies)
    for name, array in given.arrays.items():
        keep_array(group, f"{GIVEN}/{name}", array, block)
    # A function of the reader's own may be among it.
    packed = np.frombuffer(cloudpickle.dumps(plan), np.uint8)
    made = make_array(group, PLAN, packed.shape, np.uint8, packed.shape)
    write_window(made, (slice(None),), packed)
    digest = hashlib.blake2b(packed.tobytes(), digest_size=DIGEST).digest()
    return Place(output, digest, versions()), plan


class _Given:
    """Arrays that were given, to be put where every worker finds its part of them."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}

    def layers(self, name: str, value: Any) -> Any:
        """The same with [`Stored`][] in place of arrays; numbers stay."""
        if isinstance(value, list | tuple):
            return [self.layers(f"{name}_{k:04d}", one) for k, one in enumerate(value)]
        if value is None or np.ndim(value) == 0:
            return value
        self.arrays[name] = np.asarray(value)
        return Stored(name)


def _apart(
    surface: AbstractSurface, given: _Given, size: tuple[int, int]
) -> tuple[AbstractSurface, dict[str, Stored] | None]:
    """A surface without what it has for every pixel, and where that is."""
    if not isinstance(surface, NormalMap) or surface.mask.shape == (1, 1):
        return surface, None
    if surface.mask.shape != size:
        raise ValueError(
            f"scenes: expected a normal map of {size} pixels, as the images have, got "
            f"{surface.mask.shape}"
        )
    parts = ("normals", "mask", "positions")
    found = {name: getattr(surface, name) for name in parts}
    stored = {
        name: given.layers(f"surface_{name}", array)
        for name, array in found.items()
        if array is not None
    }
    places = None if surface.positions is None else np.zeros((1, 1, 3))
    return NormalMap(np.array([[[0.0, 0.0, 1.0]]]), positions=places), stored


def _identify(tree: Any, layers: Masks | Noise) -> str:
    """A checksum of arrays, and of the kinds of what holds them."""
    found = hashlib.blake2b(digest_size=DIGEST)
    leaves, structure = jax.tree.flatten(tree)
    for leaf in leaves:
        found.update(np.ascontiguousarray(leaf).tobytes())
    # Functions have an address, another one in each process.
    found.update(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    layers.identify(found.update)
    return found.hexdigest()


def _open_output(output: str, job: dict[str, str]) -> "Group":
    """The store of the maps, new or of the same job.

    **Raises:** `ValueError` if it is another's.
    """
    group = open_group(output, "a")
    held = attributes(group)
    if held.get("format") == STORE_FORMAT:
        check_job(output, held.get("job"), job)
    elif held:
        raise ValueError(f"output: {output} holds something else; give another name")
    return group


def _make_arrays(
    group: "Group", plan: Plan, settings: MapSettings, varies: bool
) -> None:
    """The arrays that are not there yet, or not as they should be."""
    floats, inf, nan = plan.head["precision"], float("inf"), float("nan")
    wanted: dict[str, tuple[tuple[int, ...], str, Any]] = {}
    for name in MAP_PARAMETERS:
        shared = name == "shininess" and settings.shared
        channels = (1,) if shared else (3,)
        wanted[name] = channels, floats, 0
        wanted[f"stderr_{name}"] = channels, floats, inf
    wanted |= {
        "noise": ((), floats, nan),
        "samples": ((), "int32", 0),
        "flags": ((), "uint16", int(Flag.OUTSIDE)),
        "normals": ((3,), floats, 0),
        "normals_stderr": ((), floats, inf),
        "depth": ((), floats, nan),
    }
    if varies:
        wanted["noise_given"] = (), floats, 0
    plan.head["arrays"].extend(wanted)
    write_attributes(group, plan.head)
    for name, (channels, dtype, fill) in wanted.items():
        shape, chunks = ((*side, *channels) for side in (plan.size, plan.block))
        if not holds(group, name, shape, dtype, chunks):
            make_array(group, name, shape, dtype, chunks, fill)
    shape, chunks = (*plan.grid, DIGEST), (1, 1, DIGEST)
    if not holds(group, LEDGER, shape, "uint8", chunks):
        # As it stands, so that one that was cut off cannot be read.
        make_array(group, LEDGER, shape, "uint8", chunks, compressed=False)


def block_size(stack: AbstractStack, wanted: tuple[int, int] | None) -> tuple[int, int]:
    """Rows and columns of a block.

    As the shards of the images have them, or chunks where there are none, or rows of
    photographs: so many of them that a block holds up to [`BLOCK_BYTES`][], or a part
    of one that holds more.
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
