"""The unknowns of a fit as one vector, and back.

The solver sees every unknown at order 1 and inside a box: reflectances as they are, the
exponent as its logarithm.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.material import Material

REFLECTANCES = ("ambient", "diffuse", "specular", "emission")
LEAVES = ("ambient", "diffuse", "specular", "shininess", "emission")
CHANNELS = ("red", "green", "blue")

DEFAULT_BOUNDS = {
    "ambient": (0.0, 1.0),
    "diffuse": (0.0, 1.0),
    "specular": (0.0, 1.0),
    # Textbooks stop at 200; a real, shiny ball fits 600-800 with Blinn's model.
    "shininess": (1.0, 1000.0),
    "emission": (0.0, 1.0),
}


class Unknowns(eqx.Module):
    """Which leaves of a material are wanted, per channel or shared, and their box.

    A vector y holds the entries of the leaves in `names`, one after the other; of M
    materials each has its own entries, material after material.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    channels: tuple[int, ...] = eqx.field(static=True)
    materials: int = eqx.field(static=True)
    known: Material
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many entries each leaf has."""
        return tuple(self.materials * channels for channels in self.channels)

    @property
    def kinds(self) -> np.ndarray:
        """The leaf that each entry belongs to."""
        return np.repeat(self.names, self.sizes)

    @property
    def owners(self) -> np.ndarray:
        """The material, 0 … M − 1, that each entry belongs to."""
        rows = np.arange(self.materials)
        return np.concatenate([np.repeat(rows, count) for count in self.channels])

    @property
    def columns(self) -> np.ndarray:
        """The channel that each entry belongs to; −1 where it is shared by all."""
        rows = [
            np.tile(np.arange(count) if count > 1 else [-1], self.materials)
            for count in self.channels
        ]
        return np.concatenate(rows)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for every entry: `diffuse.red`, or of several `ambient[2].red`."""
        return tuple(
            name
            + (f"[{owner}]" if self.materials > 1 else "")
            + (f".{CHANNELS[column]}" if column >= 0 else "")
            for name, owner, column in zip(
                self.kinds, self.owners, self.columns, strict=True
            )
        )

    def parts(self, vector: Any) -> dict[str, Any]:
        """The vector (or an array whose last axis is it) cut into its leaves."""
        ends = np.cumsum(self.sizes)
        return {
            name: vector[..., end - size : end]
            for name, size, end in zip(self.names, self.sizes, ends, strict=True)
        }

    def material(self, y: Float[Array, " n"]) -> Material:
        """The material that the solver's vector stands for."""
        return self.with_leaves(self.values(y))

    def values(self, y: Any) -> Any:
        """Parameters in the user's units: exponents instead of their logarithms."""
        xp = np if isinstance(y, np.ndarray) else jnp
        return xp.where(self.logarithmic, xp.exp(y), y)

    @property
    def bounds(self) -> np.ndarray:
        """(n, 2): lower and upper bounds in the user's units."""
        edges = np.stack([self.lower, self.upper], axis=-1).astype(float)
        edges[self.logarithmic] = np.exp(edges[self.logarithmic])
        # A logarithm of single precision gives back 1000 as 1000.00012.
        digits = 6 if self.lower.dtype == np.float32 else 14
        return np.vectorize(lambda x: float(f"{x:.{digits}g}"))(edges)

    def with_leaves(self, values: Any) -> Material:
        """A material with the wanted leaves from `values`, in the user's units."""
        material = self.known
        for (name, part), count in zip(
            self.parts(values).items(), self.channels, strict=True
        ):
            shape = (count,) if count > 1 else ()
            shape = shape if self.materials == 1 else (self.materials, count)

            def where(m: Material, name: str = name) -> Array:
                return getattr(m, name)

            material = eqx.tree_at(where, material, jnp.asarray(part.reshape(shape)))
        return material

    @property
    def logarithmic(self) -> np.ndarray:
        """True where the solver works with a logarithm."""
        return self.kinds == "shininess"


def make_unknowns(
    unknowns: Sequence[str],
    per_channel: Sequence[str],
    known: Material,
    bounds: Mapping[str, tuple[float, float]],
    materials: int = 1,
) -> Unknowns:
    """The unknowns of a fit, checked; of `materials` materials each has its own.

    **Raises:** `ValueError` that names the argument and the entry that is wrong.
    """
    for argument, names in (
        ("unknowns", unknowns),
        ("per_channel", per_channel),
        ("bounds", tuple(bounds)),
    ):
        for name in names:
            if name not in LEAVES:
                raise ValueError(
                    f"{argument}: {name!r} came, one of {', '.join(LEAVES)} is wanted"
                )
    if not unknowns:
        raise ValueError("unknowns: none came, at least one is wanted")
    if len(set(unknowns)) != len(unknowns):
        raise ValueError(f"unknowns: a name came twice: {', '.join(unknowns)}")
    rows = () if materials == 1 else ((materials, 1), (materials, 3))
    for name in LEAVES:
        shape = getattr(known, name).shape
        if shape not in ((), (1,), (3,), *rows):
            wanted = ", ".join(map(str, ((), (3,), *rows)))
            raise ValueError(f"known: {name} has shape {shape}, one of {wanted} wanted")
    # In the order of the table that users read, whatever the order they were named in.
    names = tuple(name for name in LEAVES if name in unknowns)
    channels = tuple(3 if name in per_channel else 1 for name in names)
    boxes = [_box(name, bounds.get(name, DEFAULT_BOUNDS[name])) for name in names]
    counts = [materials * count for count in channels]
    lower, upper = np.repeat(np.array(boxes, jnp.result_type(float)), counts, axis=0).T
    edges = jnp.asarray(lower), jnp.asarray(upper)
    return Unknowns(names, channels, materials, known, *edges)


def _box(name: str, box: tuple[float, float]) -> tuple[float, float]:
    """Bounds of one leaf, as the solver sees them."""
    try:
        low, high = (float(edge) for edge in box)
    except (TypeError, ValueError) as error:
        raise ValueError(f"bounds: {name}: {box!r} came, (low, high) wanted") from error
    if not low < high:
        raise ValueError(f"bounds: {name}: {low:g} < {high:g} does not hold")
    if name != "shininess":
        return low, high
    if low <= 0 or not np.isfinite(high):
        raise ValueError(
            f"bounds: {name}: ({low:g}, {high:g}) came, 0 < low and a "
            "finite high are wanted"
        )
    return float(np.log(low)), float(np.log(high))
