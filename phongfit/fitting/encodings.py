"""Comparison of fits to the same files, read as linear and as sRGB."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from phongfit.codes import coded
from phongfit.fitting.result import Fit
from phongfit.rendering.film import NamedEncoding, decode, encode

SUSPECT = 1.5
"""Ratio of the residuals from which on the encoding is doubted."""


def other_encoding(encoding: NamedEncoding) -> NamedEncoding:
    """The encoding that a file read with this one may have instead."""
    return "linear" if encoding == "srgb" else "srgb"


def reread(
    image: Float[np.ndarray, "height width 3"], encoding: NamedEncoding
) -> Float[np.ndarray, "height width 3"]:
    """Linear light of a file, if its numbers have the other encoding.

    **Arguments:**

    - `image`: linear light, from numbers decoded by `encoding`.
    """
    numbers = encode(np.clip(image, 0, 1), encoding)
    return np.asarray(decode(numbers, other_encoding(encoding)), image.dtype)


def encoding_words(found: Fit, other: Fit, encoding: NamedEncoding) -> tuple[str, ...]:
    """Warning of a file whose numbers fit the model better in the other encoding.

    Residuals are compared in linear light and in sRGB, since each fit is at an
    advantage in the space that its residuals are minimised in; the ratio is the
    geometric mean.

    **Arguments:**

    - `found`: a fit to photographs decoded by `encoding`.
    - `other`: the same fit to the photographs of [`reread`][].
    """
    rival = other_encoding(encoding)
    mine, theirs = _residuals(found, encoding), _residuals(other, rival)
    ratio = float(np.sqrt(np.prod(mine / theirs)))
    if not ratio > SUSPECT:
        return ()
    words = (
        f"read as {rival}, the photograph fits the model better: residuals are "
        f"{ratio:.1f} times smaller than with encoding={encoding}"
    )
    remedy = f"Read it with encoding={rival} unless its encoding is known"
    return (coded("encoding-doubtful", words, remedy),)


def _residuals(found: Fit, encoding: NamedEncoding) -> Float[np.ndarray, "2"]:
    """Root mean square residuals of the files' numbers: as they are, and decoded."""
    squares, count = np.zeros(2), 0
    for image, residual in zip(
        _listed(found.photographs), _listed(found.residuals), strict=True
    ):
        used = residual != 0
        seen = np.clip(image[used], 0, 1)
        shown = np.clip(seen - residual[used], 0, 1)
        numbers = encode(seen, encoding), encode(shown, encoding)
        decoded = decode(numbers[0], "srgb"), decode(numbers[1], "srgb")
        for k, (a, b) in enumerate((numbers, decoded)):
            squares[k] += np.sum((np.asarray(a, float) - b) ** 2)
        count += used.sum()
    return np.sqrt(squares / max(count, 1))


def _listed(images: np.ndarray | Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    return [images] if isinstance(images, np.ndarray) else images
