"""Pictures that were damaged on their way: taken unchanged, or refused."""

import functools
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import OpenEXR

from phongfit.files.formats import WRITERS
from phongfit.files.images import read_film, read_image, read_mask
from tests.campaign.cases import Case, Kind, Wrong, blaming, put
from tests.campaign.damage import damaged

# What a checksum in the file protects comes out as it went in, or not at all.
PROTECTED = {".png"}
D65 = 0.3127, 0.329


@functools.cache
def whole(stock: Path) -> dict[str, bytes]:
    """A small picture in each format, by suffix, and in unusual variants."""
    y, x = np.mgrid[0:24, 0:32]
    light = np.stack([x / 32, y / 24, (x + y) / 56], axis=-1)
    eight, sixteen = (light * 255).astype(np.uint8), (light * 65535).astype(np.uint16)
    floats = light.astype(np.float32)
    levels = {8: eight, 16: sixteen, 32: floats}
    found = {}
    for suffix, writers in WRITERS.items():
        for bits, write in writers.items():
            path = stock / f"whole-{bits}{suffix}"
            if not path.exists():
                write(path, levels[bits])
            found[f"{bits}{suffix}"] = path.read_bytes()
    found["grey.png"] = imagecodecs.png_encode(eight[..., 0].copy())
    found["deflated.tif"] = imagecodecs.tiff_encode(eight, compression="deflate")
    found["big.tif"] = imagecodecs.tiff_encode(eight, bigtiff=True)
    path, points = stock / "whole-p3.exr", (0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
    if not path.exists():
        header = {"type": OpenEXR.scanlineimage, "chromaticities": (*points, *D65)}
        with OpenEXR.File(header, {"RGB": floats}) as file:
            file.write(str(path))
    found["p3.exr"] = path.read_bytes()
    line = f"PRIMARIES={' '.join(map(str, (*points, *D65)))}\nFORMAT".encode()
    found["p3.hdr"] = found["32.hdr"].replace(b"FORMAT", line)
    return {name: bytes(data) for name, data in found.items()}


@functools.cache
def pixels(data: bytes, suffix: str, stock: Path) -> np.ndarray:
    """What an undamaged picture holds."""
    path = stock / f"pixels-{hash(data)}{suffix}"
    path.write_bytes(data)
    return read_image(path, "linear")


def make(random: np.random.Generator, stock: Path) -> Case:
    sources = whole(stock)
    name = str(random.choice(sorted(sources)))
    what, data = damaged(random, sources[name])
    suffix = Path(f"x{name}").suffix
    if random.random() < 0.05:
        suffix = str(random.choice([".png", ".jpg", ".tif", ".hdr", ".exr"]))
    path = f"picture{suffix}"
    readers: list[Callable] = [
        lambda path: read_image(path, "linear"),
        lambda path: read_image(path, "srgb"),
        read_mask,
        lambda path: read_film(path, "srgb"),
    ]
    reader = readers[int(random.choice(4, p=[0.7, 0.1, 0.1, 0.1]))]

    def act(folder: Path) -> None:
        with blaming(path):
            image = reader(folder / path)
        if reader is not readers[0]:
            return
        if image.ndim != 3 or image.shape[-1] != 3 or not np.isfinite(image).all():
            raise Wrong(f"an image of shape {image.shape}, or not finite")
        if suffix in PROTECTED and name.endswith(suffix):
            if not np.array_equal(image, pixels(sources[name], suffix, stock)):
                raise Wrong("other pixels than were written")

    return Case(f"{name} as {suffix}: {what}", put({path: data}), act)


def prepare(stock: Path) -> None:
    whole(stock)


KIND = Kind(make, prepare, share=2)
