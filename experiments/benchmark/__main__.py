"""Question: how fast is phongfit, next to what people use instead?

`python -m experiments.benchmark` measures every row of its table in one run, so that
the ratios hold for the machine at hand. The last result is in
`docs/how-to/speed.md`.
"""

import dataclasses
import platform
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from rich.console import Console
from rich.markdown import Markdown

from experiments.benchmark import (
    compiling,
    costs,
    map_peers,
    maps,
    normal_peers,
    single,
    textures,
)
from experiments.output import JsonFile, check_outputs, save_numbers, save_picture
from experiments.style import BLUE, GREEN, ORANGE, VERMILION, bands, page, styled
from phongfit.cli import run


@dataclasses.dataclass(frozen=True)
class Ratio:
    """One row of the table: a measured ratio of times, and the aim for it.

    - `work`, `against`: what phongfit does, and what its time is compared with;
    - `key`: name in the JSON file;
    - `at_most`: whether the ratio should be at most the aim, not at least.
    """

    work: str
    against: str
    key: str
    value: float
    aim: float
    at_most: bool = False

    @property
    def met(self) -> bool:
        """Whether the value reaches the aim."""
        return self.value <= self.aim if self.at_most else self.value >= self.aim


NO_MITSUBA = (
    "Mitsuba 3 does not render here, so it is left out: `pip install mitsuba`, and "
    "LLVM's shared library, 17 or later (Debian: `apt install libllvm19`)."
)


def single_ratios(rows: list[single.Row]) -> list[Ratio]:
    """Times of other methods over phongfit's, for one image.

    For each method two: over the whole fit, and over its search alone.
    """
    seconds = {row.key: row.seconds for row in rows}
    # A method's label, and the smallest ratio aimed at; lmfit is not to be faster.
    peers = {
        "lm_one": ("stock optimistix LM, OpenBLAS on one thread", 15),
        "lm": ("the same, OpenBLAS as it comes", 15),
        "adam": ("Adam, to 1e-3 in f", 300),
        "torch_adam": ("PyTorch's Adam, to 1e-3 in f", 300),
        "lmfit": ("lmfit", 1),
    }
    ours = {
        "fit": "fit one 256² RGB image, warm",
        "search": "the same, solution alone",
    }
    return [
        Ratio(work, against, f"{peer}_over_{key}", seconds[peer] / seconds[key], aim)
        for peer, (against, aim) in peers.items()
        if peer in seconds
        for key, work in ours.items()
    ]


def map_ratios(rows: list[map_peers.Row]) -> list[Ratio]:
    """Times of other methods over phongfit's, for maps with a material per pixel."""
    seconds = {row.key: row.seconds for row in rows}
    lm, loop = (seconds[key] / seconds["map"] for key in ("vmapped_lm", "scipy_loop"))
    work = "a material per pixel, 16 000 pixels × 96 lights"
    return [
        Ratio(work, "`vmap`ped stock LM", "vmapped_lm_over_map", lm, 120),
        Ratio("the same", "a SciPy loop", "scipy_loop_over_map", loop, 1000),
    ]


def normal_ratio(rows: list[normal_peers.Row]) -> Ratio:
    """CPU time of stock Levenberg-Marquardt over phongfit's, for normals of maps."""
    seconds = {row.key: row.seconds for row in rows}
    return Ratio(
        f"normals and materials per pixel, {rows[0].pixels:,} pixels × 49 lights",
        "`vmap`ped stock LM",
        "vmapped_lm_over_normals",
        seconds["vmapped_lm_of_normals"] / seconds["normals"],
        50,
    )


def texture_ratios(rows: list[textures.Row]) -> list[Ratio]:
    """CPU time of Adam over phongfit's, for texels; empty if Mitsuba does not work."""
    ours, *peers = rows
    return [
        Ratio(
            "texels of a mesh, 48² from 16 photographs, to the same error",
            "Adam through Mitsuba 3",
            f"{peer.key}_over_texture",
            peer.seconds / ours.seconds,
            20,
        )
        for peer in peers
    ]


def spread(costs: dict[str, float]) -> float:
    """Ratio of the largest cost to the smallest."""
    return max(costs.values()) / min(costs.values())


def table(ratios: list[Ratio]) -> str:
    """The table of ratios, as Markdown; "(short)" marks those that miss their aim."""
    lines = ["| work | against | aim | measured |", "|---|---|--:|--:|"]
    for row in ratios:
        aim = f"{'≤' if row.at_most else '≥'} {row.aim:g}×"
        mark = "" if row.met else " (short)"
        lines.append(f"| {row.work} | {row.against} | {aim} | {row.value:.3g}×{mark} |")
    return "\n".join(lines)


