"""`fit_maps`: maps of materials from stacks of images under many lights."""

import concurrent.futures
import dataclasses
import functools
import importlib.metadata
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from phongfit.checks import untraced
from phongfit.edge import checked, shown
from phongfit.fitting.problem.specification import (
    Specification,
    SpecificationOptions,
    specified,
)
from phongfit.maps.ahead import ahead
from phongfit.maps.job import Fitted, Job, check_scenes, make_job
from phongfit.maps.materials.bases import held
from phongfit.maps.materials.block import Given, fit_shared
from phongfit.maps.materials.finding import Materials, choose_sample, find_materials
from phongfit.maps.passes import fit_in_passes, usual_passes
from phongfit.maps.pixel.block import BLOCK, fit_tile, run
from phongfit.maps.pixel.settings import MAP_PARAMETERS
from phongfit.maps.result import (
    WEIGHTS,
    Layer,
    Maps,
    ParameterMaps,
    StrengthsName,
    layers_of,
)
from phongfit.maps.stacks import AbstractStack, as_index, as_stack, identify_stack
from phongfit.maps.store import BlockStore, alone_at, open_store
from phongfit.maps.strengths import find_strengths, may_be_equal, strength_error
from phongfit.material import Material
from phongfit.scene import Scene

TILES_FORMAT = "phongfit tiles"

TILE_BYTES, CORE_BYTES, CPU_BYTES = 2**26, 2**24, 2**28
"""Bytes of light in a tile by default: on a GPU, and for each core of a CPU; and of
the tiles of all cores together.

Those of a core are few enough for its caches, and enough that the blocks of a second
pass, which may be nearly empty, take a small fraction of the time."""


