"""`phongfit scene`: a surface, a camera and lights in; a scene file out."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from tyro.conf import Positional, UseAppendAction, arg

from phongfit.calibration.result import Calibration
from phongfit.commands.options import (
    EncodingName,
    WhiteLevel,
    changed,
    optional,
    read_lights,
    refuse,
)
from phongfit.commands.views import EXPOSURES, UNKNOWNS, find_views, unrounded
from phongfit.files.capture_data import (
    DIRECTION,
    START,
    calibration_of,
    find_lamps,
    list_of,
)
from phongfit.files.captures import Capture, open_capture
from phongfit.files.encodings import parse_encoding
from phongfit.files.inputs import naming, sparing
from phongfit.files.lp import read_lp
from phongfit.files.outputs import check_file
from phongfit.files.scenes import SCENE_FILE, check_size, save_scene
from phongfit.files.schema import ImageRecord
from phongfit.files.seen import seen_in
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
)
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.surfaces import AbstractSurface
from phongfit.lights import AbstractLight, DirectionalLight, PointLight
from phongfit.rendering.film import Film
from phongfit.scene import Scene

Triple = tuple[float, float, float]
Triples = UseAppendAction[tuple[Triple, ...]]

FOV = 30.0
"""Default angle of view for a mesh, degrees."""

ROOM = 1.1
"""Factor on the radius of a mesh's bounding ball, for a margin in the picture."""


@dataclass(frozen=True)
class Options:
    """Options of `phongfit scene`.

    Args:
        photograph: The photograph of the scene; or a folder of them, one lamp each,
            which becomes a data set. Default: none, with --size.
        out: The scene file to write. Default, with a folder: scene.json in it.
        size: Width and height in pixels, where there is no photograph.
        sphere: The surface is a ball: x and y of its centre and its radius in pixels,
            from the upper left corner. The radius is then the unit of length, and the
            origin is the middle of the picture, at the depth of the ball.
        mesh: The surface is a mesh: OBJ, PLY, STL, glTF or OFF. The camera looks at it
            from +z, unless --position is given.
        normals: The surface has these normals, one for each pixel: an .npz with
            normals, and optionally positions and mask, or an .npy.
        camera: orthographic: parallel rays, as of a long lens far away. perspective: a
            pinhole; with --sphere and --normals it stands at the origin. Default:
            perspective with --fov, else orthographic.
        fov: A pinhole's angle of view, from the lower to the upper edge. Default: 30,
            with --mesh.
        position: With --mesh: position of the camera.
        target: With --mesh: the point in the middle of the picture. Default: the middle
            of the mesh.
        light: Direction to a distant light: x right, y up, z to the camera. Once for
            each light.
        point_light: Position of a point light. Once for each light. Its light does not
            fall off unless you add an attenuation to the file.
        cameras: With a folder and --mesh: cameras of the photographs, in the mesh's
            axes: the folder of a COLMAP model, or a transforms.json. All lights are
            then on in all photographs, and in these axes.
        lights: Lights from a file: lights.json, as `phongfit calibrate` writes it, with
            its camera, or an .lp. With --cameras an .lp in the mesh's axes, with a
            light for each photograph.
        intensity: Intensity of each --light and --point-light: a number, or three.
        ambient: The ambient light: a number, or three.
        shadows: The surface casts shadows on itself, for objects that are not convex.
        encoding: With a photograph: encoding of its numbers, or the file of a response
            curve. Default: srgb for JPEG.
        white: With a photograph: the number in its file that is white, such as 4095 of
            12 bits in PNGs of 16. Default: the largest of the format.
        mask: With a folder: an image in it, white where pixels may be used. Default:
            the mask in it, mask.png or NAME.mask.png, if there is one.
        overwrite: Replace an older scene file.
    """

    photograph: Annotated[Positional[Path | None], optional("PHOTO|FOLDER")] = None

    out: Annotated[Path | None, optional("FILE"), arg(aliases=["-o"])] = None

    size: Annotated[tuple[int, int] | None, optional("W H")] = None

    sphere: Annotated[Triple | None, optional("X Y R")] = None

    mesh: Annotated[Path | None, optional("FILE")] = None

    normals: Annotated[Path | None, optional("FILE")] = None

    camera: Annotated[
        Literal["orthographic", "perspective"] | None,
        optional("orthographic|perspective"),
    ] = None

    fov: Annotated[float | None, optional("DEGREES")] = None

    position: Annotated[Triple | None, optional("X Y Z")] = None

    target: Annotated[Triple | None, optional("X Y Z")] = None

    light: Annotated[Triples, optional("X Y Z")] = ()

    point_light: Annotated[Triples, optional("X Y Z")] = ()

    cameras: Annotated[Path | None, optional("FILE|FOLDER")] = None

    lights: Annotated[Path | None, optional("FILE")] = None

    intensity: Annotated[tuple[float, ...], arg(metavar="I")] = (1.0,)

    ambient: Annotated[tuple[float, ...], arg(metavar="I")] = (1.0,)

    shadows: bool = False

    encoding: EncodingName = None

    white: WhiteLevel = None

    mask: Annotated[Path | None, optional("FILE")] = None

    overwrite: bool = False


