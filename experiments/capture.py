"""Question: what does a capture of a real object give, from photographs to a fit?

Runs `docs/how-to/capture.md` as it stands, on photographs of Ying Xiong's PSBox, and
draws its pictures: some of the photographs, the lamps that were found, and a photograph
next to its fit. Prints how strong the lamps are.
"""

import contextlib
import re
import shlex
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phongfit import cli

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "how-to" / "capture.md"
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$", re.DOTALL | re.MULTILINE)

SHOWN = (2, 5, 8, 11)
"""Numbers of the photographs that are drawn, from 1 on."""

WIDTH = 920
"""Width of a picture, pixels: that of a page of the documentation, with some more."""


def run_page(folder: Path) -> dict[str, Any]:
    """Run the page's code in a folder, and return the names that its Python defines.

    Of shell commands, `cp` copies a folder of the repository, and `phongfit` runs in
    this process.

    **Raises:** `ValueError` if a command fails, and what the page's Python raises.
    """
    names: dict[str, Any] = {}
    with contextlib.chdir(folder):
        for language, code in BLOCK.findall(PAGE.read_text(encoding="utf-8")):
            if language == "python":
                exec(compile(code, PAGE.name, "exec"), names)
                continue
            commands = code.replace("\\\n", " ").splitlines()
            for program, *words in map(shlex.split, commands):
                # The page has "cp -r SOURCE TARGET".
                if program == "cp":
                    shutil.copytree(ROOT / words[1], words[2])
                elif cli.main(words) != 0:
                    raise ValueError(f"failed: {shlex.join(words)}")
    return names


def photographs(folder: Path) -> Image.Image:
    """A picture of some photographs: a row of the chrome ball above a row of the cat.

    Each row is brightened so that 99.9 % of its pixels are below white.

    **Arguments:** `folder`: with folders `chrome` and `cat` of grey 8-bit files
    `01.png`, ….
    """
    rows = []
    # The cat's files are linear, so they are encoded; the ball's are encoded already.
    for name, gamma in (("chrome", 1.0), ("cat", 2.2)):
        files = [folder / name / f"{number:02d}.png" for number in SHOWN]
        shown = [np.asarray(Image.open(file)) / 255 for file in files]
        bright = np.concatenate(shown, axis=1)
        bright = (bright / np.quantile(bright, 0.999)).clip(0, 1) ** (1 / gamma)
        picture = Image.fromarray(np.round(255 * bright).astype(np.uint8))
        height = round(picture.height * WIDTH / picture.width)
        rows.append(picture.resize((WIDTH, height), Image.Resampling.LANCZOS))
    whole = Image.new("L", (WIDTH, sum(row.height for row in rows)))
    top = 0
    for row in rows:
        whole.paste(row, (0, top))
        top += row.height
    return whole


def main(pictures: Path = Path("out/capture")) -> int:
    """What does a capture of a real object give, from photographs to a fit?

    Runs docs/how-to/capture.md, prints the lamps' strengths, and draws its pictures.

    Args:
        pictures: The folder for them.
    """
    pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        names = run_page(folder)
        photographs(folder / "psbox").save(pictures / "psbox.jpg", quality=88)
        shutil.copy(folder / "out/lights/calibration.png", pictures / "psbox_lamps.png")
        compared = Image.open(folder / "out/cat/comparison.png").convert("RGB")
        compared.thumbnail((800, 2000))
        compared.save(pictures / "photograph_and_fit.jpg", quality=85)
    maps = names["maps"]
    print(f"lamps' strengths: {maps.strengths.values.round(3)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(cli.run(main, prog="python -m experiments.capture"))
