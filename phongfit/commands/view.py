"""`phongfit view`: maps in, one page out on which a lamp can be moved over them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from phongfit.commands.options import OutFile, optional
from phongfit.commands.progress import stage
from phongfit.files.inputs import sparing
from phongfit.files.outputs import check_file
from phongfit.maps.folder import load_folder
from phongfit.report.viewer import write_view


@dataclass(frozen=True)
class Options:
    """Options of `phongfit view`.

    Args:
        maps: The folder that `phongfit maps` made.
        out: The page to write, one .html that needs no other file and no network.
        title: Title of the page. Default: that of the data.
        distance: Distance of the surface from a pinhole camera, if the maps' geometry
            did not have it.
    """

    maps: Annotated[Positional[Path], arg(metavar="MAPS")]
    out: OutFile
    title: Annotated[str | None, optional("TEXT")] = None
    distance: Annotated[float | None, optional("LENGTH")] = None


def main(options: Options) -> int:
    """Write a page on which the pointer moves a lamp over the mapped object.

    It shows light, shadows, normals and each of the maps, in any browser with WebGL 2.

    For example:
      phongfit view out/maps -o coin.html
    """
    check_file(options.out)
    with sparing(options.out):
        maps, record, _ = load_folder(options.maps)
    with stage("integrating the normals"):
        surface = maps.height(distance=options.distance)
    with stage("writing the page"):
        title = options.title or record.data.name
        write_view(options.out, maps, surface=surface, title=title)
    print(surface)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.1f} MB")
    return 0