def main(options: Options) -> int:
    """Write a scene file: surface, camera and lights.

    `phongfit fit`, `render` and `predict` read it, and you can edit it as text. A
    folder of photographs becomes a data set, with a light for each photograph.

    For example:
      phongfit scene ball.jpg --sphere 179 155 81 --light 1 1 2 -o ball.json
      phongfit scene --size 96 96 --mesh cup.obj --point-light 2 3 4 -o cup.json
      phongfit scene photos --sphere 179 155 81 --lights out/lights/lights.json
      phongfit scene photos --mesh cup.obj --cameras sparse/0 --light 1 2 2 --overwrite
      phongfit scene photos --mesh cup.obj --cameras . --lights cup.lp --overwrite
    """
    out = _out(options)
    check_file(out)
    if out.exists() and not options.overwrite:
        raise ValueError(f"{out}: is there already; --overwrite replaces it")
    with sparing(out):
        made = _make(options) if options.cameras is None else _make_views(options)
        check_size(made.scene)
        save_scene(
            out,
            made.scene,
            film=made.film,
            images=made.images,
            cameras=made.cameras,
            white=options.white,
        )
    print(f"{out}: {_words(made)}")
    for note in made.notes:
        print(note)
    return 0


class _Made(NamedTuple):
    scene: Scene
    film: Film | None
    images: list[ImageRecord]
    notes: list[str]
    cameras: Sequence[AbstractCamera] = ()


def _out(options: Options) -> Path:
    photograph, own = options.photograph, None
    if photograph is not None and photograph.is_dir():
        own = photograph / SCENE_FILE
    out = options.out or own
    if out is None:
        raise ValueError("out: expected the name of the file to write, got none")
    if own is not None and out.resolve() != own.resolve():
        raise ValueError(
            f"out: expected {own}, beside the photographs of the data set, got {out}"
        )
    if own is None and out.suffix.lower() != ".json":
        raise ValueError(f"out: expected a .json file, got {out}")
    return out


def _make(options: Options) -> _Made:
    """Scene and images of photographs from one place, or of none."""
    capture = _capture(options)
    if capture is not None:
        refuse(options, "size", "expected it or a photograph, which has one, got both")
        height, width = capture.series.size
    elif options.size is not None:
        width, height = options.size
    else:
        raise ValueError("size: expected it, or a photograph to take it from")
    camera, surface = _seen(options, height, width)
    images: list[ImageRecord] = []
    if capture is None or len(capture.names) == 1:
        lights, notes = _given_lights(options)
    else:
        lights, notes = _lights_of(options, capture)
        if np.ptp(capture.series.relative_exposures):
            notes = [*capture.notes, "the ambient light is that of the first", *notes]
        images = _images(options, capture)
    film = None if capture is None else unrounded(capture.film)
    return _Made(_scene(options, surface, camera, lights), film, images, notes)


