"""`phongfit maps`: photographs under many lights in, maps of the material out."""

import contextlib
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import OmitArgPrefixes

from phongfit.codes import coded
from phongfit.commands.data import DataOptions, stack_data, tell
from phongfit.commands.keeping import keeping
from phongfit.commands.options import (
    Names,
    OutFolder,
    Words,
    known_material,
    optional,
    parse_bounds,
)
from phongfit.commands.progress import stage
from phongfit.commands.stored import Input, read_stored
from phongfit.files.budget import afford
from phongfit.files.dataset import Photographs
from phongfit.files.fits import DataRecord, LossName
from phongfit.files.inputs import naming
from phongfit.files.outputs import OVERWRITE, replacing
from phongfit.files.schema import describe_material
from phongfit.files.zarrs import address, is_store
from phongfit.fitting.fit import fit
from phongfit.fitting.problem.parameters import EXPOSURE
from phongfit.geometry.cameras import OrthographicCamera
from phongfit.lights import DirectionalLight
from phongfit.maps.cluster import dashboard, dask_client
from phongfit.maps.folder import (
    ARRAYS_FILE,
    NORMALS_FILE,
    NORMALS_PICTURE,
    RECORD_FILE,
    MapOptions,
    save_folder,
)
from phongfit.maps.job import casts_shadows, is_plane, over
from phongfit.maps.passes import usual_passes
from phongfit.maps.result import MAP_PARAMETERS, Maps, StrengthsName
from phongfit.maps.run import fit_maps
from phongfit.maps.stacks import DatasetStack
from phongfit.maps.store import Anew
from phongfit.maps.stored import StoredMaps
from phongfit.maps.view_angle import check_fov, fit_fov, seen_over
from phongfit.material import Material
from phongfit.plain import plain

TILES = "tiles"
FLAGS_FILE = "flags.png"
OURS = {
    *(RECORD_FILE, ARRAYS_FILE, NORMALS_FILE, NORMALS_PICTURE, FLAGS_FILE),
    *(f"{name}.{suffix}" for name in MAP_PARAMETERS for suffix in ("png", "tif")),
    *(f"stderr_{name}.tif" for name in MAP_PARAMETERS),
}
PIXEL = 110
"""Bytes of memory for the maps of a pixel."""
SHARED = ("ambient", "diffuse")
"""Unknowns of each pixel if all pixels share one highlight."""
EQUAL_STRENGTHS = (
    "assumed: the lamps are equally strong, since the photographs do not tell apart "
    "whether they differ or stand a little elsewhere (--strengths fit fits them)"
)
HELD = (
    "warning: the maps' errors are those of the photographs alone, and leave out those "
    "of the calibration: all pixels share them, and `phongfit fit` includes them"
)


