"""`calibrate`: lamps and their covariance from photographs of spheres."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from phongfit.calibration.highlights import Highlight, find_highlights
from phongfit.calibration.lamps import (
    Candidates,
    Chrome,
    LampEstimate,
    Lamps,
    angles,
    choose,
    follow,
    show_two_lamps,
    solve_lamps,
)
from phongfit.calibration.least_squares import differentiated
from phongfit.calibration.matte import (
    DARK,
    Matte,
    Place,
    Strengths,
    find_strengths,
    matte_sphere,
    overexposed,
)
from phongfit.calibration.outlines import (
    SMALLEST,
    View,
    as_circle,
    dots,
    sphere_behind,
    unit,
)
from phongfit.calibration.result import CalibratedSphere, Calibration, Lamp
from phongfit.calibration.spheres import (
    Crop,
    Images,
    Kind,
    Outline,
    cut_out,
    eye_error,
    find_spheres,
    looked_at,
    names_of,
    place_sphere,
)
from phongfit.codes import coded
from phongfit.edge import checked, shown
from phongfit.rendering.film import Film

DISAGREEING = 5.0
"""Photographs with a highlight further than this from the prediction, in σ, are left
out."""

MOVED = 4.0
"""Distance of a circle from the sphere's outline that is worth a warning, pixels."""

BEST = np.radians(0.03)
"""Smallest error of a direction, radians: lenses distort and spheres are imperfect."""


@checked
def calibrate(
    photographs: Any,
    *,
    chrome: Sequence[Sequence[float]] | None = None,
    matte: Sequence[float] | None = None,
    sphere_radius: float = 1.0,
    fov: float | None = None,
    lamps: Lamps = "distant",
    names: Sequence[str] | None = None,
) -> Calibration:
    """Estimate the lamps of photographs from a standing camera, one lamp each.

    A chrome sphere shows the place of each lamp, a matte one its place and strength.
    All highlights and all shading are fitted together, by least squares; the agreement
    of the spheres determines the standard errors.

        found = pf.calibrate(images, chrome=[(179, 565, 88), (781, 565, 88)],
                             matte=(179, 155, 81), fov=14)
        scenes = [pf.Scene(surface, found.camera, light) for light in found.lights]

    **Arguments:**

    - `photographs`: linear light, (height, width, 3), all of one size. Any sequence;
        one that reads each file on access needs little memory. For a [`Capture`][] the
        errors of strengths include the rounding of its files.
    - `chrome`: circles (x, y, radius) of the outlines of chrome spheres of one size, in
        pixels from the upper left corner. They are moved onto visible outlines.
        Default, without `matte` as well: chrome and matte spheres are searched for.
    - `matte`: circle of a matte, grey or white sphere.
    - `sphere_radius`: of the chrome spheres, or of the matte one if it is the only
        sphere; determines the unit of all lengths.
    - `fov`: the camera's angle from the photographs' lower to their upper edge,
        degrees; default parallel rays (a long lens, far away).
    - `lamps`: `"distant"` or `"near"`; near ones need two chrome spheres, or a chrome
        and a matte one.
    - `names`: of the photographs, for messages.

    **Returns:** a [`Calibration`][].

    **Raises:** `ValueError` that names the argument, or what is missing in photographs.
    """
    photographs = _several(photographs)
    names = names_of(photographs, names)
    height, width = next(looked_at(photographs, names)).shape[:2]
    view = View(width, height, _positive("fov", fov, 180) if fov is not None else None)
    radius = _positive("sphere_radius", sphere_radius)
    warnings: list[str] = []
    outlines = _outlines(photographs, names, chrome, matte, view, warnings)
    crops = cut_out(
        photographs, names, [outline for _, outline in outlines], (height, width)
    )
    spheres = _placed(outlines, crops, view, warnings)
    # A capture knows its film.
    film = getattr(photographs, "film", Film(clamp=False))
    setup = _set_up(names, view, radius, lamps, spheres, crops, film, warnings)
    shaded = None if setup.matte is None else setup.matte.shaded
    mirrors = zip(crops, setup.chrome.outlines, strict=False)
    highlights = [_highlights(crop, outline) for crop, outline in mirrors]
    candidates = follow(highlights, setup.chrome, view)
    chosen = choose(candidates, (len(names), len(highlights)), lamps, shaded)
    left_out = _without_lamp(setup, chosen)
    left_out |= _with_two_lamps(setup, candidates, chosen, left_out)
    estimate, kept = _solve(setup, candidates, chosen, left_out)
    strengths = _find_strengths(setup, estimate, kept)
    _judge(setup, estimate, kept, left_out)
    missing = np.full((1, 2), np.nan)
    pixels = np.concatenate([candidates.pixel, missing])[chosen[kept]]
    found = _result(setup, estimate, strengths, kept, left_out, pixels)
    return replace(found, warnings=tuple(warnings))