def _make_views(options: Options) -> _Made:
    """Scene and images of photographs whose cameras other tools have determined."""
    folder, cameras = options.photograph, options.cameras
    if folder is None or cameras is None or options.mesh is None:
        raise ValueError(
            "cameras: expected a folder of photographs, and --mesh, whose axes they "
            "are in"
        )
    others = "sphere normals camera fov position target size"
    refuse(options, others, f"{cameras} tells what is seen from where")
    refuse(options, "mask", "is of photographs from one place")
    encoding = parse_encoding(options.encoding)
    views = find_views(folder, cameras, encoding, options.white)
    images = views.images
    if options.lights is None:
        lights, notes = _given_lights(options)
    else:
        lights, notes = _own_lights(options, [Path(one.file).name for one in images])
        images = [
            one.model_copy(update={"lights": [k]}) for k, one in enumerate(images)
        ]
    scene = _scene(options, _read_mesh(options.mesh), views.cameras[0], lights)
    return _Made(scene, views.film, images, [*views.notes, *notes], views.cameras)


def _scene(
    options: Options,
    surface: AbstractSurface,
    camera: AbstractCamera,
    lights: Sequence[AbstractLight],
) -> Scene:
    ambient = _colour("ambient", options.ambient)
    return Scene(surface, camera, lights, ambient=ambient, shadows=options.shadows)


def _own_lights(
    options: Options, photographs: Sequence[str]
) -> tuple[list[AbstractLight], list[str]]:
    """A light for each of some photographs from several places, by their names."""
    file = list_of(options.lights)
    if file is None:
        raise ValueError(
            "lights: expected an .lp with --cameras, in the mesh's axes, got "
            f"{options.lights}: lights.json is of photographs from one place"
        )
    refuse(options, "light point_light", "expected it or --lights, got both")
    listed = read_lp(file)
    with naming(str(file)):
        vectors = listed.only(photographs).vectors
    intensity = _colour("intensity", options.intensity)
    left = len(listed.names) - len(photographs)
    notes = [f"{left} lights of {file} are of no photograph: left out"] if left else []
    return [DirectionalLight(vector, intensity) for vector in vectors], notes


def _capture(options: Options) -> Capture | None:
    path = options.photograph
    if path is None:
        refuse(options, "encoding white mask", "is of photographs, and none is given")
        return None
    if not path.exists():
        raise ValueError(f"{path}: there is no such file or folder")
    encoding = parse_encoding(options.encoding)
    if not path.is_dir():
        refuse(options, "mask", "is of a folder; give it to `phongfit fit` instead")
    listed = list_of(options.lights) if path.is_dir() else None
    return open_capture(path, encoding, lights=listed, white=options.white)


def _seen(
    options: Options, height: int, width: int
) -> tuple[AbstractCamera, AbstractSurface]:
    """Camera and surface, from the single option that gives a surface."""
    given = [name for name in changed(options) if name in ("sphere", "mesh", "normals")]
    if len(given) != 1:
        raise ValueError(
            "sphere: expected one of --sphere, --mesh and --normals, got "
            + (" and ".join(given) if given else "none")
        )
    if options.camera == "orthographic" and options.fov is not None:
        raise ValueError("fov: an orthographic camera has none")
    if options.mesh is not None:
        return _towards(options, _read_mesh(options.mesh), height, width)
    refuse(options, "position target", f"is for --mesh; {given[0]} is in the picture")
    if options.camera == "perspective" and options.fov is None:
        raise ValueError("fov: expected the angle of view of a perspective camera")
    found = _calibrated(options)
    if found is not None:
        refuse(options, "camera", "expected none, since the calibration has the camera")
    return seen_in(height, width, found, options.sphere, options.normals, options.fov)


def _calibrated(options: Options) -> Calibration | None:
    """The calibration that has the lights, and therefore the camera, or `None`."""
    path = options.photograph
    if options.lights is None and (path is None or not path.is_dir()):
        return None
    return calibration_of(path or Path(), options.lights)


def _read_mesh(path: Path) -> Mesh:
    # Imported here, since SciPy takes long to import.
    from phongfit.files.meshes import load_mesh

    return load_mesh(path).mesh