@dataclass(frozen=True)
class Options:
    """Options of `phongfit maps`.

    Args:
        out: Folder to make: maps.npz (all maps, errors and flags), pictures of each map
            and its errors with their scales, the same as floating-point TIFF, normals
            as numbers and as a picture (normals.npy, .png), maps.json (settings and
            versions). Until all is done it holds finished tiles: the same
            command goes on from there. A name that ends in .zarr is a store of arrays,
            for maps that memory does not hold.
        highlight: own: every pixel has its own. shared: one for all, which a fit of one
            material finds first, with all photographs in memory; for few lights or
            sharp highlights, of which a pixel sees one at most.
        materials: With --normals fit: number of materials that the pixels share, or
            auto to find it; each pixel gets the most likely one, and keeps its own
            diffuse. For few lights, which do not show the highlight of every pixel.
            Default: every pixel has its own.
        passes: With --normals fit: number of passes. Each pass after the first uses the
            surface of the last one for distances to near lamps and for cast shadows.
            Default: 3 with near lamps, else 2; from or to zarr 1.
        strengths: With --normals fit: how strong the light of each photograph is. fit:
            a number for each, of which only ratios can be found; fit_per_channel: one
            for each channel; auto: fit, unless lamps that stand 2° elsewhere would
            explain that they differ. Default: auto with a lights.json that has no
            strengths (no matte sphere was seen), else given.
        unknowns: Parameters to fit, of ambient diffuse specular shininess. Default:
            all of them; with --normals fit all but ambient.
        per_channel: Which of them differ between red, green and blue; with shininess,
            each channel has its own exponent. With --normals fit, without specular, the
            channels share one.
        known: A material for the parameters that are not unknown.
        bounds: Other bounds than 0:1 (reflectances) and 1:1000 (shininess).
        noise: Standard deviation of the sensor's noise in linear light, where white
            is 1. Default: estimated from each pixel's residuals.
        loss: Loss function of the residuals; all but linear are robust to outliers,
            such as shadows that the scene does not have. Default: linear; cauchy with
            --normals fit.
        tile_pixels: Pixels that each core works on at a time. Default: as many as have
            16 MB of light, all cores together 256 MB; 64 MB on a GPU.
        dask: With a zarr array: local:N for N workers on this machine, or the address
            of a Dask scheduler, such as tcp://10.0.0.1:8786.
        pictures: Draw the pictures.
        overwrite: Replace older maps in OUT.
    """

    data: OmitArgPrefixes[DataOptions]
    out: OutFolder
    highlight: Literal["own", "shared"] = "own"
    materials: Annotated[str | None, optional("N|auto")] = None
    passes: Annotated[int | None, optional("N")] = None
    strengths: Annotated[
        StrengthsName | None, optional("|".join(get_args(StrengthsName)))
    ] = None
    unknowns: Annotated[tuple[str, ...] | None, optional("NAME ...")] = None
    per_channel: Names = ("ambient", "diffuse", "specular")
    known: Annotated[str | None, optional("preset:NAME|FILE")] = None
    bounds: Annotated[Words, optional("NAME=LOW:HIGH ...")] = ()
    noise: Annotated[float | None, optional("SD")] = None
    loss: Annotated[LossName | None, optional("NAME")] = None
    tile_pixels: Annotated[int | None, optional("N")] = None
    dask: Annotated[str | None, optional("local:N|ADDRESS")] = None
    pictures: bool = True
    overwrite: bool = False


def main(options: Options) -> int:
    """Fit a material per pixel to photographs under many lights.

    The normals are known, or fitted with the material (--normals fit).

    For example:
      phongfit synth out/dome --shininess 40 --lights 24 --resolution 64
      phongfit maps out/dome -o out/maps
      phongfit maps out/dome -o out/shared --highlight shared --bounds shininess=1:5000
      phongfit maps coin --normals fit --encoding srgb -o out/coin
      phongfit maps coin --normals fit --encoding srgb --materials auto -o out/few
      phongfit maps coin --normals fit --encoding srgb --fov fit -o out/seen
      phongfit maps coin/stack.zarr --normals fit -o out/maps.zarr --dask local:2

    DATASET may be a zarr array (light, y, x, channel) on a disk or an object store,
    with its lights or its scene.json beside it. OUT may be such a store, too.
    """
    dataset = options.data.dataset
    if options.data.fov == "fit" and not options.data.sought:
        raise ValueError("fov: expected degrees where normals are given, got fit")
    if is_store(dataset):
        whole = "with a zarr array, since {} found from images that are whole in memory"
        if options.highlight == "shared":
            why = whole.format("a shared one is")
            raise ValueError(f"highlight: expected own {why}, got shared")
        if options.data.fov == "fit":
            raise ValueError(f"fov: expected degrees {whole.format('it is')}, got fit")
    elif options.dask is not None:
        raise ValueError(
            f"dask: {options.dask} wants a zarr array as DATASET, got {dataset}"
        )
    given = arguments(options)
    if is_store(options.out):
        found, _, notes = _fit(options, given, address(options.out))
        print("\n".join([str(found), *notes]), flush=True)
        return 0
    if not options.overwrite and (options.out / RECORD_FILE).exists():
        raise OSError(f"{options.out}: there are maps in it; {OVERWRITE}")

    def may_replace(name: str) -> bool:
        # Unfinished tiles and, with --overwrite, files of older maps.
        return name == TILES or (options.overwrite and name in OURS)

    with keeping(options.out, may_replace) as (folder, drawing):
        found, read, notes = _fit(options, given, str(options.out / TILES))
        maps = found if isinstance(found, Maps) else found.load()
        with _resumable(options):
            save(folder, maps, read, given)
        with drawing():
            print("\n".join([str(maps), *notes]), flush=True)
            if options.pictures:
                with stage("drawing"):
                    draw(folder, maps)
    return 0


@contextlib.contextmanager
def _resumable(options: Options) -> Iterator[None]:
    """Add to an interrupt's message that the same command continues the work."""
    try:
        yield
    except KeyboardInterrupt as stop:
        stay = "finished tiles stay in {}, the same command goes on there"
        stop.args = (stay.format(options.out),)
        raise