@checked
def fit_maps(
    scenes: Sequence[Scene],
    images: Any,
    specification: Specification | None = None,
    *,
    mask: Any = None,
    noise: Any = None,
    normals: Literal["given", "fit"] = "given",
    materials: int | Literal["auto"] | None = None,
    passes: int | None = None,
    strengths: StrengthsName = "given",
    start: Material | Fitted | None = None,
    min_cosine: float = 0.0,
    tile_pixels: int | None = None,
    devices: Sequence[Any] | None = None,
    output: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **changes: Unpack[SpecificationOptions],
) -> Maps:
    r"""Fit a material to every pixel of images under many lights, with standard errors.

    The data are those of photometric stereo. Normals are known, or fitted with the
    material. Every pixel is fitted from its own samples: the best reflectances for
    given f solve a small linear problem, and steps of Levenberg and Marquardt find
    $\log f$ and an unknown normal from several starts. So no initial estimate is
    needed. Tiles of pixels pass through memory one after another.

    **Arguments:**

    - `scenes`: one for each image; they share surface and camera and differ in lights
        and fog.
    - `images`: (L, H, W, 3) or a sequence of (H, W, 3), linear light as floats where
        white is 1, in memory or memory-mapped, or an [`AbstractStack`][] such as
        [`PhotographStack`][], which reads files, [`DatasetStack`][] or [`ZarrStack`][].
        From zarr to zarr, and on a cluster, maps need not fit into memory either: see
        [`fit_stored_maps`][].
    - `unknowns`: parameters to be fitted. Without ambient light in the scenes,
        `ambient` is not fitted. Other parameters of a specular model are held.
    - `per_channel`: parameters with a number for each of red, green and blue. They must
        include the unknown reflectances, since each channel of a pixel is fitted
        separately; with `"shininess"` each channel has its own exponent.
    - `known`: values of the parameters that are not unknown; default: reflectances of 0
        and an exponent of 32.
    - `bounds`: name → (low, high), as in [`fit`][].
    - `mask`: (H, W) or (H, W, 3), true where samples may be used; or one for each
        image.
    - `noise`: standard deviation of a sample in linear light: a number, (H, W) or
        (H, W, 3), or one of these for each image; samples are then weighted by its
        inverse. By default it is estimated from each pixel's residuals.
    - `film`: `Film()`: samples of 1 and above are saturated and left out.
        `Film(clamp=False)`: no sample is left out. Default: only samples of exactly 1
        are, since samples above 1 show that the images are not clipped. Of several
        films only the clamp is used, which must be common. The rounding of JPEG files
        is part of the noise, which is estimated from each pixel's residuals: give no
        `noise` with such files. Light that compression removes from all images alike,
        as at the rim of a highlight, is not restored, unlike in [`fit`][].
    - `specification`: `unknowns`, `per_channel`, `known`, `bounds`, `film` and `loss`,
        for several calls. Those that are given beside it replace its own. Other options
        of [`fit`][] must have their defaults.
    - `loss`: as in [`fit`][]; a robust loss is for images with outliers. Default:
        `"linear"`; `"cauchy"` if normals are fitted, since shadows and
        interreflections are outliers.
    - `normals`: `"given"` by the scenes' surface. `"fit"`: fitted for each pixel, with
        errors in degrees; the surface then only determines which pixels see it, and the
        positions of pixels for near lamps and a perspective camera: see `passes`. At
        least 3 images for a matte surface, 5 for one with a highlight, whose lobe must
        be a power of one cosine, as for Phong and Blinn-Phong.
        An unknown `ambient` requires ambient light in the scenes; if `specular` is not
        in `per_channel`, the channels share one ρ_s.
    - `materials`: number of materials that the pixels share, or `"auto"` to choose it
        (up to 6; none if matte light alone explains the pixels best: see
        [`Maps`][]`.matte`); `None`: each pixel has a separate material. With shared
        materials, ρ_d is fitted in each pixel; ρ_s and f are those of its most probable
        material. The materials are estimated from a sample of the pixels, and their
        number by Schwarz's criterion (BIC); their errors are part of the pixels'
        errors: see [`BasisMaterials`][]. A dozen lamps hardly determine ρ_s and f of
        one pixel; they do determine which of a few materials it has. Only with
        `normals="fit"`.
    - `passes`: with `normals="fit"`, how often pixels are fitted; default 3 with near
        lamps, 2 with distant ones. Each pass after the first assumes that pixels lie on
        the surface of the last normals, moved to the depth at which near lamps give the
        least noise, and leaves out samples in its shadow. `output` keeps the tiles of
        all passes.
    - `strengths`: with `normals="fit"`, strengths of the light of each image: `"given"`
        by the scenes' lights; `"fit"`: one factor on the lights of each image;
        `"fit_per_channel"`: three factors. They are estimated from about 2000 pixels
        before the maps. Only their ratios are identified: their mean is 1. ρ_d then has
        no upper bound, unless `bounds` has one. `"auto"`: `"fit"`, unless errors of 2°
        in the lamps' directions would explain the differences. See
        [`Maps`][]`.strengths`.
    - `start`: a fit of one material, or a material, whose exponent each pixel starts
        from, instead of the scan.
    - `min_cosine`: samples that no light reaches at a cosine above this are left out as
        shadowed; −1 keeps all.
    - `tile_pixels`: pixels that a core or a GPU works on at a time; default: as many as
        hold 16 MB of light, or 64 MB on a GPU; all cores together 256 MB.
    - `devices`: devices that work on the tiles in turn; default: all local ones.
    - `output`: a folder that keeps finished tiles, as a zarr group. An interrupted run
        continues from there, with bit-identical results. It must be empty, or of the
        same job.
    - `progress`: show a bar on a terminal, or occasional lines elsewhere.

    **Returns:** [`Maps`][]. A pixel that does not identify an unknown has infinite
    errors and flags.

    **Raises:** `ValueError` that names the argument: wrong shapes, too few images for
    the unknowns, a file of a stack that is missing or broken (finished tiles stay).
    `OSError` if `output` cannot be written, or another run writes there.
    """
    specification = _specified(specification, changes, normals == "fit")
    unknowns, per_channel = specification.unknowns, specification.per_channel
    known, bounds = specification.known, specification.bounds
    film, loss = specification.film, specification.loss
    instead = "fit_maps is no function that JAX can trace"
    untraced(instead, scenes=scenes, images=images, known=known, mask=mask, noise=noise)
    stack = as_stack(images)
    asked: dict[str, Any] = {
        "unknowns": unknowns,
        "per_channel": per_channel,
        "known": known,
        "bounds": bounds,
        "mask": mask,
        "noise": noise,
        "film": film,
        "loss": loss,
        "normals": normals,
        "materials": materials,
        "start": start,
        "min_cosine": min_cosine,
    }
    if passes is not None and (passes < 1 or (passes > 1 and normals != "fit")):
        raise ValueError(
            f"passes: expected 1, or more where normals are sought, got {shown(passes)}"
        )
    if strengths != "given" and normals != "fit":
        raise ValueError(
            f"strengths: expected 'given' where normals are given, got {strengths!r}; "
            "fit finds exposures of images under given normals"
        )
    spread = {"tile_pixels": tile_pixels, "devices": devices}
    if normals == "given":
        once = functools.partial(_fit_once, **asked, **spread)
        return once(scenes, stack, output=output, progress=progress)
    scenes = check_scenes(scenes)
    passes = usual_passes(scenes) if passes is None else passes
    if strengths != "given":
        asked["bounds"] = {"diffuse": (0.0, np.inf)} | dict(bounds or {})
    once = functools.partial(_fit_once, **asked, **spread)
    found, error = None, 0.0
    if strengths != "given":
        job = make_job(scenes, stack, **asked)
        coloured = strengths == "fit_per_channel"
        found = find_strengths(once, job, per_channel=coloured)
        if strengths == "auto" and may_be_equal(found):
            found = None
        else:
            scenes = found.lit(scenes)
    maps, placed = fit_in_passes(once, scenes, stack, passes, output, progress)
    if strengths == "given":
        error = strength_error(maps, placed, make_job(scenes, stack, **asked))
    return dataclasses.replace(maps, strengths=found, strength_error=error)


