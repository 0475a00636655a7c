"""Inputs and outputs of `phongfit maps` in zarr, perhaps fitted on a Dask cluster."""

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from phongfit.commands.data import DataOptions, stack_data, tell
from phongfit.edge import shown
from phongfit.files.budget import afford
from phongfit.files.capture_data import (
    calibration_of,
    facing,
    lamps_of,
    list_of,
    masked,
)
from phongfit.files.encodings import parse_encoding
from phongfit.files.fits import DataRecord
from phongfit.files.inputs import naming, recording
from phongfit.files.lp import read_camera_lp
from phongfit.files.matching import base_name
from phongfit.files.scenes import SCENE_FILE, load_views
from phongfit.files.seen import SOUGHT, camera_of, seen_in
from phongfit.files.zarrs import (
    address,
    attributes,
    erase,
    fingerprint,
    is_remote,
    is_store,
    open_group,
    store_of,
)
from phongfit.geometry.cameras import OrthographicCamera
from phongfit.geometry.surfaces import AbstractSurface, NormalMap
from phongfit.maps.cluster import dashboard, dask_client, fit_stored_maps
from phongfit.maps.stacks import AbstractStack, ZarrStack
from phongfit.maps.store import check_place
from phongfit.maps.stored import STORE_FORMAT, StoredMaps
from phongfit.plain import readable
from phongfit.rendering.film import Film
from phongfit.scene import Scene

if TYPE_CHECKING:
    from phongfit.commands.maps import Options


PIXEL = 110
"""Bytes of memory for the maps of a pixel."""


class Input(NamedTuple):
    """Data to fit, with further arguments of [`fit_stored_maps`][]."""

    scenes: tuple[Scene, ...]
    stack: AbstractStack
    film: Film
    arguments: dict[str, Any]
    record: DataRecord


def check_stored(options: "Options") -> None:
    """Check the options of a run from or to zarr.

    **Raises:** `ValueError` that names the option.
    """
    whole = "since a shared one is found with all images in memory"
    for name, usual, why in (
        ("highlight", ("own",), whole),
        ("tile_pixels", (None,), "since chunks or shards are read as a whole"),
        ("passes", (1, None), "since the surface would have to be whole in memory"),
        ("strengths", ("given", None), "since they are found from all images"),
    ):
        given = getattr(options, name)
        if given not in usual:
            expected = "none" if usual[0] is None else usual[0]
            raise ValueError(
                f"{name}: expected {expected} from or to zarr, {why}, got {given}"
            )
    if options.data.fov == "fit":
        raise ValueError(
            "fov: expected degrees from or to zarr, since the angle is found before "
            "the maps, got fit"
        )


def read_input(options: DataOptions) -> Input:
    """Scenes and images of a store, or of photographs, which are decoded.

    **Raises:** `ValueError` that names the file or the option.
    """
    if is_store(options.dataset):
        return _read(options)
    stack, record = stack_data(options)
    photographs = stack.photographs
    tell(photographs.notes)
    mask = None if stack.mask.all() else stack.mask
    more = {"mask": mask, "film": photographs.films()}
    return Input(photographs.scenes, stack, photographs.film, more, record)


def check_room(read: Input) -> None:
    """Check that memory can hold the maps of a folder, before the fit."""
    _, height, width = read.stack.shape
    with naming("out"):
        # A zarr store would not need this memory.
        afford(PIXEL * height * width, f"a folder of maps of {height} × {width} pixels")


def fit_to_store(
    options: "Options", read: Input, given: dict[str, Any], output: str
) -> StoredMaps:
    """Fit maps into a store, in this process or by Dask workers."""
    given = {
        name: x for name, x in given.items() if name not in ("passes", "strengths")
    }
    with contextlib.ExitStack() as place:
        client = None
        if options.dask is not None:
            client = place.enter_context(dask_client(options.dask))
            page = dashboard(client)
            if page is not None:
                print(f"dask: {page}", flush=True)
        return fit_stored_maps(
            read.scenes,
            read.stack,
            output,
            client=client,
            **given | read.arguments,
        )


def erase_maps(output: str, images: AbstractStack) -> None:
    """Remove older maps, and nothing else.

    **Raises:** `OSError` that names an existing store that has no maps.
    """
    if not is_remote(output):
        stored = isinstance(images, ZarrStack)
        check_place(output, store_of(images.array) if stored else None)
        if not Path(output).exists() or not any(Path(output).iterdir()):
            return
    if attributes(open_group(output)).get("format") != STORE_FORMAT:
        raise OSError(f"{output}: is not replaced, since it holds no maps")
    erase(output)


