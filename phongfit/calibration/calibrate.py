"""`calibrate`: from photographs with spheres in them to lamps, with errors."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from phongfit.calibration.highlights import Highlight, find_highlights
from phongfit.calibration.lamps import (
    Chrome,
    LampEstimate,
    Lamps,
    angles,
    choose,
    show_two_lamps,
    solve_lamps,
)
from phongfit.calibration.matte import (
    DARK,
    Matte,
    Place,
    Strengths,
    find_strengths,
    overexposed,
    room_light,
    shaded_directions,
)
from phongfit.calibration.outlines import (
    SMALLEST,
    View,
    across,
    as_circle,
    sphere_behind,
)
from phongfit.calibration.result import CalibratedSphere, Calibration, Lamp
from phongfit.calibration.spheres import (
    SEEN,
    Crop,
    Developed,
    Images,
    Kind,
    Outline,
    cut_out,
    find_spheres,
    looked_at,
    place_sphere,
)
from phongfit.codes import coded
from phongfit.edge import checked, shown
from phongfit.rendering.film import Film

DISAGREEING = 5.0
"""A highlight this many standard deviations from its lamp's place is another's."""

BEST = np.radians(0.03)
"""No direction is stated to be better: lenses distort, no sphere is quite round."""


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
    """Find the lamps of photographs of a standing camera, one lamp each.

    A chrome sphere shows where each lamp is, a matte one where and how strong. All
    highlights and all shading are explained together, by least squares; errors follow
    from how well the spheres agree.

        found = pf.calibrate(images, chrome=[(179, 565, 88), (781, 565, 88)],
                             matte=(179, 155, 81), fov=14)
        scenes = [pf.Scene(surface, found.camera, light) for light in found.lights]

    **Arguments:**

    - `photographs`: linear light, (height, width, 3), all of one size. Any sequence:
        one that reads each file when it is asked for needs little memory. Of a
        [`Capture`][] it is known what its files round, and strengths' errors have it.
    - `chrome`: circles (x, y, radius) of the outlines of chrome spheres of one size, in
        pixels from the upper left corner. Where an outline is seen they are moved onto
        it. Default: spheres are looked for, matte ones too.
    - `matte`: the same of a matte, grey or white sphere.
    - `sphere_radius`: of the chrome spheres, or of the matte one where there is no
        other; the unit of all lengths.
    - `fov`: the camera's angle from the photographs' lower to their upper edge,
        degrees; default parallel rays (a long lens, far away).
    - `lamps`: `"distant"` or `"near"`; near ones need two chrome spheres, or a chrome
        and a matte one.
    - `names`: of the photographs, for messages.

    **Returns:** a [`Calibration`][].

    **Raises:** `ValueError` that names the argument, or what is not seen.
    """
    photographs = _several(photographs)
    names = _names(photographs, names)
    height, width = next(looked_at(photographs, names)).shape[:2]
    view = View(width, height, _positive("fov", fov, 180) if fov is not None else None)
    radius = _positive("sphere_radius", sphere_radius)
    warnings: list[str] = []
    outlines = _outlines(photographs, names, chrome, matte, view, warnings)
    crops = cut_out(
        photographs, names, [outline for _, outline in outlines], (height, width)
    )
    spheres = _placed(outlines, crops, view, warnings)
    film = photographs.film if isinstance(photographs, Developed) else Film(clamp=False)
    return _Session(names, view, radius, lamps, spheres, crops, film, warnings).run()


def _several(photographs: Any) -> Images:
    """A sequence, of which nothing is asked for yet."""
    if isinstance(photographs, Iterator | np.ndarray):
        photographs = list(photographs)
    if isinstance(photographs, Sequence) and not isinstance(photographs, str | bytes):
        return photographs
    raise ValueError(
        f"photographs: expected a list of images, got {shown(photographs)}"
    )


def _names(photographs: Images, names: Sequence[str] | None) -> tuple[str, ...]:
    count = len(photographs)
    if count == 0:
        raise ValueError("photographs: expected at least one, got none")
    if names is None:
        return tuple(f"photograph {number}" for number in range(1, count + 1))
    if len(names) != count:
        raise ValueError(f"names: expected {count}, one a photograph, got {len(names)}")
    return tuple(names)


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
    if chrome is None and matte is None:
        found = find_spheres(photographs, names, (view.height, view.width))
        if not found:
            raise ValueError(
                "chrome: no sphere is seen in the photographs; give its circle, x, y "
                "and radius in pixels"
            )
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
        x, y, radius = outline
        if placed.coverage < SEEN:
            words = (
                f"{kind} sphere at {x:.0f}, {y:.0f}: its outline is hardly seen "
                f"(on {placed.coverage:.0%} of the circle), so the circle is used as "
                "given, ± 0.5 pixels"
            )
            warnings.append(coded("outline-unseen", words))
        spheres.append(CalibratedSphere(kind, placed.outline, placed.covariance))
    return spheres


class _Session:
    """One calibration, from placed spheres on."""

    def __init__(
        self,
        names: tuple[str, ...],
        view: View,
        radius: float,
        lamps: Lamps,
        spheres: Sequence[CalibratedSphere],
        crops: Sequence[Crop],
        film: Film,
        warnings: list[str],
    ):
        self.names, self.view, self.radius = names, view, radius
        self.lamps: Lamps = lamps
        self.spheres, self.warnings = spheres, warnings
        both = list(zip(spheres, crops, strict=True))
        chrome = [(s, crop) for s, crop in both if s.kind == "chrome"]
        self.chrome = Chrome(
            np.array([s.outline for s, _ in chrome]).reshape(-1, 3),
            np.array([s.covariance for s, _ in chrome]).reshape(-1, 3, 3),
            radius,
        )
        self.chrome_crops = [crop for _, crop in chrome]
        mattes = [(s, crop) for s, crop in both if s.kind == "matte"]
        if lamps == "near" and len(both) < 2:
            raise ValueError(
                "lamps: expected two spheres to see how far near lamps are, got one"
            )
        centres = sphere_behind(
            np.array([s.outline for s, _ in (chrome or mattes)]), view, radius
        )
        # On the optical axis, as deep as the spheres are.
        self.reference = np.array([0, 0, centres[:, 2].mean()])
        self.matte = self._matte(*mattes[0], film) if mattes else None

    def _matte(self, sphere: CalibratedSphere, crop: Crop, film: Film) -> Matte:
        """The matte sphere, as deep as the others to begin with."""
        near, other = self.lamps == "near", len(self.chrome.outlines) > 0
        radius = self.radius
        if other:
            depth = sphere_behind(sphere.outline, self.view, 1.0)[2]
            if self.view.focal is not None:
                radius = self.reference[2] / depth
            else:
                radius *= sphere.outline[2] / self.chrome.outlines[:, 2].mean()
        covariance = np.zeros((5, 5))
        covariance[:3, :3] = sphere.covariance
        covariance[3, 3] = (0.3 if near and other else 0.05 if other else 1e-6) ** 2
        covariance[4, 4] = (0.7 if near else 1e-6) ** 2
        place = Place(sphere.outline, float(radius), 1.0 if near else 0.0)
        matte = Matte(
            crop.light, crop.corner, place, covariance, self.view, self.reference
        )
        return matte._replace(film=film)

    def run(self) -> Calibration:
        shaded = None
        if self.matte is not None:
            shaded = shaded_directions(self.matte)
            light, error = room_light(self.matte, shaded)
            self.matte = self.matte._replace(ambient=light, ambient_error=error)
        on_spheres = [
            self._candidates(crop, outline)
            for crop, outline in zip(
                self.chrome_crops, self.chrome.outlines, strict=True
            )
        ]
        candidates = [
            [found[number] for found in on_spheres] for number in range(len(self.names))
        ]
        chosen = choose(candidates, self.chrome, self.view, self.lamps, shaded)
        left_out: dict[int, str] = {}
        self._leave_out_unseen(chosen, shaded, left_out)
        self._leave_out_double(candidates, chosen, left_out)
        estimate, kept = self._solve(chosen, left_out)
        return self._result(estimate, kept, left_out, shaded, chosen)

    def _candidates(self, crop: Crop, outline: Outline) -> list[list[Highlight]]:
        """What may be the lamp on one sphere, by photograph; none where it is dark."""
        grey = crop.grey
        still = grey.min(axis=0) if len(grey) >= 4 else None
        glints = grey.max(axis=(1, 2))
        dark = DARK * np.median(glints)
        return [
            _shifted(find_highlights(image, crop.within(outline), still), crop.corner)
            if glint > dark
            else []
            for image, glint in zip(grey, glints, strict=True)
        ]

    def _leave_out_unseen(
        self,
        chosen: list[list[Highlight | None]],
        shaded: np.ndarray | None,
        left_out: dict[int, str],
    ) -> None:
        """Photographs in which no lamp is seen, or only half of what places one."""
        white = np.zeros(len(chosen), bool)
        if self.matte is not None:
            white = overexposed(self.matte)
        for number, row in enumerate(chosen):
            shows = sum(one is not None for one in row)
            shows += int(shaded is not None and shaded[number].any())
            if shows == 0:
                left_out[number] = "no highlight is seen on a sphere, and " + (
                    "the matte one is overexposed" if white[number] else "no shading"
                )
            elif self.lamps == "near" and shows < 2:
                left_out[number] = (
                    "one sphere alone shows its lamp, which near lamps need two for"
                )
        if len(left_out) == len(chosen):
            raise ValueError(
                "photographs: in none of them a lamp is seen on the spheres; "
                + ("expose less" if white.any() else "are the circles right?")
            )

    def _leave_out_double(
        self,
        candidates: list[list[list[Highlight]]],
        chosen: list[list[Highlight | None]],
        left_out: dict[int, str],
    ) -> None:
        """Photographs under two lamps; one sphere alone is not enough to say so."""
        twice = show_two_lamps(candidates, chosen, self.chrome, self.view, self.lamps)
        double = np.flatnonzero(twice).tolist()
        if len(self.chrome.outlines) < 2:
            if double:
                names = ", ".join(self.names[number] for number in double[:3])
                self._warn(
                    "two-highlights",
                    f"{names}{' …' if len(double) > 3 else ''}: the sphere shows two "
                    "highlights that are alike",
                )
            return
        left_out |= {number: "it shows two lamps" for number in double}
        if len(left_out) == len(chosen):
            raise ValueError(
                "photographs: expected one lamp in each, got two in "
                f"{self.names[double[0]]} and none that can be used"
            )

    def _solve(
        self, chosen: list[list[Highlight | None]], left_out: dict[int, str]
    ) -> tuple[LampEstimate, list[int]]:
        """The lamps, without photographs that disagree with all the others."""
        while True:
            kept = [n for n in range(len(chosen)) if n not in left_out]
            matte = self.matte
            if matte is not None:
                matte = matte._replace(light=matte.light[kept])
            estimate = solve_lamps(
                [chosen[n] for n in kept],
                self.chrome,
                self.view,
                self.lamps,
                self.reference,
                matte,
            )
            if not len(self.chrome.outlines):
                return estimate, kept
            worst = np.nanmax(
                np.where(np.isfinite(estimate.residuals), estimate.residuals, 0), axis=1
            )
            wrong = [n for n, far in zip(kept, worst, strict=True) if far > DISAGREEING]
            if not wrong or len(kept) - len(wrong) < 2:
                return estimate, kept
            for n in wrong:
                left_out[n] = "its spheres disagree on where the lamp is"

    def _result(
        self,
        estimate: LampEstimate,
        kept: list[int],
        left_out: dict[int, str],
        shaded: np.ndarray | None,
        chosen: list[list[Highlight | None]],
    ) -> Calibration:
        strengths = self._strengths(estimate, kept)
        lamps, rows, used = [], [], []
        floor = np.diag([BEST**2 / 2, BEST**2 / 2, 0])
        joint = estimate.joint.copy()
        joint[:-5, :-5] += np.kron(np.eye(len(kept)), floor)
        together = strengths.slopes @ joint
        spread = strengths.covariance + together @ strengths.slopes.T
        errors = np.sqrt(np.diag(spread)).reshape(-1, 3)
        for place, number in enumerate(kept):
            direction = estimate.directions[place]
            mine = slice(3 * place, 3 * place + 3)
            covariance = joint[mine, mine]
            tangent = across(direction)
            # Of the direction, or of the place: d(u / w) = du / w − u dw / w².
            columns = np.concatenate([tangent.T, np.zeros((3, 1))], axis=1)
            position = None
            if self.lamps == "near":
                inverse = estimate.inverse_distances[place]
                if inverse <= 0:
                    left_out[number] = "its lamp is not near: the rays do not meet"
                    continue
                position = self.reference + direction / inverse
                columns = np.concatenate(
                    [tangent.T / inverse, -direction[:, None] / inverse**2], axis=1
                )
            row = np.zeros((3, len(joint)))
            row[:, mine] = columns
            rows.append(row)
            used += range(3 * place, 3 * place + 3)
            lamps.append(
                Lamp(
                    self.names[number],
                    direction,
                    position,
                    columns @ covariance @ columns.T,
                    float(np.degrees(np.sqrt(np.trace(covariance[:2, :2])))),
                    strengths.intensity[place],
                    np.where(
                        np.isfinite(strengths.intensity[place]), errors[place], np.nan
                    ),
                    _pixels(chosen[number]),
                )
            )
        falloff = 1.0 if estimate.place is None else estimate.place.falloff
        self._judge(estimate, kept, left_out, shaded, falloff)
        # Chrome spheres come first, and a matte one may follow.
        outlines = list(estimate.outlines)
        outlines += [] if estimate.place is None else [estimate.place.outline]
        spheres = [
            sphere._replace(outline=outline)
            for sphere, outline in zip(self.spheres, outlines, strict=True)
        ]
        by_place = np.array(rows).reshape(-1, len(joint))
        covariance = by_place @ joint @ by_place.T
        if np.isfinite([lamp.intensity for lamp in lamps]).all():
            # With strengths, and how light falls off.
            by_falloff = np.eye(len(joint))[-1:]
            every = np.concatenate([by_place, strengths.slopes[used], by_falloff])
            own = np.zeros((len(every), len(every)))
            place = len(by_place) + np.arange(len(used))
            own[np.ix_(place, place)] = strengths.covariance[np.ix_(used, used)]
            covariance = every @ joint @ every.T + own
        if self.lamps == "near" and self.view.focal is not None:
            lamps, covariance = self._of_any_scale(lamps, covariance)
        return Calibration(
            self.view,
            tuple(lamps),
            tuple(spheres),
            self.radius,
            self.reference,
            falloff if self.lamps == "near" else 0.0,
            strengths.ambient,
            {self.names[n]: why for n, why in sorted(left_out.items())},
            tuple(self.warnings),
            self._view_height(spheres),
            covariance,
            estimate.falloff_error if self.lamps == "near" else 0.0,
            strengths.ambient_error,
        )

    def _of_any_scale(
        self, lamps: list[Lamp], covariance: np.ndarray
    ) -> tuple[list[Lamp], np.ndarray]:
        """With how far away all of it may be: as far as the spheres' size is unknown.

        Everything that is as much further away from a pinhole looks the same. Rims of
        mirrors err alike. Strengths are those at the reference point, which stays.
        """
        if not len(self.chrome.outlines):
            return lamps, covariance
        relative = np.sqrt(self.chrome.covariances[:, 2, 2])
        relative = relative / self.chrome.outlines[:, 2]
        scale, count = float(relative.mean()), len(lamps)
        places = np.array([lamp.position for lamp in lamps])
        offset = places - self.reference
        brighter = -2 * (offset @ self.reference) / np.sum(offset**2, axis=1)
        shares = np.array([lamp.intensity for lamp in lamps])
        strengths = shares * brighter[:, None]
        # They are over their mean, which is no error of theirs.
        known = np.isfinite(strengths)
        strengths -= shares * (strengths[known].sum() / max(known.sum(), 1))
        moved = scale * np.concatenate([places.ravel(), strengths.ravel(), [0]])
        moved = moved[: len(covariance)]
        covariance = covariance + np.outer(moved, moved)
        errors = np.hypot(
            [lamp.intensity_error for lamp in lamps], scale * np.abs(strengths)
        )
        blocks = [slice(3 * k, 3 * k + 3) for k in range(count)]
        wider = [
            replace(lamp, covariance=covariance[mine, mine], intensity_error=error)
            for lamp, mine, error in zip(lamps, blocks, errors, strict=True)
        ]
        return wider, covariance

    def _view_height(self, spheres: Sequence[CalibratedSphere]) -> float | None:
        """Of parallel rays: a pixel has the size that the spheres' radius gives it."""
        if self.view.fov_y is not None:
            return None
        sizes = [s.outline[2] for s in spheres if s.kind == "chrome"]
        sizes = sizes or [s.outline[2] for s in spheres]
        return float(self.view.height * self.radius / np.mean(sizes))

    def _strengths(self, estimate: LampEstimate, kept: list[int]) -> Strengths:
        if self.matte is None:
            self._warn(
                "no-matte", "no matte sphere: how strong the lamps are is not known"
            )
            size = 3 * len(kept)
            nothing, none = np.full((len(kept), 3), np.nan), np.zeros((size, size))
            slopes = np.zeros((size, size + 5))
            return Strengths(nothing, none, slopes, np.zeros(3), np.zeros(3))
        assert estimate.place is not None
        matte = self.matte._replace(light=self.matte.light[kept], place=estimate.place)
        found = find_strengths(matte, estimate.directions, estimate.inverse_distances)
        known = np.asarray(np.isfinite(found.intensity).all(axis=1))
        if not known.all():
            names = [
                self.names[n] for n, one in zip(kept, known, strict=True) if not one
            ]
            white = overexposed(matte).all(where=~known)
            self._warn(
                "strength-unknown",
                f"{', '.join(names[:3])}{' …' if len(names) > 3 else ''}: the matte "
                f"sphere is {'overexposed' if white else 'hardly lit'}, and does not "
                "say how strong the lamp is",
            )
        return found

    def _judge(
        self,
        estimate: LampEstimate,
        kept: list[int],
        left_out: dict[int, str],
        shaded: np.ndarray | None,
        falloff: float,
    ) -> None:
        """Collect the warnings of the calibration."""
        for number, why in sorted(left_out.items()):
            self._warn("left-out", f"{self.names[number]} is left out: {why}")
        if len(self.chrome.outlines) == 1 and self.matte is None:
            self._warn("one-sphere", "one sphere alone: its highlights are unchecked")
        shown = np.isfinite(estimate.residuals).mean(axis=0)
        for sphere, share in zip(self.chrome.outlines, shown, strict=True):
            if share < 0.7:
                self._warn(
                    "sphere-disagrees",
                    f"the highlights of the chrome sphere at {sphere[0]:.0f}, "
                    f"{sphere[1]:.0f} agree with the others in {share:.0%} of the "
                    "photographs only",
                )
        if estimate.scatter > 2:
            other = "near" if self.lamps == "distant" else "distant"
            self._warn(
                "spheres-disagree",
                f"the spheres' highlights disagree by {estimate.scatter:.1f} times "
                "their accuracy",
                f"Check the circles, and whether the lamps are {other}",
            )
        if shaded is not None and len(self.chrome.outlines) and self.lamps == "distant":
            apart = np.degrees(angles(shaded[kept], estimate.directions))
            apart = apart[shaded[kept].any(axis=1)]
            if len(apart) and np.median(apart) > 3:
                self._warn(
                    "matte-disagrees",
                    f"the matte sphere's shading is {np.median(apart):.1f}° from the "
                    "chrome spheres' highlights",
                )
        if self.lamps == "near" and self.matte is not None and falloff < 0.8:
            self._warn(
                "slow-fall-off",
                "the lamps' light falls off more slowly than with the square of the "
                f"distance (κ = {falloff:.2f}), as through a lens or reflector",
            )

    def _warn(self, code: str, found: str, remedy: str | None = None) -> None:
        self.warnings.append(coded(code, found, remedy))


def _pixels(row: Sequence[Highlight | None]) -> Float[np.ndarray, "chrome 2"]:
    nowhere = np.full(2, np.nan)
    found = [nowhere if one is None else one.pixel for one in row]
    return np.array(found).reshape(-1, 2)


def _shifted(
    found: Sequence[Highlight], corner: Float[np.ndarray, "2"]
) -> list[Highlight]:
    return [one._replace(pixel=one.pixel + corner) for one in found]
