"""Maps from zarr arrays to zarr arrays, by this process or by the workers of Dask.

Dask transfers only numbers of blocks and counts of pixels; workers read and write the
arrays themselves. Finished blocks are recorded in the output's ledger instead of Dask's
memory, so that workers, scheduler and this process may die at any moment.
"""

import contextlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from phongfit.cache import cache_environment
from phongfit.checks import untraced
from phongfit.edge import checked, shown
from phongfit.files.zarrs import open_group, require, store_of, write_attributes
from phongfit.maps.ahead import ahead
from phongfit.maps.blocks import Counts, Place, fit_block, make_place
from phongfit.maps.run import as_team, bar
from phongfit.maps.stacks import AbstractStack, ZarrStack
from phongfit.maps.store import alone_at
from phongfit.maps.stored import StoredMaps
from phongfit.scene import Scene

if TYPE_CHECKING:
    import distributed

ONE_CORE = {
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}
"""Environment of a worker before it imports JAX: computations use one thread."""

BESIDE = 8
"""Maximum number of blocks that one process fits in parallel, to limit memory."""


@checked
def fit_stored_maps(
    scenes: Sequence[Scene],
    images: Any,
    output: str | os.PathLike[str],
    *,
    client: Any = None,
    block: tuple[int, int] | None = None,
    progress: bool = True,
    **options: Any,
) -> StoredMaps:
    """Fit maps as by [`fit_maps`][], if images or maps do not fit into memory.

    Each block is read from a zarr store, or from photographs, and written to another
    store, by this process or by the workers of a Dask cluster, with one block at a time
    per thread. An interrupted run continues when it is started again, with
    bit-identical results: finished blocks are compared with their checksums, and not
    fitted again. Results are bit-identical on processors of one kind.

        stack = pf.ZarrStack("dome/stack.zarr")
        with Client("tcp://10.0.0.1:8786") as client:
            pf.fit_stored_maps(scenes, stack, "dome/maps.zarr", client=client)

    **Arguments:**

    - `scenes`: as in [`fit_maps`][]. A normal map of one pixel stands for a plane.
    - `images`: a [`ZarrStack`][], or the path or URL of one; or another stack, such as
        [`DatasetStack`][], which only this process can read, without a client.
    - `output`: the path or URL of a zarr store that is new, or of the same job. Its
        chunks are the blocks.
    - `client`: client of a Dask cluster; default: the current one, or else this process
        does the work. Workers should have one thread each: see the guide.
    - `block`: rows and columns of a block. Default: as many of the images' shards or
        chunks as hold 64 MB of stored samples.
    - `progress`: show a bar on a terminal, or occasional lines elsewhere.
    - `options`: those of [`fit_maps`][]: `unknowns`, `per_channel`, `known`, `bounds`,
        `mask`, `noise`, `film`, `loss`, `normals`, `start` and `min_cosine`.

    **Returns:** [`StoredMaps`][]. They have no warnings of the maps as a whole, such as
    those of misplaced pixels or of the lamps' strengths.

    **Raises:** `ValueError` that names the argument, or the store that is missing or
    broken; `OSError` if the output cannot be written, another run writes there, or the
    cluster is gone. Finished blocks are kept.
    """
    untraced("fit_stored_maps is no function that JAX can trace", scenes=scenes)
    stack = images if isinstance(images, AbstractStack) else ZarrStack(images)
    stored = stack if isinstance(stack, ZarrStack) else None
    if stored is None and client is not None:
        raise ValueError(
            "client: expected none with photographs that this process reads; workers "
            "read a zarr array"
        )
    client = _current() if client is None and stored is not None else client
    _check_client(client)
    source = None if stored is None else store_of(stored.array)
    with alone_at(output, source) as output:
        place, count = make_place(tuple(scenes), stack, output, block, **options)
        done = (
            _here(place, count, None if stored else stack)
            if client is None
            else _spread(client, place, count)
        )
        total: Counts = {}
        for _, (counts, _) in bar(done, count, progress, "blocks"):
            total = {name: total.get(name, 0) + n for name, n in counts.items()}
        write_attributes(open_group(output, "r+"), {"counts": total})
    return StoredMaps(output)


