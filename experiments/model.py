"""Question: what does each number of a material do to its picture?

Balls with ρ_d and ρ_a from 0 to 1, and with ρ_s and f in all combinations, from plastic
to metal. Measured are how the picture's light grows with each reflectance, and how wide
the highlight is for each exponent, next to the formula.
"""

import dataclasses

import numpy as np
from matplotlib.figure import Figure

import phongfit as pf
from experiments import style
from experiments.finding import Experiment, Finding, Table

FRACTIONS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
SPECULARS = (0.25, 0.5, 0.75)
EXPONENTS = (3.0, 5.0, 10.0, 25.0, 100.0, 200.0)
# Exponents that the figure labels as typical of plastic and of metal.
PLASTIC, METAL = (5.0, 10.0), (100.0, 200.0)
# Colour of the balls that are drawn, RGB.
COLOUR = np.array([0.95, 0.75, 0.55])
# Not clamped at white, so that all light is measured.
UNCLAMPED = pf.Film(clamp=False)


@dataclasses.dataclass(frozen=True)
class Result:
    """Light for each of `FRACTIONS`, and widths for each of `EXPONENTS`.

    - `diffuse_peak`, `ambient_rise`: largest light in the image for each ρ_d and for
        each ρ_a, where 1 is white;
    - `width`: angle in degrees from the highlight's centre to half its height, as
        measured; `formula`: the same angle by the formula;
    - `nonlinearity`: largest deviation of light from being proportional to ρ_d, ρ_a or
        ρ_s, where 1 is white.
    """

    diffuse_peak: np.ndarray
    ambient_rise: np.ndarray
    width: np.ndarray
    formula: np.ndarray
    nonlinearity: float


def ball(size: int, ambient: float = 0.0, background: float = 0.0) -> pf.Scene:
    """A ball under one lamp at the upper left, in `size` × `size` pixels."""
    camera = pf.OrthographicCamera(size, size, view_height=2.1)
    lamp = pf.DirectionalLight((-1, 1, 1.6))
    return pf.Scene(pf.Sphere(), camera, lamp, ambient, background=background)


def light(scene: pf.Scene, **parameters: float) -> np.ndarray:
    """Linear light of a scene for a material with these parameters, and no others.

    Reflectances that are not given are 0.
    """
    material = pf.Material(**(dict(diffuse=0.0, ambient=0.0) | parameters))
    return np.asarray(pf.render(scene, material, film=UNCLAMPED), float)


def measure(size: int) -> Result:
    """Measure everything on pictures of `size` × `size` pixels."""
    scene = ball(size, ambient=0.4)
    diffuse = np.array([light(scene, diffuse=fraction) for fraction in FRACTIONS])
    ambient = np.array([light(scene, ambient=fraction) for fraction in FRACTIONS])
    specular = np.array([light(scene, specular=s, shininess=25.0) for s in SPECULARS])
    # Difference from the image of the largest fraction, scaled to each fraction.
    nonlinearity = [
        np.abs(images - np.multiply.outer(fractions, images[-1] / fractions[-1])).max()
        for images, fractions in (
            (diffuse, np.array(FRACTIONS)),
            (ambient, np.array(FRACTIONS)),
            (specular, np.array(SPECULARS)),
        )
    ]
    return Result(
        diffuse.max(axis=(1, 2, 3)),
        ambient.max(axis=(1, 2, 3)),
        np.array([highlight_width(scene, f) for f in EXPONENTS]),
        np.rad2deg(np.arccos(0.5 ** (1 / np.array(EXPONENTS)))),
        float(max(nonlinearity)),
    )


