"""Comparison of fits to the same files, read as linear and as sRGB."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from phongfit.codes import coded, warning_code
from phongfit.fitting.result import Fit
from phongfit.rendering.film import Film, NamedEncoding, decode, encode

SUSPECT = 1.5
"""Ratio of the residuals from which on the encoding is doubted."""


def with_encoding_doubts(
    found: Fit, fit_again: Callable[[tuple[np.ndarray, ...], Film], Fit]
) -> Fit:
    """The fit, with a warning if the other encoding explains its photographs better.

    Only a fit with lack of fit is compared, and only where the film states the encoding
    or the image's rounding shows it.

    **Arguments:** `fit_again`: from photographs and their film to the fit of them.
    """
    films, encoding = found.films, found.films[0].encoding
    stated = found.specification.film is not None or films[0].bits is not None
    if not isinstance(encoding, str) or not (stated and films[0].clamp):
        return found
    one_encoding = all(film.encoding == encoding for film in films)
    if not one_encoding or "lack-of-fit" not in map(warning_code, found.warnings):
        return found
    images = tuple(reread(image, encoding) for image in _listed(found.photographs))
    other = fit_again(images, Film(encoding=other_encoding(encoding)))
    doubts = encoding_words(found, other, encoding)
    return dataclasses.replace(found, warnings=(*found.warnings, *doubts))


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
