"""Masks and noise levels of the samples of a stack of images."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from phongfit.checks import NOISE, as_array, is_noise, unmasked
from phongfit.files.zarrs import Window, cut
from phongfit.fitting.problem.inputs import is_number
from phongfit.maps.stacks import Update, gather


class Layers:
    """Numbers for every pixel: one array for all images, or one for each image.

    - `arrays`: as they were given.
    """

    def __init__(self, name: str, given: Any, shape: tuple[int, int, int], dtype: Any):
        """**Arguments:**

        - `name`: of the argument, for errors.
        - `given`: (H, W), (H, W, 3), or a sequence of these or of numbers, one for each
            image.
        - `shape`: of the stack.
        - `dtype`: of the numbers that are taken; the arrays themselves are not copied.

        **Raises:** `ValueError` that names the argument, and the index of the array.
        """
        count, *size = shape
        for one in given if isinstance(given, list | tuple) else [given]:
            unmasked(name, one)
        fine = (tuple(size), (*size, 3))
        if not isinstance(given, list | tuple):
            given = as_array(name, given)
            if given.shape in fine:
                given = [given]
            elif given.ndim in (0, 2):
                raise ValueError(
                    f"{name}: expected shape {fine[0]} or {fine[1]}, got {given.shape}"
                )
        layers = [as_array(name, layer) for layer in given]
        if len(layers) not in (1, count):
            raise ValueError(
                f"{name}: expected {count}, one an image, got {len(layers)}"
            )
        for k, layer in enumerate(layers):
            if layer.shape not in ((), *fine) or layer.dtype.kind not in "biuf":
                which = f"{name}[{k}]" if len(layers) > 1 else name
                raise ValueError(
                    f"{which}: expected numbers of shape {fine[0]} or {fine[1]}, got "
                    f"{layer.dtype} of shape {layer.shape}"
                )
            if np.dtype(dtype).kind == "b" and not np.isfinite(layer).all():
                raise ValueError(f"{name}: expected true or false, got NaN or inf")
        self.arrays = layers
        self._size = tuple(size)
        self._dtype = np.dtype(dtype)

    def __len__(self) -> int:
        return len(self.arrays)

    def __getitem__(self, k: int) -> Shaped[np.ndarray, "height width some_channels"]:
        """One layer as a whole."""
        layer = self.arrays[k].astype(self._dtype, copy=False)
        if layer.ndim < 3:
            layer = layer[..., None]
        return np.broadcast_to(layer, (*self._size, layer.shape[-1]))

    def each(self, change: Callable[[Any], Any]) -> "Layers":
        """The numbers with a change of each array."""
        some = copy.copy(self)
        some.arrays = [change(array) for array in self.arrays]
        return some

    def part(self, window: Window) -> "Layers":
        """The numbers of a rectangle."""
        some = self.each(lambda array: cut(array, window) if array.ndim else array)
        sides = zip(self._size, window, strict=True)
        some._size = tuple(len(range(side)[part]) for side, part in sides)
        return some

    def take(
        self, pixels: Int[np.ndarray, " n"], order: Sequence[int]
    ) -> Shaped[np.ndarray, "some_images n some_channels"]:
        """Numbers of some pixels; axes of images and channels are 1 if shared."""
        if len(self) == 1:
            order = (0,)
        taken = [gather(self[k], pixels) for k in order]
        channels = max(row.shape[-1] for row in taken)
        return np.stack([np.broadcast_to(r, (len(pixels), channels)) for r in taken])

    def anywhere(self) -> Bool[np.ndarray, "height width"]:
        """Pixels where a sample of any image is true or not 0."""
        seen = np.zeros(self._size, bool)
        for k in range(len(self)):
            seen |= self[k].any(axis=-1)
        return seen

    def identify(self, update: Update) -> None:
        """Feed all numbers to a checksum."""
        for layer in self.arrays:
            update(f"{self._dtype} {layer.shape}".encode())
            update(np.ascontiguousarray(layer.astype(self._dtype)).tobytes())


def mask_layers(mask: Any, shape: tuple[int, int, int]) -> Layers:
    """Masks of the samples that may be used.

    **Arguments:** `mask`: `None` for all, or as for [`Layers`][].

    **Raises:** `ValueError` that names the mask.
    """
    return Layers("mask", [np.array(True)] if mask is None else mask, shape, bool)


class Noise:
    """Standard deviations of the samples: unknown, one number, or one per sample.

    - `known`: whether they were given.
    - `varies`: whether they were given as arrays, or one for each image.
    - `level`: the number that was given; 1 if unknown or varying.
    """

    def __init__(self, noise: Any, shape: tuple[int, int, int]):
        """**Arguments:** `noise`: `None`, a number, or as for [`Layers`][].

        **Raises:** `ValueError` that names the noise.
        """
        self.known = noise is not None
        self.varies = self.known and not is_number(noise)
        one = [1.0 if noise is None else noise]
        layers = noise if self.varies else one
        self._layers = Layers("noise", layers, shape, jnp.result_type(float))
        for k, layer in enumerate(self._layers.arrays):
            if not np.all(is_noise(layer)):
                which = f"[{k}]" if len(self._layers) > 1 else ""
                low, high = NOISE
                got = f", got {layer}" if layer.ndim == 0 else ""
                raise ValueError(
                    f"noise{which}: expected finite numbers > 0, from {low:g} to "
                    f"{high:g}{got}"
                )
        self.level = 1.0 if self.varies else float(self._layers.arrays[0])

    def weigh(
        self,
        used: Bool[np.ndarray, "some_images n some_channels"],
        pixels: Int[np.ndarray, " n"],
        order: Sequence[int],
    ) -> Shaped[np.ndarray, "images n channels"]:
        """Weights of samples: `used`, or the inverse of the noise if that varies."""
        if not self.varies:
            return used
        return np.where(used, 1 / self._layers.take(pixels, order), 0)

    def each(self, change: Callable[[Any], Any]) -> "Noise":
        """The noise with a change of each array."""
        return self._with(self._layers.each(change))

    def part(self, window: Window) -> "Noise":
        """The noise of a rectangle."""
        return self._with(self._layers.part(window))

    def _with(self, layers: Layers) -> "Noise":
        some = copy.copy(self)
        some._layers = layers
        return some

    def given(self) -> float | Float[np.ndarray, "height width"] | None:
        """The noise level, or each pixel's root mean square if it varies."""
        if not self.varies:
            return self.level if self.known else None
        layers = range(len(self._layers))
        squares = sum(np.mean(self._layers[k] ** 2, axis=-1) for k in layers)
        return np.sqrt(squares / len(layers))

    def identify(self, update: Update) -> None:
        """Feed noise that varies to a checksum; that of the lights covers one level."""
        if self.varies:
            self._layers.identify(update)