def _several(photographs: Any) -> Images:
    """The photographs as a sequence, not yet read."""
    if isinstance(photographs, Iterator | np.ndarray):
        photographs = list(photographs)
    if isinstance(photographs, Sequence) and not isinstance(photographs, str | bytes):
        return photographs
    raise ValueError(
        f"photographs: expected a list of images, got {shown(photographs)}"
    )


def _positive(name: str, value: float, below: float = np.inf) -> float:
    number = float(value)
    if not 0 < number < below:
        limit = f" and < {below:g}" if np.isfinite(below) else ""
        raise ValueError(f"{name}: expected a number > 0{limit}, got {value!r}")
    return number


def _outlines(
    photographs: Images,
    names: Sequence[str],
    chrome: Sequence[Sequence[float]] | None,
    matte: Sequence[float] | None,
    view: View,
    warnings: list[str],
) -> list[tuple[Kind, Outline]]:
    if not chrome and matte is None:
        found = find_spheres(photographs, names)
        mattes = [outline for kind, outline in found if kind == "matte"]
        if len(mattes) > 1:
            words = (
                f"{len(mattes)} matte spheres are seen, and the clearest one is used"
            )
            warnings.append(coded("several-matte", words))
        shown = [one for one in found if one[0] == "chrome"]
        return shown + [("matte", outline) for outline in mattes[:1]]
    given: list[tuple[Kind, Outline]] = [
        ("chrome", as_circle(f"chrome[{n}]", circle, view, least=SMALLEST))
        for n, circle in enumerate(chrome or ())
    ]
    if matte is not None:
        given.append(("matte", as_circle("matte", matte, view, least=SMALLEST)))
    return given


def _placed(
    outlines: Sequence[tuple[Kind, Outline]],
    crops: Sequence[Crop],
    view: View,
    warnings: list[str],
) -> list[CalibratedSphere]:
    spheres = []
    for (kind, outline), crop in zip(outlines, crops, strict=True):
        placed = place_sphere(crop, outline, kind, view)
        sphere = CalibratedSphere(kind, placed.outline, placed.covariance)
        spheres.append(sphere)
        x, y, radius = outline
        where = f"{kind} sphere at {x:.0f}, {y:.0f}"
        distance = np.abs(placed.outline - outline).max()
        if distance > MOVED:
            words = (
                f"{where}: an outline is seen {distance:.0f} pixels from the given "
                "circle, and is used: {:.0f} {:.0f} {:.0f}".format(*placed.outline)
            )
            warnings.append(coded("outline-moved", words))
        elif distance == 0:
            words = (
                f"{where}: its outline is hardly seen (on {placed.coverage:.0%} of the "
                "circle), so the circle is used as given, "
                f"± {eye_error(radius):.1f} pixels"
            )
            warnings.append(coded("outline-unseen", words))
    return spheres


class _Setup(NamedTuple):
    """Spheres and camera, for all stages of a calibration.

    - `reference`: point on the optical axis, at the mean depth of the spheres.
    - `warnings`: filled by the stages.
    """

    names: tuple[str, ...]
    view: View
    radius: float
    lamps: Lamps
    spheres: Sequence[CalibratedSphere]
    chrome: Chrome
    matte: Matte | None
    reference: Float[np.ndarray, "3"]
    warnings: list[str]

    def warn(self, code: str, words: str, remedy: str | None = None) -> None:
        self.warnings.append(coded(code, words, remedy))

    def some_names(self, numbers: Sequence[int]) -> str:
        """Names of the first three photographs, in words."""
        names = ", ".join(self.names[number] for number in numbers[:3])
        return names + (" …" if len(numbers) > 3 else "")


