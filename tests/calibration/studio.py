"""Captures of known truth: chrome and matte spheres before a wall, drawn by hand.

Nothing of the package draws them: each pixel's ray is followed here, with formulas of
its own, on a finer grid whose means are the pixels.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import phongfit as pf
from phongfit.calibration.lamps import Lamps

FINER = 3
LAMP_SIZE = 0.03  # radians from a lamp's centre to its edge, as a mirror shows it


@dataclass(frozen=True)
class Ball:
    kind: str
    centre: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Studio:
    """A camera at the origin that looks along −z; `fov` None for parallel rays."""

    width: int = 240
    height: int = 180
    fov: float | None = 20.0
    balls: tuple[Ball, ...] = (
        Ball("chrome", (-1.1, -0.5, -10.0), 0.5),
        Ball("chrome", (1.1, -0.6, -10.0), 0.5),
        Ball("matte", (-0.1, 0.8, -10.0), 0.5),
    )

    def pixel(self, ball: Ball) -> tuple[float, float, float]:
        """Centre and radius as a user would type them, in pixels."""
        x, y, z = ball.centre
        scale = self._scale(-z)
        return (
            self.width / 2 + x * scale,
            self.height / 2 - y * scale,
            ball.radius * scale,
        )

    def _scale(self, depth: float) -> float:
        """Pixels of a length 1 at a depth."""
        if self.fov is None:
            return self.height / 3.6
        return self.height / 2 / np.tan(np.radians(self.fov / 2)) / depth

    def circles(self, kind: str) -> list[tuple[float, float, float]]:
        return [self.pixel(ball) for ball in self.balls if ball.kind == kind]

    def photograph(
        self, lamp, strength=1.0, *, near=False, ambient=0.0, noise=0.003, seed=0
    ) -> np.ndarray:
        """Linear light, (height, width, 3), under one lamp: a direction, or a place."""
        image = _image(self, tuple(np.asarray(lamp, float)), near, ambient)
        light = np.clip(strength * image, 0, 1)[..., None] * np.array([1, 0.9, 0.8])
        random = np.random.default_rng(seed)
        return np.clip(light + random.normal(0, noise, light.shape), 0, 1)

    def ray_traced(self, right, down, lamp, near, ambient) -> np.ndarray:
        origin, ray = self._rays(right, down)
        # A wall, a little aslant, behind everything.
        light = 0.25 + 0.1 * ray[..., 0] - 0.1 * ray[..., 1] + 0.2 * lamp[0] * 0.1
        nearest = np.full(light.shape, np.inf)
        for ball in self.balls:
            # No ray beside a ball's outline hits it.
            x, y, radius = self.pixel(ball)
            rows, columns = (
                slice(max(int(at - 1.2 * radius), 0), int(at + 1.2 * radius) + 1)
                for at in (y, x)
            )
            window = rows, columns
            shade, distance = self._seen(
                ball, origin[window], ray[window], lamp, near, ambient
            )
            hit = distance < nearest[window]
            light[window] = np.where(hit, shade, light[window])
            nearest[window] = np.where(hit, distance, nearest[window])
        return np.minimum(light, 1.3)

    def _rays(self, right: float, down: float) -> tuple[np.ndarray, np.ndarray]:
        """Where rays start and point, of each pixel's point this far in it."""
        x = np.arange(self.width) + right - self.width / 2
        y = self.height / 2 - np.arange(self.height) - down
        x, y = np.broadcast_arrays(x[None, :], y[:, None])
        if self.fov is None:
            scale = self._scale(1.0)
            origin = np.stack([x / scale, y / scale, 0 * x], -1)
            return origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape)
        focal = self._scale(1.0)
        ray = np.stack([x / focal, y / focal, -np.ones_like(x)], -1)
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        return np.zeros_like(ray), ray

    def _seen(
        self, ball: Ball, origin, ray, lamp, near, ambient
    ) -> tuple[np.ndarray, np.ndarray]:
        """Light of a ball's points, and how far they are; infinite beside it."""
        offset = origin - np.array(ball.centre)
        along = np.sum(offset * ray, -1)
        root = along**2 - np.sum(offset**2, -1) + ball.radius**2
        distance = -along - np.sqrt(np.maximum(root, 0))
        point = origin + distance[..., None] * ray
        normal = (point - np.array(ball.centre)) / ball.radius
        to_lamp = lamp - point if near else np.broadcast_to(lamp, point.shape)
        far = np.linalg.norm(to_lamp, axis=-1)
        to_lamp = to_lamp / far[..., None]
        if ball.kind == "matte":
            fall = (self._reference(lamp) / far) ** 2 if near else 1.0
            shade = 0.6 * np.maximum(np.sum(normal * to_lamp, -1), 0) * fall
            shade = shade + ambient
        else:
            back = ray - 2 * np.sum(ray * normal, -1)[..., None] * normal
            angle = np.arccos(np.clip(np.sum(back * to_lamp, -1), -1, 1))
            # Darkness in front, the wall at the rim.
            shade = np.where(back[..., 2] > -0.2, 0.02, 0.3)
            shade = np.where(angle < LAMP_SIZE, 5.0, shade)
        return shade, np.where(root > 0, distance, np.inf)

    def _reference(self, lamp) -> float:
        return float(np.linalg.norm(lamp - np.array([0, 0, -10.0])))


@functools.cache
def _image(studio: Studio, lamp, near, ambient) -> np.ndarray:
    """Without noise; many tests have the same lamps."""
    image = np.zeros((studio.height, studio.width))
    steps = (np.arange(FINER) + 0.5) / FINER
    for down in steps:
        for right in steps:
            image += studio.ray_traced(right, down, np.array(lamp), near, ambient)
    return image / FINER**2


def directions(count: int) -> np.ndarray:
    """Unit vectors spread over what a camera's side of things shows."""
    number = np.arange(count)
    tilt = np.radians(20 + 35 * ((number * 0.618) % 1))
    turn = 2.4 * number
    return np.stack(
        [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], -1
    )


def degrees(a, b) -> np.ndarray:
    """Between unit vectors."""
    return np.degrees(2 * np.arcsin(np.linalg.norm(np.subtract(a, b), axis=-1) / 2))


def calibrated(
    studio: Studio, folder: Path, encoding=None, lamps: Lamps = "distant"
) -> pf.Calibration:
    """The lamps of photographs that lie in a folder, and lights.json beside them."""
    capture = pf.open_capture(folder, encoding)
    found = pf.calibrate(
        capture,
        chrome=studio.circles("chrome"),
        matte=studio.circles("matte")[0],
        sphere_radius=studio.balls[0].radius,
        fov=studio.fov,
        lamps=lamps,
        names=capture.names,
    )
    pf.save_calibration(folder / "lights.json", found)
    return found