def _read(options: DataOptions) -> Input:
    """The images of a store, with scenes and lights from files beside it.

    **Raises:** `ValueError` that names the file or the option.
    """
    path = address(options.dataset)
    if options.white is not None:
        raise ValueError(
            f"white: expected it of photographs' files alone, got it with {path}"
        )
    with recording() as checksums:
        stack = ZarrStack(path, parse_encoding(options.encoding))
        shaped = options.sphere is not None or options.normals is not None
        scenes, more = (_captured if shaped else _scenes)(options, stack)
    clamped = stack.array.dtype.kind != "f"
    film = Film(encoding=stack.encoding) if clamped else Film(clamp=False)
    inputs = {file.name: digest for file, digest in sorted(checksums.items())}
    record = DataRecord(
        name=readable(Path(path).stem),
        reading=options.settings(),
        inputs=inputs | {readable(Path(path).name): fingerprint(stack.array)},
    )
    if clamped:
        more["film"] = film
    return Input(scenes, stack, film, more, record)


def _scenes(
    options: DataOptions, stack: ZarrStack
) -> tuple[tuple[Scene, ...], dict[str, Any]]:
    """Scenes from the given scene file, or the one beside the images."""
    file = options.scene or options.dataset.parent / SCENE_FILE
    if options.scene is None and not file.exists():
        raise ValueError(
            f"{address(options.dataset)}: expected --scene, or --sphere or --normals, "
            f"the shape that its images show, since no {SCENE_FILE} is beside it"
        )
    for name in ("lights", "fov"):
        if getattr(options, name) is not None:
            raise ValueError(f"{name}: {file} is a scene, which says this itself")
    scenes, _ = load_views(file)
    size = stack.shape[1:]
    return scenes, {} if options.mask is None else {"mask": masked(options.mask, size)}


def _captured(
    options: DataOptions, stack: ZarrStack
) -> tuple[tuple[Scene, ...], dict[str, Any]]:
    """Scenes of a known shape, or with normals to fit, under given lights."""
    if options.scene is not None:
        raise ValueError("scene: expected it, or sphere or normals, got both")
    if options.sphere is not None and options.normals is not None:
        raise ValueError("sphere: expected it or normals, got both")
    count, height, width = stack.shape
    folder = options.dataset.parent
    source = calibration_of(folder, options.lights)
    listed = None
    if source is not None:
        known = [lamp.photograph for lamp in source.lamps]
    else:
        beside = [list_of(options.lights), *sorted(folder.glob("*.lp"))]
        found = next((path for path in beside if path is not None), None)
        if found is None:
            raise ValueError(
                f"lights: expected an .lp or lights.json in {folder}, or given"
            )
        listed = read_camera_lp(found)
        known = [*listed.names]
    told: Any = attributes(stack.array).get("names", known)
    if not isinstance(told, list):
        raise ValueError(
            f"{address(options.dataset)}: names: expected a list, got {shown(told)}"
        )
    names = [base_name(str(name)) for name in told]
    if len(names) != count:
        raise ValueError(
            f"lights: expected {count}, one for each image, got {len(names)}"
        )
    listed = None if listed is None else listed.only(names)
    lamps, unknown = lamps_of(names, listed, source)
    near = source is not None and source.lamps[0].position is not None
    sought = options.sought
    camera = camera_of(height, width, source, options.known_fov)
    camera = camera or OrthographicCamera(width, height)
    surface: AbstractSurface = NormalMap(UP)
    # With parallel rays and distant lamps a single normal describes the plane.
    if not sought or near or not isinstance(camera, OrthographicCamera):
        camera, surface = seen_in(
            height,
            width,
            source,
            options.sphere,
            SOUGHT if sought else options.normals,
            options.known_fov,
        )
    scenes = tuple(
        Scene(surface, camera, light, ambient=options.room_light) for light in lamps
    )
    if unknown:
        # An .lp has only the lamps' directions.
        print("assumed: all lamps are of one strength", flush=True)
    more: dict[str, Any] = {}
    if not sought:
        used = facing(scenes[0], options.min_facing)
        if options.mask is not None:
            used &= masked(options.mask, used.shape)
        more = {"mask": used, "min_cosine": options.min_cosine}
    elif options.mask is not None:
        more = {"mask": masked(options.mask, (height, width))}
    return scenes, more


UP = np.array([[[0.0, 0.0, 1.0]]])
"""Normals of a plane that faces the camera, as a single pixel."""