def _towards(
    options: Options, mesh: Mesh, height: int, width: int
) -> tuple[AbstractCamera, AbstractSurface]:
    """A camera that looks at a mesh, by default from where all of it is visible."""
    vertices = np.asarray(mesh.vertices)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - middle, axis=-1).max())
    target = middle if options.target is None else np.array(options.target)
    # The narrower side of the picture must contain the mesh.
    aspect = min(width / height, 1)
    size = {"width": width, "height": height}
    if options.camera == "perspective" or options.fov is not None:
        fov = FOV if options.fov is None else options.fov
        half = np.arctan(aspect * np.tan(np.radians(min(max(fov, 1e-3), 179.9)) / 2))
        back = (0, 0, ROOM * radius / np.sin(half))
        place = target + back if options.position is None else options.position
        return PerspectiveCamera.look_at(place, target, fov_y=fov, **size), mesh
    back = (0, 0, 3 * radius)
    place = target + back if options.position is None else options.position
    view_height = 2 * ROOM * radius / aspect
    camera = OrthographicCamera.look_at(place, target, view_height=view_height, **size)
    return camera, mesh


def _given_lights(options: Options) -> tuple[Sequence[AbstractLight], list[str]]:
    """The lights of a scene without listed photographs, and notes; all are on."""
    intensity = _colour("intensity", options.intensity)
    made: list[AbstractLight] = []
    with_name = (("light", DirectionalLight), ("point_light", PointLight))
    for name, kind in with_name:
        for vector in getattr(options, name):
            try:
                made.append(kind(vector, intensity))
            except ValueError as error:
                raise ValueError(f"{name}: {str(error).partition(': ')[2]}") from error
    if options.lights is None and made:
        return made, []
    if options.lights is None:
        return [DirectionalLight(START, intensity)], [
            f"no light is given: a distant one is taken, from {START}; a fit finds it "
            f"with {UNKNOWNS} {DIRECTION}"
        ]
    if made:
        raise ValueError("lights: expected it or --light and --point-light")
    names, lights = read_lights(options.lights)
    one = options.photograph
    if one is None:
        return lights, [f"all {len(lights)} lights are on"] if len(lights) > 1 else []
    if one.name not in names:
        raise ValueError(
            f"lights: expected one of {one.name}, got none in {options.lights}"
        )
    return [lights[names.index(one.name)]], []


def _lights_of(
    options: Options, capture: Capture
) -> tuple[list[AbstractLight], list[str]]:
    """A light for each photograph of a folder, and notes."""
    why = "expected --lights for a folder, a file that gives each photograph its own"
    refuse(options, "light point_light", why)
    lights, unknown = find_lamps(capture, _calibrated(options))
    if DIRECTION in unknown:
        raise ValueError(
            f"lights: expected lights.json or an .lp for the {len(capture.names)} "
            "photographs (`phongfit calibrate` makes both), got none; without lights "
            "fit the folder itself, with --sphere or --normals"
        )
    if not unknown:
        return lights, []
    return lights, [
        f"how strong the lamps are is not known: a fit finds it with {UNKNOWNS} "
        f"{EXPOSURES}"
    ]


def _images(options: Options, capture: Capture) -> list[ImageRecord]:
    mask = None if capture.mask is None else capture.mask.name
    if options.mask is not None:
        if options.mask.resolve().parent != capture.folder.resolve():
            raise ValueError(
                f"mask: expected an image in {capture.folder}, got {options.mask}"
            )
        mask = options.mask.name
    return [
        ImageRecord(file=name, lights=[number], mask=mask)
        for number, name in enumerate(capture.names)
    ]


def _colour(name: str, given: Sequence[float]) -> float | tuple[float, ...]:
    if len(given) not in (1, 3):
        raise ValueError(f"{name}: expected one number or three, got {len(given)}")
    return given[0] if len(given) == 1 else tuple(given)


def _words(made: _Made) -> str:
    scene, camera = made.scene, made.scene.camera
    lights = len(scene.lights)
    kind = type(camera).__name__.removesuffix("Camera").lower()
    what = {"Sphere": "a ball", "NormalMap": "a surface with normals"}
    surface = what.get(type(scene.surface).__name__, "a mesh")
    words = (
        f"{surface}, {camera.width} × {camera.height} pixels of a camera that is "
        f"{kind}, {lights} light{'s' if lights > 1 else ''}"
    )
    return words + (f", {len(made.images)} photographs" if made.images else "")
