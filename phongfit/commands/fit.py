"""`phongfit fit`: photographs in; table, `fit.json`, pictures and report out."""

import dataclasses
import shlex
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes

from phongfit.commands.data import DataOptions, read_data, tell
from phongfit.commands.keeping import keeping
from phongfit.commands.options import (
    FitOptions,
    OutFolder,
    UnknownOptions,
    changed,
    optional,
    refuse,
    specification_of,
)
from phongfit.commands.progress import stage
from phongfit.files.dataset import Dataset
from phongfit.files.fits import (
    DataRecord,
    FitRecord,
    distances,
    read_fit_record,
    write_fit_record,
)
from phongfit.files.outputs import replacing
from phongfit.files.schema import describe_material
from phongfit.files.texture_fits import (
    ARRAYS_FILE,
    MESH_FILE,
    RECORD_FILE,
    save_texture_fit,
)
from phongfit.fitting.fit import fit
from phongfit.fitting.problem.parameters import TEXTURE
from phongfit.fitting.problem.specification import Specification, as_names
from phongfit.fitting.result import Fit
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texture_fit import (
    MAX_STEPS,
    TEXTURED,
    fit_texture,
    textures_among,
)

FIT_FILE = "fit.json"
PICTURE_FILE = "comparison.png"
REPORT_FILE = "report.html"
OURS = (
    *(FIT_FILE, PICTURE_FILE, REPORT_FILE, RECORD_FILE, ARRAYS_FILE, MESH_FILE),
    *(f"{name}.png" for name in TEXTURED),
)


@dataclass(frozen=True)
class TextureOptions:
    """Textures among the unknowns, such as diffuse.texture or shininess.texture.

    Args:
        texture_size: Columns and rows of the textures of a mesh with uv, no finer than
            the photographs; or the word vertices, for a number at each vertex.
        separate: A texture for each material of the mesh. Default: one texture for
            all.
        smoothness: Prior standard deviation of the difference between neighbouring
            texels, which blurs. Default: no such prior.
    """

    texture_size: Annotated[
        tuple[int, int] | Literal["vertices"] | None, optional("W H|vertices")
    ] = None

    separate: bool = False

    smoothness: Annotated[float | None, optional("SD")] = None


def arguments_for(
    unknown: UnknownOptions, fitting: FitOptions, texture: TextureOptions
) -> dict[str, Any]:
    """Arguments of [`fit_texture`][], without the data; none without textures.

    **Raises:** `ValueError` that names the option.
    """
    if not textures_among(unknown.unknowns):
        refuse(
            texture,
            "texture_size separate smoothness",
            "is of textures, expected one among the unknowns, such as "
            f"{TEXTURED[1]}{TEXTURE}",
        )
        return {}
    size = texture.texture_size
    if size is None:
        raise ValueError(
            "texture_size: expected columns and rows of the textures, or vertices, got "
            "none"
        )
    asked = specification_of(unknown, fitting)
    if "max_steps" not in changed(fitting):
        asked = dataclasses.replace(asked, max_steps=MAX_STEPS)
    return {
        "specification": asked,
        "size": size if isinstance(size, str) else size[::-1],
        "separate": texture.separate,
        "smoothness": texture.smoothness,
        "noise": fitting.noise,
    }


def as_settings(found: TextureFit, given: dict[str, Any]) -> dict[str, Any]:
    """Settings of a fit of textures, for its record."""
    given = dict(given)
    asked = given.pop("specification")
    return given | {
        "textures": found.names,
        "unknowns": [n for n in asked.unknowns if not n.endswith(TEXTURE)],
        "per_channel": asked.per_channel,
        "known": None if asked.known is None else describe_material(asked.known),
        "max_steps": asked.max_steps,
    }


def draw(folder: Path, found: TextureFit, data: Dataset, command: str) -> None:
    """Write pictures of the textures and of the photographs, and the report."""
    # Imported here, since drawing takes long to import.
    from phongfit.report.textures import draw_photographs, draw_texture, write_page

    for name in found.names:
        with replacing(folder / f"{name}.png") as picture:
            draw_texture(found, name, data.scenes[0]).savefig(picture, dpi=130)
    with replacing(folder / "comparison.png") as picture:
        draw_photographs(found, data).savefig(picture, dpi=150)
    write_page(folder / "report.html", found, data, command=command)