def _fit(
    options: Options, given: dict[str, Any], out: str
) -> tuple[Maps | StoredMaps, Input, list[str]]:
    """Fit maps into a store, and complete `given` by what depends on the photographs.

    From or to zarr, images and maps need not fit into memory unless an option needs
    them whole.

    **Returns:** maps, data, and notes for the user.
    """
    stored = is_store(options.data.dataset) or is_store(options.out)
    whole = _needing_all(options, given)
    load = not stored or bool(whole)
    if whole and options.dask is not None:
        raise ValueError(
            f"dask: expected it without {' and '.join(whole)}, which one process fits "
            "with all images in memory"
        )
    if is_store(options.data.dataset):
        read, stack = read_stored(options.data), None
    else:
        read, stack = _read_photographs(options, given, stored)
    # Without a cluster, shadows that blocks cast on others need all at once.
    load = load or (options.dask is None and casts_shadows(read.scenes))
    if stored and (load or not is_store(options.out)):
        check_room(read)
    if load and is_plane(surface := read.scenes[0].surface):
        plane = over(surface, read.stack.shape[1:])
        lit = (dataclasses.replace(scene, surface=plane) for scene in read.scenes)
        read = read._replace(scenes=tuple(lit))
    renewed = is_store(options.out) and options.overwrite
    with _resumable(options), contextlib.ExitStack() as cluster:
        client = None
        if options.dask is not None:
            client = cluster.enter_context(dask_client(options.dask))
            page = dashboard(client)
            if page is not None:
                print(f"dask: {page}", flush=True)
        more = given | {"load": load, "tile_pixels": options.tile_pixels}
        more |= read.arguments
        place = Anew(out) if renewed else out
        found = fit_maps(read.scenes, read.stack, out=place, client=client, **more)
    notes = [] if stack is None or not load else _notes(options, stack, given, found)
    return found, read, notes


def _needing_all(options: Options, given: dict[str, Any]) -> list[str]:
    """The options that need images and maps whole in memory, as they were asked for."""
    asked = {
        "--passes": given["passes"] != 1,
        "--strengths": given["strengths"] != "given",
        "--materials": given["materials"] is not None,
        "--tile-pixels": options.tile_pixels is not None,
    }
    return [name for name, needed in asked.items() if needed]


def _read_photographs(
    options: Options, given: dict[str, Any], stored: bool
) -> tuple[Input, DatasetStack]:
    """Photographs; `given` is completed by what depends on them.

    **Arguments:** `stored`: whether the maps go to a store.
    """
    stack, record = stack_data(options.data)
    tell(stack.photographs.notes)
    if options.data.fov == "fit":
        stack, record = _with_fitted_fov(stack, record, given)
    photographs = stack.photographs
    if not stored and options.passes is None and options.data.sought:
        given["passes"] = usual_passes(photographs.scenes)
    if not stored and options.strengths is None and _lacks_strengths(options, stack):
        given["strengths"] = "auto"
    if options.highlight == "shared":
        given |= {"known": _shared(photographs, given), "unknowns": SHARED}
    mask = None if stack.mask.all() else stack.mask
    more = {"mask": mask, "film": photographs.films()}
    return Input(photographs.scenes, stack, photographs.film, more, record), stack


def _notes(
    options: Options, stack: DatasetStack, given: dict[str, Any], found: Maps
) -> list[str]:
    """Notes for the user on maps of photographs."""
    notes = []
    if given["strengths"] == "auto" and found.strengths is None:
        notes.append(EQUAL_STRENGTHS)
    if stack.photographs.uncertain:
        notes.append(HELD)
    if "specular" in given["unknowns"] and _assumes_parallel_rays(options, stack):
        doubtful = _fov_warning(stack, given)
        notes += [] if doubtful is None else [f"warning: {doubtful}"]
    return notes


def check_room(read: Input) -> None:
    """Check that memory can hold the maps, before the fit."""
    _, height, width = read.stack.shape
    with naming("out"):
        # A zarr store would not need this memory.
        afford(PIXEL * height * width, f"maps of {height} × {width} pixels")