def _set_up(
    names: tuple[str, ...],
    view: View,
    radius: float,
    lamps: Lamps,
    spheres: Sequence[CalibratedSphere],
    crops: Sequence[Crop],
    film: Film,
    warnings: list[str],
) -> _Setup:
    if lamps == "near" and len(spheres) < 2:
        raise ValueError(
            "lamps: expected two spheres to see how far near lamps are, got one"
        )
    chrome = [sphere for sphere in spheres if sphere.kind == "chrome"]
    outlines = np.array([sphere.outline for sphere in chrome]).reshape(-1, 3)
    spread = np.array([sphere.covariance for sphere in chrome]).reshape(-1, 3, 3)
    given = np.array([sphere.outline for sphere in chrome or spheres])
    depth = sphere_behind(given, view, radius)[:, 2].mean()
    reference, matte = np.array([0, 0, depth]), None
    if spheres[-1].kind == "matte":
        place, covariance = _matte_place(spheres[-1], outlines, view, radius, lamps)
        crop = crops[-1]
        at = crop.light, crop.corner, place, covariance
        matte = matte_sphere(*at, view, reference, film)
    mirrors = Chrome(outlines, spread, radius)
    known = names, view, radius, lamps, spheres
    return _Setup(*known, mirrors, matte, reference, warnings)


def _matte_place(
    sphere: CalibratedSphere,
    chrome: Float[np.ndarray, "spheres 3"],
    view: View,
    radius: float,
    lamps: Lamps,
) -> tuple[Place, Float[np.ndarray, "5 5"]]:
    """Initial place of the matte sphere, at the others' depth, and its covariance."""
    near, other = lamps == "near", len(chrome) > 0
    if other and view.focal is not None:
        depths = sphere_behind(chrome, view, radius)[:, 2]
        radius = depths.mean() / sphere_behind(sphere.outline, view, 1.0)[2]
    elif other:
        radius *= sphere.outline[2] / chrome[:, 2].mean()
    covariance = np.zeros((5, 5))
    covariance[:3, :3] = sphere.covariance
    covariance[3, 3] = (0.3 if near and other else 0.05 if other else 1e-6) ** 2
    covariance[4, 4] = (0.7 if near else 1e-6) ** 2
    return Place(sphere.outline, float(radius), 1.0 if near else 0.0), covariance


def _highlights(crop: Crop, outline: Outline) -> list[list[Highlight]]:
    """Candidates for the lamp on one sphere, by photograph; none if it is dark."""
    grey = crop.grey
    still = grey.min(axis=0) if len(grey) >= 4 else None
    glints = grey.max(axis=(1, 2))
    dark = DARK * np.median(glints)
    found = []
    for image, glint in zip(grey, glints, strict=True):
        inside = crop.within(outline)
        ones = find_highlights(image, inside, still) if glint > dark else []
        found.append([one._replace(pixel=one.pixel + crop.corner) for one in ones])
    return found


def _without_lamp(
    setup: _Setup,
    chosen: Int[np.ndarray, "photographs spheres"],
) -> dict[int, str]:
    """Photographs without a visible lamp, or with too few spheres for a near lamp."""
    white, shows = np.zeros(len(chosen), bool), (chosen >= 0).sum(axis=1)
    if setup.matte is not None:
        white = overexposed(setup.matte.points)
        shows = shows + setup.matte.shaded.any(axis=1)
    left_out: dict[int, str] = {}
    for number, count in enumerate(shows):
        if count == 0:
            left_out[number] = "no highlight is seen on a sphere, and " + (
                "the matte one is overexposed" if white[number] else "no shading"
            )
        elif setup.lamps == "near" and count < 2:
            left_out[number] = (
                "one sphere alone shows its lamp, which near lamps need two for"
            )
    if len(left_out) == len(chosen):
        raise ValueError(
            "photographs: in none of them a lamp is seen on the spheres; "
            + ("expose less" if white.any() else "are the circles right?")
        )
    return left_out


def _with_two_lamps(
    setup: _Setup,
    candidates: Candidates,
    chosen: Int[np.ndarray, "photographs spheres"],
    left_out: dict[int, str],
) -> dict[int, str]:
    """Photographs under two lamps; with a single sphere only a warning.

    **Raises:** `ValueError` if no photograph remains.
    """
    double = np.flatnonzero(show_two_lamps(candidates, chosen, setup.lamps)).tolist()
    if len(double) and len(setup.chrome.outlines) < 2:
        words = "the sphere shows two highlights that are alike"
        setup.warn("two-highlights", f"{setup.some_names(double)}: {words}")
        return {}
    if len({*double, *left_out}) == len(chosen):
        raise ValueError(
            "photographs: expected one lamp in each, got two in "
            f"{setup.names[double[0]]} and none that can be used"
        )
    return dict.fromkeys(double, "it shows two lamps")