def single_details(rows: list[single.Row]) -> str:
    """Table of the methods that fit one image, as Markdown."""
    lines = [
        "| one image, warm | median | steps or calls | off by |",
        "|---|--:|--:|--:|",
    ]
    lines += [
        f"| {row.name} | {1e3 * row.seconds:.1f} ms | {row.steps} "
        f"| {row.distance:.2g} σ |"
        for row in rows
    ]
    return "\n".join(lines)


def map_details(rows: list[map_peers.Row]) -> str:
    """Table of the methods that fit a map, as Markdown."""
    lines = [
        "| a material per pixel | pixels | a pixel | converged | as the map "
        "| near the truth |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    lines += [
        f"| {row.name} | {row.pixels} | {1e6 * row.seconds:.1f} µs "
        f"| {row.converged:.1%} | {row.as_map:.1%} | {row.near_truth:.1%} |"
        for row in rows
    ]
    lines += [
        "",
        "As the map: pixels with no unknown further from the map's than half an error "
        "bar. Near the truth: unknowns within two error bars of it; 95 % is right.",
    ]
    return "\n".join(lines)


def normal_details(rows: list[normal_peers.Row]) -> str:
    """Table of the methods that fit normals, as Markdown."""
    lines = [
        "| normals and materials per pixel | pixels | CPU time per pixel | error |",
        "|---|--:|--:|--:|",
    ]
    lines += [
        f"| {row.name} | {row.pixels} | {1e6 * row.seconds:.1f} µs "
        f"| {row.degrees:.2f}° |"
        for row in rows
    ]
    return "\n".join(lines)


def texture_details(rows: list[textures.Row]) -> str:
    """Table of the methods that fit texels, as Markdown."""
    lines = [
        "| texels of a mesh | CPU time | steps | error of the texels |",
        "|---|--:|--:|--:|",
    ]
    lines += [
        f"| {row.name} | {row.seconds:.1f} s | {row.steps} "
        f"| {row.error:.4f}{'' if row.arrived else ' (not converged)'} |"
        for row in rows
    ]
    if len(rows) == 1:
        lines += ["", NO_MITSUBA]
    return "\n".join(lines)


