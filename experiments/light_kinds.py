"""Question: what do the kinds of light, fog and shadow do to a picture?

A ball over a floor under ambient, directional, point and spot light, and in fog and
with a shadow. Measured on the rendered floor, next to the formulas: how light falls off
from below each lamp, how fog takes contrast with depth, and the shadow's area.
"""

import dataclasses

import jax
import numpy as np
from matplotlib.figure import Figure

import phongfit as pf
from experiments import style
from experiments.balls import ball
from experiments.finding import Experiment, Finding, Table
from phongfit.material import stack_materials

HEIGHT = 2.0
"""Height of the lamps over the floor, world units."""

CUTOFF = 30.0
"""Angle from a spot's axis to the edge of its cone, degrees."""

DENSITY = 0.25
"""Density of the fog, per world unit."""

SUN = (1.0, 1.0, 0.3)
"""Direction to the sun that casts the measured shadow; y is up."""

RADIUS = 0.45
"""Radius of the ball, world units."""

FLOOR = 0
"""Number of the floor's material; the ball's is 1."""

MATERIAL = stack_materials(
    [
        pf.Material((0.55, 0.5, 0.42), 0.0, 10.0, (0.55, 0.5, 0.42)),
        pf.Material((0.1, 0.35, 0.55), 0.5, 40.0, (0.1, 0.35, 0.55)),
    ]
)
LAMPS: dict[str, pf.AbstractLight] = {
    "directional": pf.DirectionalLight((0, 1, 0)),
    "point": pf.PointLight((0, HEIGHT, 0), HEIGHT**2, attenuation=(0, 0, 1)),
    "spot": pf.SpotLight(
        (0, HEIGHT, 0),
        (0, -1, 0),
        HEIGHT**2,
        cutoff=CUTOFF,
        exponent=4.0,
        attenuation=(0, 0, 1),
    ),
}


@dataclasses.dataclass(frozen=True)
class Result:
    """Measured values, and those of the formulas.

    - `floor_distance`: signed distance to the right of the point below the lamp, world
        units;
    - `falloff`, `falloff_formula`: light at these distances by lamp, where 1 is a white
        floor under the directional lamp;
    - `depth`: of the floor's pixels in fog, along the camera's axis, world units;
        `contrast`, `contrast_formula`: light of white minus black floor there;
    - `shadow`, `shadow_formula`: area of the ball's shadow on the floor, square world
        units.
    """

    floor_distance: np.ndarray
    falloff: dict[str, np.ndarray]
    falloff_formula: dict[str, np.ndarray]
    depth: np.ndarray
    contrast: np.ndarray
    contrast_formula: np.ndarray
    shadow: float
    shadow_formula: float

    @property
    def differences(self) -> dict[str, float]:
        """Largest differences from the formulas, by lamp, of the fog and the shadow.

        The shadow's is a fraction of its area; the others are in units of light.
        """
        differences = {
            name: float(np.abs(self.falloff[name] - formula).max())
            for name, formula in self.falloff_formula.items()
        }
        differences["fog"] = float(np.abs(self.contrast - self.contrast_formula).max())
        return differences | {"shadow": abs(self.shadow / self.shadow_formula - 1)}


def floor(size: float) -> pf.Mesh:
    """A square in the plane y = 0, from −`size` to `size` in x and z; it faces up."""
    corners = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], float)
    return pf.Mesh(size * corners, [[0, 1, 2], [0, 2, 3]])


def from_above(size: int) -> pf.OrthographicCamera:
    """A camera that looks straight down: x to the right, z downwards."""
    return pf.OrthographicCamera.look_at(
        (0, 5, 0), up=(0, 0, -1), width=size, height=size, view_height=5.0
    )


