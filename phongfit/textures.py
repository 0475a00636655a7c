r"""Textures: numbers on a surface, which multiply the parameters of its material.

They are images, or stand at the vertices of a mesh. $u$ and $v$ of images are glTF's:
(0, 0) is the upper left corner of an image and (1, 1) the lower right one, so that
texel (row, column) has its centre at $u = (column + \frac12) / W$,
$v = (row + \frac12) / H$.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.checks import as_floats, require
from phongfit.edge import checked

Filter = Literal["bilinear", "nearest"]
Wrap = Literal["repeat", "clamp"]
FILTERS: tuple[Filter, ...] = get_args(Filter)
WRAPS: tuple[Wrap, ...] = get_args(Wrap)


class Place(eqx.Module):
    """Points of a surface, by the coordinates at which textures are sampled."""

    corners: Int[Array, "*batch 3"]
    weights: Float[Array, "*batch 3"]
    uv: Float[Array, "*batch 2"] | None = None
    material_index: Int[Array, "*batch"] | None = None


Place.__init__.__doc__ = """**Arguments:**

- `corners`, `weights`: vertices of the triangle that a point lies in, and their
    weights, which sum to 1.
- `uv`: where in its textures it lies; `None` where the surface has no uv.
- `material_index`: which of several materials; `None` where there is one.
"""


class AbstractTexture(eqx.Module):
    """Numbers on a surface, of three channels, or of one for all."""

    values: eqx.AbstractVar[Float[Array, "*places channels"]]

    @abc.abstractmethod
    def look_up(self, place: Place) -> Float[Array, "*batch channels"]:
        """The numbers at points of the surface."""

    def with_values(self, values: Any) -> "AbstractTexture":
        """Other numbers in the same places."""
        return eqx.tree_at(lambda one: one.values, self, jnp.asarray(values))

    def of_ones(self) -> "AbstractTexture":
        """The number 1 in the same places."""
        return self.with_values(jnp.ones((*self.values.shape[:-1], 1)))


class Texture(AbstractTexture):
    """An image on a surface: numbers between the texels are interpolated, or not."""

    values: Float[Array, "rows columns channels"]
    filter: Filter = eqx.field(static=True)
    wrap: Wrap = eqx.field(static=True)

    @checked
    def __init__(self, values: Any, filter: Filter = "bilinear", wrap: Wrap = "repeat"):
        """**Arguments:**

        - `values`: (H, W, 3), or (H, W, 1) for all channels; linear, never sRGB.
        - `filter`: `"bilinear"` between the four texels around a point, as GL_LINEAR,
            or the `"nearest"` one, as GL_NEAREST. There is no mip map: `samples` of
            [`render`][] averages over a pixel.
        - `wrap`: what lies outside of [0, 1]: `"repeat"`, as GL_REPEAT, or the
            outermost texels (`"clamp"`), as GL_CLAMP_TO_EDGE.

        **Raises:** `ValueError` that names the argument.
        """
        self.values = _as_values(values, "H, W")
        if filter not in FILTERS:
            raise ValueError(f"filter: expected one of {FILTERS}, got {filter!r}")
        if wrap not in WRAPS:
            raise ValueError(f"wrap: expected one of {WRAPS}, got {wrap!r}")
        self.filter = filter
        self.wrap = wrap

    def look_up(self, place: Place) -> Float[Array, "*batch channels"]:
        assert place.uv is not None
        return self.at(place.uv)

    def at(self, uv: Float[Array, "*batch 2"]) -> Float[Array, "*batch channels"]:
        """The texture's numbers at points of the surface."""
        rows, columns, channels = self.values.shape
        index, weight = texels(uv, (rows, columns), self.filter, self.wrap)
        flat = self.values.reshape(-1, channels)
        total = jnp.zeros((*uv.shape[:-1], channels), self.values.dtype)
        # One by one: an innermost loop over four texels is slow.
        for k in range(index.shape[-1]):
            total += weight[..., k, None] * flat[index[..., k]]
        return total


class VertexColours(AbstractTexture):
    """Numbers at the vertices of a mesh, linear over each triangle in space."""

    values: Float[Array, "vertices channels"]

    @checked
    def __init__(self, values: Any):
        """**Arguments:** `values`: (V, 3), or (V, 1) for all channels; linear, never
        sRGB.

        **Raises:** `ValueError` that names the argument.
        """
        self.values = _as_values(values, "V")

    def look_up(self, place: Place) -> Float[Array, "*batch channels"]:
        shape = (*place.weights.shape[:-1], self.values.shape[-1])
        total = jnp.zeros(shape, self.values.dtype)
        for k in range(3):
            total += place.weights[..., k, None] * self.values[place.corners[..., k]]
        return total


def _as_values(values: Any, places: str) -> Array:
    """Numbers of three channels or one, for each place: `"V"`, or `"H, W"`."""
    values = as_floats("values", values)
    channels, count = values.shape[-1:], len(places.split(","))
    if values.ndim != count + 1 or channels not in ((1,), (3,)) or 0 in values.shape:
        raise ValueError(
            f"values: expected shape ({places}, 3) or ({places}, 1), got {values.shape}"
        )
    return require("values", values, np.isfinite, jnp.isfinite, "finite numbers")