@dataclass(frozen=True)
class Options:
    """Options of `phongfit fit`.

    Args:
        out: Folder to make: fit.json (all numbers, and what is needed to repeat the
            fit), comparison.png (photograph, fit and residual), report.html. With
            textures textures.npz (texels, their errors, and how many pixels see each),
            textures.json (all other numbers), mesh.glb (the mesh with its textures) and
            a picture of each, in place of fit.json.
        like: Repeat this fit: take all settings from it, and compare the answers.
        report: full: the picture, and the report with profiles, which solve the fit
            some fifty times more. quick: the report without profiles. none: fit.json
            alone.
        refine_lights: List distant lights of a calibration as unknowns with errors,
            with the calibration as a prior. Otherwise lights are refined in the same
            way but not listed, and their uncertainty is in the material's errors.
        overwrite: Replace an older fit in OUT.
    """

    data: OmitArgPrefixes[DataOptions]

    out: OutFolder

    unknown: OmitArgPrefixes[UnknownOptions] = UnknownOptions()
    fitting: OmitArgPrefixes[FitOptions] = FitOptions()
    texture: OmitArgPrefixes[TextureOptions] = TextureOptions()

    like: Annotated[Path | None, optional("FIT.json")] = None

    report: Literal["full", "quick", "none"] = "full"

    refine_lights: bool = False

    overwrite: bool = False


def main(options: Options) -> int:
    """Fit one material to photographs, with standard errors.

    Prints values with standard errors, correlations, and parameters that are not
    identifiable. No starting guess is needed, and the same photographs always give the
    same fit.

    For example:
      phongfit fit out/brass -o out/fit
      phongfit fit out/brass/001.png --scene out/brass/scene.json -o out/one
      phongfit fit out/brass -o out/bold --bounds shininess=1:5000 --loss cauchy
      phongfit fit out/brass -o out/again --like out/fit/fit.json
      phongfit fit cup --unknowns diffuse.texture --texture-size 64 64 -o out/cup

    Exit status 1 if the solver does not converge, or if, with --like, the answers
    differ by more than a standard error.
    """
    given = arguments_for(options.unknown, options.fitting, options.texture)
    if given:
        return _fit_textures(options, given)
    may_replace = OURS.__contains__ if options.overwrite else None
    with keeping(options.out, may_replace) as (folder, drawing):
        record = None if options.like is None else read_fit_record(options.like)
        asked, noise, reading = _asked(options, record)
        data, read = read_data(reading)
        asked = _with_unknown(asked, data, options.refine_lights)
        tell(data.notes)
        with stage("fitting"):
            found = _fit(data, asked, noise)
        write_fit_record(folder / FIT_FILE, found, data=read, noise=noise)
        with drawing():
            print(found, flush=True)
            if options.report != "none":
                with stage("drawing"):
                    _draw(folder, found, data, options)
    agrees = record is None or _compare(record, found, read)
    return 0 if found.converged and agrees else 1


def _fit_textures(options: Options, given: dict[str, Any]) -> int:
    """Fit with texels among the unknowns."""
    refuse(options, "like refine_lights", "expected none with textures")
    may_replace = OURS.__contains__ if options.overwrite else None
    with keeping(options.out, may_replace) as (folder, drawing):
        data, read = read_data(options.data)
        tell(data.notes)
        with stage("fitting"):
            found = fit_texture(
                data.scenes, data.images, mask=data.masks, film=data.film, **given
            )
        settings = as_settings(found, given)
        save_texture_fit(folder, found, data.scenes[0], data=read, settings=settings)
        with drawing():
            print(found, flush=True)
            if options.report != "none":
                with stage("drawing"):
                    draw(folder, found, data, shlex.join(_words(options)))
    return 0 if found.converged else 1


def _words(options: Options) -> list[str]:
    """The command that repeats a fit of textures, with all options that were given."""
    words = ["phongfit", "fit", str(options.data.dataset)]
    for group in (options.data, options.unknown, options.fitting, options.texture):
        for name, value in changed(group).items():
            if name != "dataset":
                words.append("--" + name.replace("_", "-"))
                many = value if isinstance(value, tuple) else [value]
                words += [str(one) for one in many if one is not True]
    return [*words, "-o", f"{options.out}-again"]


def _asked(
    options: Options, record: FitRecord | None
) -> tuple[Specification, float | None, DataOptions]:
    """Specification, noise and data, from options or from a fit to repeat."""
    if record is None:
        asked = specification_of(options.unknown, options.fitting)
        return asked, options.fitting.noise, options.data
    for name in changed(options.unknown) | changed(options.fitting):
        raise ValueError(
            f"{name}: expected this option or --like, which says it, got both"
        )
    settings, data = record.settings, options.data.like(record.data.reading)
    return settings.specification(), settings.noise, data


