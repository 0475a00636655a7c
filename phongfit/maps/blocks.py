"""Maps in blocks, each of which is read, fitted and written separately by any worker.

A block is a rectangle of the image and one chunk of every array of the output. The plan
with the inputs of all blocks is in the output's store, so that a worker needs only the
path of the store and the number of a block. The store also has the ledger, with a
checksum of the maps of every finished block, written after them. A block is not fitted
again if its maps match the checksum.
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
"""Maximum bytes of stored image samples in a block by default."""

DIGEST = 16

Counts = dict[str, int]


class Stored(NamedTuple):
    """Name of an input array in the output's store."""

    name: str

    def read(self, group: "Group", window: Window, size: tuple[int, int]) -> np.ndarray:
        """A rectangle of the array, padded to `size`."""
        return read_window(writable(group, f"{GIVEN}/{self.name}"), window, size)


@dataclasses.dataclass(frozen=True)
class Plan:
    """Inputs that all blocks share, which workers read from the output's store.

    - `images`: path or URL of the images; `encoding`: their encoding. `None` for images
        that only this process reads.
    - `size`: rows and columns of the image; `block`: of a block.
    - `scenes`: with one pixel of a normal map, whose other pixels are in `surface`.
    - `surface`: normals, mask and perhaps positions; `None` for another surface.
    - `layers`: mask and noise: a number, `None`, or one or several of [`Stored`][].
    - `options`: the other arguments of [`make_job`][].
    - `head`: attributes of the output, which are needed to read its arrays.
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
        """Number of blocks from top to bottom, and from left to right."""
        (height, width), (rows, columns) = self.size, self.block
        return -(-height // rows), -(-width // columns)

    def window(self, number: int) -> Window:
        """Rows and columns of a block, clipped to the image."""
        first = np.multiply(np.unravel_index(number, self.grid), self.block)
        last = np.minimum(first + self.block, self.size)
        rows, columns = map(slice, first.tolist(), last.tolist())
        return rows, columns

    def job(self, group: "Group", number: int, stack: AbstractStack | None) -> Job:
        """The job of a block, with masked padding.

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
            # Padding is masked, but its noise must be positive to pass the checks.
            return np.where(noise > 0, noise, 1) if np.ndim(noise) else noise

        first = self.scenes[0]
        camera = WindowCamera(first.camera, columns.start, rows.start, size[1], size[0])
        surface = first.surface
        if self.surface is not None:
            # Without normalising again, which would change the normals' last bit.
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


def _noted(ledger: "Array", entry: Window) -> bytes | None:
    """The checksum of a block in the ledger, if there is one."""
    try:
        noted = read_window(ledger, entry, (1, 1)).tobytes()
    except ValueError:
        # The ledger is damaged here: the block is fitted again.
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
        # The maps are damaged: the block is fitted again.
        return None


def _checksum(plan: Plan, number: int, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Checksum of the job, the block's number and its maps."""
    job = json.dumps(plan.head["job"], sort_keys=True)
    # SHA-256 is fast, since processors have instructions for it.
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
    """Make a plan, check it, and write it into the output's store.

    **Arguments:** as for [`fit_stored_maps`][].

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
    # Only the material of a fit is used, so that the plan is small.
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
    # Cloudpickle, since the plan may contain functions that the user defined.
    packed = np.frombuffer(cloudpickle.dumps(plan), np.uint8)
    made = make_array(group, PLAN, packed.shape, np.uint8, packed.shape)
    write_window(made, (slice(None),), packed)
    digest = hashlib.blake2b(packed.tobytes(), digest_size=DIGEST).digest()
    return Place(output, digest, versions()), plan


class _Given:
    """Input arrays that are to be written into the output's store for the workers."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}

    def layers(self, name: str, value: Any) -> Any:
        """Collect arrays and replace them by [`Stored`][]; numbers are kept."""
        if isinstance(value, list | tuple):
            return [self.layers(f"{name}_{k:04d}", one) for k, one in enumerate(value)]
        if value is None or np.ndim(value) == 0:
            return value
        self.arrays[name] = np.asarray(value)
        return Stored(name)


def _apart(
    surface: AbstractSurface, given: _Given, size: tuple[int, int]
) -> tuple[AbstractSurface, dict[str, Stored] | None]:
    """Separate a surface into one without arrays over the pixels, and these arrays."""
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
    """Checksum of a tree's arrays and structure, and of masks or noise."""
    found = hashlib.blake2b(digest_size=DIGEST)
    leaves, structure = jax.tree.flatten(tree)
    for leaf in leaves:
        found.update(np.ascontiguousarray(leaf).tobytes())
    # Addresses of functions differ between processes.
    found.update(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    layers.identify(found.update)
    return found.hexdigest()


def _open_output(output: str, job: dict[str, str]) -> "Group":
    """Open the store of the maps, which is new or of this job.

    **Raises:** `ValueError` if it holds another job or something else.
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
    """Make arrays that are missing in the store, or have another shape or type."""
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
        # Uncompressed, so that a truncated chunk raises an error when it is read.
        make_array(group, LEDGER, shape, "uint8", chunks, compressed=False)


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
