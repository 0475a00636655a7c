"""Maps from zarr to zarr: the same bits, here or on workers, whoever dies meanwhile."""

import collections
import errno
import functools
import importlib.util
import os
import shutil
import signal
import threading
import time
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import zarr

import phongfit as pf
from phongfit.files.coded import Coded
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.images import from_levels
from phongfit.files.zarrs import erase
from phongfit.maps import blocks, cluster
from phongfit.maps.blocks import block_size
from phongfit.maps.cluster import dask_client
from phongfit.maps.pixel.block import BLOCK
from phongfit.maps.tiles import Team, as_team
from tests.maps.synthetic import Stack, make_stack, same

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(
        importlib.util.find_spec("distributed") is None, reason="Dask is not installed"
    ),
]

QUICK: Any = {"unknowns": ("diffuse",), "film": pf.Film(clamp=False)}
SIZE = (20, 26)
"""A block's: none at the lower and right edges is whole."""


@functools.cache
def made() -> Stack:
    return make_stack(48, 64, 4, ambient=0.0)


def fit_apart(scenes: Any, images: Any, out: Any, **options: Any) -> pf.StoredMaps:
    """Maps that are not loaded."""
    return pf.fit_maps(scenes, images, out=out, load=False, **options)


@pytest.fixture
def images(tmp_path):
    """The stack on disk."""
    path = tmp_path / "stack.zarr"
    array = zarr.create_array(path, data=made().images, chunks=(1, 16, 16, 3))
    assert array.metadata.zarr_format == 3
    return path


@pytest.fixture(scope="module")
def maps() -> pf.Maps:
    return pf.fit_maps(made().scenes, made().images, tile_pixels=BLOCK, **QUICK)


@pytest.fixture
def counted(monkeypatch):
    """How often a block is fitted in this process."""
    fitted = []
    real = blocks.fit_job
    monkeypatch.setattr(
        blocks, "fit_job", lambda *a, **k: fitted.append(1) or real(*a, **k)
    )
    return fitted


def test_there_and_back(maps, images, tmp_path, counted):
    stored = fit_apart(
        made().scenes, images, tmp_path / "maps.zarr", block=SIZE, **QUICK
    )
    same(stored.load(), maps)
    assert stored.counts == maps.counts() and stored.shape == (48, 64)
    assert len(counted) == 9
    part = stored.load(slice(10, 30), slice(5, 64))
    np.testing.assert_array_equal(part.diffuse, maps.diffuse[10:30, 5:])
    assert part.camera is not None
    assert part.camera.project(jnp.zeros(3)).tolist() == [27.0, 14.0]


def test_blocks_begin_with_each_device_in_turn(images, tmp_path, monkeypatch):
    devices = [SimpleNamespace(platform="cpu", id=k) for k in range(3)]
    first, real = [], blocks.fit_job

    def fit_job(job, size, team, shared):
        first.append(team.devices[0].id)
        return real(job, size, as_team(), shared)

    monkeypatch.setattr(cluster, "as_team", lambda: Team(devices, 1))
    monkeypatch.setattr(blocks, "fit_job", fit_job)
    out = tmp_path / "maps.zarr"
    fit_apart(made().scenes, images, out, block=SIZE, **QUICK)
    assert collections.Counter(first) == {0: 3, 1: 3, 2: 3}


def test_a_finished_block_is_not_fitted_again_and_a_broken_one_is(
    maps, images, tmp_path, counted
):
    out = tmp_path / "maps.zarr"
    options: Any = {"block": SIZE, "progress": False} | QUICK
    fit_apart(made().scenes, images, out, **options)
    counted.clear()
    # A chunk of another block, one that was cut off, one that is gone; a ledger's
    # entry that was cut off, and one that never was written.
    chunks = out / "diffuse" / "c"
    shutil.copy(chunks / "0" / "0" / "0", chunks / "0" / "1" / "0")
    broken = out / "normals" / "c" / "1" / "0" / "0"
    broken.write_bytes(broken.read_bytes()[:20])
    (out / "flags" / "c" / "1" / "1").unlink()
    ledger = out / "ledger" / "c"
    (ledger / "2" / "0" / "0").write_bytes(b"cut")
    (ledger / "2" / "1" / "0").unlink()
    same(fit_apart(made().scenes, images, out, **options).load(), maps)
    assert len(counted) == 5


