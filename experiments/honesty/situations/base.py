"""Parts of situations: a subject under light, and the noise and film of its image.

Most share one scene, one size and one kind of image, since every new kind of fit must
be compiled, which takes longer than a hundred fits.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

import phongfit as pf
from experiments.honesty.answers import Answers, Scenes, Shot, fit_all
from experiments.honesty.judge import Kind

Image: TypeAlias = Float[np.ndarray, "height width 3"]
Draws: TypeAlias = Sequence[np.random.Generator]
Take: TypeAlias = Callable[[Image, np.random.Generator], Image]
"""From the light of a scene to its photograph."""

SIZE = 48
# For fits of many unknowns of a scene from many starts.
SMALL = 32
# For wrong models that only many pixels reveal.
LARGE = 128
NOISE = 0.01
UNCLAMPED = pf.Film(clamp=False)
LAMP = (1.0, 1.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Situation:
    """Something that users meet: how it is drawn and fitted, and how it is judged.

    - `name`, `kind`: see [`judge`][];
    - `ask`: takes a random generator for each draw, returns the answers of their fits;
    - `free`: parameters that the data cannot identify;
    - `wide`: whether intervals may be too wide;
    - `words`: part of a warning that each draw must have;
    - `share`: fraction of the draws to run, below 1 where a draw takes long.
    """

    name: str
    kind: Kind
    ask: Callable[[Draws], Answers]
    free: tuple[str, ...] = ()
    wide: bool = False
    words: str = ""
    share: float = 1.0


@dataclasses.dataclass(frozen=True)
class Subject:
    """Scenes of one material."""

    scenes: tuple[pf.Scene, ...]
    material: pf.Material

    @functools.cached_property
    def light(self) -> tuple[Image, ...]:
        """Linear light of each scene, without noise and clamp."""
        return tuple(
            np.asarray(pf.render(scene, self.material, film=UNCLAMPED), float)
            for scene in self.scenes
        )


Draw: TypeAlias = Callable[[np.random.Generator], Subject]
"""Makes the subject of a draw: a random one, or the same one each time."""


def when_asked(make: Callable[[], Subject]) -> Draw:
    """A `Draw` that makes its subject at the first use, and returns it each time."""
    made = functools.cache(make)
    return lambda rng: made()


Given: TypeAlias = Callable[[Image, np.random.Generator], Mapping[str, Any]]
"""Options of a fit that follow from the light, such as a map of its noise."""


def fits(
    subject: Subject | Draw,
    take: Take,
    *,
    fitted: Scenes | None = None,
    given: Given | None = None,
    others: Mapping[str, float] | None = None,
    **options: Any,
) -> Callable[[Draws], Answers]:
    """A function that photographs and fits a subject once for each draw.

    **Arguments:**

    - `subject`: the true one, or how to draw it.
    - `take`: makes a photograph from light.
    - `fitted`: the scenes that the fit is given; default the true ones.
    - `given`, `options`: of the fit.
    - `others`: see [`Shot`][].
    """

    def shots(draws: Draws) -> Iterator[Shot]:
        for rng in draws:
            true = subject if isinstance(subject, Subject) else subject(rng)
            single = len(true.scenes) == 1
            images = [take(light, rng) for light in true.light]
            stated = true.scenes if fitted is None else fitted
            if single and not isinstance(stated, pf.Scene):
                stated = stated[0]
            more = {} if given is None else given(true.light[0], rng)
            yield Shot(
                stated,
                images[0] if single else images,
                {**options, **more},
                true.scenes,
                true.material,
                others or {},
            )

    return lambda draws: fit_all(shots(draws))


MATERIAL = pf.Material((0.6, 0.3, 0.2), (0.3, 0.25, 0.35), 20.0, (0.5, 0.4, 0.3))


def changed(**parameters: Any) -> pf.Material:
    """The usual material, with these parameters replaced."""
    usual = {name: getattr(MATERIAL, name) for name in ("diffuse", "specular")}
    usual |= {name: getattr(MATERIAL, name) for name in ("shininess", "ambient")}
    return pf.Material(**(usual | parameters))


def lamp(
    direction: Sequence[float] | np.ndarray = LAMP, intensity: Any = 0.6
) -> pf.DirectionalLight:
    """A lamp far away; its direction has unit length, as fits give it back."""
    return pf.DirectionalLight(
        np.array(direction) / np.linalg.norm(direction), intensity
    )


def ball(
    *lights: pf.AbstractLight, size: int = SIZE, ambient: float = 0.3, **changes: Any
) -> pf.Scene:
    """A sphere under the usual lamp, or under these lights."""
    usual = {"surface": pf.Sphere(), "camera": pf.OrthographicCamera(size, size)}
    return pf.Scene(**(usual | changes), lights=lights or lamp(), ambient=ambient)


def usual(material: pf.Material = MATERIAL, *scenes: pf.Scene) -> Subject:
    """A subject of this material: the usual ball under one lamp, or these scenes."""
    return Subject(scenes or (ball(),), material)


def noisy(level: float = NOISE) -> Take:
    """A function that adds Gaussian noise to light."""
    return lambda light, rng: light + level * rng.normal(size=light.shape)


def clamped(take: Take) -> Take:
    """A function that applies `take` and clips the result to [0, 1]."""
    return lambda light, rng: np.clip(take(light, rng), 0, 1)
