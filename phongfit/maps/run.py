"""`fit_maps`: maps of materials from stacks of images under many lights."""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Sequence
from typing import Any, Literal, Unpack, overload

import numpy as np

from phongfit.checks import untraced
from phongfit.edge import checked, shown
from phongfit.fitting.problem.specification import (
    Specification,
    SpecificationOptions,
    specified,
)
from phongfit.maps.blocks import Kept, block_size, fit_whole, kept_at
from phongfit.maps.cluster import check_apart, client_for, fit_apart
from phongfit.maps.job import Fitted, Job, check_scenes, make_job
from phongfit.maps.passes import fit_in_passes, usual_passes
from phongfit.maps.result import Maps, StrengthsName
from phongfit.maps.stacks import AbstractStack, as_stack
from phongfit.maps.stored import StoredMaps, complete
from phongfit.maps.strengths import find_strengths, may_be_equal, strength_error
from phongfit.maps.tiles import Team, as_team, fit_job, tile_size, with_materials
from phongfit.material import Material
from phongfit.moved import warn_deprecated
from phongfit.scene import Scene


@overload
def fit_maps(  # pyright: ignore[reportInconsistentOverload]
    scenes: Sequence[Scene],
    images: Any,
    specification: Specification | None = None,
    *,
    load: Literal[False],
    **options: Any,
) -> StoredMaps: ...
@overload
def fit_maps(
    scenes: Sequence[Scene],
    images: Any,
    specification: Specification | None = None,
    *,
    load: Literal[True] = True,
    **options: Any,
) -> Maps: ...
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
    out: str | os.PathLike[str] | None = None,
    block: tuple[int, int] | None = None,
    load: bool = True,
    client: Any = None,
    progress: bool = True,
    output: str | os.PathLike[str] | None = None,
    **changes: Unpack[SpecificationOptions],
) -> Maps | StoredMaps:
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
        [`PhotographStack`][], which reads files, [`DatasetStack`][] or [`ZarrStack`][];
        or the path or URL of a zarr store.
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
        for several calls. Those that are given beside it replace its own. Where it has
        the default of [`fit`][], the default here applies. Other options of [`fit`][]
        must have their defaults.
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
        least noise, and leaves out samples in its shadow. Standard errors do not
        contain the error of that depth: reflectances are too large by 2 % where a
        surface is assumed 1 % too far from the lamps. `out` keeps the blocks of all
        passes.
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
        hold 16 MB of light, or 64 MB on a GPU; all cores together 256 MB. With `out` a
        block has about as many.
    - `devices`: devices that work on the tiles in turn; default: all local ones.
    - `out`: path or URL of a zarr store that is new, or of the same job: see
        [`StoredMaps`][]. It keeps finished blocks, so that an interrupted run continues
        when it is started again, with bit-identical results: finished blocks are
        compared with their checksums, and not fitted again.
    - `block`: with `out`, rows and columns of a block, which is a chunk of the store.
        Default: whole rows of images, or the images' shards or chunks, about
        `tile_pixels`; give one of the two.
    - `load`: `False`: neither images nor maps need fit into memory. Each block is read,
        fitted and written to `out` separately, with one block at a time per thread.
        There is one pass, with given strengths and a separate material for each pixel,
        and a normal map of one pixel stands for a plane; one that casts shadows is
        refused, since they fall from one block on others. By default a block has 64 MB
        of stored samples.
    - `client`: with `load=False` and images in a zarr store, client of a Dask cluster
        whose workers fit the blocks; default: the current one, or else this process
        fits them. Workers should have one thread each: see the guide.
    - `progress`: show a bar on a terminal, or occasional lines elsewhere.
    - `output`: deprecated name of `out`.

    **Returns:** [`Maps`][]. A pixel that does not identify an unknown has infinite
    errors and flags. With `load=False` [`StoredMaps`][], which have no warnings of the
    maps as a whole, such as those of misplaced pixels or of the lamps' strengths.

    **Raises:** `ValueError` that names the argument: wrong shapes, too few images for
    the unknowns, a file or store that is missing or broken. `OSError` if `out` cannot
    be written, another run writes there, or the cluster is gone. Finished blocks stay.
    """
    specification = _specified(specification, changes, normals == "fit")
    instead = "fit_maps is no function that JAX can trace"
    arguments = {"known": specification.known, "mask": mask, "noise": noise}
    untraced(instead, scenes=scenes, images=images, **arguments)
    if output is not None:
        warn_deprecated("fit_maps(output=...) goes in 0.4; write out=...", deeper=1)
        if out is not None:
            raise ValueError("output: expected its new name out alone, got both")
        out = output
    stack = as_stack(images)
    options: dict[str, Any] = arguments | {
        "unknowns": specification.unknowns,
        "per_channel": specification.per_channel,
        "bounds": specification.bounds,
        "film": specification.film,
        "loss": specification.loss,
        "normals": normals,
        "materials": materials,
        "start": start,
        "min_cosine": min_cosine,
    }
    if passes is not None and (passes < 1 or (passes > 1 and normals != "fit")):
        raise ValueError(
            f"passes: expected 1, or more where normals are sought, got {passes}"
        )
    if strengths != "given" and normals != "fit":
        raise ValueError(
            f"strengths: expected 'given' where normals are given, got {strengths!r}; "
            "fit finds exposures of images under given normals"
        )
    if not load:
        for name, given, usual in (
            ("materials", materials, None),
            ("passes", passes or 1, 1),
            ("strengths", strengths, "given"),
            ("tile_pixels", tile_pixels, None),
            ("devices", devices, None),
        ):
            if given != usual:
                raise ValueError(
                    f"{name}: expected {usual} with load=False, since images and maps "
                    f"are never whole in memory, got {shown(given)}"
                )
        if out is None:
            raise ValueError("out: expected a store with load=False, got None")
        client = client_for(stack, client)
    elif client is not None:
        raise ValueError("client: expected load=False, with which workers fit blocks")
    if block is not None and out is None:
        raise ValueError(f"block: expected it with out alone, got {block}")
    if block is not None and tile_pixels is not None:
        raise ValueError(
            f"tile_pixels: expected it or block, got {shown(tile_pixels)} and {block}"
        )
    scenes, sought = check_scenes(scenes), normals == "fit"
    passes = passes or (usual_passes(scenes) if sought and load else 1)
    if strengths != "given":
        options["bounds"] = {"diffuse": (0.0, np.inf), **specification.bounds}
    job = make_job(scenes, stack, **options)
    # Checked before older maps in `out` are removed, or a new store is made.
    if not load:
        check_apart(job)
    elif out is not None or not sought:
        _check_pixels(job)
    team = as_team(devices)
    once = functools.partial(_fit_once, team=team, tile_pixels=tile_pixels, **options)
    with contextlib.ExitStack() as place:
        kept = None
        if out is not None:
            _, height, width = stack.shape
            tile = tile_size(height * width, len(scenes), tile_pixels, team)
            block = block_size(stack, block, tile if load else None)
            asked = {"passes": passes, "strengths": strengths}
            kept = place.enter_context(kept_at(out, job, block, **asked))
        if kept is not None and not load:
            return fit_apart(job, kept, client, progress)
        if sought:
            maps = _fit_normals(once, job, passes, strengths, kept, progress)
        else:
            maps = _fit_job(job, team, tile_pixels, kept, progress)
        if kept is not None:
            complete(kept.output, maps.counts(), maps)
    return maps


def _fit_normals(
    once: Callable[..., Maps],
    job: Job,
    passes: int,
    strengths: StrengthsName,
    kept: Kept | None,
    progress: bool,
) -> Maps:
    """Fit maps with unknown normals, perhaps with strengths of the light."""
    scenes, found, error = job.scenes, None, 0.0
    if strengths != "given":
        coloured = strengths == "fit_per_channel"
        found = find_strengths(once, job, per_channel=coloured)
        if strengths == "auto" and may_be_equal(found):
            found = None
        else:
            scenes = found.lit(scenes)
    maps, placed = fit_in_passes(once, scenes, job.stack, passes, kept, progress)
    if strengths == "given":
        error = strength_error(maps, placed, job)
    return dataclasses.replace(maps, strengths=found, strength_error=error)


def _specified(
    specification: Specification | None, changes: SpecificationOptions, sought: bool
) -> Specification:
    """The options of a fit of maps."""
    usual = Specification(loss="cauchy" if sought else "linear")
    specification = specified(specification, changes, "fit outside", usual)
    others = "per_image fixed ties priors uncertain max_steps tolerance"
    specification.refuse(others, "fit_maps")
    return specification


def _fit_once(
    scenes: Sequence[Scene],
    images: AbstractStack,
    *,
    team: Team,
    tile_pixels: int | None,
    kept: Kept | None,
    progress: bool,
    **options: Any,
) -> Maps:
    """Fit one pass; `options` are those of [`make_job`][]."""
    job = make_job(scenes, images, **options)
    _check_pixels(job)
    return _fit_job(job, team, tile_pixels, kept, progress)


def _check_pixels(job: Job) -> None:
    if not len(job.pixels):
        raise ValueError("mask: it leaves no pixel that sees the surface")


def _fit_job(
    job: Job, team: Team, tile_pixels: int | None, kept: Kept | None, progress: bool
) -> Maps:
    """Fit one pass of a job."""
    wanted = job.settings.materials
    job, shared = with_materials(job, team.threads)
    if kept is None:
        size = tile_size(len(job.pixels), len(job.scenes), tile_pixels, team)
        maps = fit_job(job, size, team, shared, progress)
    else:
        maps = fit_whole(job, kept, shared, team, progress)
    matte = wanted is not None and shared is None
    return dataclasses.replace(maps, matte=matte)


@checked
def fit_stored_maps(
    scenes: Sequence[Scene],
    images: Any,
    output: str | os.PathLike[str],
    **options: Any,
) -> StoredMaps:
    """Deprecated name of [`fit_maps`][] with `out` and `load=False`."""
    warn_deprecated(
        "fit_stored_maps goes in 0.4; write fit_maps(..., out=..., load=False)",
        deeper=1,
    )
    return fit_maps(scenes, images, out=output, load=False, **options)
