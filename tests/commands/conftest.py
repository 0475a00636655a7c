"""What tests of the commands share: data sets that a command made, and no cache."""

import contextlib
import resource
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

import phongfit as pf
from phongfit.cli import main
from phongfit.fitting.problem.specification import Specification
from tests.maps.pixel.scenes import hide

SIDE = 16
"""Pixels along the edges of the data set that all commands are tried with."""
FEW = ["--unknowns", "ambient", "diffuse", "--known", "preset:brass"]
FEW += ["--noise", "0.01"]
"""Options of maps that are compiled soon."""


@pytest.fixture(scope="session", autouse=True)
def _no_cache():
    """Tests leave nothing in the cache of whoever runs them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PHONGFIT_CACHE", "off")
        yield


@pytest.fixture(scope="session")
def brass(tmp_path_factory) -> Path:
    """Three photographs of brass, which nothing may change."""
    folder = tmp_path_factory.mktemp("data") / "brass"
    options = ["--material", "preset:brass", "--resolution", f"{SIDE}"]
    assert main(["synth", f"{folder}", *options, "--lights=3", "--noise=0.01"]) == 0
    return folder


@pytest.fixture
def copy(brass, tmp_path) -> Path:
    """A copy of the data set that a test may break."""
    return Path(shutil.copytree(brass, tmp_path / "copy"))


@pytest.fixture
def stored(copy) -> Path:
    """The data set's images as a zarr array beside its scene.json."""
    images = np.stack(pf.read_dataset(copy).images)
    zarr.create_array(copy / "stack.zarr", data=images, chunks=(1, 8, 8, 3))
    return copy / "stack.zarr"


@pytest.fixture
def refused(capsys) -> Callable[..., str]:
    """A function that runs a command on bad input, and returns its error message.

    The message is one line, the exit status 2. The command may print lines that begin
    with "assumed: " before.
    """

    def refused(*words: object) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == 2
        printed = capsys.readouterr()
        assert printed.err.startswith("error: "), printed.err
        assert printed.err.count("\n") == 1, printed.err
        told = printed.out.splitlines()
        assert all(line.startswith("assumed: ") for line in told), printed.out
        return printed.err

    return refused


def files_in(folder: Path) -> dict[Path, bytes]:
    """All that is in a folder, as it is."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder): path.read_bytes() for path in found}


@pytest.fixture
def asked_of(monkeypatch, tmp_path) -> Callable[..., tuple[tuple, dict[str, Any]]]:
    """Arguments that a command calls a function with, which is not called.

    A specification's options are among the keyword arguments.
    """

    def asked(place: str, *words: object) -> tuple[tuple, dict[str, Any]]:
        heard = []

        def stop(*arguments, **options):
            heard.append((arguments, options))
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(place, stop)
            patch.chdir(tmp_path)
            assert main([*map(str, words)]) == 130
        ((arguments, options),) = heard
        if isinstance(arguments[-1], Specification):
            *arguments, asked = arguments
            options = asked.options | options
        return tuple(arguments), options

    return asked


@contextlib.contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file can grow beyond `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fail(*args, **kwargs):
    """Stands in for a function that finds its input wrong."""
    raise ValueError("no such font")


def interrupt(*args, **kwargs):
    """Stands in for a function during which Ctrl-C is pressed."""
    raise KeyboardInterrupt


def close(*args, **kwargs):
    """Stands in for a function whose reader, such as `head`, has gone."""
    raise BrokenPipeError


ENDS = [(fail, 2), (interrupt, 130), (close, 141)]
"""Ways in which drawing may fail, and the exit status of each."""


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """Photographs of something, and their list of lights; what it is, too."""
    folder = tmp_path_factory.mktemp("capture")
    hidden = hide(surface="dome")
    names = [f"{k:02d}.png" for k in range(24)]
    directions = []
    for name, image, scene in zip(names, hidden.images, hidden.scenes, strict=True):
        # As bright as the strongest channel of the lamps: a list knows no strengths.
        pf.write_image(folder / name, image / [1.0, 0.9, 0.8], "linear", 16)
        (lamp,) = scene.lights
        assert isinstance(lamp, pf.DirectionalLight)
        directions.append(np.asarray(lamp.direction))
    pf.write_lp(folder / "dome.lp", names, np.array(directions))
    return folder, hidden
