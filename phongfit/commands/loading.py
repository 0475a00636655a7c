"""Lines of Python that read the data of a command's fit, with public names only."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from phongfit.commands.data import DataOptions
from phongfit.files.diligent import is_diligent
from phongfit.files.records import read_record
from phongfit.files.scenes import SCENE_FILE
from phongfit.files.schema import SceneRecord
from phongfit.rendering.film import ENCODINGS


def loading_lines(options: DataOptions, names: Collection[str]) -> str:
    """Python that makes the arguments for `fit` in a report.

    **Arguments:**

    - `options`: the command's options of reading.
    - `names`: variables to define, such as `scene`, `image` and `mask`.

    **Returns:** the lines, or `""` if there would be too many: for a scene file in
    which each image has a camera, unless it is a data set's.
    """
    if options.sphere is not None or options.normals is not None:
        lines = _of_capture(options)
    elif options.dataset.is_dir():
        lines = _of_dataset(options)
    else:
        return "\n".join(_of_image(options, names))
    several = "scenes" in names
    targets = "scenes, images, masks" if several else "(scene,), (image,), (mask,)"
    lines.append(f"{targets} = data.scenes, data.images, data.masks")
    lines += [f"{n} = data.{n}" for n in ("film", "uncertain") if n in names]
    return "\n".join(lines)


def _of_capture(options: DataOptions) -> list[str]:
    encoding, before = _encoding(options.encoding)
    given = {
        name: getattr(options, name)
        for name in _CAPTURED
        if getattr(options, name) != getattr(_USUAL, name)
    }
    arguments = _arguments(given)
    encoded = f", {encoding}" if encoding else ""
    call = f"pf.open_captured({_text(options.dataset)}{encoded}{arguments})"
    return [*before, f"data = {call}.load()"]


def _of_dataset(options: DataOptions) -> list[str]:
    folder = _text(options.dataset)
    if (options.dataset / SCENE_FILE).exists() or not is_diligent(options.dataset):
        return [f"data = pf.read_dataset({folder})"]
    given = {name: getattr(options, name) for name in ("min_cosine", "min_facing")}
    # DiLiGenT's layout does not state the ambient light.
    return [
        "import dataclasses",
        "",
        f"data = pf.read_dataset({folder}{_arguments(given)})",
        "data = dataclasses.replace(",
        "    data,",
        "    scenes=tuple(",
        f"        dataclasses.replace(scene, ambient={options.room_light})",
        "        for scene in data.scenes",
        "    ),",
        "    masks=tuple(mask.all(axis=-1) for mask in data.masks),",
        ")",
    ]


def _of_image(options: DataOptions, names: Collection[str]) -> list[str]:
    """Lines that read one image with a scene file."""
    path, file = options.dataset, options.scene
    assert file is not None
    record = read_record(file, SceneRecord)
    entry = next(
        (
            one
            for one in record.images
            if (file.parent / one.file).resolve() == path.resolve()
        ),
        None,
    )
    encoding, before = _encoding(options.encoding)
    if not encoding and isinstance(record.encoding, str):
        encoding = repr(record.encoding)
    elif not encoding:
        encoding, before = _curve(file, '["encoding"]["light"]')
    if entry is None:
        scene = [f"scene = pf.load_scene({_text(file)})"]
    elif file.name == SCENE_FILE:
        scene = [
            f"data = pf.open_dataset({_text(file.parent)})",
            f"scene = data.scenes[data.names.index({path.name!r})]",
        ]
    elif entry.camera is None and entry.lights is not None:
        numbers = f"{tuple(entry.lights)}"
        scene = [
            f"scene = pf.load_scene({_text(file)})",
            f"lights = tuple(scene.lights[k] for k in {numbers})",
            "scene = dataclasses.replace(scene, lights=lights)",
        ]
        before = ["import dataclasses", *before]
    elif entry.camera is None:
        scene = [f"scene = pf.load_scene({_text(file)})"]
    else:
        return []
    white = record.white if options.white is None else options.white
    given = {} if white is None else {"white": white}
    lines = [
        *before,
        *scene,
        f"photo = pf.read_photograph({_text(path)}, {encoding}{_arguments(given)})",
        "image, mask = photo.image, photo.usable",
    ]
    if options.mask is not None:
        lines.append(f"mask = mask & pf.read_mask({_text(options.mask)})")
    return lines + (["film = photo.film"] if "film" in names else [])


def _encoding(word: str | None) -> tuple[str, list[str]]:
    """An encoding as an argument, and lines that must precede the call."""
    if word is None or word in ENCODINGS:
        return "" if word is None else repr(word), []
    return _curve(Path(word), '["light"]')


def _curve(file: Path, place: str) -> tuple[str, list[str]]:
    """A response curve as an argument, and lines that read it from a JSON file."""
    return "curve", [
        "import json",
        "from pathlib import Path",
        "",
        f"numbers = json.loads(Path({_text(file)}).read_text(encoding='utf-8')){place}",
        "curve = pf.ResponseCurve(numbers)",
    ]


def _arguments(given: dict[str, Any]) -> str:
    return "".join(
        f", {name}={_text(value) if isinstance(value, Path) else repr(value)}"
        for name, value in given.items()
    )


def _text(path: Path) -> str:
    return repr(str(path))


_USUAL = DataOptions(Path())
_CAPTURED = (
    *("sphere", "normals", "lights", "fov", "mask"),
    *("min_cosine", "min_facing", "room_light", "white"),
)
