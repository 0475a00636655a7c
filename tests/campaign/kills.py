"""Commands that are stopped at any moment: nothing is lost, and the next run is right.

`python -m tests.campaign.kills --cases 200 --seed 1`
"""

import argparse
import collections
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from phongfit.cli import main
from phongfit.files.images import write_image
from phongfit.files.outputs import WORK
from tests.calibration.studio import Studio, directions
from tests.campaign.cases import ASIDE, Wrong

SIGNALS = ("KILL", "TERM", "INT", "HUP", "STOP")
FULL, CLOCK = "a full disk", "a clock set back"
DISTURBANCES = (*SIGNALS, FULL, CLOCK)
A_YEAR = 365 * 86_400
PATIENCE = 600.0
"""Seconds that a command may take, on a machine that has other work too."""

SMALL = ["--unknowns", "diffuse", "--noise", "0.01"]

STUDIO = Studio(120, 90)
CIRCLES = [
    word
    for circle in STUDIO.circles("chrome")
    for word in ("--sphere", *(f"{number:.2f}" for number in circle))
]

# A command whose clock goes back a year while it runs.
SET_BACK = f"""
import sys, threading, time
moment, read, back = float(sys.argv.pop(1)), time.time, [0]
time.time = lambda: read() - back[0]
timer = threading.Timer(moment, lambda: back.__setitem__(0, {A_YEAR}))
timer.daemon = True
timer.start()
from phongfit.cli import main
sys.exit(main())
"""

# One whose files may have so many bytes, as if no more were left.
CONFINED = """
import resource, sys
room = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
from phongfit.cli import main
sys.exit(main())
"""

COMMANDS: dict[str, Callable[[str], list[str]]] = {
    "fit": lambda out: ["fit", "in", *SMALL, "--report", "none", "-o", out],
    "drawn": lambda out: ["fit", "in", *SMALL, "--report", "quick", "-o", out],
    "maps": lambda out: [
        "maps", "in", *SMALL, "--known", "in/truth.mtl", "--tile-pixels", "64",
        "-o", out,
    ],
    "export": lambda out: [
        "export", "preset:gold", "--to", "gltf", "--nearest", "-o", f"{out}.glb",
    ],
    "textures": lambda out: ["export", "mapped", "-o", f"{out}.mtl"],
    "calibrate": lambda out: [
        "calibrate", "photos", *CIRCLES, "--fov", "20", "-o", out,
    ],
}  # fmt: skip
TO_FILES = ("export", "textures")
"""Commands that write to `out`, or to a file of its name."""

# What is written of when and how it ran differs from run to run: of these, that they
# are there.
VARYING = (".html", ".png")