def highlight_width(scene: pf.Scene, exponent: float) -> float:
    """Angle in degrees between the normals at a highlight's centre and at half height.

    Computed from the solid angle of the normals whose pixels are brighter than half the
    peak. A cap of half-angle θ has the solid angle 2π (1 − cos θ); on a ball of radius
    1 in orthographic view, a pixel covers its area divided by n_z.
    """
    # All channels are equal.
    image = light(scene, specular=1.0, shininess=exponent)[..., 0]
    facing = np.asarray(scene.trace().normal, float)[..., 2]
    camera = scene.camera
    assert isinstance(camera, pf.OrthographicCamera)
    pixel = float(camera.view_height) / camera.height
    cap = pixel**2 * np.sum(1 / facing[image > 0.5])
    return float(np.rad2deg(np.arccos(1 - cap / (2 * np.pi))))


@style.styled
def draw(size: int) -> Figure:
    """Draw rows of balls, in `size` × `size` pixels each."""
    figure = style.page(6.9)
    top, bottom = style.bands(figure, 2.7, 4.0)
    scene = ball(size, ambient=0.5, background=1.0)

    def picture(diffuse: float, ambient: float = 0.0, **highlight: float) -> np.ndarray:
        material = pf.Material(diffuse * COLOUR, ambient=ambient * COLOUR, **highlight)
        return np.asarray(pf.render(scene, material, samples=4))

    style.picture_grid(
        top,
        [
            [picture(diffuse=fraction) for fraction in FRACTIONS],
            [picture(diffuse=0.4, ambient=fraction) for fraction in FRACTIONS],
        ],
        columns=[f"{s:g}" for s in FRACTIONS],
        rows=[style.symbol("diffuse"), style.symbol("ambient")],
    )
    top.suptitle("reflectances from 0 to 1")
    kinds = {f: "\nplastic" for f in PLASTIC} | {f: "\nmetal" for f in METAL}
    style.picture_grid(
        bottom,
        [
            [picture(diffuse=0.25, specular=s, shininess=f) for f in EXPONENTS]
            for s in SPECULARS
        ],
        columns=[f"$f$ = {f:g}{kinds.get(f, chr(10))}" for f in EXPONENTS],
        rows=[f"{style.symbol('specular')} = {s:g}" for s in SPECULARS],
    )
    bottom.suptitle("highlights: stronger downwards, narrower to the right")
    return figure


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    size = 64 if small else 256
    result = measure(size)
    widths = dict(zip(EXPONENTS, result.width, strict=True))
    halved = widths[100.0] / widths[25.0]
    answer = (
        "Light is proportional to each reflectance "
        f"(to {result.nonlinearity:.0e} of white): ρ_d scales the shading, ρ_a lifts "
        "all of the ball alike, ρ_s scales the highlight. The exponent alone sets the "
        f"highlight's width: from centre to half height it is {widths[5.0]:.1f}° for "
        f"plastic (f = 5) and {widths[200.0]:.1f}° for metal (f = 200). A larger f "
        f"makes it narrower; four times the exponent gives {halved:.2f} of the width."
    )
    rows = tuple(
        (f"{f:g}", f"{width:.2f}°", f"{formula:.2f}°")
        for f, width, formula in zip(
            EXPONENTS, result.width, result.formula, strict=True
        )
    )
    # In a highlight of n pixels, about √n are on its edge: whether each is counted
    # depends on rounding.
    tolerance = 0.25 if small else 0.05
    relative_error = np.abs(result.width / result.formula - 1)
    failed_checks = [
        f"f = {f:g}: the highlight's width is {100 * error:.0f} % off the formula"
        for f, error in zip(EXPONENTS, relative_error, strict=True)
        if error > tolerance
    ]
    return Finding(
        answer,
        dataclasses.asdict(result),
        draw(size),
        "Rows of shaded balls: brighter with the diffuse and the ambient reflectance, "
        "and a grid in which highlights get stronger downwards and narrower to the "
        "right.",
        Table(("exponent f", "half width, measured", "acos 2^(−1/f)"), rows),
        failed_checks=tuple(failed_checks),
    )


EXPERIMENT = Experiment("model", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