def test_another_job_is_refused(images, tmp_path):
    out = tmp_path / "maps.zarr"
    options: Any = {"block": SIZE, "progress": False} | QUICK
    fit_apart(made().scenes, images, out, **options)
    with pytest.raises(ValueError, match="another job .*settings differs"):
        fit_apart(made().scenes, images, out, min_cosine=0.1, **options)
    with pytest.raises(ValueError, match="another job .*block differs"):
        fit_apart(made().scenes, images, out, **options | {"block": (48, 32)})
    turned = [
        pf.Scene(scene.surface, scene.camera, made().scenes[0].lights)
        for scene in made().scenes
    ]
    with pytest.raises(ValueError, match="another job .*lights differs"):
        fit_apart(turned, images, out, **options)
    with pytest.raises(ValueError, match="another job .*surface differs"):
        mask = np.ones((48, 64), bool)
        fit_apart(made().scenes, images, out, mask=mask, **options)
    zarr.open_array(images, mode="r+")[0, 0, 0, 0] = 0.5
    with pytest.raises(ValueError, match="another job .*images differs"):
        fit_apart(made().scenes, images, out, **options)


def test_a_disk_that_is_full(maps, images, tmp_path, monkeypatch):
    """One line that says so; what was finished stays, and the run goes on."""
    from zarr.storage import _local

    out, real, written = tmp_path / "maps.zarr", _local._put, []

    def put(path, value, exclusive=False):
        if "diffuse" in str(path) and "zarr.json" not in str(path):
            written.append(path)
            if len(written) == 4:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, value, exclusive)

    monkeypatch.setattr(_local, "_put", put)
    options: Any = {"block": SIZE, "progress": False} | QUICK
    with pytest.raises(OSError, match="diffuse: cannot be written: No space left"):
        fit_apart(made().scenes, images, out, **options)
    with pytest.raises(ValueError, match="not complete"):
        pf.StoredMaps(out)
    same(fit_apart(made().scenes, images, out, **options).load(), maps)


def test_masks_noise_and_whole_numbers(tmp_path):
    """Arrays of pixels reach the workers by way of the store; one block is empty."""
    levels = np.clip(made().images * 40_000, 0, 65_535).astype(np.uint16)
    path = tmp_path / "stack.zarr"
    written = zarr.create_array(
        path, name="images", data=levels, shards=(4, 32, 32, 3), chunks=(1, 16, 16, 3)
    )
    written.attrs["encoding"] = "linear"
    rng = np.random.default_rng(2)
    mask = rng.uniform(size=(48, 64)) > 0.3
    inside = np.ones((48, 64), bool)
    inside[32:, 32:] = False
    options: Any = QUICK | {
        "mask": [one & inside for one in (mask, mask, ~mask, mask)],
        "noise": rng.uniform(0.01, 0.02, (48, 64)),
    }
    stored = fit_apart(
        made().scenes, path, tmp_path / "maps.zarr", progress=False, **options
    )
    expected = pf.fit_maps(
        made().scenes, from_levels(levels, "linear"), tile_pixels=BLOCK, **options
    )
    same(stored.load(), expected)
    np.testing.assert_array_equal(stored.load().noise_given, expected.noise_given)
    # A stack is a stack wherever else one is taken, too.
    same(pf.fit_maps(made().scenes, pf.ZarrStack(path), **options), expected)


