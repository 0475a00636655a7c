"""Maps from zarr arrays to zarr arrays, by this process or by the workers of Dask.

Dask transfers only numbers of blocks and counts of pixels; workers read and write the
arrays themselves. Finished blocks are recorded in the output's ledger instead of Dask's
memory, so that workers, scheduler and this process may die at any moment.
"""

import contextlib
import importlib.util
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from phongfit.cache import cache_environment
from phongfit.edge import shown
from phongfit.files.zarrs import require
from phongfit.geometry.surfaces import NormalMap
from phongfit.maps.ahead import ahead
from phongfit.maps.blocks import (
    Blocks,
    Kept,
    Place,
    fit_block,
    make_blocks,
    make_place,
)
from phongfit.maps.job import Job, casts_shadows, is_plane
from phongfit.maps.stacks import AbstractStack, ZarrStack
from phongfit.maps.stored import StoredMaps, complete
from phongfit.maps.tiles import as_team, bar

if TYPE_CHECKING:
    import distributed

    from phongfit.files.zarrs import Group

ONE_CORE = {
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}
"""Environment of a worker before it imports JAX: computations use one thread."""

BESIDE = 8
"""Maximum number of blocks that one process fits in parallel, to limit memory."""


def fit_apart(job: Job, kept: Kept, client: Any, progress: bool) -> StoredMaps:
    """Fit maps that need not fit into memory, by this process or by workers.

    **Arguments:** `client`: see [`client_for`][].

    **Raises:** as [`fit_maps`][] does.
    """
    blocks, group = make_blocks(job, kept)
    count = math.prod(blocks.store(group).grid)
    if client is None:
        done = _here(blocks, group, count)
    else:
        done = _spread(client, make_place(blocks, group, kept.output), count)
    total: Counter[str] = Counter()
    for _, counts in bar(done, count, progress, "blocks"):
        total.update(counts)
    complete(kept.output, total)
    return StoredMaps(kept.output)


def check_apart(job: Job) -> None:
    """Check that blocks of a job can be fitted without the others.

    **Raises:** `ValueError` that names the argument.
    """
    surface, size = job.scenes[0].surface, job.stack.shape[1:]
    if not isinstance(surface, NormalMap):
        return
    if surface.mask.shape != size and not is_plane(surface):
        raise ValueError(
            f"scenes: expected a normal map of {size} pixels, as the images have, got "
            f"{surface.mask.shape}"
        )
    if casts_shadows(job.scenes):
        raise ValueError(
            "scenes: expected load=True with a normal map that casts shadows, since "
            "they fall from one block on others"
        )


def _here(
    blocks: Blocks, group: "Group", count: int
) -> Iterator[tuple[int, dict[str, int]]]:
    """Fit blocks in this process, some in parallel, and yield their counts in order."""
    team = as_team()
    cpu = team.devices[0].platform == "cpu"
    beside = min(team.threads if cpu else len(team.devices), BESIDE)

    def fit(number: int, threads: int = team.threads // beside) -> dict[str, int]:
        return blocks.counts(blocks.fit(group, number, team, threads))

    # The first alone, since the others use the program that it compiles.
    yield 0, fit(0, team.threads)
    for number, counts in ahead(lambda k: fit(k + 1), count - 1, beside):
        yield number + 1, counts


def client_for(stack: AbstractStack, client: Any) -> "distributed.Client | None":
    """The client whose workers fit maps of a stack; by default the current one.

    **Raises:** `ValueError` for another object, or if workers cannot read the stack.
    """
    if not isinstance(stack, ZarrStack):
        if client is not None:
            raise ValueError(
                "client: expected none with photographs that this process reads; "
                "workers read a zarr array"
            )
        return None
    if client is None:
        module = sys.modules.get("distributed")
        with contextlib.suppress(ValueError):
            client = None if module is None else module.get_client()
        if client is None:
            return None
    require("distributed")
    import distributed

    if not isinstance(client, distributed.Client) or client.asynchronous:
        raise ValueError(
            f"client: expected a Client of Dask's that waits, got {shown(client)}"
        )
    return client


def _spread(
    client: "distributed.Client", place: Place, count: int
) -> Iterator[tuple[int, dict[str, int]]]:
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
