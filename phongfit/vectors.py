"""Vector algebra whose values and derivatives are finite, also at zero vectors."""

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.programs import program

Vec3: TypeAlias = Float[Array, "3"]
Rgb: TypeAlias = Float[Array, "rgb=3"]
Scalar: TypeAlias = Float[Array, ""]


def dot(a: Float[Array, " few"], b: Float[Array, " few"]) -> Scalar:
    r"""$a \cdot b$ of two vectors of shape (3,), or of another small length."""
    # Not a sum over an axis of length three, for which compilers make slow code.
    first, *others = a * b
    for product in others:
        first = first + product
    return first


def norm(vector: Float[Array, " few"]) -> Scalar:
    r"""Length $|a|$ in the vector's own units; its gradient at zero is zero."""
    squared = dot(vector, vector)
    positive = squared > 0
    # The double where: the branch not taken must have a finite derivative too.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


def normalize(vector: Vec3) -> Vec3:
    r"""Unit vector $a / |a|$; a zero vector stays zero, and so does its gradient."""
    length = norm(vector)
    return vector / jnp.where(length > 0, length, jnp.inf)


@program()
def normalize_all(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Unit vectors of many vectors, as [`normalize`][] makes them; zeros stay zero."""
    units = jax.vmap(normalize)(vectors.reshape(-1, 3))
    return units.reshape(vectors.shape)


def power(base: Float[Array, "..."], exponent: Float[Array, "..."]) -> Array:
    r"""$\max(x, 0)^f$, elementwise, finite to second order in both arguments.

    `maximum(x, 0) ** f` gives NaN gradients in $f$ and infinite ones in $x$ where
    $x \le 0$; here they are zero.
    """
    positive = base > 0
    logarithm = jnp.log(jnp.where(positive, base, 1))
    return jnp.where(positive, jnp.exp(exponent * logarithm), 0)