def test_photographs_that_this_process_reads(maps, tmp_path, counted):
    """Block by block, and those that are finished are left when it goes on."""
    hidden = np.zeros(made().images.shape[1:3], bool)
    hidden[:, 40:] = True

    def read(number: int) -> Photograph:
        return Photograph(Coded(made().images[number]), ~(hidden & (number == 2)))

    names = tuple("abcd")
    stack = pf.DatasetStack(
        Photographs("made", made().scenes, names, QUICK["film"], read)
    )
    masks = [~(hidden & (number == 2)) for number in range(4)]
    options: Any = QUICK | {"mask": masks, "tile_pixels": BLOCK}
    expected = pf.fit_maps(made().scenes, made().images, **options)
    out = tmp_path / "maps.zarr"
    stored = fit_apart(made().scenes, stack, out, block=SIZE, **QUICK)
    same(stored.load(), expected)
    assert len(counted) == 9
    fit_apart(made().scenes, stack, out, block=SIZE, **QUICK)
    assert len(counted) == 9
    with pytest.raises(ValueError, match="client: expected none with photographs"):
        fit_apart(made().scenes, stack, out, client=object(), **QUICK)


def test_blocks_are_as_shards_and_chunks_are(tmp_path):
    def block(shape, dtype="uint8", **layout):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.zarr"
        zarr.create_array(path, shape=shape, dtype=dtype, **layout)
        return block_size(pf.ZarrStack(path), None)

    # 96 images of 8 bits: 233 016 pixels make 64 MB.
    assert block((96, 9000, 9000, 3), chunks=(1, 512, 512, 3)) == (256, 512)
    assert block((48, 9000, 9000, 3), "uint16", chunks=(1, 512, 512, 3)) == (256, 512)
    assert block((96, 9000, 9000, 3), chunks=(1, 256, 256, 3)) == (256, 512)
    shards: Any = {"shards": (96, 384, 384, 3), "chunks": (1, 64, 64, 3)}
    assert block((96, 9000, 9000, 3), **shards) == (384, 384)
    assert block((96, 100, 130, 3), chunks=(1, 64, 64, 3)) == (100, 130)
    assert block((4000, 9000, 9000, 3), chunks=(1, 4096, 4096, 3)) == (1, 4096)


def test_what_is_wrong_is_named(images, tmp_path, monkeypatch):
    out = tmp_path / "maps.zarr"
    with pytest.raises(ValueError, match="gone.zarr: there is no such zarr array"):
        pf.ZarrStack(tmp_path / "gone.zarr")
    with pytest.raises(ValueError, match=r"images: expected 3, one for each of scenes"):
        fit_apart(made().scenes[:3], images, out, **QUICK)
    eight = tmp_path / "eight.zarr"
    zarr.create_array(eight, data=np.concatenate([made().images] * 2))
    with pytest.raises(ValueError, match="materials: expected None with load=False"):
        scenes = made().scenes * 2
        fit_apart(scenes, eight, out, materials=2, normals="fit")
    with pytest.raises(ValueError, match="block: expected rows and columns"):
        fit_apart(made().scenes, images, out, block=(0, 5), **QUICK)
    flat = zarr.create_array(tmp_path / "flat.zarr", shape=(3, 4), dtype="f4")
    assert flat.ndim == 2
    with pytest.raises(ValueError, match=r"expected images of shape \(light, y, x, 3"):
        pf.ZarrStack(tmp_path / "flat.zarr")
    spoilt = tmp_path / "spoilt.zarr"
    zarr.create_array(spoilt, data=np.full((4, 48, 64, 3), np.nan, "f4"))
    with pytest.raises(ValueError, match="has NaN"):
        fit_apart(made().scenes, spoilt, out, progress=False, **QUICK)
    (tmp_path / "bad.zarr").mkdir()
    (tmp_path / "bad.zarr" / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match="bad.zarr: cannot be read"):
        pf.ZarrStack(tmp_path / "bad.zarr")
    huge = tmp_path / "huge.zarr"
    zarr.create_array(
        huge, shape=(9, 99_999, 99_999, 3), dtype="f4", chunks=(9, 99_999, 9_999, 3)
    )
    with pytest.raises(ValueError, match="at most 1 GB of memory, got a chunk"):
        pf.ZarrStack(huge)
    with pytest.raises(ValueError, match="dask: expected local:N or the address"):
        with dask_client("local:none"):
            raise AssertionError
    import distributed

    monkeypatch.setattr(distributed, "get_client", object)
    with pytest.raises(ValueError, match="client: expected a Client of Dask's that"):
        fit_apart(made().scenes, images, tmp_path / "new.zarr", **QUICK)
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n: None if n == "distributed" else real(n)
    )
    with pytest.raises(
        ValueError, match=r"distributed not .*: pip .*phongfit\[cluster"
    ):
        with dask_client("local:1"):
            raise AssertionError


