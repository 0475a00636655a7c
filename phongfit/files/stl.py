"""STL files: triangles without materials, in text or binary.

??? cite "Source"
    3D Systems, *StereoLithography interface specification*, 1988.
"""

import re
import struct
from pathlib import Path

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.inputs import Note, read_bytes
from phongfit.files.mesh_parts import UNNAMED, MeshPart
from phongfit.files.mtl_textures import Shaded

MEMORY = 16
"""Memory that reading takes, as a multiple of the file's size (measured)."""

HEAD = 84
ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path, note: Note) -> list[MeshPart]:
    """Triangles of an STL file, as one part whose equal corners will be merged.

    **Arguments:** `note`: called with a sentence for each unused part of the file.

    **Raises:** `ValueError` if the file is broken or truncated.
    """
    data = read_bytes(path)
    afford(MEMORY * len(data), "triangles")
    count = struct.unpack_from("<I", data, HEAD - 4)[0] if len(data) >= HEAD else -1
    if len(data) == HEAD + ROW.itemsize * count:
        rows = np.frombuffer(data, ROW, count, HEAD)
        if rows["more"].any():
            note("attributes of its triangles, colours of some programs, are not used")
        corners = rows["corners"].reshape(-1, 3).astype(float)
    else:
        corners = _corners_of_text(data)
    faces = np.arange(len(corners)).reshape(-1, 3)
    groups = np.zeros(len(corners), int)
    part = MeshPart(corners, faces, UNNAMED, Shaded(), groups=groups)
    return [part] if len(faces) else []


def _corners_of_text(data: bytes) -> np.ndarray:
    words = VERTEX.findall(data)
    facets = len(re.findall(rb"endfacet", data, re.IGNORECASE))
    try:
        corners = np.array(words, dtype=object).reshape(-1, 3).astype(float)
    except ValueError:
        corners = None
    if corners is None or len(corners) != 3 * facets or b"\0" in data:
        raise ValueError(
            "is broken or truncated: expected a binary file of its length, or text "
            "with three vertices for each facet"
        )
    return corners
