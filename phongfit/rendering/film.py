"""Film: from linear light to the numbers in a file, and back."""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.edge import checked
from phongfit.rendering.jpeg import JpegCompression, compressed, namespace
from phongfit.rendering.response import ResponseCurve

NamedEncoding = Literal["linear", "srgb"]
Encoding = NamedEncoding | ResponseCurve
"""From linear light in [0, 1] to the numbers in a file: by name, or as a curve."""

ENCODINGS: tuple[NamedEncoding, ...] = ("linear", "srgb")
"""Encodings that are given by name."""


def encode(linear: Any, encoding: Encoding) -> Any:
    """Linear light in [0, 1] as the numbers of `encoding`, in [0, 1].

    JAX arrays, or NumPy's, of any shape.

    ??? cite "Source"
        IEC 61966-2-1 (sRGB), 1999.
    """
    if encoding == "linear":
        return linear
    if isinstance(encoding, ResponseCurve):
        return encoding.encode(linear)
    xp = namespace(linear)
    # Double where: the power has an infinite slope at 0, where it is not used.
    curved = linear > 0.0031308
    root = 1.055 * xp.where(curved, linear, 1) ** (1 / 2.4) - 0.055
    return xp.where(curved, root, 12.92 * linear)


def decode(encoded: Any, encoding: Encoding) -> Any:
    """Linear light of the numbers of `encoding`: the inverse of [`encode`][]."""
    if encoding == "linear":
        return encoded
    if isinstance(encoding, ResponseCurve):
        return encoding.decode(encoded)
    xp = namespace(encoded)
    curved = encoded > 0.04045
    root = ((xp.where(curved, encoded, 1) + 0.055) / 1.055) ** 2.4
    return xp.where(curved, root, encoded / 12.92)


class Film(eqx.Module):
    """The steps from linear light to a file: clamp, encode, round, JPEG compression."""

    clamp: bool = eqx.field(static=True)
    encoding: Encoding = eqx.field(static=True)
    bits: int | None = eqx.field(static=True)
    jpeg: JpegCompression | None = eqx.field(static=True)

    @checked
    def __init__(
        self,
        clamp: bool = True,
        encoding: Encoding = "linear",
        bits: int | None = None,
        jpeg: JpegCompression | None = None,
    ):
        """**Arguments:**

        - `clamp`: clip light to [0, 1]. `False` is for floating-point images that were
            never cut off, in linear light and without `bits`.
        - `encoding`: `"linear"`, `"srgb"` or a [`ResponseCurve`][].
        - `bits`: 1 to 16: round to 2^bits levels. Default: no rounding, or 8 with
            `jpeg`. The derivative of rounding is 0, so omit it where gradients are
            needed.
        - `jpeg`: the compression of a JPEG file, for images of 8 bits:
            [`read_film`][] reads it from the file. Default: none.

        **Raises:** `ValueError` that names the argument.
        """
        self.clamp = bool(clamp)
        self.encoding = as_encoding(encoding)
        self.bits = as_bits(8 if bits is None and jpeg is not None else bits)
        self.jpeg = jpeg
        if not self.clamp and (self.bits is not None or self.encoding != "linear"):
            raise ValueError("clamp: expected True for a film that encodes or rounds")
        if jpeg is not None and self.bits != 8:
            raise ValueError(f"bits: expected 8 beside jpeg, got {self.bits}")

    @checked
    def expose(
        self, light: Float[Array, "..."] | Float[np.ndarray, "..."]
    ) -> Float[Array, "..."]:
        """The numbers that are stored for linear light, in [0, 1] if clamped.

        Files of integers hold them times 2^bits − 1.

        **Arguments:** `light`: of any shape; (height, width, 3) for a JPEG.
        """
        shown = jnp.clip(light, 0, 1) if self.clamp else light
        encoded = encode(shown, self.encoding)
        if self.bits is None:
            return encoded
        white = 2**self.bits - 1
        if self.jpeg is not None:
            return compressed(jnp.asarray(encoded) * white, self.jpeg) / white
        return jnp.round(encoded * white) / white


def as_films(
    film: Film | Sequence[Film], count: int, each: str = "image"
) -> tuple[Film, ...]:
    """A film for each of `count` images: those given, or one for all.

    **Arguments:** `each`: "image" or "scene", for the message.

    **Raises:** `ValueError` for another number of films.
    """
    films = (film,) * count if isinstance(film, Film) else tuple(film)
    if len(films) != count:
        raise ValueError(
            f"film: expected {count}, one for each {each}, got {len(films)}"
        )
    return films


def as_encoding(value: Any) -> Encoding:
    """`value` if it is an encoding, else a `ValueError`."""
    if isinstance(value, ResponseCurve) or value in ENCODINGS:
        return value
    names = ", ".join(repr(name) for name in ENCODINGS)
    raise ValueError(f"encoding: expected {names} or a ResponseCurve, got {value!r}")


def as_bits(value: Any) -> int | None:
    """`value` if it is a bit depth (None, 1 … 16), else a `ValueError`."""
    if value is None:
        return None
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not 1 <= value <= 16:
        raise ValueError(f"bits: expected None or 1 … 16, got {value!r}")
    return int(value)
