"""Coverage-guided fuzzing of the readers: `python -m tests.campaign.fuzz`.

Each reader by its own for its share of the time, in a process of its own, from small
files that are right. A fault is what is neither taken nor a `ValueError` or `OSError`:
libFuzzer then keeps the input in the folder that is printed.
"""

import argparse
import importlib
import importlib.util
import logging
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

WANTED = "atheris is not installed: pip install atheris"
MEGABYTES = 2500


def readers(stock: Path) -> dict[str, tuple[Callable[[Path], Any], list[bytes]]]:
    """What is read: a name with its suffix, the reader, and files that are right."""
    import json

    from phongfit.files.calibrations import load_calibration
    from phongfit.files.encodings import read_response
    from phongfit.files.images import read_image, read_mask
    from phongfit.files.lp import read_lp
    from phongfit.files.meshes import load_mesh
    from phongfit.files.mtl import read_mtl
    from phongfit.files.saved import load_fit
    from phongfit.files.scenes import load_scene
    from phongfit.maps.result import load_maps
    from tests.campaign.kinds import archives, captures, pictures, records, shapes

    images, meshes = pictures.whole(stock), shapes.whole()
    found: dict[str, tuple[Callable[[Path], Any], list[bytes]]] = {}
    for suffix in sorted({Path(f"x{name}").suffix for name in images}):
        whole = [data for name, data in images.items() if name.endswith(suffix)]
        found[f"image{suffix}"] = lambda path: read_image(path, "linear"), whole
    found["mask.png"] = read_mask, [images["grey.png"]]
    for name in ("a.obj", "a.stl", "a.ply", "a.off", "a.glb", "a.gltf"):
        suffix = Path(name).suffix
        whole = [data for key, data in meshes.items() if key.endswith(suffix)]
        found[f"mesh{suffix}"] = load_mesh, whole
    found["a.mtl"] = read_mtl, [meshes["a.mtl"]]
    found["scene.json"] = load_scene, [json.dumps(records.SCENE).encode()]
    found["response.json"] = read_response, [json.dumps(records.RESPONSE).encode()]
    captures.prepare(stock)
    lights = (stock / captures.STOCK / captures.LIGHTS_FILE).read_bytes()
    found["lights.json"] = load_calibration, [lights]
    found["lights.lp"] = read_lp, [captures.LIST]
    found["maps.npz"] = load_maps, [archives.packed(archives.maps())]
    found["fit.npz"] = load_fit, [archives.packed(archives.maps())]
    return found


def written(folder: Path, name: str) -> Path:
    """Where inputs are put for the reader; libFuzzer ends without removing it."""
    return Path("/dev/shm", f"{folder.name}-{name}")


def fuzz(name: str, seconds: int, folder: Path) -> None:
    """Fuzz one reader in this process, which ends with it."""
    atheris: Any = importlib.import_module("atheris")
    with atheris.instrument_imports(include=["phongfit", "trimesh", "PIL"]):
        read, whole = readers(folder)[name]
    seeds, faults = folder / "seeds", folder / "faults"
    seeds.mkdir()
    faults.mkdir()
    for number, data in enumerate(whole):
        (seeds / f"{number}").write_bytes(data)
    path = written(folder, name)
    warnings.simplefilter("ignore")
    logging.disable()

    def one(data: bytes) -> None:
        path.write_bytes(data)
        try:
            read(path)
        except (ValueError, OSError) as error:
            if not str(error):
                raise AssertionError("a refusal without words") from error

    options = [
        f"-max_total_time={seconds}", "-timeout=60", f"-rss_limit_mb={MEGABYTES}",
        "-max_len=20000", f"-artifact_prefix={faults}/", "-print_final_stats=1",
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *options, str(seeds)], one)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.fuzz")
    parser.add_argument("--seconds", type=int, default=600, help="in all")
    parser.add_argument("--only", metavar="NAME", help="such as a.mtl")
    parser.add_argument("--here", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if importlib.util.find_spec("atheris") is None:
        print(WANTED, file=sys.stderr)
        return 2
    if options.here is not None:
        fuzz(options.only, options.seconds, options.here)
        return 0
    with tempfile.TemporaryDirectory() as stock:
        names = [options.only] if options.only else sorted(readers(Path(stock)))
    failed = 0
    for name in names:
        folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
        words = ["--only", name, "--here", str(folder)]
        words += ["--seconds", str(max(options.seconds // len(names), 1))]
        command = [sys.executable, "-m", "tests.campaign.fuzz", *words]
        done = subprocess.run(command, capture_output=True, text=True)
        written(folder, name).unlink(missing_ok=True)
        lines = (done.stdout + done.stderr).splitlines()
        runs = [line for line in lines if "number_of_executed_units" in line]
        executed = runs[0].split()[-1] if runs else "?"
        print(f"{name:<16}{executed:>9} inputs, status {done.returncode}", flush=True)
        if done.returncode:
            failed += 1
            print("\n".join(lines[-40:]), f"\n  kept in {folder}", flush=True)
        else:
            shutil.rmtree(folder)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