def _with_unknown(asked: Specification, data: Dataset, refine: bool) -> Specification:
    """A specification that includes unknown or uncertain lights and strengths.

    Strengths are relative to the first lamp's unless another one is fixed, since
    brighter lamps and darker materials are degenerate.
    """
    fixed = dict(asked.fixed)
    if "exposure" in data.unknown and not any("exposure" in name for name in fixed):
        fixed["exposure[0]"] = 1.0
    if refine and not data.uncertain:
        raise ValueError(
            "refine_lights: expected lights of a calibration, whose errors are known"
        )
    several = len(data.images) > 1
    known = tuple(name for key in data.uncertain for name in as_names(key))
    if refine and any("attenuation" in name for name in known):
        raise ValueError(
            "refine_lights: expected distant lamps, got near ones: their places and "
            "how light falls off hang together, and are brought to the photographs "
            "anyway"
        )
    refined = known if refine else ()
    names = (*data.unknown, *refined)
    own = tuple(name for name in names if name.startswith("scene."))
    return dataclasses.replace(
        asked,
        unknowns=tuple(dict.fromkeys((*asked.unknowns, *names))),
        per_channel=tuple(dict.fromkeys((*asked.per_channel, *refined))),
        per_image=tuple(dict.fromkeys((*asked.per_image, *(own if several else ())))),
        fixed=fixed,
        uncertain=data.uncertain,
    )


def _fit(data: Dataset, asked: Specification, noise: float | None) -> Fit:
    # A single image is not passed as a tuple, so that its residual is one image too.
    asked = dataclasses.replace(asked, film=data.film)
    scenes, images, mask = data.scenes, data.images, data.masks
    if len(images) == 1:
        scenes, images, mask = scenes[0], images[0], mask[0]
    return fit(scenes, images, asked, mask=mask, noise=noise)


def _compare(record: FitRecord, found: Fit, read: DataRecord) -> bool:
    """Compare a repeated fit and print the result; true if it agrees or data differ."""
    then, now = record.data.inputs, read.inputs
    if sorted(then.values()) != sorted(now.values()):
        changed = sorted(
            {name for name, _ in set(then.items()) ^ set(now.items())},
        )
        shown = ", ".join(changed[:5]) + (" …" if len(changed) > 5 else "")
        print(f"other data than in the recorded fit ({shown}): not compared")
        return True
    distance = distances(record, found)
    if np.isnan(distance).all():
        print("like the recorded fit: neither identifies anything")
        return True
    worst = int(np.nanargmax(distance))
    agrees = bool(distance[worst] <= 1)
    verdict = "agrees with" if agrees else "DIFFERS from"
    print(
        f"{verdict} the recorded fit: the largest difference is {distance[worst]:.2g} "
        f"standard errors, of {found.labels[worst]}"
    )
    return agrees


def _draw(folder: Path, found: Fit, data: Dataset, options: Options) -> None:
    """Write the picture and the report."""
    # Imported here, since drawing takes long to import, and the table comes first.
    from phongfit.report.page import write_page
    from phongfit.report.repeat import names as names_in_call

    with replacing(folder / PICTURE_FILE) as picture:
        found.plot(data.names).savefig(picture, dpi=150)
    write_page(
        folder / REPORT_FILE,
        found,
        title=data.name,
        names=data.names,
        assumptions={"exposures": "; ".join(data.notes)} if data.notes else None,
        command=_again(options),
        loading=loading_lines(options.data, names_in_call(found)),
        diagnostics=found.diagnose() if options.report == "full" else None,
    )


def _again(options: Options) -> str:
    """The command that repeats the fit."""
    words = ["phongfit", "fit", str(options.data.dataset)]
    for name in ("scene", "mask"):
        path = getattr(options.data, name)
        words += [] if path is None else [f"--{name}", str(path)]
    like = str(options.out / FIT_FILE)
    return shlex.join([*words, "--like", like, "-o", f"{options.out}-again"])


def loading_lines(options: DataOptions, names: Collection[str]) -> str:
    """Python that reads the data and defines variables, such as `scene` and `image`."""
    given = options.arguments.items()
    first, *others = [repr(v) if n == "dataset" else f"{n}={v!r}" for n, v in given]
    several = "scenes" in names
    targets = "scenes, images, masks" if several else "(scene,), (image,), (mask,)"
    lines = [
        f"data = pf.open_data({', '.join([first, *others])}).load()",
        f"{targets} = data.scenes, data.images, data.masks",
    ]
    lines += [f"{n} = data.{n}" for n in ("film", "uncertain") if n in names]
    return "\n".join(lines)
