"""The judge: cases done one by one in a process that may die, and what came of them."""

import contextlib
import ctypes
import dataclasses
import hashlib
import json
import os
import re
import resource
import select
import shutil
import signal
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from tests.campaign.cases import Case, Kind, Refused, Wrong

MARGIN = 3 * 2**30
"""Bytes of addresses that a worker may ask for besides those that it starts with."""

# Limits of ours come before those of the machine.
OUT_OF_MEMORY = re.compile(
    r"MemoryError|not enough memory|[Uu]nable to allocate|bad_alloc|malloc|"
    r"[Oo]ut of memory|RESOURCE_EXHAUSTED|cannot allocate",
)
IDLE = 10
"""A case that takes so many times its limit by the clock is not working any more."""


Numbered = Callable[[int], Case]
"""Gives the case of a number."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What came of a case: `fault` is None if all is well."""

    number: int
    name: str
    taken: bool
    fault: str | None
    seconds: float = 0.0
    megabytes: float = 0.0
    words: str = ""


def numbered(kind: str, maker: Kind, seed: int, stock: Path) -> Numbered:
    """The case of each number: always the same one."""

    def case(number: int) -> Case:
        random = np.random.default_rng([seed, zlib.crc32(kind.encode()), number])
        return maker.make(random, stock)

    return case


def judge(case: Numbered, limits: Kind, numbers: Iterable[int]) -> Iterator[Verdict]:
    """The verdicts on the cases of some numbers, in their order."""
    left = list(numbers)
    while left:
        done = 0
        with tempfile.TemporaryDirectory(prefix="campaign-") as root:
            for verdict in _watched(case, limits, left, Path(root)):
                done += 1
                yield verdict
        left = left[done:]


def _watched(
    case: Numbered, limits: Kind, numbers: list[int], root: Path
) -> Iterator[Verdict]:
    """Verdicts of one worker, which ends with the first case that it does not bear."""
    reading, writing = os.pipe()
    worker = os.fork()
    if worker == 0:
        os.close(reading)
        _work(case, limits, numbers, root, writing)
    os.close(writing)
    words = _Words(reading)
    try:
        for number in numbers:
            name = words.next()
            fault = None if name is None else _overrun(worker, limits, words)
            told = words.next() if name is not None and fault is None else None
            if told is not None:
                yield Verdict(**told)
                continue
            if fault is not None:
                os.kill(worker, signal.SIGKILL)
            # It has closed its end: it is gone, or about to be.
            _, status = os.waitpid(worker, 0)
            worker = 0
            fault = fault or f"the process died of {_death(status)}"
            yield Verdict(number, name or "?", False, fault)
            return
    finally:
        os.close(reading)
        if worker:
            os.kill(worker, signal.SIGKILL)
            os.waitpid(worker, 0)


class _Words:
    """What a worker says, a line of JSON each."""

    def __init__(self, reading: int):
        self._reading = reading
        self._bytes = b""

    def wait(self, seconds: float) -> bool:
        """Whether a line, or the end, has come by then."""
        if b"\n" in self._bytes:
            return True
        if not select.select([self._reading], [], [], seconds)[0]:
            return False
        more = os.read(self._reading, 2**16)
        self._bytes += more
        return not more or b"\n" in self._bytes

    def next(self) -> Any:
        """The next line; None at the end."""
        while b"\n" not in self._bytes:
            more = os.read(self._reading, 2**16)
            if not more:
                return None
            self._bytes += more
        line, _, self._bytes = self._bytes.partition(b"\n")
        return json.loads(line)


def _overrun(worker: int, limits: Kind, words: _Words) -> str | None:
    """Wait for a worker's next word; what it takes too much of, if it does."""
    began, spent = time.monotonic(), _cpu_seconds(worker)
    while not words.wait(0.05):
        seconds = _cpu_seconds(worker) - spent
        # Beyond what is judged: only what does not end is ended from here.
        if seconds > limits.seconds + 10:
            return f"time: more than {seconds:.0f} s of a core"
        if time.monotonic() - began > IDLE * (limits.seconds + 10):
            return f"time: still there after {time.monotonic() - began:.0f} s"
        resident = _status(worker, "VmRSS")
        if resident > limits.megabytes + 1000:
            return f"memory: {resident:.0f} MB and more"
    return None


