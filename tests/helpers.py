"""Contracts of the interfaces: a new class earns its place with a three-line test."""

import os
import struct
import zlib
from pathlib import Path
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.geometry.cameras import AbstractCamera, Ray
from phongfit.geometry.surfaces import AbstractSurface
from phongfit.geometry.tracing import trace
from phongfit.lights import AbstractLight
from phongfit.reflectance import AbstractSpecular
from phongfit.testing import check_gradients

T = TypeVar("T")


def eps() -> float:
    """Relative rounding error of the precision that is set: 1.2e-7 or 2.2e-16."""
    return float(jnp.finfo(jnp.result_type(float)).eps)


def close() -> float:
    """A hundred rounding errors: 1e-5 or 2e-14."""
    return 100 * eps()


def near(actual, expected, tolerance: float | None = None) -> None:
    """Assert that two arrays agree to `tolerance`, default `close()`.

    The tolerance is absolute and relative.
    """
    tolerance = close() if tolerance is None else tolerance
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance)


def unit(*vector: float) -> jax.Array:
    """A unit vector in the run's precision, worked out by NumPy."""
    array = np.array(vector, float)
    return floats(array / np.linalg.norm(array))


def floats(array) -> jax.Array:
    """An array in the run's precision."""
    return jnp.asarray(array, jnp.result_type(float))


def only(value: T | tuple[T, ...]) -> T:
    """What a fit of one image has, where fits of several have a tuple."""
    assert not isinstance(value, tuple)
    return value


def known(value: T | None) -> T:
    """What is there in this case, though elsewhere it may be None."""
    assert value is not None
    return value


def random_units(count: int, seed: int = 0) -> np.ndarray:
    """Unit vectors, (count, 3): NumPy's, which broadcasts, in the run's precision."""
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors.astype(jnp.result_type(float))


def random_rotation(seed: int) -> np.ndarray:
    """A proper rotation, (3, 3)."""
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def check_specular(
    model: AbstractSpecular, *, gated: bool = True, normalized: bool = False
) -> None:
    """A highlight: finite, ≥ 0, none from behind, the same however the world is turned.

    `gated`: no highlight where the light is behind the surface. `normalized`: the lobe
    does not reach 1 in its centre.
    """
    normals, to_light, to_viewer = (random_units(200, seed) for seed in (1, 2, 3))
    exponent = floats(7.0)

    @jax.jit
    def heights(normals, to_light, to_viewer):
        cosines = jax.vmap(model.cosine)(normals, to_light, to_viewer)
        return cosines, model.lobe(cosines, exponent)

    cosines, lobes = map(np.asarray, heights(normals, to_light, to_viewer))
    assert np.all(np.abs(cosines) <= 1 + close())
    assert np.all(np.isfinite(lobes)) and np.all(lobes >= 0)
    behind = np.sum(normals * to_light, axis=1) < 0
    assert behind.any() and np.any(lobes[~behind] > 0)
    assert np.any(lobes[behind] > 0) != gated

    turn = random_rotation(4).T
    turned, _ = heights(
        floats(normals @ turn), floats(to_light @ turn), floats(to_viewer @ turn)
    )
    clear = np.abs(np.sum(normals * to_light, axis=1)) > 1e-4
    near(np.where(clear, turned, 0), np.where(clear, cosines, 0))

    # In the mirror direction the highlight has its centre, and that is where it peaks.
    mirrored = 2 * np.sum(to_light * normals, axis=1, keepdims=True) * normals
    centres, _ = heights(normals, to_light, mirrored - to_light)
    near(np.asarray(centres)[~behind], 1)

    falling = floats(np.linspace(1, 0, 11))
    broad, narrow = (model.lobe(falling, floats(f)) for f in (5.0, 50.0))
    assert np.all(np.diff(broad) < 0) and np.all(np.diff(narrow) <= 0)
    assert np.all((narrow / narrow[0])[1:-1] < (broad / broad[0])[1:-1])
    assert broad[-1] == 0
    if not normalized:
        near(broad[0], 1)
    assert np.all(model.lobe(floats([-1.0, -0.1]), exponent) == 0)
    assert 0 < model.diffuse_scale() <= 1


def check_light(light: AbstractLight) -> None:
    """A light: unit direction, intensities ≥ 0, turns and moves with the scene.

    Finite everywhere, its own place included; never brighter further away. One that
    comes from all around has no intensity of its own, but surrounds.
    """
    positions = 3 * random_units(50) + np.array([0.1, 0.2, 0.3])
    illuminate = eqx.filter_jit(jax.vmap(type(light).illuminate, in_axes=(None, 0)))
    arriving = illuminate(light, floats(positions))
    near(np.linalg.norm(arriving.to_light, axis=1), 1)
    for colour in (arriving.intensity, arriving.specular, arriving.ambient):
        assert colour.shape == (50, 3)
        assert np.all(np.isfinite(colour)) and np.all(colour >= 0)
    assert np.any(arriving.intensity > 0) == light.directed
    around = jax.vmap(light.surround)(floats(random_units(50)))
    assert np.all(np.isfinite(around)) and np.all(around >= 0)
    assert np.any(around > 0) != light.directed

    turn, shift = random_rotation(5), np.array([0.3, -0.2, 0.5])
    there = illuminate(_moved(light, turn, shift), floats(positions @ turn.T + shift))
    if light.directed:
        near(there.to_light, np.asarray(arriving.to_light) @ turn.T)
    near(there.intensity, arriving.intensity)
    near(there.specular, arriving.specular)

    place = getattr(light, "position", floats([0.0, 0.0, 0.0]))
    axis = np.asarray(getattr(light, "axis", [1.0, 2.0, 3.0]))
    away = np.linspace(0.1, 10, 30)[:, None] * axis
    along = illuminate(light, floats(np.asarray(place) + away))
    assert np.all(np.diff(along.intensity, axis=0) <= close())

    @eqx.filter_jit
    def here(light, place):
        slopes = jax.jacrev(lambda at: light.illuminate(at).intensity)(place)
        return light.illuminate(place), slopes

    arriving, slopes = here(light, place)
    near(arriving.distance, 0 if hasattr(light, "position") else np.inf)
    colours = (arriving.intensity, arriving.specular, arriving.ambient)
    for array in (arriving.to_light, *colours, slopes):
        assert np.all(np.isfinite(array))


