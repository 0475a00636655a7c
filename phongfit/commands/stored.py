"""Images of `phongfit maps` in a zarr store, and what is beside it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from phongfit.commands.data import DataOptions
from phongfit.edge import shown
from phongfit.files.capture_data import (
    calibration_of,
    facing,
    lamps_of,
    list_of,
    masked,
)
from phongfit.files.encodings import parse_encoding
from phongfit.files.fits import DataRecord
from phongfit.files.inputs import recording
from phongfit.files.lp import read_camera_lp
from phongfit.files.matching import base_name
from phongfit.files.scenes import SCENE_FILE, load_views
from phongfit.files.seen import SOUGHT, camera_of, seen_in
from phongfit.files.zarrs import address, attributes, fingerprint
from phongfit.geometry.cameras import OrthographicCamera
from phongfit.geometry.surfaces import AbstractSurface, NormalMap
from phongfit.maps.stacks import AbstractStack, ZarrStack
from phongfit.plain import readable
from phongfit.rendering.film import Film
from phongfit.scene import Scene


class Input(NamedTuple):
    """Data to fit, with further arguments of [`fit_maps`][]."""

    scenes: tuple[Scene, ...]
    stack: AbstractStack
    film: Film
    arguments: dict[str, Any]
    record: DataRecord


def read_stored(options: DataOptions) -> Input:
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