def _start(
    words: list[str], folder: Path, program: Sequence[str] = ("-m", "phongfit")
) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, *program, *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def _tree(folder: Path) -> dict[str, str]:
    """Every file below a folder, and its contents where they are always the same."""
    return {
        str(path.relative_to(folder)): ""
        if path.suffix in VARYING
        else hashlib.blake2b(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def prepare(stock: Path) -> None:
    """The data, what each command makes undisturbed, and how long it takes."""
    folder = stock / "kills"
    folder.mkdir()
    options = ["--material", "preset:brass", "--resolution", "16", "--lights", "4"]
    main(["synth", str(folder / "in"), *options, "--noise", "0.01"])
    truth = str(folder / "in" / "truth.json")
    main(["export", truth, "--to", "mtl", "-o", str(folder / "in" / "truth.mtl")])
    main(["maps", str(folder / "in"), *SMALL, "-o", str(folder / "mapped"),
          "--known", str(folder / "in" / "truth.mtl"), "--no-pictures"])  # fmt: skip
    (folder / "photos").mkdir()
    for number, lamp in enumerate(directions(3), 1):
        image = STUDIO.photograph(lamp, seed=number)
        write_image(folder / "photos" / f"{number}.jpg", image, "srgb")
    for name, words in COMMANDS.items():
        whole, begin = stock / f"kills-{name}", 0.0
        shutil.copytree(folder, whole)
        # Once to compile, once to see how long it takes.
        for _ in range(2):
            shutil.rmtree(whole)
            shutil.copytree(folder, whole)
            begin = time.perf_counter()
            process = _start(words("out"), whole)
            _, complaint = process.communicate()
            if process.returncode:
                raise Wrong(f"{name}: {complaint.decode()}")
        seconds = time.perf_counter() - begin
        (stock / f"kills-{name}.txt").write_text(str(seconds))


def disturb(random: np.random.Generator, stock: Path, folder: Path) -> str:
    """One case in an empty folder.

    **Returns:** what it was, in words. **Raises:** `Wrong` that says what was lost.
    """
    name = str(random.choice(list(COMMANDS)))
    words = COMMANDS[name]("out")
    by = str(random.choice(DISTURBANCES))
    lasting = float((stock / f"kills-{name}.txt").read_text())
    # More often late, where it writes.
    moment = lasting * float(random.uniform(0.3 if random.random() < 0.8 else 0, 1.05))
    old = bool(random.random() < 0.5) and name not in TO_FILES
    whole, work = stock / f"kills-{name}", folder / "work"
    shutil.copytree(whole if old else stock / "kills", work)
    before = _tree(work)
    title = f"{name}, {by} after {moment:.2f} s{', over an old one' * old}"
    first = words + (["--overwrite"] if old else [])
    if by == FULL:
        room = int(2 ** random.uniform(0, 20))
        title = f"{name}, {by} with room for {room} bytes{', over an old one' * old}"
        _run_full(first, work, room, title)
    elif by == CLOCK:
        _run_set_back(first, work, moment, title)
    else:
        process = _start(first, work)
        time.sleep(moment)
        process.send_signal(getattr(signal, f"SIG{by}"))
        if by == "STOP":
            # Another one meanwhile does not disturb it, nor is it disturbed.
            _start(first, work).communicate(timeout=PATIENCE)
            process.send_signal(signal.SIGCONT)
        process.communicate(timeout=PATIENCE)
    (work / "out").mkdir(exist_ok=True)
    (work / "out" / "notes.txt").write_text("mine")
    if by in (FULL, "TERM", "INT", "HUP"):
        # A new result is kept without its pictures, and those of the old one go.
        before = {name: content for name, content in before.items() if content}
    _check_kept(before, _tree(work), _tree(whole), title)
    (work / "out" / "notes.txt").unlink()
    _finish(words, name, work, title)
    if name in TO_FILES:
        (work / "out").rmdir()
    left = [path.name for path in work.rglob("*") if path.name.endswith(WORK)]
    after, wanted = _tree(work), _tree(whole)
    if left or after != wanted:
        other = sorted(after.items() ^ wanted.items())
        raise Wrong(f"{title}: after the next run: {left} {other}")
    return title


def _run_full(words: list[str], work: Path, room: int, title: str) -> None:
    """It says so in one line, or there was room enough."""
    used = sum(4096 * (2 + path.lstat().st_size // 4096) for path in work.rglob("*"))
    with tempfile.TemporaryDirectory(prefix="full-") as folder:
        disk = Path(folder)
        size = f"size={used + room}"
        mounted = not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", size, "none", folder], capture_output=True
        ).returncode
        if mounted:
            # A disk of that size, on which nothing else is.
            shutil.copytree(work, disk / "work")
            process = _start(words, disk / "work")
        else:
            process = _start([str(room), *words], work, ("-c", CONFINED))
        try:
            _, complaint = process.communicate(timeout=PATIENCE)
            if mounted:
                shutil.rmtree(work)
                shutil.copytree(disk / "work", work)
        finally:
            if mounted:
                subprocess.run(["umount", folder], check=True)
    lines = complaint.decode().splitlines()
    said = [line for line in lines if not ASIDE.match(line)]
    if process.returncode not in (0, 2) or len(said) != bool(process.returncode):
        raise Wrong(f"{title}: status {process.returncode}: {complaint.decode()}")


def _run_set_back(words: list[str], work: Path, moment: float, title: str) -> None:
    """A clock that goes back, and files that come from the future."""
    later = time.time() + A_YEAR
    for path in work.rglob("*"):
        os.utime(path, (later, later))
    process = _start([str(moment), *words], work, ("-c", SET_BACK))
    _, complaint = process.communicate(timeout=PATIENCE)
    if process.returncode:
        raise Wrong(f"{title}: {complaint.decode()}")


def _check_kept(
    before: dict[str, str], after: dict[str, str], whole: dict[str, str], title: str
) -> None:
    """What was there is there, or what the run makes in its place."""
    for name, content in before.items():
        if after.get(name) not in (content, whole.get(name)):
            what = "changed" if name in after else "lost"
            raise Wrong(f"{title}: {name} was {what}")


def _finish(words: list[str], name: str, work: Path, title: str) -> None:
    """The next run: over what is there, if that is a whole result."""
    overwrite = [] if name in TO_FILES else ["--overwrite"]
    process = _start([*words, *overwrite], work)
    _, complaint = process.communicate(timeout=PATIENCE)
    if process.returncode:
        raise Wrong(f"{title}: the next run: {complaint.decode()}")


def run(cases: int, seed: int) -> int:
    """Print every fault; how many there are."""
    faults: list[str] = []
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory(prefix="kills-") as root:
        os.environ["PHONGFIT_CACHE"] = str(Path(root, "compiled"))
        prepare(Path(root))
        for number in range(cases):
            random = np.random.default_rng([seed, number])
            with tempfile.TemporaryDirectory(prefix="kill-") as folder:
                try:
                    title = disturb(random, Path(root), Path(folder))
                    counts[re.split(" after| with", title)[0]] += 1
                except (Wrong, subprocess.TimeoutExpired) as fault:
                    faults.append(f"{number}: {fault}")
                    print(faults[-1], flush=True)
    told = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    print(f"seed {seed}: {cases} runs stopped, {len(faults)} faults ({told})")
    return len(faults)


def main_of_kills() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.kills")
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    return int(run(options.cases, options.seed) > 0)


if __name__ == "__main__":
    sys.exit(main_of_kills())
