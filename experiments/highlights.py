"""Question: how do the highlights of an ideal mirror, of Phong and of Blinn differ?

An ideal mirror shows a round lamp as a sharp disc; Phong's and Blinn's models blur it.
Profiles are drawn, and images of Blinn's model are fitted with Phong's, for several
exponents and lamps from beside the viewer to far around the ball.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

import phongfit as pf
from experiments import style
from experiments.finding import Experiment, Finding, Table
from phongfit.vectors import Scalar, Vec3

EXPONENTS = (10.0, 25.0, 50.0, 100.0, 200.0)
"""Exponents f of the Blinn highlights that are fitted."""

ANGLES = (10.0, 40.0, 70.0, 100.0)
"""Angles between the directions to lamp and viewer, degrees."""

SHOWN = 50.0
"""Exponent of the highlights that are drawn."""

LAMP = 8.0
"""Radius in degrees of the lamp that the ideal mirror shows."""


class IdealMirror(pf.AbstractSpecular):
    """A mirror that shows a round lamp: 1 inside the lamp's disc, 0 outside.

    **Fields:** `radius`: the lamp's, degrees.
    """

    radius: float = eqx.field(static=True, default=LAMP)

    def cosine(self, normal: Vec3, to_light: Vec3, to_viewer: Vec3) -> Scalar:
        """Cosine of the angle between mirrored light and viewer, as for Phong."""
        return pf.Phong().cosine(normal, to_light, to_viewer)

    def lobe(
        self, cosine: Float[Array, "..."], shininess: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """1 inside the lamp's disc, 0 outside; a mirror has no exponent."""
        del shininess
        inside = cosine >= np.cos(np.deg2rad(self.radius))
        return inside.astype(cosine.dtype)


@dataclasses.dataclass(frozen=True)
class Result:
    """Blinn highlights fitted by Phong's model: arrays of shape (exponents, angles).

    - `ratio`: the fitted Phong exponent over Blinn's;
    - `residual`: RMS residual, relative to the RMS of the highlight.
    """

    ratio: np.ndarray
    residual: np.ndarray


def ball(
    size: int, angle: float, model: pf.AbstractSpecular, background: float = 0.0
) -> pf.Scene:
    """A ball; its lamp stands to the upper left, `angle` degrees off the viewer (+z).

    **Arguments:** `size`: width and height of the image, pixels.
    """
    radians = np.deg2rad(angle)
    across = np.array([-1.0, 1.0]) / np.sqrt(2) * np.sin(radians)
    lamp = pf.DirectionalLight((*across, np.cos(radians)))
    camera = pf.OrthographicCamera(size, size, view_height=2.05)
    return pf.Scene(
        pf.Sphere(), camera, lamp, specular_model=model, background=background
    )


def measure(size: int) -> Result:
    """Fit Phong's model to Blinn's highlights, in images of `size` × `size` pixels."""
    ratio, residual = [], []
    for exponent in EXPONENTS:
        material = pf.Material(0.0, 0.9, exponent, 0.0)
        for angle in ANGLES:
            image = np.asarray(pf.render(ball(size, angle, pf.BlinnPhong()), material))
            fit = pf.fit(
                ball(size, angle, pf.Phong()),
                image,
                unknowns=("specular", "shininess"),
                per_channel=(),  # one value for all three channels
                film=pf.Film(clamp=False),
            )
            ratio.append(float(fit.material.shininess) / exponent)
            residual.append(
                np.linalg.norm(np.asarray(fit.residuals, float)) / np.linalg.norm(image)
            )
    shape = len(EXPONENTS), len(ANGLES)
    return Result(np.reshape(ratio, shape), np.reshape(residual, shape))


def profile(model: pf.AbstractSpecular, degrees: np.ndarray, f: float) -> np.ndarray:
    """Height of a highlight for normals at these angles from its centre.

    Lamp and viewer are in the same direction, so the centre is where the normal points
    to them. `f` is the exponent.
    """
    to_both = jnp.array([0.0, 0.0, 1.0])
    angles = np.deg2rad(degrees)
    normals = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    dtype = to_both.dtype
    cosines = [model.cosine(jnp.asarray(n, dtype), to_both, to_both) for n in normals]
    return np.asarray(model.lobe(jnp.stack(cosines), jnp.asarray(f, dtype)))


MODELS = (
    (f"ideal mirror,\nlamp's radius {LAMP:g}°", IdealMirror(), SHOWN, style.BLACK, ":"),
    (f"Phong\n$f$ = {SHOWN:g}", pf.Phong(), SHOWN, style.BLUE, "-"),
    (f"Blinn\n$f$ = {SHOWN:g}", pf.BlinnPhong(), SHOWN, style.VERMILION, "-"),
    (f"Blinn\n$f$ = {4 * SHOWN:g}", pf.BlinnPhong(), 4 * SHOWN, style.ORANGE, "--"),
)
"""Highlights that are drawn: title, model, exponent, colour and line style."""