def _moved(light: AbstractLight, turn: np.ndarray, shift: np.ndarray) -> AbstractLight:
    """The light in a world turned and shifted: places are shifted, directions not."""
    for name, by in (("position", shift), ("axis", 0), ("direction", 0)):
        if hasattr(light, name):
            vector = floats(turn @ np.asarray(getattr(light, name)) + by)
            light = eqx.tree_at(lambda a, n=name: getattr(a, n), light, vector)
    return light


def check_surface(
    surface: AbstractSurface, camera: AbstractCamera, *, order: int = 1
) -> None:
    """A surface: unit normals that face the viewer, finite everywhere, gradients too.

    The camera must see some of it, at no more than some ten pixels. `order`: 2 checks
    second derivatives as well.
    """
    buffer = trace(surface, camera)
    size = (camera.height, camera.width)
    assert buffer.mask.shape == size and buffer.mask.dtype == bool
    for array in (buffer.position, buffer.normal, buffer.to_viewer):
        assert array.shape == (*size, 3)
        assert np.all(np.isfinite(array)), "placeholders must be finite"
    assert buffer.mask.any()
    mask = np.asarray(buffer.mask)
    normal, to_viewer = (
        np.asarray(vectors)[mask] for vectors in (buffer.normal, buffer.to_viewer)
    )
    near(np.linalg.norm(normal, axis=-1), 1)
    near(np.linalg.norm(to_viewer, axis=-1), 1)
    assert np.all(np.sum(normal * to_viewer, axis=-1) > 0)

    def arrays(both):
        seen = both[0].trace(both[1])
        return jnp.stack([seen.position, seen.normal, seen.to_viewer])

    check_gradients(arrays, (surface, camera), order=order)


@eqx.filter_jit
def _ray(camera: AbstractCamera, x: jax.Array, y: jax.Array) -> Ray:
    return camera.ray(x, y)


@eqx.filter_jit
def _at_points(camera: AbstractCamera, points: jax.Array):
    def at_point(at):
        return camera.to_viewer(at), camera.depth(at), camera.project(at)

    return jax.vmap(jax.vmap(at_point))(points)


def check_camera(camera: AbstractCamera) -> None:
    """A camera: unit rays, row 0 at the top, x to the right, half-integer centres."""
    rays = eqx.filter_jit(type(camera).rays)(camera)
    height, width = camera.height, camera.width
    assert rays.direction.shape == rays.origin.shape == (height, width, 3)
    near(np.linalg.norm(rays.direction, axis=-1), 1)

    right, up, back = np.asarray(camera.rotation).T
    points = np.asarray(rays.origin) + 3 * np.asarray(rays.direction)
    assert np.all(np.diff(points @ right, axis=1) > 0), "x goes to the right"
    assert np.all(np.diff(points @ up, axis=0) < 0), "row 0 is at the top"
    assert np.all(np.asarray(rays.direction) @ back < 0), "looks along its own −z"

    # The middle of the image lies between the pixels of an even grid, and is what the
    # camera looks at unless it was calibrated to look elsewhere.
    centre = getattr(camera, "cx", width / 2), getattr(camera, "cy", height / 2)
    middle = _ray(camera, *map(floats, centre))
    near(middle.direction, -back)
    near(middle.origin, camera.position)
    centre = _ray(camera, floats(1.5), floats(0.5))
    near(centre.direction, np.asarray(rays.direction)[0, 1])
    near(centre.origin, np.asarray(rays.origin)[0, 1])

    # Back along the ray is towards the viewer, and depth is measured along the axis.
    to_viewer, depth, place = _at_points(camera, floats(points))
    near(to_viewer, -np.asarray(rays.direction))
    near(place, np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) + 0.5)
    near(depth, (np.asarray(camera.position) - points) @ back)
    assert np.all(depth > 0)


def photographs(name: str) -> Path:
    """A folder of real photographs; without it, the test is skipped.

    They are not ours to give away: they lie beside the repository, or where the
    environment says.
    """
    beside = Path(__file__).parents[1] / ".." / "shared" / "photos"
    folder = Path(os.environ.get("PHONGFIT_PHOTOS", beside)) / name
    if not folder.is_dir():
        pytest.skip(f"there are no photographs at {folder}")
    return folder


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """A part of a PNG file, with its length and its checksum."""
    named = kind + body
    return struct.pack(">I", len(body)) + named + struct.pack(">I", zlib.crc32(named))


def png_promising(width: int, height: int) -> bytes:
    """A PNG whose header states this size, with data for a few pixels."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = {b"IHDR": head, b"IDAT": zlib.compress(bytes(1000)), b"IEND": b""}
    return b"\x89PNG\r\n\x1a\n" + b"".join(map(png_chunk, parts, parts.values()))


def said(words: str, text: str) -> bool:
    """Whether a text has these words; what stands for ` ... ` may be anything."""
    start = 0
    for part in words.split(" ... "):
        found = text.find(part, start)
        if found < 0:
            return False
        start = found + len(part)
    return True