def _solve(
    setup: _Setup,
    candidates: Candidates,
    chosen: Int[np.ndarray, "photographs spheres"],
    left_out: dict[int, str],
) -> tuple[LampEstimate, list[int]]:
    """Estimate the lamps of consistent photographs; others are added to `left_out`."""
    while True:
        kept = [n for n in range(len(chosen)) if n not in left_out]
        estimate = solve_lamps(
            candidates,
            chosen[kept],
            setup.chrome,
            setup.view,
            setup.lamps,
            setup.reference,
            None if setup.matte is None else setup.matte.of(kept),
        )
        beyond = estimate.inverse_distances <= 0
        if setup.lamps == "near" and beyond.any():
            if beyond.all():
                raise ValueError(
                    "lamps: expected near ones, got rays from the spheres that do not "
                    "meet; are the lamps distant?"
                )
            wrong, why = beyond, "its lamp is not near: the rays do not meet"
        else:
            wrong = np.nanmax(estimate.residuals, axis=1, initial=0) > DISAGREEING
            why = "its spheres disagree on where the lamp is"
            if not wrong.any() or (~wrong).sum() < 2:
                return estimate, kept
        left_out |= {kept[n]: why for n in np.flatnonzero(wrong)}


def _find_strengths(
    setup: _Setup, estimate: LampEstimate, kept: list[int]
) -> Strengths:
    """Strengths of the lamps, `nan` without a matte sphere."""
    if setup.matte is None or estimate.place is None:
        setup.warn("no-matte", "no matte sphere: how strong the lamps are is not known")
        size = 3 * len(kept)
        nothing, none = np.full((len(kept), 3), np.nan), np.zeros((size, size))
        return Strengths(nothing, none, np.zeros((size, size + 5)))
    matte = setup.matte.of(kept)._replace(place=estimate.place)
    lamps = estimate.directions, estimate.tangents, estimate.inverse_distances
    found = find_strengths(matte, *lamps)
    dark = ~np.isfinite(found.intensity).all(axis=1)
    if dark.any():
        white = overexposed(matte.points)[dark].all()
        setup.warn(
            "strength-unknown",
            f"{setup.some_names([kept[n] for n in np.flatnonzero(dark)])}: the matte "
            f"sphere is {'overexposed' if white else 'hardly lit'}, and does not "
            "say how strong the lamp is",
        )
    return found


def _numbers(
    near: bool, step: Any, estimate: Any, strengths: Any, known: Any, reference: Any
) -> Any:
    """Positions or directions, strengths, and the fall-off, near an estimate.

    A step has the numbers of `estimate.joint`, errors of strengths, and the logarithm
    of a factor on all distances from the camera, which a pinhole's image does not
    determine. Strengths are those at the fixed reference point, over their mean.
    """
    size = strengths.slopes.shape[1]
    joint, errors, scale = jnp.split(step, (size, 2 * size - 5))
    own = joint[:-5].reshape(-1, 3)
    turned = jnp.einsum("li,lij->lj", own[:, :2], estimate.tangents)
    places = unit(estimate.directions + turned)
    moved = strengths.slopes @ joint + errors
    strength = strengths.intensity + moved.reshape(-1, 3)
    if near:
        offset = (
            jnp.exp(scale) * places / (estimate.inverse_distances + own[:, 2])[:, None]
        )
        places = jnp.exp(scale) * reference + offset
        nearer = dots(offset, offset) / dots(places - reference, places - reference)
        strength = strength * nearer
    mean = jnp.sum(strength * known) / jnp.maximum(jnp.sum(known), 1)
    strength = strength / jnp.where(mean > 0, mean, 1)
    return jnp.concatenate([places.ravel(), strength.ravel(), joint[-1:]])