def _here(
    place: Place, count: int, stack: AbstractStack | None
) -> Iterator[tuple[int, tuple[Counts, bool]]]:
    """Fit blocks in this process, some in parallel, and yield them in order."""
    devices, threads = as_team()
    cpu = devices[0].platform == "cpu"
    beside = min(threads if cpu else len(devices), BESIDE)

    def fit(number: int) -> tuple[Counts, bool]:
        return fit_block(place, number + 1, stack, threads // beside)

    # The first alone, since the others use the program that it compiles.
    yield 0, fit_block(place, 0, stack, threads)
    for number, done in ahead(fit, count - 1, beside):
        yield number + 1, done


def _current() -> "distributed.Client | None":
    """The current client, if this process has one."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return distributed.get_client()
    except ValueError:
        return None


def _check_client(client: Any) -> None:
    if client is None:
        return
    require("distributed")
    import distributed

    if not isinstance(client, distributed.Client) or client.asynchronous:
        raise ValueError(
            f"client: expected a Client of Dask's that waits, got {shown(client)}"
        )


def _spread(
    client: "distributed.Client", place: Place, count: int
) -> Iterator[tuple[int, tuple[Counts, bool]]]:
    """Submit all blocks to workers, and yield a number and each one as it is finished.

    **Raises:** `ValueError` or `OSError` of a block; `OSError` if the cluster is gone,
    or if more workers die over a block than Dask allows.
    """
    import distributed

    futures = client.map(fit_block, [place] * count, range(count), pure=False)
    waiting: Any = distributed.as_completed(futures, loop=client.loop)
    try:
        for number, future in enumerate(waiting):
            error: Any = future.exception() if future.status == "error" else None
            if future.status == "finished":
                yield number, future.result()
            elif isinstance(error, ValueError | OSError):
                raise error
            else:
                killed = isinstance(error, distributed.KilledWorker)
                why = (
                    f"workers died over one block {error.allowed_failures + 1} times: "
                    "give them more memory, or a smaller block"
                    if killed
                    else "the cluster is gone"
                )
                raise OSError(
                    f"client: {why}; finished blocks stay in {place.output}, and the "
                    "same run goes on there"
                ) from error
    finally:
        with contextlib.suppress(Exception):
            client.cancel(futures)


@contextlib.contextmanager
def dask_client(where: str) -> "Iterator[distributed.Client]":
    """A Dask client for the value of a command's option.

    **Arguments:** `where`: `local:N`, N workers on this machine with one thread each,
    which end with the context; or the address of a scheduler, such as
    `tcp://10.0.0.1:8786`.

    **Raises:** `ValueError` for other values, or if Dask is not installed; `OSError` if
    no scheduler answers.
    """
    require("dask", "distributed")
    kind, _, rest = where.partition(":")
    if kind == "local" and rest.isdecimal() and int(rest):
        with _local(int(rest)) as client:
            yield client
        return
    if kind not in ("tcp", "tls", "ws", "wss", "ucx") or not rest.startswith("//"):
        raise ValueError(
            "dask: expected local:N or the address of a scheduler, such as "
            f"tcp://10.0.0.1:8786, got {where!r}"
        )
    import distributed

    try:
        client = distributed.Client(where, timeout=20, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise OSError(f"dask: no scheduler answers at {where}") from error
    with client:
        yield client


@contextlib.contextmanager
def _local(count: int) -> "Iterator[distributed.Client]":
    import logging

    import dask.config
    import distributed

    flags = f"{os.environ.get('XLA_FLAGS', '')} {ONE_CORE['XLA_FLAGS']}".strip()
    environment = ONE_CORE | cache_environment() | {"XLA_FLAGS": flags}
    settings = {
        # JAX is multithreaded, and a fork of its process may deadlock.
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.nanny.pre-spawn-environ": environment,
        # The block is rarely the reason for a worker's death.
        "distributed.scheduler.allowed-failures": 11,
    }
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


def dashboard(client: "distributed.Client") -> str | None:
    """The address of Dask's dashboard, or `None` if it does not run."""
    if client.cluster is not None and importlib.util.find_spec("bokeh") is None:
        return None
    services = client.scheduler_info().get("services", {})
    return client.dashboard_link if "dashboard" in services else None
