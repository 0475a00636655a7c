"""Result of a fit of textures."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.fitting.texels.job import Job
from phongfit.fitting.texels.sums import AbstractTexels
from phongfit.fitting.uncertainty.misfit import Misfit
from phongfit.geometry.meshes import Mesh
from phongfit.material import Material
from phongfit.scene import Scene
from phongfit.textures import Textures

CHANNELS = ("red", "green", "blue")


class Shared(NamedTuple):
    """A number that a whole material shares, and its standard error."""

    label: str
    value: float
    stderr: float


def as_textures(job: Job, vectors: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Each parameter's texels, (layers, rows, columns, 3), or (…, 1) for exponents.

    **Arguments:** `vectors`: one for each system, ordered as in [`Job.vectors`][].
    """
    whole = np.concatenate(vectors).reshape(-1, *job.grid.shape)
    fields = [field.name for fields in job.systems for field in fields]
    return {
        name: np.moveaxis(whole[[own == name for own in fields]], 0, -1)
        for name in job.names
    }


@dataclasses.dataclass(frozen=True, eq=False)
class TextureFit:
    """Textures that [`fit_texture`][] found, with errors.

    **Arguments:**

    - `values`: each textured parameter's texels, (layers, rows, columns, 3), or
        (layers, rows, columns, 1) for exponents. There is one layer, or one for each
        material. For vertices, here and below, V replaces rows and columns.
    - `stderr`: standard errors of `values`, infinite for texels that the photographs do
        not identify, since no pixel or too few see them.
    - `seen`: number of pixels that see each texel, (layers, rows, columns).
    - `material`: parameters without texture, with a row for each material. Textured
        parameters are 1.
    - `shared`: unknowns among these: label, value, standard error.
    - `covariance`: covariance of `shared`, in its order; an exponent's entries are for
        log f.
    - `names`: the textured parameters.
    - `noise`: estimated standard deviation of a sample, in linear light; 1 if noise was
        given.
    - `n_samples`: number of samples that are not clipped.
    - `residuals`: photograph − model for each image, (height, width, 3).
    - `misfit`: test whether the residuals are noise.
    - `converged`, `steps`: whether the solver converged, and its number of steps.
    - `warnings`: problems, how large they are, and what to try.
    - `texels`: places of texels on the mesh: a grid, or the vertices.
    """

    values: dict[str, np.ndarray]
    stderr: dict[str, np.ndarray]
    seen: np.ndarray
    material: Material
    shared: tuple[Shared, ...]
    covariance: np.ndarray
    names: tuple[str, ...]
    noise: float
    n_samples: int
    residuals: tuple[np.ndarray, ...]
    misfit: Misfit
    converged: bool
    steps: int
    warnings: tuple[str, ...]
    texels: AbstractTexels

    def scene(self, scene: Scene) -> Scene:
        """A scene of the same mesh, with the fitted textures.

        Texels that are not identified are filled as in [`TextureFit.filled`][].

        **Raises:** `ValueError` if the scene's surface is not such a [`Mesh`][].
        """
        self.texels.check(scene.surface)
        assert isinstance(scene.surface, Mesh)
        textures = self.textures(scene.surface.textures)
        surface = scene.surface.with_textures(textures)
        return dataclasses.replace(scene, surface=surface)

    def textures(self, known: tuple[Textures, ...] | None = None) -> list[Textures]:
        """Fitted textures, filled, together with the known textures."""
        before = known or (Textures(),)
        filled = {name: self.filled(name) for name in self.names}
        layers = max(len(self.seen), len(before))

        def of(layer: int) -> Textures:
            found: dict[str, Any] = {
                name: self.texels.texture(values[min(layer, len(values) - 1)])
                for name, values in filled.items()
            }
            return dataclasses.replace(before[min(layer, len(before) - 1)], **found)

        return [of(layer) for layer in range(layers)]

    def filled(self, name: str) -> Float[np.ndarray, "layers *places channels"]:
        """A texture whose unidentified texels are the nearest identified ones."""
        known = np.isfinite(self.stderr[name])
        each = zip(self.values[name], known, strict=True)
        return np.stack([self.texels.filled(*layer) for layer in each])

    def __str__(self) -> str:
        texels, count = self.seen.size, len(self.residuals)
        images = f"{count} image{'s' * (count > 1)}"
        lines = [
            f"phongfit: {images}, {self.n_samples:,} samples",
            f"  {'converged' if self.converged else 'did not converge'} after "
            f"{self.steps} steps; noise {self.noise:.3g}",
        ]
        for name in self.names:
            errors = self.stderr[name]
            known = np.isfinite(errors)
            median = np.median(errors[known]) if known.any() else np.inf
            share = known.all(axis=-1).sum()
            lines.append(
                f"  {name}: {share:,} of {texels:,} {self.texels.word} identified, "
                f"median standard error {median:.2g}"
            )
        lines += [
            f"  {one.label:20} {one.value:12.5g}  ± {one.stderr:8.2g}"
            for one in self.shared
        ]
        return "\n".join([*lines, *(f"  warning: {words}" for words in self.warnings)])
