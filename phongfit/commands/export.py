"""`phongfit export`: a material for other programs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from phongfit.commands.fit import FIT_FILE
from phongfit.commands.options import optional
from phongfit.files.inputs import sparing
from phongfit.files.limits import as_blinn
from phongfit.files.materials import NamedMaterial, read_material, write_material
from phongfit.files.mesh_saving import save_mesh
from phongfit.files.mtl import write_mtl
from phongfit.files.opengl import write_opengl
from phongfit.files.outputs import check_file
from phongfit.files.scenes import load_scene
from phongfit.files.texture_fits import MESH_FILE
from phongfit.files.usd import SUFFIXES
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.shapes import Ball
from phongfit.geometry.surfaces import AbstractSurface, Sphere
from phongfit.maps.export import export_maps
from phongfit.maps.folder import RECORD_FILE
from phongfit.material import Material, stack_materials, unstack_materials
from phongfit.reflectance import AbstractSpecular, BlinnPhong

Target = Literal["mtl", "gltf", "usd", "json", "opengl", "obj", "ply", "stl"]

BY_SUFFIX: dict[str, Target] = {
    ".mtl": "mtl",
    ".glb": "gltf",
    ".gltf": "gltf",
    ".json": "json",
    ".h": "opengl",
    ".c": "opengl",
    ".obj": "obj",
    ".ply": "ply",
    ".stl": "stl",
    **dict.fromkeys(SUFFIXES, "usd"),
}

MESHES = (".obj", ".ply", ".glb", ".gltf")
"""Suffixes of meshes with materials."""


@dataclass(frozen=True)
class Options:
    """Options of `phongfit export`.

    Args:
        fit: A fit.json or the folder that holds it, preset:NAME, an .mtl, another .json
            of a material, the folder that `phongfit maps` made, or a mesh with its
            materials and textures: a file, or the folder of a fit of textures.
        out: The file to write; for gltf .glb, or .gltf, which is text; for usd .usda,
            which is text, .usd, .usdc, or .usdz, which contains its textures.
        to: mtl: Wavefront's .mtl. gltf: glTF 2.0, on the scene's mesh. usd: the same as
            UsdPreviewSurface (pip install 'phongfit[usd]'). json: what phongfit reads
            again. opengl: C lines of glMaterialfv. Of a mesh gltf, usd and obj, with an
            .mtl and textures beside it, and stl: its triangles alone (--nearest). Of
            maps mtl, gltf, obj: the mesh of their height, likewise, ply: the mesh with
            colours, and stl: its triangles. Default: what the file's suffix says (.mtl;
            .glb, .gltf; .usda, .usd, .usdc, .usdz; .json; .h, .c; .obj; .ply; .stl).
        scene: For gltf and usd: a scene file whose mesh, or sphere, gets the material.
            Default: a sphere.
        nearest: Where the format cannot hold the material (colours above 1, an exponent
            above 1000 in .mtl or 128 in OpenGL, an exponent for each channel), write
            the nearest that it holds, with a warning; else that is an error.
        surface: With maps, for gltf: the mesh of their height, in place of a rectangle.
        distance: With maps: distance of the surface from a pinhole camera, if the
            maps' geometry did not have it.
    """

    fit: Annotated[Positional[str], arg(metavar="FIT")]
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
    to: Annotated[Target | None, optional("mtl|gltf|usd|json|opengl|obj|ply|stl")] = (
        None
    )
    scene: Annotated[Path | None, optional("FILE")] = None
    nearest: bool = False
    surface: bool = False
    distance: Annotated[float | None, optional("LENGTH")] = None


def main(options: Options) -> int:
    """Write a material for other programs: .mtl, glTF, USD, OpenGL, JSON.

    All but json get Blinn's un-normalised model: Phong's exponents are multiplied by 4,
    GGX's and Ward's alpha becomes f = 2 / alpha^2 - 2. glTF knows another one:
    roughness = (2 / (f + 2))^(1/4), F0 = 8 rho_s / (f + 2) by KHR_materials_specular,
    metallic 0; the exact numbers stand in its extras. Its highlight differs from
    Blinn's by up to 0.16 of the peak, from GGX's by what Fresnel's law takes of the
    diffuse light. USD has the same numbers, with F0 as the specular colour. Maps become
    texture images: beside an .mtl; inside a glTF file, on a rectangle with their
    normals, or on the mesh of their height (--surface; .obj, .ply, .stl always). A
    highlight that is 0 within its error is 0 there, and what a pixel does not identify
    is the median of those that can.

    For example:
      phongfit export out/fit -o out/brass.glb
      phongfit export out/fit/fit.json -o out/brass.h --nearest
      phongfit export preset:gold -o out/gold.mtl
      phongfit export out/maps -o out/maps.glb
      phongfit export out/maps -o out/coin.obj
      phongfit export cup.obj -o out/cup.glb
      phongfit export out/fit -o out/brass.usda
    """
    check_file(options.out)
    to = _target(options)
    if options.scene is not None and to not in ("gltf", "usd"):
        raise ValueError(
            f"scene: expected none, since {to} holds no shape; gltf and usd do"
        )
    try:
        with sparing(options.out):
            written = _export(options, to)
    except ValueError as error:
        # Name the command's option in place of the library's argument.
        words = str(error).replace("nearest=True", "--nearest")
        raise ValueError(words) from error
    print(f"{options.out}: {written}")
    return 0


def _target(options: Options) -> Target:
    """The format from `--to`, or else from the file's suffix."""
    to = options.to or BY_SUFFIX.get(options.out.suffix.lower())
    if to is None:
        raise ValueError(
            f"out: expected a name that ends in {', '.join(BY_SUFFIX)}, or --to, got "
            f"{options.out.name}"
        )
    return to


