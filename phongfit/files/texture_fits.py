"""A folder of fitted textures: arrays for programs, and a mesh for viewers.

`textures.npz` has each texture NAME, (layers, rows, columns, 3), or with 1 channel for
exponents; its standard errors `stderr_NAME`, infinite where no photograph identifies a
texel; and `seen`, the number of pixels that see each texel, (layers, rows, columns).
For vertices, one axis of length V replaces rows and columns, in the order of the
scene's mesh. `textures.json` has the settings and all other numbers. `mesh.glb` is the
mesh with its material and textures.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.arguments import describe
from phongfit.files.fits import DataRecord, made_with
from phongfit.files.limits import as_blinn, lost
from phongfit.files.mesh_saving import save_mesh
from phongfit.files.outputs import replacing, write_json
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texels.sums import Grid
from phongfit.geometry.meshes import Mesh
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular
from phongfit.scene import Scene
from phongfit.textures import Textures

TEXTURES_FORMAT = "phongfit textures"
RECORD_FILE = "textures.json"
ARRAYS_FILE = "textures.npz"
MESH_FILE = "mesh.glb"


def save_texture_fit(
    folder: Path,
    found: TextureFit,
    scene: Scene,
    *,
    data: DataRecord,
    settings: dict[str, Any],
) -> None:
    """Write fitted textures into an existing folder, in the files listed above.

    Texels that are not identified are filled only in `mesh.glb`: see
    [`TextureFit`][]`.filled`.

    **Arguments:** `scene`: of one of the photographs; `settings`: of the fit.

    **Raises:** `OSError` that names the file.
    """
    arrays = {"seen": found.seen}
    for name in found.names:
        arrays |= {name: found.values[name], f"stderr_{name}": found.stderr[name]}
    with replacing(folder / ARRAYS_FILE) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)
    # Parts that glTF cannot hold, such as ambient textures, give a warning.
    save_mesh(folder / MESH_FILE, *_as_blinn(found, scene), nearest=True)
    write_json(folder / RECORD_FILE, _record(found, scene, data, settings))


def _as_blinn(found: TextureFit, scene: Scene) -> tuple[Mesh, Material]:
    """The mesh and its material, converted to the un-normalised Blinn-Phong model.

    The factor of ρ_s depends on f, so it differs between texels if f does.
    """
    surface, model = found.scene(scene).surface, scene.specular_model
    assert isinstance(surface, Mesh) and surface.textures is not None
    material = as_blinn(found.material, model)
    if "shininess" not in found.names:
        return surface, material
    textures = [_blinn_textures(one, model) for one in surface.textures]
    whole = dataclasses.replace(
        material, specular=found.material.specular, shininess=found.material.shininess
    )
    return surface.with_textures(textures), whole


def _blinn_textures(own: Textures, model: AbstractSpecular) -> Textures:
    f, rho = own.shininess, own.specular
    assert f is not None
    one = as_blinn(Material(specular=1.0, shininess=np.asarray(f.values)), model)
    made = f.with_values(one.shininess)
    # 1 where the model is Blinn's or Phong's.
    factor = np.asarray(one.specular, float)
    if (factor == 1).all():
        return dataclasses.replace(own, shininess=made)
    if rho is None:
        rho = f.of_ones()
    if rho.values.shape[:-1] != factor.shape[:-1]:
        lost("specular: its texture is not as large as the exponent's", nearest=True)
        factor = np.exp(np.log(factor).mean())
    scaled = rho.with_values(factor * np.asarray(rho.values, float))
    return dataclasses.replace(own, specular=scaled, shininess=made)


def _record(
    found: TextureFit, scene: Scene, data: DataRecord, settings: dict[str, Any]
) -> dict[str, Any]:
    identified = {
        name: int(np.isfinite(found.stderr[name]).all(axis=-1).sum())
        for name in found.names
    }
    known = {
        field.name: getattr(found.material, field.name)
        for field in dataclasses.fields(found.material)
        if field.name not in found.names
    }
    return {
        "format": TEXTURES_FORMAT,
        "version": 1,
        "data": data.model_dump(),
        "settings": settings,
        "model": describe(scene.specular_model),
        "textures": found.names,
        "texels": found.seen.size,
        "seen": int((found.seen > 0).sum()),
        "identified": identified,
        "wrap": found.texels.wrap if isinstance(found.texels, Grid) else None,
        "material": known,
        "labels": [one.label for one in found.shared],
        "values": [one.value for one in found.shared],
        "errors": [one.stderr for one in found.shared],
        "covariance": found.covariance,
        "noise": found.noise,
        "n_samples": found.n_samples,
        "n_images": len(found.residuals),
        "misfit_significance": found.misfit.significance,
        "converged": found.converged,
        "steps": found.steps,
        "warnings": found.warnings,
        "made_with": made_with(),
    }
