"""Small files that promise much: refused before memory or time is spent on them."""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import OpenEXR
import scipy.io
from PIL import Image

from phongfit.files.diligent import open_diligent
from phongfit.files.images import read_image, read_mask
from phongfit.files.meshes import load_mesh
from phongfit.files.mtl import read_mtl
from phongfit.files.saved import load_fit
from phongfit.files.scenes import load_scene, load_views
from phongfit.maps.result import load_maps
from tests.campaign.cases import Case, Kind, Wrong, blaming, put
from tests.files.test_gltf_reading import triangle
from tests.helpers import png_chunk

Random = np.random.Generator


def _side(random: Random) -> int:
    """Of a picture that no machine should decode."""
    return int(random.choice([2**15, 50_000, 2**16 - 1, 10**6, 2**31 - 1]))


def _png(random: Random) -> bytes:
    depth, colour = [(8, 2), (16, 6), (1, 0), (8, 3)][int(random.integers(4))]
    side = _side(random)
    head = struct.pack(">IIBBBBB", side, side, depth, colour, 0, 0, 0)
    text = png_chunk(b"zTXt", b"key\0\0" + zlib.compress(bytes(2**23)))
    body = png_chunk(b"IDAT", zlib.compress(bytes(2**20))) + png_chunk(b"IEND", b"")
    texts = text * int(random.integers(0, 300))
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", head) + texts + body


def _png_of_text(random: Random) -> bytes:
    """A small picture with very much text in it."""
    small = bytes(imagecodecs.png_encode(np.zeros((4, 4, 3), np.uint8)))
    text = zlib.compress(bytes(int(random.choice([2**22, 2**23 - 9]))))
    chunk = png_chunk(b"zTXt", b"key\0\0" + text)
    return small[:33] + chunk * int(random.integers(300, 1200)) + small[33:]


def _tiff(random: Random) -> bytes:
    side, big = _side(random), random.random() < 0.7
    order = "<" if random.random() < 0.5 else ">"
    kind, spelled = [(16, "Q"), (4, "I"), (17, "q"), (9, "i")][int(random.integers(4))]
    if not big and kind in (16, 17):
        kind, spelled = 4, "I"
    tags = {256: side, 257: side, 258: 8, 259: 1, 262: 2, 277: 3}
    tags |= {278: 2**31 - 1} if random.random() < 0.5 else {322: side, 323: side}
    if random.random() < 0.3:
        tags |= {256: 4, 257: 4}
    count, number, field = ("Q", "Q", 8) if big else ("H", "I", 4)
    entries = b""
    for tag, value in tags.items():
        value = struct.pack(order + spelled, value).ljust(field, b"\0")
        entries += struct.pack(order + "HH" + number, tag, kind, 1) + value
    first = b"II" if order == "<" else b"MM"
    head = struct.pack(order + "HHHQ", 43, 8, 0, 16) if big else b""
    head = head or struct.pack(order + "HI", 42, 8)
    body = struct.pack(order + count, len(tags)) + entries + bytes(field)
    return first + head + body


