"""Warnings of a fit with remedies that name controls of the page."""

from collections.abc import Mapping
from types import MappingProxyType

from phongfit.codes import REMEDIES, coded, warning_code

PAGE_REMEDIES: Mapping[str, str] = MappingProxyType(
    {
        "not-converged": "Move the sliders of the light and the circle nearer to the "
        "photograph, and fit again",
        "not-identifiable": "Fit a target that depends on it: lit, not white, and with "
        "a highlight",
        "no-highlight": "Quote no exponent, or load a photograph that shows a "
        "highlight",
        "all-white": "Load a photograph that is exposed less, or a mask without what "
        "is overexposed",
        "degenerate": "Set the light by its sliders, and remove the tick at “the "
        "light's direction or position is unknown too”",
        "rejected-highlight": "Choose the loss “least squares”, or load a mask if they "
        "show something else",
        "moving-edge": "Raise “rim left out”, load a mask without the edge, or move "
        "the light nearer to the truth",
        "at-bound": "Quote it as a limit, without ±",
        "bound-decides": "Compare “intensity” and “ambient light” with the "
        "photograph: too little or too much light moves a number to its bound",
        "two-solutions": "Move the light nearer to the truth and fit again, or remove "
        "the tick at “the light's direction or position is unknown too”",
        "lack-of-fit": "Look at “Target − fit”. Check the circle, the light and the "
        "encoding; raise “rim left out”, load a mask of what does not belong, or try "
        "the other “highlight”",
        "encoding-doubtful": "Load the photograph in the other encoding, unless you "
        "know its own",
        "jpeg-blocks": "Load the photograph as PNG or TIFF, saved without loss by the "
        "camera or from its raw file",
        "low-white": "Load a mask without these samples, or start again with "
        "`phongfit lab PHOTO --white LEVEL`",
        "few-unclipped": "Load a photograph that is exposed less",
        "outliers": "Load a mask without them, or choose the loss “Cauchy” or “Tukey”",
    }
)
"""Remedies on the page, by the codes of warnings that its fits can give."""


def in_page_words(warning: str) -> str:
    """A warning of a fit whose remedy names controls of the page, not of Python."""
    code = warning_code(warning)
    if code is None or code not in PAGE_REMEDIES:
        return warning
    sentences = warning.removesuffix(f" [{code}]")
    # The remedy is the last sentence, and has no full stop inside.
    found = sentences.removesuffix(f". {REMEDIES[code]}")
    if found == sentences:
        found = sentences.rpartition(". ")[0]
    found = found.replace("scene.lights[0].", "light ")
    return coded(code, found, PAGE_REMEDIES[code])
