"""Arrays on disk that were damaged, or are of wrong shapes and types."""

import functools
import io
import json
import os
import zipfile
from pathlib import Path

import imagecodecs
import numpy as np
import scipy.io

from phongfit.files.arrays import read_array
from phongfit.files.datasets import read_dataset
from phongfit.files.saved import STRUCTURE, header, load_fit, write_packed
from phongfit.maps.pixel.settings import MAP_PARAMETERS
from phongfit.maps.result import load_maps
from tests.campaign.cases import Case, Kind, Wrong, blaming, put
from tests.campaign.damage import damaged
from tests.campaign.kinds.records import changed

SIZE = (5, 6)
CAMERA = {"kind": "orthographic", "width": SIZE[1], "height": SIZE[0]}
MODEL = {"kind": "blinn-phong"}


@functools.cache
def maps() -> dict[str, np.ndarray]:
    """What `Maps.save` writes, small."""
    random = np.random.default_rng(0)
    channels = dict.fromkeys(MAP_PARAMETERS, 3) | {"shininess": 1}
    arrays = {n: random.random((*SIZE, c)).astype("f4") for n, c in channels.items()}
    arrays |= {f"stderr_{name}": arrays[name] / 9 for name in channels}
    return arrays | {
        "noise": random.random(SIZE).astype("f4"),
        "samples": np.full(SIZE, 9, np.int32),
        "flags": np.zeros(SIZE, np.uint16),
        "unknowns": np.array(MAP_PARAMETERS),
        "noise_given": np.array(np.nan),
        "normals": np.tile(np.array([0, 0, 1], "f4"), (*SIZE, 1)),
        "normals_stderr": np.zeros(SIZE, "f4"),
        "depth": np.full(SIZE, np.nan, "f4"),
        "view": np.array(json.dumps({"camera": CAMERA, "specular_model": MODEL})),
    }


def packed(arrays: dict[str, np.ndarray], packed: bool = False) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(file, allow_pickle=True, **arrays)
    return file.getvalue()


def _wrong_array(random: np.random.Generator, array: np.ndarray) -> np.ndarray:
    """Another shape, type or value in place of an array."""
    match int(random.integers(7)):
        case 0:
            return np.atleast_1d(array)[..., :1]
        case 1:
            return array.astype(str)
        case 2:
            return np.array([{}, None], object)
        case 3:
            return np.full(array.shape, np.nan)
        case 4:
            return np.zeros((0,) * array.ndim)
        case 5:
            return np.asarray(array.ravel()[0])
    return np.full(array.shape, -(10**9))


def _of_maps(random: np.random.Generator) -> Case:
    arrays = dict(maps())
    name = str(random.choice(sorted(arrays)))
    match int(random.integers(4)):
        case 0:
            del arrays[name]
            what, data = f"without {name}", packed(arrays)
        case 1 | 2:
            arrays[name] = _wrong_array(random, arrays[name])
            what, data = f"{name} is {arrays[name].dtype}", packed(arrays)
        case _:
            what, data = damaged(random, packed(arrays, bool(random.integers(2))))

    def act(folder: Path) -> None:
        with blaming("maps.npz"):
            found = load_maps(folder / "maps.npz")
        # What is taken can be looked at.
        if found.identified.shape != found.flags.shape or not str(found):
            raise Wrong("maps of different sizes")
        found.chi_squared.sum()

    return Case(f"maps.npz: {what}", put({"maps.npz": data}), act)


def _of_array(random: np.random.Generator) -> Case:
    file = io.BytesIO()
    np.save(file, np.arange(30.0).reshape(5, 6))
    what, data = damaged(random, file.getvalue())

    def act(folder: Path) -> None:
        with blaming("a.npy"):
            array = read_array(folder / "a.npy", "a")
        if array.nbytes > len(data):
            raise Wrong(f"{array.nbytes} bytes from {len(data)}")

    return Case(f"a.npy: {what}", put({"a.npy": data}), act)


