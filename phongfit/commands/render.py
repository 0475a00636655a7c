"""`phongfit render`: a scene file and a material in, an image out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from phongfit.commands.options import EncodingName, optional
from phongfit.commands.progress import stage
from phongfit.files.encodings import parse_encoding
from phongfit.files.images import Bits, check_image, write_image
from phongfit.files.inputs import sparing
from phongfit.files.materials import read_material
from phongfit.files.scenes import TRUTH_FILE, load_scene, load_truth, with_lights
from phongfit.material import Material
from phongfit.rendering.film import Film
from phongfit.rendering.render import render

FLOATS = (".hdr", ".exr")
"""Formats that hold linear light, also above white."""


@dataclass(frozen=True)
class Options:
    """Options of `phongfit render`.

    Args:
        scene: A scene.json, or the folder of a data set.
        out: The image to write: .png, .jpg, .tif, .hdr or .exr.
        material: preset:NAME, an .mtl (FILE.mtl:NAME for one of several), or a .json:
            fit.json, truth.json, or one that `phongfit export` wrote. Default: the
            truth.json beside the scene, else a matte grey.
        lights: Numbers of the lights that are on, from 0. Default: all.
        encoding: Encoding of the image, or the file of a response curve. Default: srgb;
            linear for .hdr, .exr, 32 bits.
        bits: Bits of a channel; 32 for floating-point numbers, which are not clipped.
            Default: the fewest that the format has.
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    out: Annotated[Path, arg(aliases=["-o"], metavar="IMAGE")]
    material: Annotated[str | None, optional("preset:NAME|FILE")] = None
    lights: Annotated[tuple[int, ...] | None, optional("N ...")] = None
    encoding: EncodingName = None
    bits: Annotated[Bits | None, optional("8|16|32")] = None


def main(options: Options) -> int:
    """Render a scene with a material, as an image.

    For example:
      phongfit render out/brass/scene.json -o brass.png
      phongfit render out/brass --material preset:gold --lights 0 -o gold.png
      phongfit render out/brass --material out/fit/fit.json -o fitted.exr
    """
    floats = options.bits == 32 or options.out.suffix.lower() in FLOATS
    encoding = parse_encoding(options.encoding) or ("linear" if floats else "srgb")
    check_image(options.out, encoding, options.bits)
    with sparing(options.out):
        scene = with_lights(load_scene(options.scene), options.lights)
        material = _material(options)
    with stage("rendering"):
        light = np.asarray(render(scene, material, film=Film(clamp=not floats)))
    write_image(options.out, light, encoding, options.bits)
    height, width, _ = light.shape
    white = 100 * float(np.mean(light >= 1))
    print(
        f"{options.out}: {width} × {height} pixels, {encoding}; {white:.2g} % of the "
        "samples are white" + (" or brighter" if floats else "")
    )
    return 0


def _material(options: Options) -> Material:
    if options.material is not None:
        return read_material(options.material).material
    folder = options.scene if options.scene.is_dir() else options.scene.parent
    truth = folder / TRUTH_FILE
    return load_truth(truth) if truth.exists() else Material()