def _specified(
    specification: Specification | None, changes: SpecificationOptions, sought: bool
) -> Specification:
    """The options of a fit of maps; those that are `None` have their defaults."""
    given = {name: value for name, value in changes.items() if value is not None}
    usual = Specification(loss="cauchy" if sought else "linear")
    specification = specified(specification, given, "fit outside", usual)
    others = "per_image fixed ties priors uncertain max_steps tolerance"
    specification.refuse(others, "fit_maps")
    return specification


def _fit_once(
    scenes: Sequence[Scene],
    images: AbstractStack,
    *,
    tile_pixels: int | None,
    devices: Sequence[Any] | None,
    output: str | os.PathLike[str] | None,
    progress: bool,
    **asked: Any,
) -> Maps:
    """Fit one pass; the arguments are those of [`fit_maps`][]."""
    job = make_job(scenes, images, **asked)
    if not len(job.pixels):
        raise ValueError("mask: it leaves no pixel that sees the surface")
    team = as_team(devices)
    size = tile_size(len(job.pixels), len(job.scenes), tile_pixels, team)
    if output is None:
        return fit_job(job, size, team, None, progress)
    identity = job.identify() | {
        "images": identify_stack(images),
        "tile": f"{size} pixels",
        "versions": versions(),
    }
    with alone_at(output) as place:
        group = open_store(place, {"format": TILES_FORMAT, "job": identity})
        store = BlockStore(group, identity, (len(job.pixels),), (size,))
        return fit_job(job, size, team, store, progress)


class Team(NamedTuple):
    """Devices that work on tiles in turn, and the number of threads that feed them."""

    devices: Sequence[Any]
    threads: int


def as_team(devices: Sequence[Any] | None = None) -> Team:
    """The devices of a run; `None` for all local ones."""
    devices = jax.local_devices() if devices is None else list(devices)
    if not devices or not all(isinstance(one, jax.Device) for one in devices):
        raise ValueError(f"devices: expected devices of JAX, got {shown(devices)}")
    # XLA uses one core for a tile. On other devices one tile is read while the last is
    # fitted.
    cpu = devices[0].platform == "cpu"
    return Team(devices, (os.cpu_count() or 1) if cpu else 2 * len(devices))


def fit_job(
    job: Job,
    size: int,
    team: Team,
    store: BlockStore | None = None,
    progress: bool = False,
) -> Maps:
    """Fit the maps of a job, tile by tile.

    **Arguments:**

    - `size`: pixels of a tile, for which the program is compiled.
    - `store`: the store of finished tiles.
    """
    shared, matte = None, False
    if job.settings.materials is not None:
        shared = _materials(job, team.threads)
        matte = not len(shared.bases.shares)
    if matte:
        job, shared = _without_highlights(job), None
    among, fit = job.outside, fit_tile
    if shared is not None:
        among, fit = Given(job.outside, shared.bases), fit_shared
    layers, pixels = _layers(job, shared), job.pixels
    tiles = [pixels[k : k + size] for k in range(0, len(pixels), size)]
    if store is not None:
        store.make(layers, job.outside.noise.dtype)

    def work(number: int) -> dict[str, np.ndarray]:
        done = None if store is None else store.load(number, layers)
        if done is not None:
            return done
        device = team.devices[number % len(team.devices)]
        inputs = jax.device_put((job.tile(tiles[number], size), among), device)
        fitted = run(*inputs, job.settings, fit)
        count = len(tiles[number])
        arrays = {name: np.asarray(array)[:count] for name, array in fitted.items()}
        if store is not None:
            store.save(number, arrays)
        return arrays

    whole = {
        name: np.full(
            (job.geometry.mask.size, *layer.channels),
            layer.outside,
            job.outside.noise.dtype if layer.dtype == "float" else layer.dtype,
        )
        for name, layer in layers.items()
    }
    done = ahead(work, len(tiles), team.threads)
    for number, arrays in bar(done, len(tiles), progress):
        for name, values in arrays.items():
            whole[name][as_index(tiles[number])] = values
    return dataclasses.replace(_maps_of(job, whole, shared), matte=matte)


