"""`phongfit export`: a material for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from phongfit.commands.fit import FIT_FILE
from phongfit.commands.options import OutFile, optional, refuse
from phongfit.files.inputs import sparing
from phongfit.files.limits import as_blinn
from phongfit.files.materials import read_material, write_material
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
from phongfit.reflectance import BlinnPhong

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
    out: OutFile
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
    if to not in ("gltf", "usd"):
        why = f"expected none, since {to} holds no shape; gltf and usd do"
        refuse(options, "scene", why)
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
    suffix = options.out.suffix.lower()
    to = options.to or BY_SUFFIX.get(suffix)
    if to is None:
        raise ValueError(
            f"out: expected a name that ends in {', '.join(BY_SUFFIX)}, or --to, got "
            f"{options.out.name}"
        )
    own = [name for name, kind in BY_SUFFIX.items() if kind == to]
    if to not in ("mtl", "json", "opengl") and suffix not in own:
        raise ValueError(f"out: expected suffix {' or '.join(own)}, got {suffix!r}")
    return to


def _export(options: Options, to: Target) -> str:
    """Write the file and return a description of its contents."""
    source = Path(options.fit)
    mesh = source if source.is_file() else source / MESH_FILE
    if mesh.is_file() and mesh.suffix.lower() in MESHES:
        return _export_mesh(mesh, options, to)
    if (source / RECORD_FILE).is_file():
        return _export_maps(source, options, to)
    if to in ("obj", "ply", "stl") or options.surface:
        raise ValueError(
            f"{options.fit}: expected the folder of `phongfit maps` for a surface: a "
            "material has none"
        )
    return _export_material(options, to)


def _export_mesh(mesh: Path, options: Options, to: Target) -> str:
    """Convert a mesh with its materials and textures to another format."""
    # Imported here, since SciPy takes long to import.
    from phongfit.files.meshes import load_mesh

    refuse(options, "scene surface distance", f"expected none, since {mesh} is a mesh")
    if to not in ("gltf", "usd", "obj", "stl"):
        raise ValueError(f"to: expected gltf, usd, obj or stl for a mesh, got {to}")
    loaded = load_mesh(mesh)
    save_mesh(options.out, *loaded, nearest=options.nearest)
    return f"{mesh.name}, {len(loaded.names)} materials"


def _export_maps(folder: Path, options: Options, to: Target) -> str:
    if to not in ("mtl", "gltf", "obj", "ply", "stl"):
        why = "" if to == "usd" else f": {to} holds one material"
        wanted = "mtl, gltf, obj, ply or stl"
        raise ValueError(f"to: expected {wanted} for maps, got {to}{why}")
    refuse(options, "scene", "expected none, since maps lie on their picture")
    return export_maps(
        folder,
        options.out,
        to,
        nearest=options.nearest,
        surface=options.surface,
        distance=options.distance,
    )


def _export_material(options: Options, to: Target) -> str:
    """Write one or several materials, converted to Blinn's model except for json."""
    source, out, nearest = Path(options.fit), options.out, options.nearest
    is_fit = (source / FIT_FILE).is_file()
    if source.is_dir() and not is_fit:
        raise ValueError(f"{source}: holds neither a {FIT_FILE} nor a {RECORD_FILE}")
    read = read_material(str(source / FIT_FILE) if is_fit else options.fit)
    given, model = unstack_materials(read.material), read.model or BlinnPhong()
    if to in ("json", "opengl") and len(given) != 1:
        raise ValueError(
            f"to: expected one material for {to}, got {len(given)}; mtl, gltf and usd "
            "hold several"
        )
    name = " ".join(read.name.replace("#", " ").split()) or "material"
    names = [name] if len(given) == 1 else [f"{name}-{k}" for k in range(len(given))]
    if to == "json":
        write_material(out, name, given[0], model)
        return read.name
    blinn = [as_blinn(one, model) for one in given]
    if to == "mtl":
        write_mtl(out, dict(zip(names, blinn, strict=True)), nearest=nearest)
    elif to == "opengl":
        write_opengl(out, name, blinn[0], nearest=nearest)
    else:
        _write_surface(options, names, blinn)
    return read.name


def _write_surface(
    options: Options, names: list[str], materials: list[Material]
) -> None:
    """Write the scene's surface, or a sphere, with the materials."""
    surface = Sphere() if options.scene is None else load_scene(options.scene).surface
    count, material = len(materials), materials[0]
    mesh = surface_mesh(surface, several=count > 1)
    if count != mesh.materials:
        raise ValueError(
            f"scene: expected {mesh.materials} materials for its surface, got {count}"
        )
    if count > 1:
        material = stack_materials(materials)
    save_mesh(options.out, mesh, material, names, nearest=options.nearest)


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