def _with_fitted_fov(
    stack: DatasetStack, read: DataRecord, given: dict[str, Any]
) -> tuple[DatasetStack, DataRecord]:
    """The photographs with a camera of the fitted angle of view.

    The camera keeps parallel rays if the data do not determine the angle.
    """
    scenes = stack.photographs.scenes
    found = fit_fov(scenes, stack, **_fov_arguments(stack, given))
    print(found, flush=True)
    if not found.determined:
        return stack, read
    reading = read.reading.model_copy(update={"fov": found.degrees})
    return (
        stack.with_scenes(seen_over(scenes, found.degrees)),
        read.model_copy(update={"reading": reading}),
    )


def _fov_warning(stack: DatasetStack, given: dict[str, Any]) -> str | None:
    """A warning if another angle of view would give smaller residuals."""
    scenes = stack.photographs.scenes
    other = check_fov(scenes, stack, **_fov_arguments(stack, given))
    if not other.improves:
        return None
    less = 1 - other.noise_ratio
    return coded(
        "fov-doubtful",
        f"an angle of view of about {other.degrees:.0f}° leaves {less:.0%} less noise "
        "than parallel rays",
    )


def _fov_arguments(stack: DatasetStack, given: dict[str, Any]) -> dict[str, Any]:
    names = ("unknowns", "per_channel", "known", "bounds", "noise", "loss")
    own = {name: given[name] for name in names}
    return own | {"mask": stack.mask, "film": stack.photographs.films()}


def _assumes_parallel_rays(options: Options, stack: DatasetStack) -> bool:
    """True if parallel rays are a default, normals are fitted and lamps are distant."""
    scene = stack.photographs.scenes[0]
    return (
        options.data.sought
        and options.data.fov is None
        and isinstance(scene.camera, OrthographicCamera)
        and all(isinstance(light, DirectionalLight) for light in scene.lights)
    )


def save(folder: Path, found: Maps, read: Input, given: dict[str, Any]) -> None:
    """Write all files except pictures."""
    known = given["known"]
    described = None if known is None else describe_material(known)
    settings = MapOptions.model_validate(plain(given | {"known": described}))
    save_folder(
        folder,
        found,
        data=read.record,
        settings=settings,
        model=read.scenes[0].specular_model,
        encoding=read.film.encoding,
    )


def arguments(options: Options) -> dict[str, Any]:
    """Keyword arguments of [`fit_maps`][]."""
    sought = options.data.sought
    if sought and options.highlight == "shared":
        raise ValueError("highlight: expected own where normals are sought, got shared")
    unknowns = MAP_PARAMETERS[1:] if sought else MAP_PARAMETERS
    return {
        "unknowns": unknowns if options.unknowns is None else options.unknowns,
        "per_channel": options.per_channel,
        "bounds": parse_bounds(options.bounds),
        "known": known_material(options.known),
        "noise": options.noise,
        "loss": options.loss or ("cauchy" if sought else "linear"),
        "normals": "fit" if sought else "given",
        "materials": _number(options.materials),
        "passes": 1 if options.passes is None else options.passes,
        "strengths": options.strengths or "given",
    }


def _lacks_strengths(options: Options, stack: DatasetStack) -> bool:
    """True if normals are fitted and the lights are a calibration without strengths."""
    lights = options.data.lights
    calibrated = lights is not None and lights.suffix != ".lp"
    return options.data.sought and calibrated and EXPOSURE in stack.photographs.unknown


def _number(words: str | None) -> int | str | None:
    """The number of materials; other words are left to [`fit_maps`][] to check."""
    return int(words) if words is not None and words.isdecimal() else words


def _shared(photographs: Photographs, given: dict[str, Any]) -> Material:
    """Fit one material to all pixels, for the highlight that they share."""
    with stage("fitting one material"):
        data = photographs.load()
        options = given | {"mask": data.masks, "film": data.film}
        for name in ("normals", "materials", "passes", "strengths"):
            options.pop(name)
        options |= {"uncertain": data.uncertain}
        one = fit(data.scenes, data.images, **options)
    print(one, "\n", flush=True)
    return one.material


def draw(folder: Path, found: Maps) -> None:
    """Write the pictures."""
    # Imported here, since drawing takes long to import.
    from phongfit.report.scales import draw_flags, draw_parameter

    for name in found.unknowns:
        with replacing(folder / f"{name}.png") as picture:
            draw_parameter(found, name).savefig(picture, dpi=130)
    with replacing(folder / FLAGS_FILE) as picture:
        draw_flags(found).savefig(picture, dpi=130)