@pytest.fixture(scope="module")
def client():
    """Two workers, for the whole file: each imports JAX."""
    with dask_client("local:2") as client:
        yield client


def test_workers_one_of_which_is_killed(client, maps, images, tmp_path):
    """While it works on a block, at the moment that another one is finished."""
    killed = []

    def kill():
        ledger = tmp_path / "maps.zarr" / "ledger" / "c"
        while not any(ledger.rglob("0")):
            time.sleep(0.01)
        killed.append(next(iter(client.run(os.getpid).values())))
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    stored = fit_apart(
        made().scenes,
        images,
        tmp_path / "maps.zarr",
        client=client,
        block=(8, 16),
        progress=False,
        **QUICK,
    )
    thread.join()
    assert killed
    same(stored.load(), maps)


def test_a_scheduler_that_is_gone(maps, images, tmp_path, counted):
    """One line that says so; what was finished is not fitted again."""
    from distributed import Client, LocalCluster

    out = tmp_path / "maps.zarr"
    options: Any = {"block": SIZE, "progress": False} | QUICK
    alone: Any = {"processes": False, "dashboard_address": None}
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, **alone)
    with Client(cluster, set_as_default=False) as client:

        def end():
            while len(counted) < 3:
                time.sleep(0.01)
            cluster.close()

        thread = threading.Thread(target=end, daemon=True)
        thread.start()
        with pytest.raises(OSError, match="client: the cluster is gone; finished"):
            fit_apart(made().scenes, images, out, client=client, **options)
        thread.join()
    # The last that was begun may have been finished, or not.
    begun = len(counted)
    assert 2 < begun < 9
    same(fit_apart(made().scenes, images, out, **options).load(), maps)
    assert 9 <= len(counted) <= 10


@pytest.fixture
def bucket(client, monkeypatch):
    """An object store that speaks as S3 does, on this machine."""
    server = pytest.importorskip("moto.server")
    pytest.importorskip("s3fs")
    import fsspec
    from fsspec import config

    running = server.ThreadedMotoServer(port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    settings = {
        "s3": {"key": "a", "secret": "b", "endpoint_url": f"http://{host}:{port}"}
    }

    def tell(settings):
        config.conf.update(settings)

    monkeypatch.setattr(config, "conf", settings)
    client.run(tell, settings)
    fsspec.filesystem("s3").mkdir("coins")
    yield "s3://coins"
    running.stop()


def test_an_object_store(bucket, client, maps, counted):
    array = zarr.create_array(f"{bucket}/a/stack.zarr", data=made().images)
    out = f"{bucket}/a/maps.zarr"
    options: Any = {"block": SIZE, "progress": False} | QUICK
    stored = fit_apart(
        made().scenes,
        pf.ZarrStack(f"{bucket}/a/stack.zarr"),
        out,
        client=client,
        **options,
    )
    same(stored.load(), maps)
    # Gone, and made again, by this process; the others are not.
    import fsspec

    fsspec.filesystem("s3").rm("coins/a/maps.zarr/noise/c/1/1")
    same(
        fit_apart(made().scenes, f"{bucket}/a/stack.zarr", out, **options).load(),
        maps,
    )
    assert len(counted) == 1
    array[0, 0, 0, 0] = 0.25
    with pytest.raises(ValueError, match="another job .*images differs"):
        fit_apart(made().scenes, f"{bucket}/a/stack.zarr", out, **options)
    with pytest.raises(ValueError, match="s3://coins/no.zarr: there is no such"):
        pf.ZarrStack(f"{bucket}/no.zarr")
    erase(out)
    assert not fsspec.filesystem("s3").exists("coins/a/maps.zarr")