def _result(
    setup: _Setup,
    estimate: LampEstimate,
    strengths: Strengths,
    kept: list[int],
    left_out: dict[int, str],
    pixels: Float[np.ndarray, "lamps spheres 2"],
) -> Calibration:
    """Lamps with their joint covariance, to first order."""
    near, count, chrome = setup.lamps == "near", len(kept), setup.chrome
    known = np.isfinite(strengths.intensity)
    mean = strengths.intensity[known].mean() if known.any() else 1.0
    mean = mean if mean > 0 else 1.0
    floor = np.diag([BEST**2 / 2, BEST**2 / 2, 0])
    joint = estimate.joint.copy()
    joint[:-5, :-5] += np.kron(np.eye(count), floor)
    scale = 0.0
    if near and setup.view.focal is not None and len(chrome.outlines):
        # Errors of radii are common to all spheres, since their rims look alike.
        sizes = chrome.outlines[:, 2]
        scale = float(np.mean(np.sqrt(chrome.covariances[:, 2, 2]) / sizes))
    from scipy.linalg import block_diag

    spread = np.asarray(block_diag(joint, strengths.covariance, scale**2))
    filled = strengths._replace(intensity=np.nan_to_num(strengths.intensity))
    numbers = differentiated(functools.partial(_numbers, near))
    values, slopes = numbers(
        np.zeros(len(spread)),
        estimate._replace(place=None),
        filled,
        known.astype(float),
        setup.reference,
    )
    covariance = slopes @ spread @ slopes.T
    errors = np.sqrt(np.diag(covariance))
    places, intensity = values[:-1].reshape(2, count, 3)
    intensity_error = errors[3 * count : -1].reshape(count, 3)
    own = [slice(3 * number, 3 * number + 3) for number in range(count)]
    turns = [np.trace(joint[lamp, lamp][:2, :2]) for lamp in own]
    rows = zip(
        [setup.names[number] for number in kept],
        estimate.directions,
        places if near else [None] * count,
        [covariance[lamp, lamp] for lamp in own],
        np.degrees(np.sqrt(turns)).tolist(),
        np.where(known, intensity, np.nan),
        np.where(known, intensity_error, np.nan),
        pixels,
        strict=True,
    )
    lamps = [Lamp(*row) for row in rows]
    # Chrome spheres come first, and a matte one may follow.
    place = estimate.place
    outlines = [*estimate.outlines, *([] if place is None else [place.outline])]
    spheres = tuple(
        sphere._replace(outline=outline)
        for sphere, outline in zip(setup.spheres, outlines, strict=True)
    )
    ambient, error = np.zeros(3), np.zeros(3)
    if setup.matte is not None:
        ambient, error = setup.matte.ambient, setup.matte.ambient_error
    falloff = 1.0 if place is None else float(place.falloff)
    return Calibration(
        setup.view,
        tuple(lamps),
        spheres,
        setup.radius,
        setup.reference,
        falloff if near else 0.0,
        ambient / mean,
        {setup.names[n]: why for n, why in sorted(left_out.items())},
        (),
        _view_height(setup, spheres),
        covariance if known.all() else covariance[: 3 * count, : 3 * count],
        float(errors[-1]) if near else 0.0,
        error / mean,
    )


def _view_height(setup: _Setup, spheres: Sequence[CalibratedSphere]) -> float | None:
    """Height of the view for parallel rays, from the spheres' radius in pixels."""
    if setup.view.fov_y is not None:
        return None
    sizes = [s.outline[2] for s in spheres if s.kind == "chrome"]
    sizes = sizes or [s.outline[2] for s in spheres]
    return float(setup.view.height * setup.radius / np.mean(sizes))


def _judge(
    setup: _Setup,
    estimate: LampEstimate,
    kept: list[int],
    left_out: dict[int, str],
) -> None:
    """Add the warnings of the whole calibration."""
    outlines, near = setup.chrome.outlines, setup.lamps == "near"
    for number, why in sorted(left_out.items()):
        setup.warn("left-out", f"{setup.names[number]} is left out: {why}")
    if len(outlines) == 1 and setup.matte is None:
        setup.warn("one-sphere", "one sphere alone: its highlights are unchecked")
    shown = np.isfinite(estimate.residuals).mean(axis=0)
    for (x, y, _), share in zip(outlines, shown, strict=True):
        if share < 0.7:
            setup.warn(
                "sphere-disagrees",
                f"the highlights of the chrome sphere at {x:.0f}, {y:.0f} agree with "
                f"the others in {share:.0%} of the photographs only",
            )
    if estimate.scatter > 2:
        setup.warn(
            "spheres-disagree",
            f"the spheres' highlights disagree by {estimate.scatter:.1f} times "
            "their accuracy",
            "Check the circles, and whether the lamps are "
            + ("distant" if near else "near"),
        )
    if setup.matte is not None and len(outlines) and not near:
        shaded = setup.matte.shaded[kept]
        apart = np.degrees(angles(shaded, estimate.directions))[shaded.any(axis=1)]
        if len(apart) and np.median(apart) > 3:
            setup.warn(
                "matte-disagrees",
                f"the matte sphere's shading is {np.median(apart):.1f}° from the "
                "chrome spheres' highlights",
            )
    if near and estimate.place is not None and estimate.place.falloff < 0.8:
        setup.warn(
            "slow-fall-off",
            "the lamps' light falls off more slowly than with the square of the "
            f"distance (κ = {estimate.place.falloff:.2f}), as through a lens or "
            "reflector",
        )