def measure(size: int) -> Result:
    """Measure everything on pictures of `size` × `size` pixels."""
    white = pf.Material(1.0, 0.0, ambient=0.0)
    camera = from_above(size)
    # Rays run straight down, so they meet the floor at the x and z of their origins.
    middle_row = size // 2
    x, _, z = np.asarray(camera.rays().origin, float)[middle_row].T
    falloff = {
        name: light_of(pf.Scene(floor(5.0), camera, lamp), white)[middle_row]
        for name, lamp in LAMPS.items()
    }
    depth, contrast = fog_contrast(size)
    return Result(
        x,
        falloff,
        falloff_formulas(np.hypot(x, z)),
        depth,
        contrast,
        np.exp(-DENSITY * depth),
        shadow_area(size),
        # The shadow of a disc across the rays: an ellipse, longer by 1 / cos of the
        # angle between the sun and the floor's normal.
        np.pi * RADIUS**2 / (SUN[1] / float(np.linalg.norm(SUN))),
    )


def light_of(scene: pf.Scene, material: pf.Material) -> np.ndarray:
    """Linear light of a grey image, not clamped at white: shape (H, W)."""
    image = pf.render(scene, material, film=pf.Film(clamp=False))
    # All channels are equal.
    return np.asarray(image, float)[..., 0]


def falloff_formulas(floor_distance: np.ndarray) -> dict[str, np.ndarray]:
    """Light by lamp, at distances (world units) from the point of the floor below it.

    It is 1 below the lamp.
    """
    cosine = HEIGHT / np.hypot(floor_distance, HEIGHT)
    # Lambert's cosine, times cos² for the inverse square of the distance.
    point = cosine**3
    inside = cosine >= np.cos(np.deg2rad(CUTOFF))
    return {
        "directional": np.ones_like(floor_distance),
        "point": point,
        # 4 is the spot's exponent.
        "spot": np.where(inside, point * cosine**4, 0),
    }