def _export(options: Options, to: Target) -> str:
    """Write the file and return a description of its contents."""
    folder = Path(options.fit)
    mesh = _mesh_in(folder)
    if mesh is not None:
        return _export_mesh(mesh, options, to)
    if not (folder / RECORD_FILE).is_file():
        if to in ("obj", "ply", "stl") or options.surface:
            raise ValueError(
                f"{options.fit}: expected the folder of `phongfit maps` for a surface: "
                "a material has none"
            )
        return _export_material(options, to)
    _check_maps(folder, options, to)
    return export_maps(
        folder,
        options.out,
        to,
        nearest=options.nearest,
        surface=options.surface,
        distance=options.distance,
    )


def _mesh_in(source: Path) -> Path | None:
    """Path of a mesh, given directly or by the folder of a fit of textures."""
    if source.is_file() and source.suffix.lower() in MESHES:
        return source
    fitted = source / MESH_FILE
    return fitted if fitted.is_file() else None


def _export_mesh(mesh: Path, options: Options, to: Target) -> str:
    """Convert a mesh with its materials and textures to another format."""
    # Imported here, since SciPy takes long to import.
    from phongfit.files.meshes import load_mesh

    for name in ("scene", "surface", "distance"):
        if getattr(options, name):
            raise ValueError(f"{name}: expected none, since {mesh} is a mesh")
    if to not in ("gltf", "usd", "obj", "stl"):
        raise ValueError(f"to: expected gltf, usd, obj or stl for a mesh, got {to}")
    loaded = load_mesh(mesh)
    save_mesh(options.out, *loaded, nearest=options.nearest)
    return f"{mesh.name}, {len(loaded.names)} materials"


def _check_maps(folder: Path, options: Options, to: Target) -> None:
    if to in ("json", "opengl"):
        raise ValueError(
            f"to: {to} holds one material, {folder} holds maps; mtl and gltf "
            "know textures"
        )
    if to == "usd":
        raise ValueError(f"to: expected mtl, gltf, obj, ply or stl for maps, got {to}")
    if options.scene is not None:
        raise ValueError("scene: expected none, since maps lie on their picture")


class Job(NamedTuple):
    """Materials to write, as given and converted to Blinn's, with names and options."""

    names: list[str]
    given: list[Material]
    blinn: list[Material]
    model: AbstractSpecular
    to: Target
    options: Options


def _export_material(options: Options, to: Target) -> str:
    source = Path(options.fit)
    is_fit = (source / FIT_FILE).is_file()
    if source.is_dir() and not is_fit:
        raise ValueError(f"{source}: holds neither a {FIT_FILE} nor a {RECORD_FILE}")
    read = read_material(str(source / FIT_FILE) if is_fit else options.fit)
    _WRITERS[to](_job(read, options, to))
    return read.name


def _job(read: NamedMaterial, options: Options, to: Target) -> Job:
    given = unstack_materials(read.material)
    model = read.model or BlinnPhong()
    name = " ".join(read.name.replace("#", " ").split()) or "material"
    names = [name] if len(given) == 1 else [f"{name}-{k}" for k in range(len(given))]
    return Job(
        names, given, [as_blinn(one, model) for one in given], model, to, options
    )


def _write_mtl(job: Job) -> None:
    materials = dict(zip(job.names, job.blinn, strict=True))
    write_mtl(job.options.out, materials, nearest=job.options.nearest)


def _single(job: Job) -> str:
    """The name of the only material, for formats that hold a single one."""
    if len(job.given) != 1:
        raise ValueError(
            f"to: expected one material for {job.to}, got {len(job.given)}; "
            "mtl, gltf and usd hold several"
        )
    return job.names[0]


def _write_json(job: Job) -> None:
    write_material(job.options.out, _single(job), job.given[0], job.model)


def _write_opengl(job: Job) -> None:
    name, nearest = _single(job), job.options.nearest
    write_opengl(job.options.out, name, job.blinn[0], nearest=nearest)


def _write_surface(job: Job) -> None:
    """Write the scene's surface, or a sphere, with the materials."""
    out, scene = job.options.out, job.options.scene
    wanted = [suffix for suffix, to in BY_SUFFIX.items() if to == job.to]
    if out.suffix.lower() not in wanted:
        raise ValueError(
            f"{out}: expected suffix {' or '.join(wanted)}, got {out.suffix!r}"
        )
    surface = Sphere() if scene is None else load_scene(scene).surface
    count, material = len(job.blinn), job.blinn[0]
    mesh = surface_mesh(surface, several=count > 1)
    if count != mesh.materials:
        raise ValueError(
            f"scene: expected {mesh.materials} materials for its surface, got {count}"
        )
    if count > 1:
        material = stack_materials(job.blinn)
    save_mesh(out, mesh, material, job.names, nearest=job.options.nearest)


_WRITERS: dict[Target, Callable[[Job], None]] = {
    "mtl": _write_mtl,
    "gltf": _write_surface,
    "usd": _write_surface,
    "json": _write_json,
    "opengl": _write_opengl,
}


def surface_mesh(surface: AbstractSurface, several: bool) -> Mesh:
    """A surface as triangles without textures; a unit sphere if it is no solid.

    **Arguments:** `several`: keep the materials of a mesh apart.
    """
    center = np.zeros(3)
    if not isinstance(surface, Mesh):
        ball = surface if isinstance(surface, Sphere) else Sphere()
        surface, center = Ball(float(ball.radius)).mesh(96, 48), np.asarray(ball.center)
    index = surface.material_index if several else None
    places, normals = np.asarray(surface.vertices) + center, surface.vertex_normals()
    return Mesh(places, surface.faces, normals, index)
