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

    A vector y holds the entries of the leaves in `names`, one after the other.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    known: Material
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for every entry, such as `diffuse.red` or `shininess`."""
        return tuple(
            f"{name}.{channel}" if size > 1 else name
            for name, size in zip(self.names, self.sizes, strict=True)
            for channel in CHANNELS[:size]
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
        for name, part in self.parts(values).items():
            leaf = jnp.asarray(part if part.shape[-1] > 1 else part[0])

            def where(m: Material, name: str = name) -> Array:
                return getattr(m, name)

            material = eqx.tree_at(where, material, leaf)
        return material

    @property
    def logarithmic(self) -> np.ndarray:
        """True where the solver works with a logarithm."""
        return np.repeat([name == "shininess" for name in self.names], self.sizes)


def make_unknowns(
    unknowns: Sequence[str],
    per_channel: Sequence[str],
    known: Material,
    bounds: Mapping[str, tuple[float, float]],
) -> Unknowns:
    """The unknowns of a fit, checked.

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
    for name in LEAVES:
        shape = getattr(known, name).shape
        if shape not in ((), (1,), (3,)):
            raise ValueError(f"known: {name} has shape {shape}, () or (3,) is wanted")
    # In the order of the table that users read, whatever the order they were named in.
    names = tuple(name for name in LEAVES if name in unknowns)
    sizes = tuple(3 if name in per_channel else 1 for name in names)
    boxes = [_box(name, bounds.get(name, DEFAULT_BOUNDS[name])) for name in names]
    lower, upper = np.repeat(np.array(boxes), sizes, axis=0).T
    dtype = jnp.result_type(float)
    return Unknowns(
        names, sizes, known, jnp.asarray(lower, dtype), jnp.asarray(upper, dtype)
    )


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