def _without_highlights(job: Job) -> Job:
    """The job without highlights: only matte light is fitted."""
    dark = jnp.zeros_like(job.outside.known.specular)
    known = job.outside.known._replace(specular=dark)
    return dataclasses.replace(
        job, settings=held(job.settings), outside=job.outside._replace(known=known)
    )


def _materials(job: Job, threads: int) -> Materials:
    """The shared materials, the same for equal jobs."""
    sample = choose_sample(job.pixels, len(job.scenes))
    blocks = [
        job.tile(sample[k : k + BLOCK], BLOCK) for k in range(0, len(sample), BLOCK)
    ]
    with concurrent.futures.ThreadPoolExecutor(threads) as workers:
        return find_materials(blocks, len(sample), job.outside, job.settings, workers)


def tile_size(pixels: int, images: int, wanted: int | None, team: Team) -> int:
    """Pixels of a tile, a multiple of a block's."""
    if wanted is None:
        cpu = team.devices[0].platform == "cpu"
        size = min(CORE_BYTES, CPU_BYTES // team.threads) if cpu else TILE_BYTES
        most = size // (images * 12 * BLOCK) * BLOCK
        # Tiles of equal size, since a partly filled one takes as long as a full one; in
        # a multiple of the number of cores, so that none idles.
        unit = team.threads if cpu else 1
        rounds = max(round(pixels / max(most, BLOCK) / unit), 1)
        wanted = -(-pixels // (rounds * unit))
    elif not isinstance(wanted, int) or wanted < 1:
        raise ValueError(f"tile_pixels: expected a whole number ≥ 1, got {wanted!r}")
    return -(-min(wanted, pixels) // BLOCK) * BLOCK


def versions() -> str:
    """Versions of the packages that compute maps."""
    names = ("phongfit", "jax", "jaxlib")
    return " ".join(f"{name} {importlib.metadata.version(name)}" for name in names)


def bar(
    items: Iterator[tuple[int, Any]], total: int, wanted: bool, what: str = "tiles"
) -> Iterator[tuple[int, Any]]:
    """Yield the items and show a progress bar, or occasional lines in a log."""
    console = Console(stderr=True)
    if not wanted:
        yield from items
        return
    if not console.is_terminal:
        yield from _lines(items, total, what)
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(what, *columns, console=console, transient=True) as bar:
        yield from bar.track(items, total=total)


def _lines(
    items: Iterator[tuple[int, Any]], total: int, what: str, every: float = 30.0
) -> Iterator[tuple[int, Any]]:
    """Yield the items and print a line of progress every `every` seconds."""
    start = shown = time.monotonic()
    for k, item in items:
        now = time.monotonic()
        if k and now - shown >= every:
            shown, left = now, (now - start) * (total - k) / k
            words = f"{k} of {total} {what}, {left / 60:.1f} minutes left"
            print(f"maps: {words}", file=sys.stderr, flush=True)
        yield k, item


def _layers(job: Job, shared: Materials | None) -> dict[str, Layer]:
    """The arrays over the pixels that are fitted."""
    layers = layers_of(1 if job.settings.shared else 3)
    known = ("depth", "normals", "normals_stderr")
    for name in known[: 1 if job.settings.normals == "fit" else 3]:
        layers.pop(name)
    if shared is not None:
        layers[WEIGHTS] = Layer((len(shared.bases.shares),), 0)
    return layers


def _maps_of(job: Job, arrays: dict[str, np.ndarray], shared: Materials | None) -> Maps:
    """The maps of fitted arrays, whose first axis is all pixels."""
    settings, scene = job.settings, job.scenes[0]
    size = job.geometry.mask.shape
    normals, depth = job.geometry.seen(scene, arrays.pop("normals", None))
    maps: dict[str, Any] = {
        name: array.reshape(*size, *array.shape[1:]) for name, array in arrays.items()
    }
    errors = {name: maps.pop(f"stderr_{name}") for name in MAP_PARAMETERS}
    for name in job.unknowns:
        # Without ambient light ρ_a is not identified, and was left out of the fit.
        if name not in settings.names:
            errors[name][:] = np.inf
    given: Any = job.noise.given()
    if job.noise.varies:
        # Residuals are in units of each sample's own noise.
        maps["noise"] = maps["noise"] * given
    known = np.where(job.geometry.mask, 0, np.inf).astype(normals.dtype)
    maps.setdefault("normals_stderr", known)
    weights = maps.pop(WEIGHTS, None)
    return Maps(
        **maps,
        stderr=ParameterMaps(**errors),
        normals=normals,
        unknowns=tuple(name for name in MAP_PARAMETERS if name in settings.names),
        noise_given=given,
        depth=depth,
        camera=scene.camera,
        specular_model=scene.specular_model,
        ambient_light=tuple(np.asarray(scene.ambient).tolist()),
        materials=None if shared is None else shared.basis(settings, weights),
    )