def _cpu_seconds(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _status(process: int | str, name: str) -> float:
    """A line of a process's status, in megabytes; 0 when it has ended."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    return 0.0


def _death(status: int) -> str:
    if os.WIFSIGNALED(status):
        return signal.Signals(os.WTERMSIG(status)).name
    return f"exit status {os.waitstatus_to_exitcode(status)}"


# In the worker.


def _work(
    make: Numbered, limits: Kind, numbers: list[int], root: Path, writing: int
) -> None:
    """Do cases, and tell of each when it begins and what came of it; never returns."""
    try:
        os.setpgid(0, 0)
        _confine(root)
        with os.fdopen(writing, "w", buffering=1) as words:
            for number in numbers:
                case = make(number)
                words.write(json.dumps(case.name) + "\n")
                verdict = _judged(case, number, limits, root)
                words.write(json.dumps(dataclasses.asdict(verdict)) + "\n")
        os._exit(0)
    except BaseException:
        os.write(2, traceback.format_exc().encode())
        os._exit(70)


def _confine(root: Path) -> None:
    """A home and a place for temporary files of its own; an end to its memory."""
    for name in ("home", "tmp", "outside"):
        (root / name).mkdir()
    (root / "outside" / "canary.txt").write_text("not to be touched")
    os.environ["HOME"] = str(root / "home")
    os.environ["TMPDIR"] = tempfile.tempdir = str(root / "tmp")
    # Die with whoever watches.
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    _warm_up()
    most = int(_status("self", "VmSize") * 2**20) + MARGIN
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _warm_up() -> None:
    """What JAX does once is no part of any case."""
    import jax.numpy as jnp

    jnp.zeros(3).block_until_ready()


def _judged(case: Case, number: int, limits: Kind, root: Path) -> Verdict:
    folder = root / "outside" / "case"
    folder.mkdir()
    case.arrange(folder)
    before = _snapshot(root)
    # The peak of memory is counted from here on.
    Path("/proc/self/clear_refs").write_text("5")
    spent = time.process_time()
    with _heard() as heard:
        taken, fault, words = _outcome(case, folder)
        noise = heard()
    seconds = time.process_time() - spent
    megabytes = _status("self", "VmHWM")
    if fault is None:
        fault = (
            _excess(limits, seconds, megabytes)
            or _noise(noise)
            or _traces(case, taken, before, _snapshot(root))
        )
    for path in root.iterdir():
        if path.name != "outside":
            shutil.rmtree(path)
            path.mkdir()
    shutil.rmtree(folder)
    return Verdict(number, case.name, taken, fault, seconds, megabytes, words)


def _outcome(case: Case, folder: Path) -> tuple[bool, str | None, str]:
    """Whether the input was taken, what was wrong, and the words of a refusal."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case.act(folder)
    except Wrong as error:
        return False, f"wrong: {error}", ""
    except (ValueError, OSError, Refused) as error:
        words = str(error)
        if OUT_OF_MEMORY.search(words):
            return False, f"memory: {words}", words
        return False, None if words else f"no words: {error!r}", words
    except BaseException as error:
        (frame,) = traceback.extract_tb(error.__traceback__)[-1:]
        place = f"{Path(frame.filename).name}:{frame.name}"
        told = f"{type(error).__name__} in {place}: {error}"
        kind = "memory" if isinstance(error, MemoryError) else "traceback"
        return False, f"{kind}: {told}", ""
    return True, None, ""


@contextlib.contextmanager
def _heard() -> Iterator[Callable[[], bytes]]:
    """What is written to the standard error past Python, as C libraries do."""
    saved = os.dup(2)
    with tempfile.TemporaryFile(dir="/dev/shm") as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lambda: os.pread(file.fileno(), 2**16, 0)
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _noise(words: bytes) -> str | None:
    return f"noise: {words[:300]!r}" if words else None


def _excess(limits: Kind, seconds: float, megabytes: float) -> str | None:
    if megabytes > limits.megabytes:
        return f"memory: {megabytes:.0f} MB"
    if seconds > limits.seconds:
        return f"time: {seconds:.1f} s of a core"
    return None


def _snapshot(root: Path) -> dict[str, str]:
    """Every name below a folder, and what is there."""
    found = {}
    for path in sorted(root.rglob("*")):
        name = str(path.relative_to(root))
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_file():
            found[name] = hashlib.blake2b(path.read_bytes()).hexdigest()
        else:
            found[name] = "folder" if path.is_dir() else "special"
    return found


def _traces(
    case: Case, taken: bool, before: dict[str, str], after: dict[str, str]
) -> str | None:
    """What has been changed or left behind, and must not have been."""
    here = "outside/case/"
    outputs = case.anyway + (case.outputs if taken else ())
    allowed = [f"{here}{name}{more}" for name in outputs for more in ("", "/*")]
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) == after.get(name):
            continue
        if any(fnmatchcase(name, one) for one in allowed):
            continue
        what = {name not in before: "left", name not in after: "lost"}.get(True)
        return f"traces: {what or 'changed'}: {name}"
    return None