def fog_contrast(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the floor's pixels, and white minus black floor as seen through fog.

    Of the middle column of an image of `size` × `size` pixels, up to a depth of 12
    world units.
    """
    camera = pf.PerspectiveCamera.look_at(
        (0, 1.2, 4), (0, 0.4, 0), width=size, height=size, fov_y=40.0
    )
    fog = pf.Fog(0.7, density=DENSITY)
    scene = pf.Scene(floor(30.0), camera, ambient=1.0, fog=fog)
    light, dark = (
        light_of(scene, pf.Material(0.0, 0.0, ambient=a)) for a in (1.0, 0.0)
    )
    gbuffer = scene.trace()
    on_floor = np.asarray(gbuffer.mask)[:, size // 2]
    positions = gbuffer.position[:, size // 2]
    depth = np.asarray(jax.vmap(camera.depth)(positions))[on_floor]
    contrast = (light - dark)[:, size // 2][on_floor]
    shown = depth < 12
    return depth[shown], contrast[shown]


def shadow_area(size: int) -> float:
    """Area of the ball's shadow on the floor, square world units, from counted pixels.

    The sun is so low that the ball does not hide its shadow from the camera above.
    """
    camera = from_above(size)
    both = pf.geometry.join([floor(5.0), ball(48, RADIUS, (0, 1.4, 0))])
    scene = pf.Scene(both, camera, pf.DirectionalLight(SUN), shadows=True)
    gbuffer = scene.trace()
    assert gbuffer.visibility is not None and gbuffer.material_index is not None
    # The last axis is for the lights, of which there is one.
    dark = np.asarray(gbuffer.visibility)[..., 0] == 0
    on_floor = np.asarray(gbuffer.material_index) == FLOOR
    pixel = float(camera.view_height) / size
    return float(np.sum(dark & on_floor)) * pixel**2


def pictures(size: int) -> dict[str, pf.Scene]:
    """Scenes of ball and floor from one camera, by their kind of light."""
    camera = pf.PerspectiveCamera.look_at(
        (0.6, 1.9, 4.0), (0.25, 0.4, 0), width=size, height=size, fov_y=34.0
    )
    both = pf.geometry.join([floor(60.0), ball(48, RADIUS, (0, 0.75, 0))])
    sun = pf.DirectionalLight((-0.8, 1.2, 0.6), 0.9)
    position, inverse_square = (-0.5, 2.0, 0.8), (0, 0, 1)
    point = pf.PointLight(position, 2.5, attenuation=inverse_square)
    spot = pf.SpotLight(
        position, (0.5, -1.4, -0.8), 3.0, cutoff=CUTOFF, attenuation=inverse_square
    )

    def scene(
        *lamps: pf.AbstractLight, ambient: float = 0.12, fog: pf.Fog | None = None
    ) -> pf.Scene:
        return pf.Scene(
            both, camera, lamps, ambient, background=0.6, fog=fog, shadows=bool(lamps)
        )

    return {
        "ambient": scene(ambient=0.6),
        "directional": dataclasses.replace(scene(sun), shadows=False),
        "directional, shadow": scene(sun),
        "point, shadow": scene(point),
        "spot, shadow": scene(spot),
        "directional, shadow, fog": scene(sun, fog=pf.Fog(0.6, density=0.16)),
    }


@style.styled
def draw(result: Result, size: int) -> Figure:
    """Draw six pictures of `size` × `size` pixels; fall-off of light and fog below."""
    figure = style.page(7.6)
    top, bottom = style.bands(figure, 5.1, 2.5)
    scenes = pictures(size)
    panels = top.subplots(2, 3).flat
    for axes, (name, scene) in zip(panels, scenes.items(), strict=True):
        style.show(axes, pf.render(scene, MATERIAL, samples=4), name)
    fall, fog = bottom.subplots(1, 2)
    colours = (style.ORANGE, style.BLUE, style.VERMILION)
    step = max(len(result.floor_distance) // 32, 1)  # about 32 markers
    for colour, marker, name in zip(colours, "s^o", LAMPS, strict=True):
        fall.plot(
            result.floor_distance, result.falloff_formula[name], c=colour, label=name
        )
        points = result.floor_distance[::step], result.falloff[name][::step]
        fall.plot(*points, marker, c=colour, mfc="none")
    fall.set_xlabel("place on the floor (world units)")
    fall.set_ylabel("light (1 below the lamp)")
    fall.set_title(f"lamps {HEIGHT:g} above a floor")
    fall.legend(title="lines: formulas")
    fog.plot(result.depth, result.contrast_formula, c=style.BLUE, label="$e^{-ρz}$")
    step = max(len(result.depth) // 24, 1)
    points = result.depth[::step], result.contrast[::step]
    fog.plot(*points, "o", c=style.BLUE, mfc="none", label="rendered")
    fog.set_ylim(0, None)
    fog.set_xlabel("depth along the view (world units)")
    fog.set_ylabel("contrast left")
    fog.set_title(f"fog of density ρ = {DENSITY:g}")
    fog.legend()
    return figure


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    result = measure(64 if small else 256)
    distance = HEIGHT / 2
    point, spot = (
        float(np.interp(distance, result.floor_distance, result.falloff[name]))
        for name in ("point", "spot")
    )
    worst = max(
        difference
        for name, difference in result.differences.items()
        if name != "shadow"
    )
    answer = (
        "Ambient light shows an outline alone. Parallel light is the same all over a "
        f"floor; a lamp {HEIGHT:g} above it falls off as cos³ of the angle: "
        f"{distance:g} to the side {100 * point:.0f} % are left, and of a spot of "
        f"{CUTOFF:g}° "
        f"{100 * spot:.0f} %. Fog takes contrast as e^(−ρz), half of it in "
        f"{np.log(2) / DENSITY:.1f} units. The ball's shadow is {result.shadow:.2f} "
        f"units² large, by the formula {result.shadow_formula:.2f}. Light and "
        f"fog differ from their formulas by {worst:.0e} at most."
    )
    # A pixel counts as shadow or as light, so the shadow's area has an error of the
    # order of a pixel along its edge.
    tolerance = {"shadow": 0.1 if small else 0.02}
    failed_checks = tuple(
        f"{name} is {difference:.1e} off its formula"
        for name, difference in result.differences.items()
        if difference > tolerance.get(name, 1e-3)
    )
    rows = tuple(
        (name, f"{difference:.1e}") for name, difference in result.differences.items()
    )
    return Finding(
        answer,
        dataclasses.asdict(result) | {"off": result.differences},
        draw(result, 64 if small else 512),
        "A ball over a floor under ambient, directional, point and spot light, with a "
        "shadow, and in fog; how light falls off from below each lamp; how fog takes "
        "contrast with depth.",
        Table(("", "largest difference from the formula"), rows),
        failed_checks=failed_checks,
    )


EXPERIMENT = Experiment("light_kinds", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
