"""A synthetic stack of images, with a random known material and normal per pixel."""

import dataclasses
from pathlib import Path

import numpy as np

import phongfit as pf
from data_synth.lights import spread_directions

AMBIENT = 0.3
# Standard deviation, where white is 1.
NOISE = 0.01
FREE = pf.Film(clamp=False)
# Unknowns of a pixel in the peers: ρ_a, ρ_d, ρ_s of three channels, and log f.
UNKNOWNS = 10


@dataclasses.dataclass(frozen=True)
class Stack:
    """Images of a surface under one lamp each, and the truth.

    - `images`: (lights, H, W, 3), linear, not clamped;
    - `truth`: (H, W, 10): ρ_a, ρ_d, ρ_s of three channels each, and log f;
    - `normals`: (H, W, 3), unit vectors; `directions`: (lights, 3), unit vectors to the
        lamps; in the camera's axes, where the viewer is at +z.
    """

    scenes: tuple[pf.Scene, ...]
    images: np.ndarray
    truth: np.ndarray
    normals: np.ndarray
    directions: np.ndarray


def make_stack(
    pixels: int, lights: int, *, folder: Path | None = None, seed: int = 0
) -> Stack:
    """Images of random normals and materials, one of each in every pixel, with noise.

    They are made without phongfit's renderer, by `_light`; σ is `NOISE`.

    **Arguments:**

    - `pixels`: about as many; height and width are nearly the same.
    - `lights`: number of images; a different lamp lights each.
    - `folder`: for a memory-mapped `stack.npy`; `None`: in memory.
    """
    rng = np.random.default_rng(seed)
    height = int(np.sqrt(pixels))
    width = pixels // height
    normals = np.ones((height, width, 3), np.float32)
    normals[..., :2] = rng.uniform(-0.4, 0.4, (height, width, 2))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    surface = pf.NormalMap(normals)
    camera = pf.OrthographicCamera(width, height)
    directions = spread_directions(lights).astype(np.float32)
    scenes = tuple(
        pf.Scene(surface, camera, pf.DirectionalLight(d), ambient=AMBIENT)
        for d in directions
    )
    truth = np.empty((height, width, UNKNOWNS), np.float32)
    truth[..., :3] = rng.uniform(0.2, 0.6, (height, width, 3))
    truth[..., 3:6] = rng.uniform(0.15, 0.4, (height, width, 3))
    truth[..., 6:9] = rng.uniform(0.2, 0.4, (height, width, 3))
    truth[..., 9] = rng.uniform(np.log(6), np.log(30), (height, width))
    shape = (lights, height, width, 3)
    if folder is None:
        images = np.empty(shape, np.float32)
    else:
        path = folder / "stack.npy"
        images = np.lib.format.open_memmap(path, "w+", np.float32, shape)
    noise = rng.normal(0, NOISE, (height, width, 3)).astype(np.float32)
    for image, direction in zip(images, directions, strict=True):
        image[:] = _light(truth, normals, direction)
        # Drawing noise is the slowest step, so all images have the same, shifted down
        # and across by random numbers of pixels.
        image += np.roll(noise, rng.integers((height, width)), axis=(0, 1))
    return Stack(scenes, images, truth, normals, directions)


def _light(
    unknowns: np.ndarray, normals: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Blinn's model for one lamp and a distant viewer, in linear light (H, W, 3).

    **Arguments:** `unknowns`: as [`Stack`][] has the truth.
    """
    lit, logarithm = (part[..., None] for part in cosines(normals, direction))
    lobe = np.where(lit > 0, np.exp(np.exp(unknowns[..., 9:]) * logarithm), 0)
    return (
        AMBIENT * unknowns[..., :3]
        + lit * unknowns[..., 3:6]
        + lobe * unknowns[..., 6:9]
    )


def cosines(
    normals: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cosine n · l (0 from behind), and the logarithm of n · h for the half vector h.

    The viewer is at +z; n · h counts as at least 1e-6.

    **Arguments:** unit vectors, (…, 3), whose shapes broadcast: one direction and any
    number of normals, or any numbers of both along different axes.
    """
    half = directions + np.array([0, 0, 1], directions.dtype)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    lit = np.maximum((normals * directions).sum(-1), 0)
    return lit, np.log(np.maximum((normals * half).sum(-1), 1e-6))
