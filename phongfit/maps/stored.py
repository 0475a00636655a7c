"""Maps in a zarr store, with the array names of `maps.npz`, read by windows."""

import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
from pydantic import Field, model_validator

from phongfit.edge import checked
from phongfit.files.budget import afford
from phongfit.files.inputs import naming
from phongfit.files.records import AbstractRecord, parse_record, validated
from phongfit.files.zarrs import (
    address,
    attributes,
    keep_array,
    open_group,
    read_window,
    writable,
    write_attributes,
)
from phongfit.geometry.cameras import WindowCamera
from phongfit.maps.job import Job
from phongfit.maps.pixel.settings import Flag
from phongfit.maps.result import (
    MAPS_VERSION,
    WEIGHTS,
    Maps,
    ViewRecord,
    checked_maps,
    counted,
    view_of,
)

STORE_FORMAT = "phongfit maps"
STORE_VERSION = 2
"""Version of stores. Those of version 1 have no arrays about the maps as a whole."""

Count = Annotated[int, Field(ge=1)]


class StoreRecord(AbstractRecord):
    """Attributes of a store of maps; `counts` exists once the maps are complete.

    `arrays` are the names of those over the pixels, `whole` of others.
    """

    format: Literal["phongfit maps"]
    version: Literal[1, 2]
    job: dict[str, str]
    size: Annotated[list[Count], Field(min_length=2, max_length=2)]
    unknowns: list[str]
    noise_given: float | None
    view: ViewRecord
    precision: Literal["float32", "float64"]
    arrays: list[str]
    whole: list[str] = []
    counts: dict[str, Annotated[int, Field(ge=0)]] | None = None

    @model_validator(mode="after")
    def _all_counted(self) -> "StoreRecord":
        named = {"fitted", "identified", *(str(flag.name).lower() for flag in Flag)}
        if self.counts is not None and not named <= self.counts.keys():
            lacking = ", ".join(sorted(named - self.counts.keys()))
            raise ValueError(f"counts: expected those of {lacking}, too")
        return self


def make_head(
    job: Job, identity: Mapping[str, str], layers: Iterable[str]
) -> dict[str, Any]:
    """Attributes of a store, as in [`StoreRecord`][], of maps that are not complete.

    **Arguments:** `layers`: names of the arrays over the pixels.
    """
    first = job.scenes[0]
    ambient = np.asarray(first.ambient).tolist()
    return {
        "format": STORE_FORMAT,
        "version": STORE_VERSION,
        "job": dict(identity),
        "size": list(job.stack.shape[1:]),
        "unknowns": list(job.settings.names),
        "noise_given": None if job.noise.varies else job.noise.given(),
        "view": view_of(first.camera, first.specular_model, ambient),
        "precision": str(jnp.result_type(float)),
        "arrays": list(layers),
    }


def complete(output: str, counts: Mapping[str, int], maps: Maps | None = None) -> None:
    """Mark the maps of a store as complete, with arrays about `maps` as a whole."""
    group, whole = open_group(output, "r+"), {}
    if maps is not None:
        whole = maps.whole_arrays()
        # Probabilities in the pixels are written block by block.
        whole.pop(WEIGHTS, None)
    for name, array in whole.items():
        keep_array(group, name, array, array.shape)
    write_attributes(group, {"whole": list(whole), "counts": dict(counts)})


def maps_of(arrays: Mapping[str, np.ndarray], head: Mapping[str, Any]) -> Maps:
    """Make maps from arrays by their names in a store, without the camera.

    **Arguments:** `head`: the store's attributes.

    **Raises:** `ValueError` for an array that is missing or wrong.
    """
    given = head["noise_given"]
    more = {
        "version": np.array(MAPS_VERSION),
        "unknowns": np.array(head["unknowns"]),
        "noise_given": np.array(np.nan if given is None else given),
        "view": np.array(json.dumps(head["view"] | {"camera": None})),
    }
    try:
        return checked_maps(more | dict(arrays))
    except KeyError as error:
        raise ValueError(f"has no array {error}") from error


class StoredMaps:
    """Maps that [`fit_maps`][] has written into a zarr store.

    The arrays have the names of [`Maps`][], and `stderr_diffuse` and the like for its
    errors; any program that reads zarr can read them. `str` gives counts of pixels, as
    for [`Maps`][].
    """

    @checked
    def __init__(self, path: str | os.PathLike[str]):
        """**Arguments:** `path`: path or URL of the store.

        **Raises:** `ValueError` that names the store if it is missing, is not a store
        of maps, or its maps are not complete.
        """
        self.path = address(path)
        self._group = open_group(path)
        head = attributes(self._group)
        with naming(self.path):
            if head.get("format") != STORE_FORMAT:
                raise ValueError("expected a store of maps, got something else")
            if head.get("counts") is None:
                raise ValueError(
                    "the maps are not complete; the run that was interrupted goes on "
                    "when it is started again"
                )
            validated(head, StoreRecord)
        self._head: dict[str, Any] = head

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        height, width = self._head["size"]
        return height, width

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of pixels that were `fitted`, `identified`, and have each flag."""
        return dict(self._head["counts"])

    @checked
    def load(self, rows: slice | None = None, columns: slice | None = None) -> Maps:
        """Read the maps of a rectangle into memory; by default all pixels.

        **Raises:** `ValueError` that names the store if it is broken, or if the maps
        take more memory than allowed (`PHONGFIT_MAX_MEMORY`).
        """
        height, width = self.shape
        sides = (
            range(size)[slice(None) if part is None else part]
            for part, size in ((rows, height), (columns, width))
        )
        down, along = sides
        if down.step != 1 or along.step != 1 or not len(down) or not len(along):
            raise ValueError("rows: expected rows and columns one after another")
        window = slice(down.start, down.stop), slice(along.start, along.stop)
        found = [writable(self._group, name) for name in self._head["arrays"]]
        size = len(down), len(along)
        pixel = sum(a.dtype.itemsize * math.prod(a.shape[2:]) for a in found)
        with naming(self.path):
            afford(pixel * size[0] * size[1], f"maps of {size[0]} × {size[1]} pixels")
            arrays = {a.basename: read_window(a, window) for a in found}
            for name in self._head.get("whole", []):
                arrays[name] = read_window(writable(self._group, name), ())
            maps = maps_of(arrays, self._head)
            view = parse_record(json.dumps(self._head["view"]), ViewRecord)
        if view.camera is None:
            return maps
        camera = view.camera.build()
        if size != self.shape:
            camera = WindowCamera(camera, along.start, down.start, size[1], size[0])
        return dataclasses.replace(maps, camera=camera)

    def __str__(self) -> str:
        lines = counted(self.shape, self._head["unknowns"], self.counts)
        return "\n".join([*lines, f"  in {self.path}"])

    def __repr__(self) -> str:
        return str(self)
