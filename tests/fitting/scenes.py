"""Small scenes for fits: few distinct shapes, so that tests share compilations."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

import phongfit as pf
from phongfit.fitting.problem.layout import make_unknowns
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.rendering.film import decode

SIZE = 32
PARAMETERS = ("ambient", "diffuse", "specular", "shininess")


def two_lights(kind: str) -> tuple[pf.AbstractLight, pf.AbstractLight]:
    """A main light and a weaker one, of one kind, from different sides."""
    if kind == "directional":
        return (
            pf.DirectionalLight((1, 1, 2), 0.35),
            pf.DirectionalLight((-1, 0.3, 1), (0.3, 0.25, 0.2)),
        )
    if kind == "point":
        return (
            pf.PointLight((2, 2, 3), 0.5, attenuation=(1, 0.05, 0.02)),
            pf.PointLight((-2, 0.5, 2), (0.3, 0.35, 0.3)),
        )
    return (
        pf.SpotLight((2, 2, 3), (-2, -2, -3), 0.6, cutoff=40, exponent=2),
        pf.SpotLight((-2, 0.5, 2), (2, -0.5, -2), (0.4, 0.35, 0.3), cutoff=30),
    )


def ball(
    kind: str = "directional",
    specular_model: pf.AbstractSpecular | None = None,
    ambient: float = 0.3,
    size: int = SIZE,
) -> pf.Scene:
    """A sphere under two lights."""
    camera = pf.OrthographicCamera(size, size)
    return pf.Scene(
        pf.Sphere(),
        camera,
        two_lights(kind),
        ambient=ambient,
        specular_model=specular_model,
    )


def truth() -> pf.Material:
    """The material of most made-up photographs, in the precision that is set."""
    return pf.Material(
        diffuse=(0.6, 0.3, 0.2),
        specular=(0.3, 0.25, 0.35),
        shininess=20.0,
        ambient=(0.5, 0.4, 0.3),
    )


def as_vector(material: pf.Material) -> np.ndarray:
    """The ten numbers of a material in the order of a fit's default unknowns."""
    leaves = [np.asarray(getattr(material, name), float) for name in PARAMETERS]
    return np.concatenate([np.ravel(leaf) for leaf in leaves])


def photograph(
    scene: pf.Scene,
    material: pf.Material,
    *,
    noise: float = 0.0,
    film: pf.Film | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Light plus noise, as `film` keeps it, read back as linear light."""
    light = np.asarray(pf.render(scene, material, film=pf.Film(clamp=False)))
    light = light + noise * np.random.default_rng(seed).normal(size=light.shape)
    return developed(light, pf.Film() if film is None else film)


def developed(light: np.ndarray, film: pf.Film) -> np.ndarray:
    """What a film makes of linear light, as linear light again, in NumPy."""
    shown = np.clip(light, 0, 1) if film.clamp else light
    if film.encoding == "srgb":
        curved = 1.055 * np.maximum(shown, 0.0031308) ** (1 / 2.4) - 0.055
        shown = np.where(shown > 0.0031308, curved, 12.92 * shown)
    if film.bits is not None:
        top = 2**film.bits - 1
        shown = np.round(shown * top) / top
    return decode(shown, film.encoding)


class Case(NamedTuple):
    """A made-up photograph and what lies behind it."""

    scene: pf.Scene
    material: pf.Material
    film: pf.Film
    clipped: float


def random_case(seed: int) -> Case:
    """A random material under two random lights, with up to 20 % of clipped samples."""
    rng = np.random.default_rng(seed)
    material = pf.Material(
        diffuse=rng.uniform(0.05, 0.95, 3),
        specular=rng.uniform(0.05, 0.95, 3),
        shininess=np.exp(rng.uniform(np.log(1.2), np.log(200))),
        ambient=rng.uniform(0.05, 0.95, 3),
    )
    # In one order, so that fewer combinations are compiled.
    lights = [_random_light(rng, kind) for kind in sorted(rng.integers(3, size=2))]
    ambient = rng.uniform(0.05, 0.4)
    model = pf.BlinnPhong() if rng.random() < 0.5 else pf.Phong()
    encoding = "linear" if rng.random() < 0.5 else "srgb"
    clipped = rng.uniform(0, 0.2)

    def scene(exposure: float) -> pf.Scene:
        return pf.Scene(
            pf.Sphere(),
            pf.OrthographicCamera(SIZE, SIZE),
            [light(exposure) for light in lights],
            ambient=exposure * ambient,
            specular_model=model,
        )

    light = np.asarray(
        pf.render(scene(1.0), material, film=pf.Film(clamp=False)), float
    )
    seen = light[light.any(axis=-1)]
    exposure = 1 / np.quantile(seen, 1 - clipped)
    film = pf.Film(encoding=encoding, bits=8)
    return Case(scene(exposure), material, film, float(np.mean(seen * exposure > 1)))


def _random_light(rng: np.random.Generator, kind: int):
    """A light of a random place in front of the ball, for any exposure."""
    direction = np.array([*rng.normal(size=2), rng.uniform(0.4, 2.0)])
    direction /= np.linalg.norm(direction)
    colour = rng.uniform(0.3, 1.0, 3)
    place = rng.uniform(2.5, 5) * direction

    def light(exposure: float) -> pf.AbstractLight:
        if kind == 0:
            return pf.DirectionalLight(direction, exposure * colour)
        if kind == 1:
            return pf.PointLight(place, exposure * colour, attenuation=(1, 0.05, 0.02))
        return pf.SpotLight(
            place, -direction, exposure * colour, cutoff=60, exponent=1.5
        )

    return light


def unknowns_of(
    unknowns: Sequence[str],
    per_channel: Sequence[str],
    known: pf.Material,
    bounds: Mapping[str, tuple[float, float]],
    *,
    materials: int = 1,
    scenes: Sequence[pf.Scene] = (),
    **options: Any,
) -> Unknowns:
    """Those of a fit that is asked for these."""
    asked = Specification(
        unknowns=unknowns,
        per_channel=per_channel,
        known=known,
        bounds=bounds,
        **options,
    )
    return make_unknowns(asked, materials, scenes)