@styled
def figure(ratios: list[Ratio], fit_times: dict[str, dict[str, float]]) -> Figure:
    """Draw the ratios next to their aims, and the growth of a fit's time.

    **Arguments:** `fit_times`: seconds as [`growth`][] returns them, by what grows and
    by number.
    """
    gains = [row for row in ratios if not row.at_most][::-1]
    # Heights in inches; each name takes two lines.
    bars, growth_panel = 0.4 * len(gains) + 0.6, 2.1
    drawing = page(bars + growth_panel)
    above, below = (band.subplots() for band in bands(drawing, bars, growth_panel))
    positions = np.arange(len(gains))
    above.barh(positions, [row.value for row in gains], color=BLUE, height=0.6)
    aims = [row.aim for row in gains]
    above.plot(aims, positions, "|", ms=13, mew=3, color=VERMILION)
    names = [f"{row.work}\nagainst {row.against}" for row in gains]
    above.set_yticks(positions, [name.replace("`", "") for name in names])
    above.grid(False, axis="y")
    above.set(
        xscale="log", xlim=(1, None), xlabel="times as fast (bar: measured, mark: aim)"
    )
    above.xaxis.set_major_formatter("{x:g}")
    looks = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), (ORANGE, "D"))
    for (name, times), (colour, mark) in zip(fit_times.items(), looks, strict=True):
        counts = np.array([float(count) for count in times])
        taken = np.array(list(times.values()))
        (line,) = below.plot(counts / counts[0], taken / taken[0], color=colour)
        line.set(marker=mark, label=name)
    below.axline((1, 1), slope=1, color="0.6", lw=1, label="linear")
    below.set(
        xscale="log",
        yscale="log",
        xlabel="times as many as at first",
        ylabel="times as long",
    )
    for axis in (below.xaxis, below.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    below.legend(ncols=2)
    return drawing


def machine() -> str:
    """One line about the machine: processor, devices, version of JAX."""
    device = jax.devices()[0]
    return (
        f"{platform.machine()}, {len(jax.devices())} {device.platform} device(s), "
        f"{platform.processor() or platform.system()}, jax {jax.__version__}"
    )


def main(
    resolution: int = 256,
    runs: int = 15,
    quick: bool = False,
    json: JsonFile = None,
    picture: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """How fast is phongfit, next to what people use instead?

    Prints ratios of medians, all from this run, as tables in Markdown. Takes some ten
    minutes on two cores; leave the machine alone meanwhile.

    Args:
        resolution: Width and height of the one image, pixels.
        runs: Timed runs of each method, after two warm-up runs.
        quick: Small maps and images: a look, not a result.
        json: File for the ratios, a key for each, and the medians behind them.
        picture: File for a figure of the ratios.
    """
    if min(resolution, runs) < 1:
        raise ValueError("resolution, runs: expected whole numbers ≥ 1")
    check_outputs(picture, json)
    console = Console()

    def show(text: str) -> None:
        # Without wrapping: in a file, a row of a table must be one line.
        console.print(Markdown(text) if console.is_terminal else text, soft_wrap=True)

    # Numbers of pixels are divided by it.
    divisor = 40 if quick else 1
    rows = single.rows(resolution, runs, console)
    show(single_details(rows))
    # Maps have a fixed cost, so only a run at full size is a result.
    map_rows = map_peers.rows(16_000 // divisor, scipy=200 // divisor)
    show("\n" + map_details(map_rows))
    normal_rows = normal_peers.rows(16_000 // divisor)
    show("\n" + normal_details(normal_rows))
    texture_rows = textures.rows(max_steps=20 if quick else textures.MAX_STEPS)
    show("\n" + texture_details(texture_rows))
    rendered = costs.render_costs(costs.SIZES[: 2 if quick else None])
    sizes = (10_000, 100_000, 1_000_000, 4_000_000)
    pixels = maps.scaling(tuple(n // divisor for n in sizes[: 2 if quick else None]))
    fit_times = costs.growth((32, 64) if quick else (64, 128, 256, 512))
    cold_starts = costs.cold_starts()
    memory = maps.peak_memory(4_000_000 // divisor)
    compiled = costs.first_and_warm()
    twelve = compiling.time_in_processes(12, "exposure", 128)["empty"]["first"]
    ratios = [
        *single_ratios(rows),
        *map_ratios(map_rows),
        normal_ratio(normal_rows),
        *texture_ratios(texture_rows),
        Ratio(
            "render, a pixel from 128² to 2048²",
            "itself",
            "render_pixel_spread",
            spread(rendered),
            2,
            True,
        ),
        Ratio(
            "a map, a pixel from 10 000 to 4 000 000",
            "itself",
            "map_pixel_spread",
            spread({str(k): v for k, v in pixels.items()}),
            1.5,
            True,
        ),
        Ratio(
            "a cold `phongfit fit` of one 256² image",
            "importing jax and optimistix",
            "cold_fit_over_import",
            cold_starts["fit"] / cold_starts["import"],
            2.5,
            True,
        ),
        Ratio(
            "the same, nothing compiled before",
            "the same",
            "first_fit_over_import",
            cold_starts["first_fit"] / cold_starts["import"],
            6,
            True,
        ),
        Ratio(
            "a first fit of 12 images with 11 unknown exposures",
            "the same",
            "first_fit_of_twelve_over_import",
            twelve / cold_starts["import"],
            6,
            True,
        ),
    ]
    show("\n" + table(ratios))
    console.print(
        f"\na map: {memory['peak_gigabytes']:.2f} GB at most for "
        f"{4_000_000 // divisor:,} pixels × 24 lights\n"
        f"a first fit, with compiling: {compiled['first']:.1f} s"
        f"\n{machine()}",
        soft_wrap=True,
    )
    if picture is not None:
        save_picture(picture, figure(ratios, fit_times))
    numbers: dict[str, Any] = {row.key: row.value for row in ratios}
    numbers["seconds"] = {row.key: row.seconds for row in rows} | {
        **{f"{row.key}_pixel": row.seconds for row in map_rows},
        **{f"{row.key}_pixel": row.seconds for row in normal_rows},
        **{row.key: row.seconds for row in texture_rows},
        "render_pixel": rendered,
        "map_pixel_by_size": {str(k): v for k, v in pixels.items()},
        "fit_by": fit_times,
        "cold": cold_starts,
        "compile": compiled,
    }
    numbers["map_answers"] = {row.key: dataclasses.asdict(row) for row in map_rows}
    numbers["memory"] = memory
    numbers["machine"] = machine()
    save_numbers(json, numbers)


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.benchmark"))
