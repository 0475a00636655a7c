"""Fits of textures by `phongfit fit`: options, pictures, report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from phongfit.commands.options import (
    FitOptions,
    UnknownOptions,
    changed,
    known_material,
    optional,
    refuse,
)
from phongfit.files.dataset import Dataset
from phongfit.files.outputs import replacing
from phongfit.files.schema import describe_material
from phongfit.fitting.problem.parameters import TEXTURE
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texture_fit import TEXTURED


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


def textures_among(unknowns: Sequence[str]) -> tuple[str, ...]:
    """Parameters whose textures are among the unknowns."""
    return tuple(n.removesuffix(TEXTURE) for n in unknowns if n.endswith(TEXTURE))


def arguments_for(
    unknown: UnknownOptions, fitting: FitOptions, texture: TextureOptions
) -> dict[str, Any]:
    """Keyword arguments of [`fit_texture`][], without the data.

    **Raises:** `ValueError` that names the option.
    """
    names = textures_among(unknown.unknowns)
    if not names:
        refuse(
            texture,
            "texture_size separate smoothness",
            "is of textures, expected one among the unknowns, such as "
            f"{TEXTURED[1]}{TEXTURE}",
        )
        return {}
    others = "per_image bounds fixed ties priors"
    refuse(unknown, others, "expected none with textures")
    if fitting.loss != "linear":
        raise ValueError(f"loss: expected linear with textures, got {fitting.loss}")
    if texture.texture_size is None:
        raise ValueError(
            "texture_size: expected columns and rows of the textures, or vertices, got "
            "none"
        )
    size = texture.texture_size
    steps = {"max_steps": fitting.max_steps} if "max_steps" in changed(fitting) else {}
    return {
        "size": size if isinstance(size, str) else size[::-1],
        "textures": names,
        "unknowns": tuple(n for n in unknown.unknowns if not n.endswith(TEXTURE)),
        "per_channel": unknown.per_channel,
        "known": known_material(fitting.known),
        "separate": texture.separate,
        "smoothness": texture.smoothness,
        "noise": fitting.noise,
        **steps,
    }


def as_settings(given: dict[str, Any]) -> dict[str, Any]:
    """Settings of a fit of textures, for its record."""
    known = given["known"]
    return given | {"known": None if known is None else describe_material(known)}


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
