"""`python -m experiments.conformance [FOLDER…]`: do other renderers agree?

Every scene of the folders (see `experiments.references` for their files; by default
those that come with the project, 6 by Mesa and 2 by POV-Ray) is rendered and compared
with the image that OpenGL or POV-Ray made of it. It agrees where

- light at the vertices, if the reference has it, is the same to 1e-5;
- 99.9 % of the pixels that both cover differ by no more than 1e-4 (OpenGL), or 2/255
  (POV-Ray, whose shadows have edges), and by less than 1e-5 in the median;
- both cover the same 99.9 % of the image.

Result, x86-64, November 2026, float32 and float64: all of 12 scenes by Mesa 22.3 and 4
by POV-Ray 3.7 agree. Worst of Mesa: vertices 6.4e-6, median 3.6e-7, 99.969 % within the
bound, coverage 99.995 %; worst of POV-Ray: median 6.1e-6, which is the rounding of 16
bits, 99.993 % within the bound, coverage 100 %.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro

import phongfit as pf
from experiments.references import (
    KEPT,
    Reference,
    covered_pixels,
    find_references,
    read_reference,
)
from phongfit.cli import run
from phongfit.files.outputs import check_file, write_json

VERTEX_BOUND = 1e-5
"""Largest difference of light at a vertex, where 1 is white."""

MEDIAN_BOUND = 1e-5
"""Largest median difference of the pixels."""

SHARE_BOUND = 0.999
"""Smallest fraction of the pixels within their bound, and of those covered alike."""


class Agreement(NamedTuple):
    """Differences between phongfit's image and a reference's, where 1 is white.

    - `vertex_colors`: largest difference of light at vertices; `None` if the reference
        has none;
    - `median`, `quantile_999`: of the pixels' differences, each the largest of its
        channels;
    - `bound`: difference of a pixel that counts as agreement; `within`: fraction of the
        pixels within it;
    - `coverage`: fraction of the image that both cover or both leave.
    """

    name: str
    vertex_colors: float | None
    median: float
    quantile_999: float
    bound: float
    within: float
    coverage: float

    @property
    def agrees(self) -> bool:
        """Whether all differences are within the bounds of the module's docstring."""
        return (
            (self.vertex_colors is None or self.vertex_colors <= VERTEX_BOUND)
            and self.median < MEDIAN_BOUND
            and self.within >= SHARE_BOUND
            and self.coverage >= SHARE_BOUND
        )

    def line(self, width: int) -> str:
        """A line of the table, whose first column has `width` letters."""
        vertices = (
            "      –" if self.vertex_colors is None else f"{self.vertex_colors:7.1e}"
        )
        return (
            f"{self.name:{width}}  {vertices}  {self.median:7.1e}  "
            f"{self.quantile_999:7.1e}  "
            f"{100 * self.within:7.3f} % ≤ {self.bound:.1e}  "
            f"{100 * self.coverage:7.3f} %  "
            f"{'agrees' if self.agrees else 'FALLS SHORT'}"
        )


def head(width: int) -> str:
    """Column titles for [`Agreement.line`][] of the same `width`."""
    return (
        f"{'scene':{width}}  {'vertex':>7}  {'median':>7}  {'q 99.9':>7}  "
        f"{'within bound':>19}  {'coverage':>9}"
    )


def compare(reference: Reference) -> Agreement:
    """Render a reference's scene, and compare the images.

    **Raises:** `ValueError` that names the reference, if the images differ in size or
    no pixel can be compared.
    """
    scene, material = reference.scene, reference.material
    gbuffer = scene.trace()
    image = pf.render(scene, material, film=reference.film, gbuffer=gbuffer)
    image = np.asarray(image, float)
    if image.shape != reference.image.shape:
        raise ValueError(
            f"{reference.name}: expected shape {image.shape}, got "
            f"{reference.image.shape}"
        )
    mask = np.asarray(gbuffer.mask)
    if reference.vertex_colors is None:
        # A ray tracer gives no coverage: both are where an image differs from its
        # background.
        mask = covered_pixels(image, np.asarray(scene.background))
        compared = mask | reference.covered
    else:
        compared = mask & reference.covered
    error = abs(image - reference.image).max(axis=-1)[compared]
    if error.size == 0:
        raise ValueError(f"{reference.name}: there is no pixel that both cover")
    return Agreement(
        name=reference.name,
        vertex_colors=_vertex_error(reference, gbuffer),
        median=float(np.median(error)),
        quantile_999=float(np.quantile(error, 0.999)),
        bound=reference.bound,
        within=float((error <= reference.bound).mean()),
        coverage=float((mask == reference.covered).mean()),
    )


def _vertex_error(reference: Reference, gbuffer: pf.geometry.GBuffer) -> float | None:
    """Largest difference of light at the vertices; `None` if the reference has none."""
    expected = reference.vertex_colors
    if expected is None:
        return None
    # With flat and Gouraud shading, `terms` are at vertices, not at pixels.
    light = pf.rendering.combine(pf.terms(reference.scene, gbuffer), reference.material)
    lit = np.asarray(reference.film.expose(light), float)
    return float(abs(lit - expected.colors).max())


@dataclass(frozen=True)
class Options:
    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[FOLDER…]")
    ] = KEPT
    """Each with the NAME.json and NAME.npz of any number of scenes."""

    json: Path | None = None
    """File to write the numbers to as well."""


def main(options: Options) -> int:
    """Do other renderers see what phongfit does?

    Renders every scene of the folders, compares it with the image that OpenGL or
    POV-Ray made of it, and prints a line: the largest difference of light at the
    vertices, if the reference has it; median and 99.9 % quantile of the differences
    between pixels; the share of pixels within the bound; the share of the image that
    both cover or both leave. Exits with 1 if a scene falls short, and with 2 if a
    folder cannot be read.
    """
    if options.json is not None:
        check_file(options.json)
    paths = [path for folder in options.folders for path in find_references(folder)]
    width = max(len(str(path.with_suffix(""))) for path in paths)
    print(head(width))
    agreements = []
    for path in paths:
        reference = read_reference(path)._replace(name=str(path.with_suffix("")))
        agreements.append(compare(reference))
        print(agreements[-1].line(width), flush=True)
    n_failed = sum(not agreement.agrees for agreement in agreements)
    print(f"{len(agreements) - n_failed} of {len(agreements)} scenes agree")
    if options.json is not None:
        fields = [one._asdict() | {"agrees": one.agrees} for one in agreements]
        write_json(options.json, {"scenes": fields, "agree": n_failed == 0})
    return int(n_failed > 0)


if __name__ == "__main__":
    sys.exit(run(main, prog="python -m experiments.conformance"))
