r"""Textures: values on a surface that multiply the parameters of its material.

A texture is an image, or has a value at each vertex of a mesh. Images have glTF's uv:
(0, 0) is the upper left corner of an image and (1, 1) the lower right one, so that
texel (row, column) has its centre at $u = (column + \frac12) / W$,
$v = (row + \frac12) / H$.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from phongfit.checks import as_floats, finite, require
from phongfit.edge import checked

Filter = Literal["bilinear", "nearest"]
Wrap = Literal["repeat", "clamp"]


class Place(eqx.Module):
    """Points of a surface, by the coordinates at which textures are looked up.

    Textures of vertices use the weights of a triangle's corners, images use uv.

    **Fields:**

    - `corners`, `weights`: indices of the vertices of the triangle that a point lies
        in, and their weights, which sum to 1.
    - `uv`: texture coordinates of the points; `None` where the surface has no uv.
    - `material_index`: which of several materials; `None` where there is one.
    """

    corners: Int[Array, "*batch 3"]
    weights: Float[Array, "*batch 3"]
    uv: Float[Array, "*batch 2"] | None = None
    material_index: Int[Array, "*batch"] | None = None


class AbstractTexture(eqx.Module):
    """Base class of textures: values on a surface, with three channels or with one."""

    values: eqx.AbstractVar[Float[Array, "*places channels"]]

    @abc.abstractmethod
    def look_up(self, place: Place) -> Float[Array, "*batch channels"]:
        """The texture's values at points of the surface."""

    def with_values(self, values: Any) -> "AbstractTexture":
        """A copy of this texture with other values."""
        return eqx.tree_at(lambda one: one.values, self, jnp.asarray(values))

    def of_ones(self) -> "AbstractTexture":
        """A texture of the same size, with one channel and the value 1 everywhere."""
        return self.with_values(jnp.ones((*self.values.shape[:-1], 1)))


class Texture(AbstractTexture):
    """An image on a surface, interpolated between texels or not."""

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
        - `wrap`: values for u or v outside of [0, 1]: `"repeat"` the image, as
            GL_REPEAT, or `"clamp"` to the outermost texels, as GL_CLAMP_TO_EDGE.

        **Raises:** `ValueError` that names the argument.
        """
        self.values = _as_values(values, "H, W")
        self.filter = filter
        self.wrap = wrap

    def look_up(self, place: Place) -> Float[Array, "*batch channels"]:
        assert place.uv is not None
        return self.at(place.uv)

    def at(self, uv: Float[Array, "*batch 2"]) -> Float[Array, "*batch channels"]:
        """The texture's values at texture coordinates (u, v), of any batch shape."""
        rows, columns, channels = self.values.shape
        index, weight = texels(uv, (rows, columns), self.filter, self.wrap)
        return weighted_sum(self.values.reshape(-1, channels), index, weight)


class VertexColours(AbstractTexture):
    """Values at the vertices of a mesh, interpolated linearly over each triangle."""

    values: Float[Array, "vertices channels"]

    @checked
    def __init__(self, values: Any):
        """**Arguments:** `values`: (V, 3), or (V, 1) for all channels; linear, never
        sRGB.

        **Raises:** `ValueError` that names the argument.
        """
        self.values = _as_values(values, "V")

    def look_up(self, place: Place) -> Float[Array, "*batch channels"]:
        return weighted_sum(self.values, place.corners, place.weights)


def _as_values(values: Any, places: str) -> Array:
    """Check for shape (`places`, 3) or (`places`, 1); `places` is `"V"` or `"H, W"`."""
    values = as_floats("values", values)
    channels, count = values.shape[-1:], len(places.split(","))
    if values.ndim != count + 1 or channels not in ((1,), (3,)) or 0 in values.shape:
        raise ValueError(
            f"values: expected shape ({places}, 3) or ({places}, 1), got {values.shape}"
        )
    return require("values", values, finite, "finite numbers")


def weighted_sum(
    values: Float[Array, "places channels"],
    index: Int[Array, "*batch corners"],
    weight: Float[Array, "*batch corners"],
) -> Float[Array, "*batch channels"]:
    """Weighted sums of a few rows of `values`, whose numbers are in `index`."""
    total = jnp.zeros((*weight.shape[:-1], values.shape[-1]), values.dtype)
    # One by one: an innermost loop over three or four corners is slow.
    for k in range(weight.shape[-1]):
        total += weight[..., k, None] * values[index[..., k]]
    return total


