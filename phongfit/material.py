"""Materials: how a surface reflects light."""

import difflib
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.checks import as_reflectance, is_traced
from phongfit.edge import checked
from phongfit.presets import OPENGL_MATERIALS


class Material(eqx.Module):
    r"""Reflectances $\rho_d, \rho_s, \rho_a$, exponent $f$ and own light of a surface.

    $$I = \text{emission} + I_a \rho_a + \sum_{\text{lights}} I_s (\rho_d \max(s \cdot
    m, 0) + \rho_s \cos^f)$$

    with the ambient light $I_a$, a light's intensity $I_s$ and direction $s$, and the
    normal $m$; the scene's specular model defines the cosine.

    Every parameter has shape () (one number for all channels) or ends in a colour axis
    of 1 or 3: (3,) is one material, (M, 3) is M materials, (H, W, 3) is a map.
    """

    diffuse: Float[Array, "..."]
    specular: Float[Array, "..."]
    shininess: Float[Array, "..."]
    ambient: Float[Array, "..."]
    emission: Float[Array, "..."]

    def __init__(
        self,
        diffuse: Any = 0.8,
        specular: Any = 0.0,
        shininess: Any = 32.0,
        ambient: Any = 0.2,
        emission: Any = 0.0,
    ):
        r"""**Arguments:** numbers, or arrays whose last axis is 1 or 3 (colours).

        - `diffuse`: Lambert reflectance $\rho_d$ (GL_DIFFUSE, Kd).
        - `specular`: strength of the highlight $\rho_s$ (GL_SPECULAR, Ks).
        - `shininess`: exponent $f$ (GL_SHININESS, Ns). A larger $f$ makes a *narrower*
            highlight, since $\cos^f$ falls off faster; some lecture notes state the
            opposite by mistake. Textbooks give 5–10 for plastics and 100–200 for
            metals; fits to photographs often give much larger values. Blinn's
            exponent is about 4 times Phong's for the same highlight: see
            [`blinn_from_phong`][].
        - `ambient`: fraction $\rho_a$ of the ambient light that is reflected
            (GL_AMBIENT, Ka).
        - `emission`: emitted light (GL_EMISSION, Ke), where white is 1.

        **Raises:** `ValueError` that names the argument, if a value is negative or not
        finite, or the last axis of an array is not 1 or 3.
        """
        self.diffuse = as_reflectance("diffuse", diffuse)
        self.specular = as_reflectance("specular", specular)
        self.shininess = as_reflectance("shininess", shininess)
        self.ambient = as_reflectance("ambient", ambient)
        self.emission = as_reflectance("emission", emission)

    def __repr__(self) -> str:
        numbers = (f"{name}={_written(value)}" for name, value in vars(self).items())
        return f"Material({', '.join(numbers)})"

    def _repr_html_(self) -> str:
        from phongfit.report.notebook import of_material

        return of_material(self)


def _written(value: Any) -> str:
    """A parameter as text: numbers and RGB to four digits, others as type and shape."""
    if not eqx.is_array_like(value):
        # JAX transformations may put placeholders in place of arrays.
        return repr(value)
    if jnp.ndim(value) > 1 or is_traced(value):
        return eqx.tree_pformat(value)
    numbers = [f"{float(one):.4g}" for one in jnp.atleast_1d(jnp.asarray(value))]
    return f"({', '.join(numbers)})" if jnp.ndim(value) else numbers[0]


@checked
def stack_materials(materials: Iterable[Material]) -> Material:
    """Several materials as one `Material` of parameters (M, 3), for `material_index`.

    **Arguments:** `materials`: parameters of shape () or (3,), or several: (M, 3).

    **Returns:** all materials as one, in order. The exponent has shape (M, 3) if any
    material has an exponent for each channel, else (M, 1).

    **Raises:** `ValueError` if there are none, or one is a map (H, W, 3).
    """
    materials = list(materials)
    if not materials:
        raise ValueError("materials: expected at least one, got none")

    # NumPy unless traced, so that nothing is compiled.
    xp: Any = jnp if is_traced(materials) else np

    def rows(material: Material) -> list[Any]:
        """Parameters of shape (M, 1) or (M, 3), with the same M for all of them."""
        leaves = [xp.atleast_2d(leaf) for leaf in jax.tree.leaves(material)]
        if any(leaf.ndim > 2 for leaf in leaves):
            raise ValueError("materials: expected single materials, got a map")
        count = max(len(leaf) for leaf in leaves)
        return [xp.broadcast_to(leaf, (count, leaf.shape[1])) for leaf in leaves]

    def stack(*leaves: Any) -> Array:
        """One parameter of all materials, with as many channels as any of them has."""
        channels = max(leaf.shape[1] for leaf in leaves)
        spread = [xp.broadcast_to(leaf, (len(leaf), channels)) for leaf in leaves]
        return jnp.asarray(xp.concatenate(spread))

    stacked = [stack(*leaves) for leaves in zip(*map(rows, materials), strict=True)]
    return jax.tree.unflatten(jax.tree.structure(materials[0]), stacked)


@checked
def unstack_materials(material: Material, count: int | None = None) -> list[Material]:
    """The inverse of [`stack_materials`][]: one `Material` for each row.

    **Arguments:** `count`: number of materials, at most 65 536; default the largest
    number of rows of a parameter. A parameter of one row or of shape () or (3,) belongs
    to all materials.

    **Raises:** `ValueError` for a parameter of another number of rows, and for a map
    (H, W, 3).
    """
    rows_of_parameters = [
        len(leaf) for leaf in jax.tree.leaves(material) if leaf.ndim == 2
    ]
    count = max(rows_of_parameters, default=1) if count is None else count
    if not 1 <= count <= 2**16:
        raise ValueError(f"count: expected a number from 1 to {2**16}, got {count}")

    def row(leaf: Array, i: int) -> Array:
        """A parameter's value for material `i`, of shape (), (1,) or (3,)."""
        if leaf.ndim < 2:
            return leaf
        if leaf.ndim > 2 or len(leaf) not in (1, count):
            raise ValueError(
                f"material: expected {count} rows, got a parameter of shape "
                f"{leaf.shape}"
            )
        return leaf[min(i, len(leaf) - 1)]

    return [
        jax.tree.map(lambda leaf, i=i: row(leaf, i), material) for i in range(count)
    ]


PRESETS = tuple(OPENGL_MATERIALS)
"""Names that [`preset`][] accepts."""


@checked
def preset(name: str) -> Material:
    """One of the 24 classic OpenGL materials, for the Blinn-Phong model.

    **Arguments:** `name`: one of `phongfit.material.PRESETS`, such as `"brass"`; spaces
    and hyphens count as underscores.

    **Raises:** `ValueError` for any other name; it suggests the most similar one, or
    lists all.
    """
    key = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    if key not in OPENGL_MATERIALS:
        near = difflib.get_close_matches(key, PRESETS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else f": {', '.join(PRESETS)}"
        raise ValueError(f"name: there is no preset {name!r}{hint}")
    ambient, diffuse, specular, shininess = OPENGL_MATERIALS[key]
    return Material(diffuse, specular, shininess, ambient)
