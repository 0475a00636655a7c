"""Benchmark of texels, with ρ_s and f of materials, next to Adam through Mitsuba 3.

The vase of [`experiments.textured_object`][]: a checkered diffuse texture, of two
materials ρ_s and f; photographs of 8 bits with 1 % noise from eight places under two
lamps each. Adam (learning rate 0.03) starts with mid-range reflectances and f = 8, and
has come as far when its texels are as near the truth as those of the fit, within 5 %.
`fit_texture` needs no start, and gives errors as well. CPU time is measured, which
depends least on other programs. PyTorch3D has no wheel for current Python versions,
nvdiffrast needs a GPU.

Result, x86-64 with two quiet cores, November 2026, Mitsuba 3.9.1 with LLVM 19: the fit
takes 1.43 s, texels off by 0.0054; Adam after 1200 steps and 180 s is off by 0.0062, so
more than 126 times as long.
"""

import dataclasses
import time

import numpy as np

import phongfit as pf
from experiments.benchmark import texture_peers
from experiments.textured_object import (
    SMALL,
    TRUTH,
    Size,
    checkered,
    fit_texels,
    photograph,
    vase,
    views,
)

MAX_STEPS = 3000
# Adam has arrived if its error is at most this multiple of that of `fit_texture`.
NEAR = 1.05


@dataclasses.dataclass(frozen=True)
class Row:
    """Time and accuracy of one method to fit texels.

    - `name`, `key`: its name in the printed table, and in the JSON file.
    - `seconds`: CPU time; for Adam, of its steps alone.
    - `error`: root mean square of fitted − true values of the texels.
    - `arrived`: whether the error is at most 5 % larger than that of `fit_texture`.
    """

    name: str
    key: str
    seconds: float
    steps: int
    error: float
    arrived: bool


def rows(size: Size = SMALL, max_steps: int = MAX_STEPS) -> list[Row]:
    """Run `fit_texture`, and Adam through Mitsuba if it is installed."""
    mesh, true = vase(size.around, size.along), checkered(size.texels)
    painted = mesh.with_textures(pf.Textures(diffuse=pf.Texture(true)))
    images = [
        photograph(scene, TRUTH, k) for k, scene in enumerate(views(painted, size))
    ]
    scenes = views(mesh, size)

    fit_texels(scenes, images, size)
    begin = time.process_time()
    fitted = fit_texels(scenes, images, size)
    taken = time.process_time() - begin
    seen = fitted.seen[0] >= 3

    def error(texels: np.ndarray) -> float:
        """Root mean square error of the texels that three pixels or more see."""
        return float(np.sqrt(np.mean((texels - true)[seen] ** 2)))

    ours = error(fitted.values["diffuse"][0])
    result_rows = [
        Row("phongfit, `fit_texture`", "texture", taken, fitted.steps, ours, True)
    ]
    if texture_peers.mitsuba_works():
        mitsuba = texture_peers.Mitsuba(scenes, size.texels)

        def near_enough(texels: np.ndarray) -> bool:
            return error(texels) <= NEAR * ours

        # Two steps compile its programs; their time does not count.
        mitsuba.descend(images, near_enough, 2)
        end = mitsuba.descend(images, near_enough, max_steps)
        last = error(end.texels)
        adam = "Mitsuba 3, Adam", "mitsuba_adam", end.seconds, end.steps, last
        result_rows.append(Row(*adam, last <= NEAR * ours))
    return result_rows