def _of_zip(random: np.random.Generator) -> Case:
    """The same entry twice, or packed in ways that NumPy does not know."""
    file, ways = io.BytesIO(), [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_STORED]
    entry = io.BytesIO()
    np.save(entry, np.zeros(5))
    with zipfile.ZipFile(file, "w", ways[int(random.integers(3))]) as archive:
        for name in ("a.npy", "b.npy", f"{random.choice(['c', 'a/b', '..'])}.npy"):
            archive.writestr(name, entry.getvalue())
    data = file.getvalue()

    def act(folder: Path) -> None:
        with blaming("a.npz"):
            read_array(folder / "a.npz", "a")

    return Case("a.npz of another kind", put({"a.npz": data}), act)


@functools.cache
def _saved(stock: Path) -> dict[str, np.ndarray]:
    """What `save_fit` writes, of a scene: it never becomes a fit."""
    import phongfit as pf

    scene = pf.Scene(pf.Sphere(), pf.OrthographicCamera(4, 4), pf.PointLight((0, 0, 3)))
    path = stock / f"saved-{os.getpid()}.npz"
    write_packed(path, header(), [scene, pf.Material(), {"a": (1, 2.5, None)}])
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays}


def _of_saved(random: np.random.Generator, stock: Path) -> Case:
    """A fit that was saved: its archive damaged, or what stands in it."""
    arrays = dict(_saved(stock))
    if random.random() < 0.5:
        what, data = damaged(random, packed(arrays, bool(random.integers(2))))
    else:
        name = str(random.choice(sorted(arrays)))
        if name == STRUCTURE or random.random() < 0.7:
            name, record = STRUCTURE, json.loads(arrays[STRUCTURE].tobytes())
            what, text = changed(random, record)
            arrays[name] = np.frombuffer(text, np.uint8)
        else:
            arrays[name] = _wrong_array(random, arrays[name])
            what = f"{name} is {arrays[name].dtype}"
        data = packed(arrays)

    def act(folder: Path) -> None:
        with blaming("fit.npz"):
            load_fit(folder / "fit.npz")
        raise Wrong("what is no fit was taken for one")

    return Case(f"fit.npz: {what}", put({"fit.npz": data}), act)


def _of_diligent(random: np.random.Generator) -> Case:
    """A data set in DiLiGenT's layout, one file of which was damaged."""
    matrix, packed = io.BytesIO(), bool(random.integers(2))
    normals = np.broadcast_to([0.0, 0.6, 0.8], (4, 5, 3))
    scipy.io.savemat(matrix, {"Normal_gt": normals}, do_compression=packed)
    grey = np.full((4, 5, 3), 9000, np.uint16)
    files = {
        "filenames.txt": b"001.png\n002.png\n",
        "light_directions.txt": b"0 0 1\n0 0.6 0.8\n",
        "light_intensities.txt": b"1 1 1\n0.9 1 1.1\n",
        "mask.png": bytes(imagecodecs.png_encode(np.full((4, 5), 255, np.uint8))),
        "Normal_gt.mat": matrix.getvalue(),
        "001.png": bytes(imagecodecs.png_encode(grey)),
        "002.png": bytes(imagecodecs.png_encode(grey)),
    }
    weights = np.array([1, 1, 1, 1, 4, 1, 1]) / 10
    name = str(random.choice(list(files), p=weights))
    what, data = damaged(random, files[name])
    if name.startswith("light") and random.random() < 0.5:
        number = random.choice(["1e-45", "1e300", "-1", "nan", "1e-320", "0", "x"])
        what, data = f"{number}", files[name].replace(b"0.9", str(number).encode())

    def act(folder: Path) -> None:
        with blaming("case"):
            found = read_dataset(folder)
        if not all(np.isfinite(image).all() for image in found.images):
            raise Wrong("an image that is not finite")

    return Case(f"{name}: {what}", put(files | {name: data}), act)


MAKERS = [_of_maps, _of_array, _of_zip, _of_diligent]


def make(random: np.random.Generator, stock: Path) -> Case:
    if random.random() < 0.15:
        return _of_saved(random, stock)
    weights = np.array([4, 2, 1, 4]) / 11
    return MAKERS[int(random.choice(len(MAKERS), p=weights))](random)


KIND = Kind(make)
