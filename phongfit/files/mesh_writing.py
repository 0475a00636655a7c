"""Write triangles: OBJ that refers to an .mtl, PLY with vertex colours, and STL."""

import os
from typing import Any

import numpy as np
from jaxtyping import UInt

from phongfit.files.gltf import Part
from phongfit.files.outputs import replacing


def obj_text(part: Part, library: str, material: str) -> str:
    """The text of a Wavefront .obj of a part with normals and uv.

    **Arguments:** `library`: name of the .mtl; `material`: name of the material in it.
    """
    assert part.normals is not None and part.uv is not None
    # In OBJ v points up.
    uv = part.uv * [1, -1] + [0, 1]
    numbers = part.faces + 1
    corners = np.repeat(numbers.reshape(-1, 3), 3, axis=1)
    return "\n".join(
        [
            f"mtllib {library}",
            *lines("v %.7g %.7g %.7g", part.positions),
            *lines("vt %.7g %.7g", uv),
            *lines("vn %.5f %.5f %.5f", part.normals),
            f"usemtl {material}",
            *lines("f %d/%d/%d %d/%d/%d %d/%d/%d", corners),
            "",
        ]
    )


def lines(form: str, rows: Any) -> list[str]:
    """Rows of numbers as lines of text, by a % format."""
    return [form % tuple(row) for row in np.asarray(rows).tolist()]


def write_ply(
    path: str | os.PathLike[str], part: Part, colours: UInt[np.ndarray, "vertices 3"]
) -> None:
    """Write a binary .ply of a part, with 8-bit colours of its vertices.

    **Raises:** `OSError` that names `path`.
    """
    mesh = _triangles(part, vertex_normals=part.normals, vertex_colors=colours)
    _write(path, mesh.export(file_type="ply", vertex_normal=True))


def write_stl(path: str | os.PathLike[str], part: Part) -> None:
    """Write a binary .stl of a part's triangles.

    **Raises:** `OSError` that names `path`.
    """
    _write(path, _triangles(part).export(file_type="stl"))


def _triangles(part: Part, **more: Any) -> Any:
    # Imported here, since trimesh takes long to import.
    import trimesh

    return trimesh.Trimesh(part.positions, part.faces, process=False, **more)


def _write(path: str | os.PathLike[str], content: Any) -> None:
    assert isinstance(content, bytes)
    with replacing(path) as temporary:
        temporary.write_bytes(content)
