r"""Directions and rotations as unconstrained numbers.

A direction is two coordinates on the tangent plane of the sphere at a base direction; a
rotation is three angles relative to the first rotation.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.vectors import Vec3, dot

# A GPU would otherwise multiply in reduced precision.
EXACT = "highest"


def on_sphere(
    base: Vec3, across: Float[Array, "2 3"], y: Float[Array, "2"]
) -> Float[Array, "3"]:
    r"""The direction at `y` of the stereographic chart around `base`.

    $\frac{(1 - q) b + y_1 a_1 + y_2 a_2}{1 + q}$ with $q = |y|^2 / 4$: every direction
    but $-b$ has one `y`, and the map is conformal. Near the base a step is an angle in
    radians; $|y| = 2$ is 90° from the base.
    """
    quarter = dot(y, y) / 4
    moved = (1 - quarter) * base + y[0] * across[0] + y[1] * across[1]
    return moved / (1 + quarter)


def tangents(base: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2 3"]:
    """Two unit vectors at right angles to each direction and to one another."""
    helper = np.where(np.abs(base[..., :1]) < 0.7, [1.0, 0, 0], [0, 1.0, 0])
    one = np.cross(base, helper)
    one = one / np.maximum(np.linalg.norm(one, axis=-1, keepdims=True), 1e-30)
    return np.stack([one, np.cross(base, one)], axis=-2)


def spread_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit vectors all over the sphere, about equally far from one another.

    ??? cite "Source"
        González, *Measurement of areas on a sphere using Fibonacci and latitude-
        longitude lattices*, Mathematical Geosciences 42, 2010.
    """
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)


def turned(
    start: Float[Array, "3 3"], degrees: Float[Array, "3"]
) -> Float[Array, "3 3"]:
    r"""A rotation, turned about its own axes: $R \exp([\omega]_\times)$.

    With $\theta = |\omega|$ and $s = \sin(\theta / 2) / (\theta / 2)$ it is $R (1 + s
    \cos(\theta / 2) [\omega]_\times + \tfrac12 s^2 [\omega]_\times^2)$, which is
    accurate near 0.

    **Arguments:**

    - `start`: $R$, whose columns are the axes.
    - `degrees`: $\omega$, about these axes; small angles are rotations about the three
        axes.

    ??? cite "Source"
        Rodrigues, *Des lois géométriques qui régissent les déplacements d'un système
        solide dans l'espace*, 1840.
    """
    x, y, z = vector = jnp.deg2rad(degrees)
    squared = dot(vector, vector)
    turning = squared > 0
    # The double where: derivatives at 0 are those of the limits.
    half = jnp.sqrt(jnp.where(turning, squared, 1)) / 2
    ratio = jnp.where(turning, jnp.sin(half) / half, 1)
    cosine = jnp.where(turning, jnp.cos(half), 1)
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    twice = jnp.matmul(cross, cross, precision=EXACT)
    turn = jnp.eye(3, dtype=cross.dtype) + ratio * cosine * cross
    return jnp.matmul(start, turn + ratio**2 / 2 * twice, precision=EXACT)


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix with nearly orthonormal columns.

    ??? cite "Source"
        Higham, *Computing the polar decomposition - with applications*, SIAM J. Sci.
        Stat. Comput. 7(4), 1986.
    """
    left, _, right = np.linalg.svd(matrix.astype(float))
    return left @ right
