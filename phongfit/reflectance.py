"""Reflection at one point of a surface: Lambert's, Phong's and Blinn's laws.

Everything here takes unit vectors of shape (3,) that point away from the surface; the
caller batches with `vmap`.
"""

import abc
import math
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from phongfit.edge import check_fields, checked
from phongfit.vectors import Scalar, Vec3, dot, normalize, power


def lambert(normal: Vec3, to_light: Vec3) -> Scalar:
    r"""Fraction of a light's intensity that a white matte surface reflects.

    $\max(s \cdot m, 0)$: none from behind.

    **Arguments:**

    - `normal`: unit surface normal $m$.
    - `to_light`: unit vector $s$ from the surface to the light.

    **Returns:**

    A number in [0, 1], no unit.

    ??? cite "Source"
        Lambert, *Photometria*, 1760.
    """
    return jnp.maximum(dot(to_light, normal), 0)


def mirror(normal: Vec3, to_light: Vec3) -> Vec3:
    r"""Direction $r = 2 (s \cdot m) m - s$ in which a mirror would reflect a light.

    **Arguments:** as in [`lambert`][]. **Returns:** a unit vector.
    """
    return 2 * dot(to_light, normal) * normal - to_light


def halfway(to_light: Vec3, to_viewer: Vec3) -> Vec3:
    r"""Half vector $h = (s + v) / |s + v|$ of light and viewer.

    **Arguments:** unit vectors to light and viewer. **Returns:** a unit vector; zero
    where $s = -v$.
    """
    return normalize(to_light + to_viewer)


class AbstractSpecular(eqx.Module):
    """A specular model: a cosine from the geometry, and a lobe as a function of it.

    The split makes fits fast: the cosine is computed once, the lobe at every step. A
    model may have further parameters of the lobe as float fields. They can be unknowns
    of a fit, by paths such as `"scene.specular_model.roughness"`. `bounds` maps names
    of such fields to their lowest and highest value in a fit.
    """

    bounds: ClassVar[Mapping[str, tuple[float, float]]] = {}

    @abc.abstractmethod
    def cosine(
        self, normal: Vec3, to_light: Vec3, to_viewer: Vec3
    ) -> PyTree[Float[Array, ""]]:
        """Cosine of the angle from the highlight's centre; ≤ 0 where there is none.

        A lobe that needs more numbers gets them as a named tuple, with this cosine as
        its first field. The lobe must accept zeros, which stand for lights that an
        image lacks.

        **Arguments:** unit vectors of one point that point away from the surface.
        """

    @abc.abstractmethod
    def lobe(
        self, cosine: PyTree[Float[Array, "..."]], shininess: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Light of the highlight at `cosine`, elementwise, ≥ 0, for ρ_s = 1.

        It is a factor on the light's specular colour.

        **Arguments:** `cosine`: as returned by `cosine`, of any shape; `shininess`:
        exponents that broadcast to it.
        """

    def diffuse_scale(self) -> float:
        """Factor on the diffuse term: 1, or 1 / π where the model is normalised."""
        return 1.0


def _gated(cosine: Scalar, normal: Vec3, to_light: Vec3, gate: bool) -> Scalar:
    """The cosine, or with `gate` 0 where the light is behind the surface."""
    return jnp.where(dot(to_light, normal) > 0, cosine, 0) if gate else cosine


class Phong(AbstractSpecular):
    r"""Phong's highlight $\max(r \cdot v, 0)^f$, $r = 2 (s \cdot m) m - s$.

    Unit vectors $s$, $v$ point to light and viewer; $m$ is the normal.

    **Fields:**

    - `gate`: no highlight where the light is behind the surface (s·m ≤ 0), as in
        OpenGL; `False` is the textbook's bare formula.

    ??? cite "Source"
        Phong, *Illumination for computer generated pictures*, CACM 18(6), 1975.
    """

    gate: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        check_fields(self)

    def cosine(self, normal: Vec3, to_light: Vec3, to_viewer: Vec3) -> Scalar:
        cosine = dot(mirror(normal, to_light), to_viewer)
        return _gated(cosine, normal, to_light, self.gate)

    def lobe(
        self, cosine: Float[Array, "..."], shininess: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        return power(cosine, shininess)


class BlinnPhong(AbstractSpecular):
    r"""Blinn's highlight $\max(h \cdot m, 0)^f$, $h = (s + v) / |s + v|$.

    Unit vectors $s$, $v$ point to light and viewer; $m$ is the normal.

    **Fields:**

    - `gate`: as in [`Phong`][].
    - `normalized`: scale the lobe by $(f+2)/(2\pi)$ and the diffuse term by $1/\pi$.

    ??? cite "Source"
        Blinn, *Models of light reflection for computer synthesized pictures*,
        SIGGRAPH 1977.
    """

    gate: bool = eqx.field(static=True, default=True)
    normalized: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        check_fields(self)

    def cosine(self, normal: Vec3, to_light: Vec3, to_viewer: Vec3) -> Scalar:
        cosine = dot(halfway(to_light, to_viewer), normal)
        return _gated(cosine, normal, to_light, self.gate)

    def lobe(
        self, cosine: Float[Array, "..."], shininess: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        height = (shininess + 2) / (2 * math.pi) if self.normalized else 1
        return height * power(cosine, shininess)

    def diffuse_scale(self) -> float:
        return 1 / math.pi if self.normalized else 1.0


@checked
def blinn_from_phong(shininess: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Blinn exponent with about the highlight that Phong's `shininess` gives: $4 f$.

    Where light, viewer and normal share a plane, the angle between $h$ and $m$ is half
    of that between $r$ and $v$, and $\cos^{4f}(\theta/2) \approx \cos^f \theta$ near
    the centre of the highlight.

    **Arguments:** `shininess`: Phong exponents, any shape. **Returns:** Blinn exponents
    of that shape.

    ??? cite "Source"
        Fisher and Woo, *R·E versus N·H specular highlights*, Graphics Gems IV, 1994.
    """
    return 4 * shininess


@checked
def phong_from_blinn(shininess: Float[Array, "..."]) -> Float[Array, "..."]:
    """Phong exponent for a Blinn exponent: the inverse of [`blinn_from_phong`][]."""
    return shininess / 4