@style.styled
def draw(result: Result, size: int) -> Figure:
    """Draw balls of `size` × `size` pixels, profiles, and the ratio of exponents."""
    figure = style.page(6.3)
    top, bottom = style.bands(figure, 3.7, 2.6)
    images = [
        [
            np.asarray(
                pf.render(
                    ball(size, angle, model, background=1.0),
                    pf.Material((0.35, 0.08, 0.05), 0.7, exponent, 0.0),
                    samples=4,
                )
            )
            for _, model, exponent, *_ in MODELS
        ]
        for angle in (ANGLES[1], ANGLES[-1])
    ]
    style.picture_grid(
        top,
        images,
        columns=[name for name, *_ in MODELS],
        rows=[f"lamp at {angle:g}°" for angle in (ANGLES[1], ANGLES[-1])],
    )
    profiles, ratios = bottom.subplots(1, 2)
    degrees = np.linspace(0, 35, 281)
    for name, model, exponent, colour, line in MODELS:
        height = profile(model, degrees, exponent)
        profiles.plot(degrees, height, line, c=colour, label=name.replace("\n", " "))
    profiles.set_xlabel("normal's angle from the highlight (degrees)")
    profiles.set_ylabel("height (share of the peak)")
    profiles.set_title("profiles, lamp beside the viewer")
    profiles.legend()
    colours = (style.BLUE, style.SKY, style.ORANGE, style.VERMILION)
    for column, angle, colour, marker in zip(
        result.ratio.T, ANGLES, colours, "o^sD", strict=True
    ):
        ratios.semilogx(
            EXPONENTS, column, f"{marker}-", c=colour, label=f"lamp at {angle:g}°"
        )
    ratios.axhline(0.25, c=style.BLACK, lw=0.8, ls=":")
    ratios.set_xticks(EXPONENTS, [f"{f:g}" for f in EXPONENTS])
    ratios.minorticks_off()
    ratios.set_ylim(0, None)
    ratios.set_xlabel("Blinn's exponent $f$")
    ratios.set_ylabel("fitted Phong exponent / Blinn's")
    ratios.set_title("the same highlight in the other model")
    ratios.legend()
    return figure


def find(small: bool) -> Finding:
    """Run the experiment: measure, draw and answer; `small`: quick and coarse."""
    size = 48 if small else 128
    result = measure(size)
    # Ratios for the lamp nearest to the viewer's direction, and for the farthest.
    near, far = result.ratio[:, 0], result.ratio[:, -1]
    answer = (
        "An ideal mirror shows the lamp itself, as a disc; Phong and Blinn blur it, "
        "the more the smaller f is. For one f, Blinn's highlight is twice as wide as "
        "Phong's, since the half vector turns half as fast: with the lamp "
        f"{ANGLES[0]:g}° from the viewer, the Phong exponent that fits best is "
        f"{near[-1]:.3f} of Blinn's for f = {EXPONENTS[-1]:g}, a quarter, and "
        f"{near[0]:.3f} for f = {EXPONENTS[0]:g}, where the highlight is wide. With "
        "the "
        f"lamp {ANGLES[-1]:g}° away it is {far.min():.2f} to {far.max():.2f}, and no "
        "Phong highlight is like Blinn's: Phong's is drawn out along the ball's rim, "
        "as a mirror's is, and Blinn's stays round. There the residual is "
        f"{100 * result.residual[-1, -1]:.0f} % of the highlight (RMS), against "
        f"{100 * result.residual[-1, 0]:.1f} % at {ANGLES[0]:g}° "
        f"(f = {EXPONENTS[-1]:g})."
    )
    rows = tuple(
        (f"{f:g}", *(f"{ratio:.3f}" for ratio in line))
        for f, line in zip(EXPONENTS, result.ratio, strict=True)
    )
    narrow = near[np.array(EXPONENTS) >= 50]
    failed_checks = ()
    if np.any(np.abs(narrow / 0.25 - 1) > 0.05):
        failed_checks = (
            "a narrow highlight's Phong exponent is not a quarter of Blinn's",
        )
    return Finding(
        answer,
        dataclasses.asdict(result),
        draw(result, 48 if small else 256),
        "Balls with the highlights of a mirror, of Phong and of Blinn, under a lamp "
        "near the viewer and one far around; profiles of the four; the ratio of the "
        "exponents of Phong and Blinn, near a quarter for lamps near the viewer.",
        Table(("Blinn's f", *(f"lamp at {angle:g}°" for angle in ANGLES)), rows),
        failed_checks=failed_checks,
    )


EXPERIMENT = Experiment("highlights", __doc__, find)

if __name__ == "__main__":
    raise SystemExit(EXPERIMENT.run())