def texels(
    uv: Float[Array, "*batch 2"], size: tuple[int, int], filter: Filter, wrap: Wrap
) -> tuple[Int[Array, "*batch corners"], Float[Array, "*batch corners"]]:
    """Indices of the texels around a point, and their weights, which sum to 1.

    **Arguments:** `size`: rows and columns of the texture; `filter`, `wrap`: as in
    [`Texture`][].

    **Returns:** flat indices of the texels, row · columns + column: four for
    `"bilinear"`, one for `"nearest"`; and weights of the same shape.

    ??? cite "Source"
        Segal and Akeley, *The OpenGL Graphics System*, version 2.1, section 3.8.8.
    """
    rows, columns = size
    u, v = uv[..., 0], uv[..., 1]
    if wrap == "repeat":
        # Reduced to [0, 1) first: multiplied by the size, large u and v would leave few
        # digits for the place in a texel.
        u, v = u - jnp.floor(u), v - jnp.floor(v)
    x, y = _rounded(u * columns), _rounded(v * rows)

    def wrapped(index: Array, count: int) -> Array:
        """Row or column inside the image for one that may be outside."""
        index = index.astype(jnp.int32)
        return index % count if wrap == "repeat" else jnp.clip(index, 0, count - 1)

    if filter == "nearest":
        index = wrapped(jnp.floor(y), rows) * columns + wrapped(jnp.floor(x), columns)
        return index[..., None], jnp.ones_like(x)[..., None]
    # Centres of texels are at half integers.
    left, top = jnp.floor(x - 0.5), jnp.floor(y - 0.5)
    right, down = x - 0.5 - left, y - 0.5 - top
    indices, weights = [], []
    for below in (0, 1):
        for beside in (0, 1):
            row, column = wrapped(top + below, rows), wrapped(left + beside, columns)
            indices.append(row * columns + column)
            across = right if beside else 1 - right
            weights.append(across * (down if below else 1 - down))
    return jnp.stack(indices, axis=-1), jnp.stack(weights, axis=-1)


def _rounded(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Drop the last bit, so that all uses of a product agree on its rounding.

    A compiler may fuse multiplication and subtraction in one use and not in another.
    At the centre of a texel, `floor` and remainder would then belong to two texels.
    """
    kind = jnp.finfo(x.dtype)
    return jax.lax.reduce_precision(x, kind.nexp, kind.nmant - 1)


class Textures(eqx.Module):
    """The textures of one material. Each multiplies the parameter of its name.

    They belong to the surface. The material's reflectances are factors on them, so that
    light stays linear in the reflectances.

    **Fields:**

    - `diffuse`, `specular`, `ambient`, `emission`: [`Texture`][] or [`VertexColours`][]
        of numbers ≥ 0, with three channels or one.
    - `shininess`: a texture of numbers ≥ 0 with one channel.
    - `normal`: a [`Texture`][] whose three channels are the normal's components along
        u, along −v (up in the image) and outwards, from −1 to 1. Flat and Gouraud
        shading do not use it.

    **Raises:** `ValueError` that names the argument.
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
                require(name, texture.values, lambda a: a >= 0, "numbers ≥ 0")

    @property
    def at_vertices(self) -> dict[str, VertexColours]:
        """The textures with values at vertices, by the names of their parameters."""
        each = vars(self).items()
        return {name: one for name, one in each if isinstance(one, VertexColours)}

    def rearranged(self, change: Callable[[Array], Array]) -> "Textures":
        """A copy in which `change` is applied to all arrays of values at vertices."""
        changed = {
            name: VertexColours(change(one.values))
            for name, one in self.at_vertices.items()
        }
        return dataclasses.replace(self, **changed)


COLOURED = ("ambient", "diffuse", "specular", "emission")
"""Parameters with a value for each channel, in the order of the basis images."""


class Factors(eqx.Module):
    """Factors of the textures at each pixel, on the basis images and the emission."""

    ambient: Float[Array, "*batch 3"]
    diffuse: Float[Array, "*batch 3"]
    specular: Float[Array, "*batch 3"]
    emission: Float[Array, "*batch 3"]


def looked_up(
    name: str, textures: Sequence[Textures], place: Place
) -> Float[Array, "*batch channels"] | None:
    """One parameter's texture values at points of a surface; `None` without a texture.

    **Arguments:**

    - `name`: the parameter, or `"normal"`.
    - `textures`: one for each material, or one for the whole surface.

    **Returns:** three channels or one. Points whose material has no such texture get 1,
    or the normal map's vector (0, 0, 1), which leaves normals unchanged.
    """
    of_materials = [getattr(textures_of, name) for textures_of in textures]
    present = [texture for texture in of_materials if texture is not None]
    if not present:
        return None
    channels = max(texture.values.shape[-1] for texture in present)
    neutral = [0.0, 0.0, 1.0] if name == "normal" else [1.0] * channels
    *shape, _ = place.weights.shape
    dtype = place.weights.dtype

    def look_up(texture: AbstractTexture | None) -> Array:
        none = texture is None
        values = jnp.asarray(neutral, dtype) if none else texture.look_up(place)
        return jnp.broadcast_to(values, (*shape, channels))

    if len(of_materials) == 1 or place.material_index is None:
        return look_up(of_materials[0])
    factor = look_up(None)
    for index, texture in enumerate(of_materials):
        if texture is not None:
            has_material = (place.material_index == index)[..., None]
            factor = jnp.where(has_material, look_up(texture), factor)
    return factor


def factors(textures: Sequence[Textures], place: Place) -> Factors | None:
    """Factors of the four colour textures at points of a surface; `None` without any.

    **Arguments:** `textures`: one for each material, or one for the whole surface.
    """
    values_by_name = {name: looked_up(name, textures, place) for name in COLOURED}
    if all(values is None for values in values_by_name.values()):
        return None
    *shape, _ = place.weights.shape
    one = jnp.ones((), place.weights.dtype)
    return Factors(
        **{
            name: jnp.broadcast_to(one if values is None else values, (*shape, 3))
            for name, values in values_by_name.items()
        }
    )