def _hdr(random: Random) -> bytes:
    side = _side(random)
    decoy = b"-Y 4 +X 4\n" if random.random() < 0.5 else b""
    return (
        b"#?RADIANCE\n"
        + decoy
        + (b"FORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (side, side))
    )


def _other_formats(random: Random) -> bytes:
    """A picture of a format that Pillow knows and phongfit does not name."""
    kind = str(random.choice(["GIF", "BMP", "ICO", "TGA", "PPM", "WEBP", "EPS", "PNG"]))
    size = 200 if kind in ("ICO", "EPS") else int(random.integers(8, 4000))
    file = io.BytesIO()
    Image.new("RGB", (size, size)).save(file, kind)
    return file.getvalue()


def _jpeg(random: Random) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG")
    data = bytearray(file.getvalue())
    at = data.index(b"\xff\xc0") + 5
    side = int(random.integers(30_000, 65_500))
    data[at : at + 4] = struct.pack(">HH", side, side)
    return bytes(data)


_PACKED = {
    "compression": OpenEXR.ZIP_COMPRESSION,
    "displayWindow": ((0, 0), (3, 3)),
}


def _exr(random: Random, stock: Path) -> bytes:
    names = ["R", "G", "B"]
    if random.random() < 0.5:
        names = [f"c{k}" for k in range(60)]
    first = {name: np.zeros((2048, 2048), np.float16) for name in names[:3]}
    first |= {name: first[names[0]] for name in names}
    small = {name: np.zeros((4, 4), np.float16) for name in "RGB"}
    large = {name: np.zeros((9000, 9000), np.float16) for name in "RGB"}
    parts = [OpenEXR.Part(dict(_PACKED), first, "one")]
    if random.random() < 0.5:
        sizes = zip("ab", (small, large), strict=True)
        parts = [OpenEXR.Part(dict(_PACKED), size, name) for name, size in sizes]
    path = stock / f"bomb-{len(names)}-{len(parts)}.exr"
    if not path.exists():
        OpenEXR.File(parts).write(str(path))
    return path.read_bytes()


def _gltf(random: Random) -> bytes:
    count = int(random.choice([10**8, 2**28, 2**31 - 1, 10**15]))
    accessor: dict[str, Any] = {"componentType": 5126, "count": count, "type": "VEC3"}
    if random.random() < 0.5:
        accessor |= {"bufferView": 0}
    if random.random() < 0.3:
        at = {"bufferView": 0, "componentType": 5121}
        accessor |= {"sparse": {"count": 1, "indices": at, "values": {"bufferView": 0}}}
    return json.dumps(triangle(accessors=[accessor])).encode()


def _gltf_of_nodes(random: Random) -> bytes:
    """A mesh in very many places: each node holds the next one many times."""
    depth, width = int(random.integers(2, 40)), int(random.integers(1, 30))
    nodes: list[dict[str, Any]] = [{"mesh": 0}]
    nodes = [{"children": [k + 1] * width} for k in range(depth)] + nodes
    if random.random() < 0.3:
        nodes[-1]["children"] = [0]
    return json.dumps(triangle(nodes=nodes)).encode()


def _stl(random: Random) -> bytes:
    return bytes(80) + struct.pack("<I", int(random.integers(10**6, 2**32))) + bytes(50)


def _ply(random: Random) -> bytes:
    count = int(random.choice([10**7, 10**9, 10**12]))
    kind = str(random.choice(["ascii", "binary_little_endian"]))
    return (
        f"ply\nformat {kind} 1.0\ncomment TextureFile picture.eps\n"
        f"element vertex {count}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {count}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()


def _off(random: Random) -> bytes:
    count = int(random.choice([10**7, 10**9, 10**12]))
    return f"OFF\n{count} {count} 0\n0 0 0\n".encode()


def _obj(random: Random) -> bytes:
    names, same = int(random.integers(5_000, 20_000)), random.random() < 0.5
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0"]
    for k in range(names):
        lines += [f"usemtl m{0 if same else k}", "f 1 2 3"]
    return "\n".join(lines).encode()


def _mtl(random: Random) -> bytes:
    each = "newmtl m{}\n", "newmtl m{}\nKd 0.5 0.2 0.1\n", "newmtl m\nmap_Kd {}.png\n"
    count = int(random.integers(20_000, 200_000))
    line = each[int(random.integers(3))]
    return "".join(line.format(k) for k in range(count)).encode()[: 2**24 - 1]


def _npz(random: Random) -> bytes:
    """Arrays of zeros, or a head that promises more than there is."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("normals", "ambient", "structure", "noise_given"):
            if random.random() < 0.5:
                side = int(random.choice([10**5, 2**31, 2**40]))
                head = {"descr": "<f8", "fortran_order": False, "shape": (side, side)}
                entry = io.BytesIO()
                np.lib.format.write_array_header_1_0(entry, head)
                archive.writestr(f"{name}.npy", entry.getvalue() + bytes(100))
            else:
                head = {"descr": "<f8", "fortran_order": False, "shape": (2**24,)}
                entry = io.BytesIO()
                np.lib.format.write_array_header_1_0(entry, head)
                archive.writestr(f"{name}.npy", entry.getvalue() + bytes(2**27))
    return file.getvalue()


def _mat(random: Random) -> bytes:
    """A variable twice: the one that is asked for, and one that is read."""
    side = int(random.choice([4, 4000]))
    file = io.BytesIO()
    scipy.io.savemat(
        file, {"Normal_gt": np.zeros((side, side, 3), np.uint8)}, do_compression=True
    )
    again = io.BytesIO()
    scipy.io.savemat(again, {"Normal_gt": np.zeros((4, 4, 3))}, do_compression=True)
    return file.getvalue() + again.getvalue()[128:]


def _scene(random: Random) -> bytes:
    side = int(random.choice([8, 11_585, 2**31 - 1, 10**12]))
    count = int(random.choice([1, 200_000, 3_000_000]))
    lights = str(random.choice(["0", "[]", '{"kind":"point"}', "{}"]))
    images = "[]"
    if random.random() < 0.3:
        images = json.dumps(
            [{"file": f"{k}.png", "lights": [0]} for k in range(20_000)]
        )
    return (
        '{"format": "phongfit scene", "version": 1, "surface": {"kind": "sphere"}, '
        f'"camera": {{"kind": "orthographic", "width": {side}, "height": {side}}}, '
        f'"images": {images}, "encoding": "linear", '
        f'"lights": [{",".join([lights] * count)}]}}'
    ).encode()[: 2**24 - 1]


def _images(random: Random) -> bytes:
    """A right scene with very many images and lights."""
    count, lights = int(random.integers(1, 20_000)), int(random.integers(1, 300))
    light = {"kind": "directional", "direction": [0, 0, 1]}
    entries = [{"file": f"{k}.png", "lights": [k % lights]} for k in range(count)]
    return json.dumps(
        {
            "format": "phongfit scene",
            "version": 1,
            "surface": {"kind": "sphere"},
            "camera": {"kind": "orthographic", "width": 8, "height": 8},
            "lights": [light] * lights,
            "images": entries,
            "encoding": "linear",
        }
    ).encode()


def _keys(random: Random) -> bytes:
    """Very many keys, one of them twice; or very deep."""
    count = int(random.integers(20_000, 200_000))
    if random.random() < 0.3:
        return b'{"format":' * count
    if random.random() < 0.2:
        return b"[" * count + b"]" * count
    if random.random() < 0.2:
        return b'{"format": ' + b"9" * count + b"}"
    keys = [f'"k{k}": 0' for k in range(count)]
    return f'{{{", ".join(keys)}, "k{count - 1}": 1}}'.encode()


def _normal_map(folder: Path, data: bytes) -> None:
    """A DiLiGenT set around a `.mat`."""
    (folder / "filenames.txt").write_text("a.png")
    (folder / "light_directions.txt").write_text("0 0 1")
    (folder / "light_intensities.txt").write_text("1 1 1")
    white = np.full((4, 4), 255, np.uint8)
    (folder / "mask.png").write_bytes(imagecodecs.png_encode(white))
    (folder / "Normal_gt.mat").write_bytes(data)


Reader = Callable[[Path], object]


def _linear(path: Path) -> object:
    return read_image(path, "linear")


# What the file is called, what makes it, and what reads it.
BOMBS: list[tuple[str, Callable[[Random], bytes], Reader]] = [
    ("a.png", _png, _linear),
    ("a.png", _png, read_mask),
    ("b.png", _png_of_text, _linear),
    ("a.tif", _tiff, _linear),
    ("a.hdr", _hdr, _linear),
    ("a.jpg", _other_formats, _linear),
    ("b.jpg", _jpeg, _linear),
    ("a.gltf", _gltf, load_mesh),
    ("b.gltf", _gltf_of_nodes, load_mesh),
    ("a.stl", _stl, load_mesh),
    ("a.ply", _ply, load_mesh),
    ("a.off", _off, load_mesh),
    ("a.obj", _obj, load_mesh),
    ("a.mtl", _mtl, read_mtl),
    ("a.npz", _npz, load_maps),
    ("b.npz", _npz, load_fit),
    ("a.json", _scene, load_scene),
    ("b.json", _keys, load_scene),
    ("c.json", _images, load_views),
]


def make(random: Random, stock: Path) -> Case:
    at = int(random.integers(len(BOMBS) + 2))
    if at == len(BOMBS):
        data = _mat(random)

        def act(folder: Path) -> None:
            with blaming("Normal_gt.mat"):
                open_diligent(folder)

        return Case("a .mat", lambda folder: _normal_map(folder, data), act)
    if at == len(BOMBS) + 1:
        name, maker, reader = "c.exr", lambda random: _exr(random, stock), _linear
    else:
        name, maker, reader = BOMBS[at]
    data = maker(random)

    def act_on_file(folder: Path) -> None:
        with blaming(name):
            reader(folder / name)
        if name == "a.jpg":
            raise Wrong("a picture that is no JPEG was read as one")

    return Case(f"{name} of {maker.__name__}", put({name: data}), act_on_file)


KIND = Kind(make, share=0.05)