def texels(
    uv: Float[Array, "*batch 2"], size: tuple[int, int], filter: Filter, wrap: Wrap
) -> tuple[Int[Array, "*batch corners"], Float[Array, "*batch corners"]]:
    """Indices of the texels around a point, and their weights, which sum to 1.

    **Arguments:** `size`: rows and columns of the texture.

    **Returns:** numbers of the texels, row by row: four, or with `"nearest"` one.

    ??? cite "Source"
        Segal and Akeley, *The OpenGL Graphics System*, version 2.1, section 3.8.8.
    """
    rows, columns = size
    u, v = uv[..., 0], uv[..., 1]
    if wrap == "repeat":
        # First, since a whole number of images away there is little precision left.
        u, v = u - jnp.floor(u), v - jnp.floor(v)
    x, y = _rounded(u * columns), _rounded(v * rows)

    def wrapped(at: Array, count: int) -> Array:
        at = at.astype(jnp.int32)
        return at % count if wrap == "repeat" else jnp.clip(at, 0, count - 1)

    if filter == "nearest":
        number = wrapped(jnp.floor(y), rows) * columns + wrapped(jnp.floor(x), columns)
        return number[..., None], jnp.ones_like(x)[..., None]
    left, top = jnp.floor(x - 0.5), jnp.floor(y - 0.5)
    right, down = x - 0.5 - left, y - 0.5 - top
    numbers, weights = [], []
    for below in (0, 1):
        for beside in (0, 1):
            row, column = wrapped(top + below, rows), wrapped(left + beside, columns)
            numbers.append(row * columns + column)
            across = right if beside else 1 - right
            weights.append(across * (down if below else 1 - down))
    return jnp.stack(numbers, axis=-1), jnp.stack(weights, axis=-1)


def _rounded(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Drop the last bit, so that all uses of a product agree on its rounding.

    A compiler may fuse multiplication and subtraction in one use and not in another.
    At the centre of a texel, `floor` and the remainder would then be of two texels.
    """
    kind = jnp.finfo(x.dtype)
    return jax.lax.reduce_precision(x, kind.nexp, kind.nmant - 1)


class Textures(eqx.Module):
    """The textures of one material. Each multiplies the parameter of its name.

    A surface has them: light stays linear in the reflectances, which are factors then.
    """

    diffuse: AbstractTexture | None = None
    specular: AbstractTexture | None = None
    shininess: AbstractTexture | None = None
    ambient: AbstractTexture | None = None
    emission: AbstractTexture | None = None
    normal: Texture | None = None

    def __check_init__(self) -> None:
        for name, texture in vars(self).items():
            if texture is None:
                continue
            kind = Texture if name == "normal" else AbstractTexture
            if not isinstance(texture, kind):
                more = " or VertexColours" if name != "normal" else ""
                raise ValueError(f"{name}: expected a Texture{more}, got {texture!r}")
            wanted = {"shininess": 1, "normal": 3}.get(name)
            if wanted not in (None, texture.values.shape[-1]):
                raise ValueError(
                    f"{name}: expected a texture of channels: {wanted}, got shape "
                    f"{texture.values.shape}"
                )
            if name != "normal":

                def positive(a: Any) -> Any:
                    return a >= 0

                require(name, texture.values, positive, positive, "numbers ≥ 0")

    @property
    def at_vertices(self) -> dict[str, VertexColours]:
        """The textures that are numbers at vertices, not images."""
        each = vars(self).items()
        return {name: one for name, one in each if isinstance(one, VertexColours)}

    def rearranged(self, change: Callable[[Array], Array]) -> "Textures":
        """These textures after `change` rearranged the rows of vertices' numbers."""
        changed = {
            name: VertexColours(change(one.values))
            for name, one in self.at_vertices.items()
        }
        return dataclasses.replace(self, **changed)


Textures.__init__.__doc__ = """**Arguments:**

- `diffuse`, `specular`, `ambient`, `emission`: [`Texture`][] or [`VertexColours`][] of
    numbers ≥ 0, with three channels or one.
- `shininess`: of one channel.
- `normal`: a [`Texture`][] of the normal's part along u, along −v (up in the image)
    and outwards, from −1 to 1; seen with Phong shading only.

**Raises:** `ValueError` that names the argument.
"""

COLOURED = ("ambient", "diffuse", "specular", "emission")
"""Parameters with a value for each channel, in the order of the basis images."""


class Factors(eqx.Module):
    """Factors of the textures at each pixel, on the basis images and the exponent."""

    ambient: Float[Array, "*batch 3"]
    diffuse: Float[Array, "*batch 3"]
    specular: Float[Array, "*batch 3"]
    emission: Float[Array, "*batch 3"]


def looked_up(
    name: str, textures: Sequence[Textures], place: Place
) -> Float[Array, "*batch channels"] | None:
    """One parameter's factor at points of a surface; `None` if it has no texture.

    **Arguments:** `textures`: of each material, or of all.
    """
    own = [getattr(one, name) for one in textures]
    given = [one for one in own if one is not None]
    if not given:
        return None
    channels = max(one.values.shape[-1] for one in given)
    neutral = [0.0, 0.0, 1.0] if name == "normal" else [1.0] * channels
    *shape, _ = place.weights.shape
    dtype = place.weights.dtype

    def at(texture: AbstractTexture | None) -> Array:
        none = texture is None
        values = jnp.asarray(neutral, dtype) if none else texture.look_up(place)
        return jnp.broadcast_to(values, (*shape, channels))

    if len(own) == 1 or place.material_index is None:
        return at(own[0])
    total = at(None)
    for number, texture in enumerate(own):
        if texture is not None:
            here = (place.material_index == number)[..., None]
            total = jnp.where(here, at(texture), total)
    return total


def factors(textures: Sequence[Textures], place: Place) -> Factors | None:
    """Factors of the colour textures; `None` if there is no such texture."""
    found = {name: looked_up(name, textures, place) for name in COLOURED}
    if all(values is None for values in found.values()):
        return None
    *shape, _ = place.weights.shape
    one = jnp.ones((), place.weights.dtype)
    return Factors(
        **{
            name: jnp.broadcast_to(one if values is None else values, (*shape, 3))
            for name, values in found.items()
        }
    )
