"""Codes and remedies of all warnings.

A warning ends with what to try and its code in brackets: `shininess lies at its upper
bound 1000: its error is one-sided. Try … [at-bound]`. Sentences may change from version
to version, codes stay. `docs/how-to/warnings.md` has a paragraph for each.
"""

import functools
import importlib.metadata
import re
import warnings
from collections.abc import Mapping
from types import MappingProxyType

REMEDIES: Mapping[str, str] = MappingProxyType(
    {
        # Warnings of fits.
        "not-converged": "Raise max_steps, or hold one of two unknowns that are nearly "
        "degenerate",
        "not-identifiable": "Leave it out of unknowns, or use pixels that depend on it",
        "no-highlight": "Quote no exponent, or light it so that a highlight is seen",
        "all-white": "Expose less, or mask what is overexposed",
        "degenerate": "Hold one of them (fixed), give one a prior, or add an image in "
        "which they differ",
        "rejected-highlight": 'Try loss="linear", or a mask if they show something '
        "else",
        "moving-edge": "Mask out what lies near the edge, or start nearer to the truth",
        "at-bound": "Quote fit.intervals() in place of ±",
        "bound-decides": "Look for light that is missing from the image, or too much "
        "of it in the scene",
        "prior-conflict": "Widen the prior, or look for what else is wrong",
        "two-solutions": "Hold a number in which they differ (fixed), give one a "
        "prior, or add an image under another light",
        "lack-of-fit": "Look at plot_residuals(); mask what does not belong, try "
        "another specular model, or make what may be wrong unknown",
        "encoding-doubtful": "Read the photograph with the other encoding",
        "jpeg-blocks": "Fit the photograph as it lies in its file, with "
        "film=pf.read_film(path, encoding)",
        "coarse-jpeg": "Use the photograph at quality 50 or better",
        "jpeg-texels": "Take photographs without loss: PNG, TIFF or raw",
        "noise-level": "Give the noise as it is, or leave it to be estimated",
        "low-white": "State the number that is white (read_image(white=…), or "
        "--white), or mask these samples",
        "few-unclipped": "Give noise, or expose less",
        "outliers": "Leave them out by a mask, or try a robust loss",
        # Warnings of maps, heights and meshes.
        "bulging-normals": "Try the lights with y (or x) of the opposite sign",
        "broad-highlights": "Let pixels share their highlight (materials=1, or as many "
        "as the object has), or bound it (shininess from 15)",
        "pixels-misplaced": "Fit in more passes (passes=5), or give the scenes the "
        "object's own surface",
        "strengths-doubtful": 'Let them be fitted (strengths="fit", or --strengths '
        "fit), or check the lamps and the exposures",
        "materials-run-out": "Give their number (materials=1), or make ambient one of "
        "the unknowns if the room was not dark",
        "fov-doubtful": "Give the camera's angle of view (fov), or fit it (fit_fov, or "
        "--fov fit)",
        "separate-pieces": "Give depth where it is known, which moves them",
        "vague-normals": "Mask these pixels, or photograph them under more lights",
        "nothing-seen": "Aim the camera at it, or give two_sided=True if its faces "
        "show their backs",
        # Warnings about files.
        "saturated": "Leave these pixels out, with read_photograph's mask",
        "list-count": "Check that no line of the list is missing",
        "exif-broken": "Save it anew if it lies on its side",
        "jpeg-turned": "Turn it without loss first (jpegtran -trim)",
        "part-unused": "Put what is missing beside the file, bake what is not used "
        "into its textures, or go on without it",
        "texture-unread": "Read it with its mesh (load_mesh), or go on with one colour",
        "nearest-taken": "Export to a format that holds it, or expect what is written",
        "unregistered": "Call register(class, kind) before saving",
        # Warnings of calibrations.
        "several-matte": "Give the circle of the one that is meant (matte)",
        "outline-moved": "Look at the picture: the circle must lie on the rim",
        "outline-unseen": "Look at the picture, or give its circle as a fit by eye",
        "two-highlights": "Look at the picture: two lamps, or something that the "
        "sphere mirrors",
        "no-matte": "Let a fit find the strengths (the unknown exposure), or "
        "photograph a matte sphere",
        "strength-unknown": "Photograph it at another exposure, leave these "
        "photographs out, or let a fit find the strengths (the unknown exposure)",
        "left-out": "Look at it in the picture; take it out of the folder, photograph "
        "it again (exposed less where it is white), or give the spheres' circles",
        "one-sphere": "Look at the picture, or photograph a second sphere",
        "sphere-disagrees": "Check its circle, the camera's angle of view and the "
        "kind of lamps (distant, near)",
        "spheres-disagree": "Check the circles, and the kind of lamps",
        "matte-disagrees": "Check that it is matte, and the encoding",
        "slow-fall-off": "Take the lights from lights.json, which say so",
        # Warnings of response curves.
        "range-unseen": "Photograph brighter and darker, too",
        "not-one-curve": "Check that the surface is matte, that the camera stands "
        "still, and shape, lamps or exposures",
        # Warnings about the machine.
        "shared-cache": "Take away others' right to write (chmod go-w), or set "
        "PHONGFIT_CACHE=off",
        "open-to-others": "Leave --host out if only you are to use it",
    }
)
"""Default remedy for each code; a warning may replace it by a more specific one."""

PAGE = "docs/how-to/warnings.md"
"""The page on warnings, in the sources; the documentation's site has it as HTML."""

_CODE = re.compile(r" \[([a-z]+(?:-[a-z]+)*)\]$")


def coded(code: str, found: str, remedy: str | None = None) -> str:
    """A warning in one line: what is wrong, what to try, and the code in brackets.

    **Arguments:**

    - `code`: a key of `REMEDIES`.
    - `found`: what is wrong, and how large it is; no full stop at its end.
    - `remedy`: what to try; default the one in `REMEDIES`.
    """
    return f"{found}. {REMEDIES[code] if remedy is None else remedy} [{code}]"


def warn(code: str, found: str, remedy: str | None = None, *, stacklevel: int) -> None:
    """Call Python's `warnings.warn` with the text of [`coded`][].

    **Arguments:** `stacklevel`: as for `warnings.warn`: 1 is the line of this call.
    """
    warnings.warn(coded(code, found, remedy), stacklevel=stacklevel + 1)


def warning_code(warning: str | Warning) -> str | None:
    """The code of a warning, such as `"at-bound"`.

    It stands in brackets at the end of the text. The text may change from version to
    version; the code keeps its meaning. Python's warnings can be silenced by code:
    `warnings.filterwarnings("ignore", r".*\\[texture-unread\\]$")`.

    **Arguments:** `warning`: a sentence of `fit.warnings` and the like, or what
    `warnings.warn` was called with.

    **Returns:** the code, or `None` if the text has none, as in version 0.1.
    """
    found = _CODE.search(str(warning))
    return found[1] if found else None


def paragraph(code: str) -> str:
    """Address of a code's paragraph in the documentation: its site, or the sources."""
    site = _site()
    return f"{site}/how-to/warnings.html#{code}" if site else f"{PAGE}#{code}"


@functools.cache
def _site() -> str | None:
    """URL of the documentation, from the package's metadata; `None` if it has none."""
    try:
        stated = importlib.metadata.metadata("phongfit").get_all("Project-URL") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    urls = dict(one.split(", ", 1) for one in stated)
    return urls.get("Documentation", "").rstrip("/") or None
