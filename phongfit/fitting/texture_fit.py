"""`fit_texture`: photographs and geometry in, texels with errors out.

For given exponents the light is linear in the texels and in the shared parameters of a
material, so Gauss-Newton steps solve for all of them together. Texels of exponents need
damped steps.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, Unpack

import jax.numpy as jnp
import numpy as np

from phongfit.checks import as_floats, untraced
from phongfit.edge import checked
from phongfit.fitting.problem.inputs import as_photographs, as_scenes
from phongfit.fitting.problem.noise import arithmetic_floor
from phongfit.fitting.problem.parameters import TEXTURE
from phongfit.fitting.problem.posing import find_films
from phongfit.fitting.problem.specification import (
    Specification,
    SpecificationOptions,
    specified,
)
from phongfit.fitting.texels.job import Few, Job
from phongfit.fitting.texels.judged import judge
from phongfit.fitting.texels.lit import BASIS, Photographs, without
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texels.steps import find_start, solve
from phongfit.fitting.texels.sums import AbstractTexels, Grid
from phongfit.fitting.texels.vertices import Vertices, as_mesh
from phongfit.material import Material
from phongfit.moved import warn_deprecated
from phongfit.scene import Scene
from phongfit.textures import Filter, Wrap

TEXTURED = ("ambient", "diffuse", "specular", "shininess")
"""Parameters that may have a texture."""

MAX_STEPS = 30
"""Largest number of steps by default. Most fits need a few, each over all texels."""

_DEFAULT = Specification(
    unknowns=(f"diffuse{TEXTURE}", "specular", "shininess"), max_steps=MAX_STEPS
)


@checked
def fit_texture(
    scene: Scene | Sequence[Scene],
    image: Any,
    specification: Specification | None = None,
    *,
    size: tuple[int, int] | Literal["vertices"],
    separate: bool = False,
    smoothness: float | None = None,
    filter: Filter = "bilinear",
    wrap: Wrap = "repeat",
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
    textures: Sequence[str] | None = None,
    **options: Unpack[SpecificationOptions],
) -> TextureFit:
    r"""Textures that explain photographs of a mesh, texel by texel, with errors.

    Minimises $\sum_i w_i (I_i - t_i)^2 / \sigma^2$ over the texels of the reflectances,
    within 0 … 1, of the exponents, within 1 … 1000, and over the parameters that all
    points of a material share. The photographs may show the surface from any places,
    under any lamps.

    **Arguments:**

    - `scene`: a scene, or a sequence of scenes, of one [`Mesh`][]; for textures that
        are images it must have uv. Other textures of the mesh are known, and apply as
        usual.
    - `image`: as in [`fit`][].
    - `specification`: the options below from `unknowns` on, for several calls. Those
        that are given beside it replace its own. Other options of [`fit`][] must have
        their defaults.
    - `size`: rows and columns of the fitted textures; or `"vertices"`: a value for each
        vertex of the mesh, as in [`VertexColours`][].
    - `separate`: whether each material has its own texture; default one for all.
    - `smoothness`: standard deviation of differences between neighbouring texels, as a
        prior, which softens sharp edges; default no such prior. For exponents it is
        that of log f: 0.05 means differences of 5 %.
    - `filter`, `wrap`: as in [`Texture`][].
    - `mask`, `weights`, `noise`: as in [`fit`][].
    - `unknowns`: parameters with a value for each texel and channel, some of
        `"ambient.texture"`, `"diffuse.texture"`, `"specular.texture"`, and
        `"shininess.texture"`, which has one value for all channels; and, without the
        suffix, parameters with one value for each material. Default: the texture of
        diffuse reflectance, specular reflectance and exponent. Textures of exponents
        need lamps at many angles: a texel without a lamp near its mirror direction does
        not determine its exponent.
    - `per_channel`: the unknowns of a material with separate values for red, green and
        blue.
    - `known`: the parameters that are not unknown; default reflectances of 0 and an
        exponent of 32. For M materials, parameters have shape (M, 3), (M, 1), or less.
    - `film`: as in [`fit`][].
    - `max_steps`: limit on Gauss-Newton steps, or with exponents on Levenberg-Marquardt
        steps; default 20.
    - `textures`: the older spelling of unknowns with the suffix; it goes with 0.4.

    Each texel has a prior of 0.5 ± 1, which matters only where the photographs contain
    almost no information. A texel with an error above 0.5 is not identified, and its
    error is infinite. The prior of an exponent is $\log f = \log f_0 \pm 1$, with the
    $f_0$ that fits all texels best, or all of a material if `separate`. A texel without
    a highlight does not identify its exponent. A sample between texels has the mean of
    their f, as in a render. The model does not average over a pixel, so a texture
    should not be finer than the photographs.

    **Returns:** a [`TextureFit`][].

    **Raises:** `ValueError` that names the argument.
    """
    untraced("fit outside", scene=scene, image=image, noise=noise)
    options = _with_suffix(textures, options, specification)
    asked = specified(specification, options, "fit outside", _DEFAULT)
    others = "per_image bounds fixed ties priors uncertain loss tolerance"
    asked.refuse(others, "fit_texture")
    names = textures_among(asked.unknowns)
    few_names = tuple(n for n in asked.unknowns if not n.endswith(TEXTURE))
    _check_names(names, few_names)
    scenes = as_scenes(scene)
    observed = as_photographs(
        scene if isinstance(scene, Scene) else scenes, image, mask, weights, noise
    )
    films = find_films(asked.film, observed)
    if smoothness is not None and not 0 < smoothness < np.inf:
        raise ValueError(f"smoothness: expected a number > 0, got {smoothness}")
    materials = scenes[0].surface.materials
    grid = _texels(size, materials if separate else 1, scenes[0], filter, wrap)
    for one in scenes:
        grid.check(one.surface)
    per_channel = {*asked.per_channel} - {"shininess"}
    few = [
        Few(name, material, channel)
        for name in few_names
        for material in range(materials)
        for channel in (range(3) if name in per_channel else [None])
    ]
    observed = tuple(
        dataclasses.replace(one, scene=without(one.scene, names)) for one in observed
    )
    job = Job(
        Photographs(observed, films, grid),
        names,
        few,
        films[0].clamp,
        None if smoothness is None else 1 / smoothness**2,
        # Smaller residuals are rounding errors of the arithmetic, or irrelevant.
        max(float(arithmetic_floor(jnp.asarray(one.used()))) for one in observed)
        if noise is None
        else 0.01,
        any(one.jpeg is not None for one in films),
    )
    if not any(len(one.place) for one in job.images):
        raise ValueError("mask: it leaves no pixel that sees the surface")
    numbers = _numbers(asked.known, materials)
    start, sigma = find_start(job, numbers, noise is not None)
    state, sigma, system, converged, steps = solve(
        job, start, sigma, noise is not None, asked.max_steps
    )
    return judge(job, state, sigma, system, noise is not None, converged, steps)


def _texels(
    size: Any, layers: int, scene: Scene, filter: Filter, wrap: Wrap
) -> AbstractTexels:
    """The texels to fit: a grid, or the vertices of the mesh."""
    if isinstance(size, str):
        if size != "vertices":
            raise ValueError(
                f"size: expected rows and columns, or 'vertices', got {size!r}"
            )
        if (filter, wrap) != ("bilinear", "repeat"):
            raise ValueError("filter, wrap: expected none of vertices")
        mesh = as_mesh(scene.surface)
        points = np.asarray(mesh.vertices, float)
        return Vertices(layers, points, np.asarray(mesh.faces))
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"size: expected rows and columns, or 'vertices', got {size}")
    rows, columns = size
    return Grid(layers, rows, columns, wrap, filter)


def textures_among(unknowns: Sequence[str]) -> tuple[str, ...]:
    """Parameters whose textures are among the unknowns."""
    return tuple(n.removesuffix(TEXTURE) for n in unknowns if n.endswith(TEXTURE))


def _with_suffix(
    textures: Sequence[str] | None,
    options: SpecificationOptions,
    specification: Specification | None,
) -> SpecificationOptions:
    """The options, with names of textures that were given without the suffix."""
    unknowns = options.get("unknowns")
    if textures is not None and specification is not None:
        raise ValueError(
            f"textures: expected none beside a specification; write unknowns with "
            f"{TEXTURE}"
        )
    if textures is None:
        given = unknowns is not None and specification is None
        if not given or textures_among(unknowns or ()):
            return options
    warn_deprecated(
        f"textures: write unknowns=('diffuse{TEXTURE}', ...), with this suffix for "
        "each texture; names without one will need it from 0.4 on",
        deeper=2,
    )
    few = _DEFAULT.unknowns[1:] if unknowns is None else tuple(unknowns)
    names = (TEXTURED[1],) if textures is None else tuple(textures)
    return {**options, "unknowns": (*(f"{name}{TEXTURE}" for name in names), *few)}


def _check_names(names: tuple[str, ...], few: tuple[str, ...]) -> None:
    for name in (*names, *few):
        if name not in TEXTURED:
            wanted = ", ".join(TEXTURED)
            raise ValueError(
                f"unknowns: expected some of {wanted}, with {TEXTURE} or without, got "
                f"{name!r}"
            )
    if not names:
        raise ValueError(
            f"unknowns: expected a texture, such as {TEXTURED[1]}{TEXTURE}, got none"
        )
    for name in names:
        if name in few:
            raise ValueError(f"unknowns: expected {name} or {name}{TEXTURE}, got both")


def _numbers(known: Material | None, materials: int) -> dict[str, np.ndarray]:
    """Known reflectances of the materials, (M, 3), and their exponents, (M,)."""
    if known is None:
        known = Material(0.0, 0.0, 32.0, 0.0)
    numbers = {}
    for name in (*BASIS, "shininess"):
        leaf = np.asarray(as_floats(name, getattr(known, name)), float)
        if leaf.ndim > 2 or (leaf.ndim == 2 and len(leaf) not in (1, materials)):
            raise ValueError(f"known: {name} has shape {leaf.shape}")
        numbers[name] = np.broadcast_to(leaf, (materials, 3)).copy()
    exponents = numbers["shininess"]
    if np.ptp(exponents, axis=1).any():
        raise ValueError("known: expected one exponent for all channels")
    numbers["shininess"] = exponents[:, 0].copy()
    return numbers
