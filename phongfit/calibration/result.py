"""Result of a calibration: lamps, spheres and camera."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.calibration.outlines import View, sphere_behind
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
)
from phongfit.lights import AbstractLight, DirectionalLight, PointLight
from phongfit.plain import plain


class CalibratedSphere(NamedTuple):
    """A sphere in the photographs.

    - `kind`: `"chrome"` or `"matte"`.
    - `outline`: x, y and radius in pixels from the upper left corner.
    - `covariance`: of these three.
    """

    kind: str
    outline: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Lamp:
    """The lamp of one photograph.

    - `photograph`: its name.
    - `direction`: unit vector to it, from the calibration's reference point.
    - `position`: of a near lamp, in the camera's axes and the spheres' unit.
    - `covariance`: of the position, or else of the direction.
    - `direction_error`: root mean square angle of the direction's error, degrees.
    - `intensity`, `intensity_error`: its strength at the reference point, RGB, relative
        to the mean of all lamps and channels; `nan` if it is not determined.
    - `highlights`: in pixels, on each chrome sphere; `nan` for missing ones.
    """

    photograph: str
    direction: Float[np.ndarray, "3"]
    position: Float[np.ndarray, "3"] | None
    covariance: Float[np.ndarray, "3 3"]
    direction_error: float
    intensity: Float[np.ndarray, "3"]
    intensity_error: Float[np.ndarray, "3"]
    highlights: Float[np.ndarray, "chrome 2"]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Lamps and camera of a capture: see [`calibrate`][].

    Axes are the camera's: x right, y up, z back to the viewer. A pinhole camera stands
    at the origin; with parallel rays the spheres' centres lie in the plane z = 0.

    - `view`: the camera by its size and angle.
    - `lamps`: one for each photograph that is not left out.
    - `spheres`: their outlines, refined by all photographs.
    - `sphere_radius`: of the chrome spheres; determines the unit of all lengths.
    - `reference`: origin of the directions, and the point at which strengths are given.
    - `falloff`: κ of near lamps' light, 1 / (1 − κ + κ (d / d₀)²), where d₀ is the
        lamp's distance from the reference point; 1 for a bulb.
    - `ambient`: light without a lamp, RGB, in the unit of intensities. It has been
        subtracted from the matte sphere's light; a fit estimates that of its object.
    - `left_out`: reasons for photographs that are not used, by name.
    - `warnings`: problems that affect the result.
    - `view_height`: with parallel rays, height of the view in the spheres' unit.
    - `covariance`: of all lamps' positions or directions, lamp by lamp, and, if
        strengths are known, of strengths and then of the fall-off; `None` if only the
        covariance of each lamp is known.
    - `falloff_error`, `ambient_error`: standard errors of fall-off and ambient light.
    """

    view: View
    lamps: tuple[Lamp, ...]
    spheres: tuple[CalibratedSphere, ...]
    sphere_radius: float
    reference: Float[np.ndarray, "3"]
    falloff: float
    ambient: Float[np.ndarray, "3"]
    left_out: Mapping[str, str]
    warnings: tuple[str, ...]
    view_height: float | None = None
    covariance: Float[np.ndarray, "n n"] | None = None
    falloff_error: float = 0.0
    ambient_error: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))

    @property
    def joint(self) -> Float[np.ndarray, "numbers numbers"]:
        """Covariance of positions or directions, of strengths, and of the fall-off.

        The first two are ordered lamp by lamp; `nan` for unknown strengths.
        """
        from scipy.linalg import block_diag

        place = self.covariance
        if place is None:
            place = np.asarray(block_diag(*[lamp.covariance for lamp in self.lamps]))
        if len(place) == 6 * len(self.lamps) + 1:
            return place
        errors = [*[lamp.intensity_error for lamp in self.lamps], [self.falloff_error]]
        return np.asarray(block_diag(place, np.diag(np.concatenate(errors) ** 2)))

    @property
    def camera(self) -> AbstractCamera:
        """The camera, for a [`Scene`][]."""
        width, height, fov = self.view.width, self.view.height, self.view.fov_y
        if fov is not None:
            return PerspectiveCamera(width, height, fov_y=fov, position=(0, 0, 0))
        return OrthographicCamera(
            width,
            height,
            view_height=self.view_height,
            position=(0, 0, 100 * self.sphere_radius),
        )

    @property
    def lights(self) -> tuple[AbstractLight, ...]:
        """A light for each lamp, of strength 1 where it is unknown."""
        return tuple(self._light(lamp) for lamp in self.lamps)

    def _light(self, lamp: Lamp) -> AbstractLight:
        intensity = np.where(np.isfinite(lamp.intensity), lamp.intensity, 1.0)
        if lamp.position is None:
            return DirectionalLight(lamp.direction, intensity)
        distance = float(np.linalg.norm(lamp.position - self.reference))
        share = min(self.falloff, 1.0)
        return PointLight(
            lamp.position, intensity, attenuation=(1 - share, 0, share / distance**2)
        )

    def centre(self, sphere: CalibratedSphere) -> Float[np.ndarray, "3"]:
        """Centre of a chrome sphere, in the camera's axes."""
        return sphere_behind(sphere.outline, self.view, self.sphere_radius)

    def __str__(self) -> str:
        lines = [
            f"{'photograph':<24} {'x':>8} {'y':>8} {'z':>8}  {'±':>6}  strength",
        ]
        for lamp in self.lamps:
            where = lamp.direction if lamp.position is None else lamp.position
            numbers = " ".join(f"{value:8.4f}" for value in where)
            mean, error = lamp.intensity.mean(), lamp.intensity_error.mean()
            strength = f"{mean:.3f} ± {error:.3f}" if np.isfinite(mean) else "not known"
            lines.append(
                f"{lamp.photograph:<24.24} {numbers}  {lamp.direction_error:5.2f}°  "
                f"{strength}"
            )
        spheres = ", ".join(
            f"{s.kind} at {s.outline[0]:.1f}, {s.outline[1]:.1f}, radius "
            f"{s.outline[2]:.1f}"
            for s in self.spheres
        )
        lines += ["", f"spheres (pixels): {spheres}"]
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)

    def __repr__(self) -> str:
        near = any(lamp.position is not None for lamp in self.lamps)
        kind = "near" if near else "distant"
        return (
            f"Calibration({len(self.lamps)} {kind} lamps, {len(self.spheres)} spheres)"
        )

    def to_dict(self) -> dict[str, Any]:
        """All numbers, in types for `json.dumps`, without unknown strengths' errors."""
        lamps = []
        for lamp, light in zip(self.lamps, self.lights, strict=True):
            where = {"direction": lamp.direction}
            if isinstance(light, PointLight):
                attenuation = np.asarray(light.attenuation, float)
                where = {"position": lamp.position, "attenuation": attenuation}
            strength = {"intensity": np.ones(3)}
            if np.isfinite(lamp.intensity).all():
                error = lamp.intensity_error
                strength = {"intensity": lamp.intensity, "intensity_error": error}
            seen = [p if np.isfinite(p).all() else None for p in lamp.highlights]
            lamps.append(
                {
                    "photograph": lamp.photograph,
                    **where,
                    **strength,
                    "direction_error_degrees": lamp.direction_error,
                    "covariance": lamp.covariance,
                    "highlights": seen,
                }
            )
        names = ("sphere_radius", "falloff", "falloff_error", "covariance")
        names += ("ambient", "ambient_error", "left_out", "warnings")
        found = {
            "camera": {
                "width": self.view.width,
                "height": self.view.height,
                "fov_y_degrees": self.view.fov_y,
                "view_height": self.view_height,
            },
            "reference": self.reference,
            "lights": lamps,
            "spheres": [sphere._asdict() for sphere in self.spheres],
        }
        return plain(found | {name: getattr(self, name) for name in names})
