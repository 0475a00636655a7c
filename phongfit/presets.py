"""The 24 classic OpenGL materials, as numbers: the rows of `presets.csv`.

??? cite "Source"
    The table of the OpenGL programming guide's `material` example and of
    M. J. Kilgard's teapots; shininess is 128 times the table's last column.
"""

import csv
from pathlib import Path

Numbers = tuple[float, ...]


def _read(path: Path) -> dict[str, tuple[Numbers, Numbers, Numbers, float]]:
    """Ambient, diffuse and specular reflectance, and shininess, by name."""
    with path.open(newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    materials = {}
    for name, *words in rows:
        numbers = tuple(map(float, words))
        materials[name] = numbers[:3], numbers[3:6], numbers[6:9], numbers[9]
    return materials


OPENGL_MATERIALS = _read(Path(__file__).with_suffix(".csv"))
