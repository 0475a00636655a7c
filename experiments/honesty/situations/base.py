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
from experiments.honesty.answers import Answers, Scenes, Trial, fit_trials
from experiments.honesty.judge import Kind

Image: TypeAlias = Float[np.ndarray, "height width 3"]
Draws: TypeAlias = Sequence[np.random.Generator]
"""A random generator for each draw, that is for each repetition with fresh noise."""

Photograph: TypeAlias = Callable[[Image, np.random.Generator], Image]
"""Makes a photograph from the linear light of a scene: adds noise, clips, rounds."""

# Width and height of most images, pixels.
SIZE = 48
# For fits of many unknowns of a scene from many starts.
SMALL = 32
# For wrong models that only many pixels reveal.
LARGE = 128
# Standard deviation of most noise, where white is 1.
NOISE = 0.01
UNCLAMPED = pf.Film(clamp=False)
# Direction to the usual lamp: x right, y up, z to the camera.
LAMP = (1.0, 1.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Situation:
    """A kind of data and fit that users meet, and what is expected of its results.

    - `name`: unique; `kind`: what is expected, see [`judge`][];
    - `answer`: fits one draw for each random generator, and returns the answers;
    - `unidentifiable`: labels or names of parameters that the data cannot identify;
    - `wide`: whether intervals may contain the truth too often;
    - `required_warning`: part of a warning that each draw must have;
    - `draw_fraction`: fraction of the draws to run, below 1 where a draw takes long.
    """

    name: str
    kind: Kind
    answer: Callable[[Draws], Answers]
    unidentifiable: tuple[str, ...] = ()
    wide: bool = False
    required_warning: str = ""
    draw_fraction: float = 1.0


def alike(
    kind: Kind, answers: Mapping[str, Callable[[Draws], Answers]], **options: Any
) -> list[Situation]:
    """Situations that differ in their names and answers alone.

    **Arguments:** `options`: other fields of [`Situation`][].
    """
    return [Situation(name, kind, one, **options) for name, one in answers.items()]


@dataclasses.dataclass(frozen=True)
class Subject:
    """Scenes of one material, of which photographs are made: the truth of a fit."""

    scenes: tuple[pf.Scene, ...]
    material: pf.Material

    @functools.cached_property
    def light(self) -> tuple[Image, ...]:
        """Linear light of each scene, without noise, not clamped at white."""
        return tuple(
            np.asarray(pf.render(scene, self.material, film=UNCLAMPED), float)
            for scene in self.scenes
        )


Draw: TypeAlias = Callable[[np.random.Generator], Subject]
"""Makes the subject of a draw: a random one, or the same one each time."""


def cached_subject(make: Callable[[], Subject]) -> Draw:
    """A `Draw` that calls `make` once, and returns this subject in every draw."""
    cached = functools.cache(make)
    return lambda rng: cached()


DrawOptions: TypeAlias = Callable[[Image, np.random.Generator], Mapping[str, Any]]
"""Makes options of a fit from a draw's light and generator, such as a noise map."""


def fits(
    subject: Subject | Draw,
    photograph: Photograph,
    *,
    fitted: Scenes | None = None,
    draw_options: DrawOptions | None = None,
    other_truths: Mapping[str, float] | None = None,
    **options: Any,
) -> Callable[[Draws], Answers]:
    """A function that photographs a subject and fits it, once for each draw.

    A draw is a random generator: one repetition of the experiment.

    **Arguments:**

    - `subject`: the true scenes and material, or a function that makes them with a
        draw's generator.
    - `photograph`: adds a camera's noise and rounding to light of shape (H, W, 3).
    - `fitted`: the scenes that `pf.fit` is given; `None`: the true ones.
    - `options`: arguments of `pf.fit`, the same in all draws.
    - `draw_options`: further ones, made in each draw from the light of scene 0.
    - `other_truths`: true values, by label, of unknowns that are neither in the scenes
        nor in the material, such as `"exposure[1]"`.

    **Returns:** a function from draws to their `Answers`: estimates, errors and truths.
    """

    def trials(draws: Draws) -> Iterator[Trial]:
        for rng in draws:
            true = subject if isinstance(subject, Subject) else subject(rng)
            one_scene = len(true.scenes) == 1
            images = [photograph(light, rng) for light in true.light]
            assumed = true.scenes if fitted is None else fitted
            if one_scene and not isinstance(assumed, pf.Scene):
                assumed = assumed[0]
            extra = {} if draw_options is None else draw_options(true.light[0], rng)
            yield Trial(
                assumed,
                images[0] if one_scene else images,
                {**options, **extra},
                true.scenes,
                true.material,
                other_truths or {},
            )

    return lambda draws: fit_trials(trials(draws))


MATERIAL = pf.Material((0.6, 0.3, 0.2), (0.3, 0.25, 0.35), 20.0, (0.5, 0.4, 0.3))


def usual_material(**changes: Any) -> pf.Material:
    """`MATERIAL` with the parameters `changes` replaced."""
    names = ("diffuse", "specular", "shininess", "ambient")
    return pf.Material(**({name: getattr(MATERIAL, name) for name in names} | changes))


def lamp(
    direction: Sequence[float] | np.ndarray = LAMP, intensity: Any = 0.6
) -> pf.DirectionalLight:
    """A directional light; its direction has unit length, as fits return it.

    **Arguments:** `direction`: to the lamp, of any length; `intensity`: RGB or a
    number.
    """
    return pf.DirectionalLight(
        np.array(direction) / np.linalg.norm(direction), intensity
    )


def ball_scene(
    *lights: pf.AbstractLight, size: int = SIZE, ambient: float = 0.3, **changes: Any
) -> pf.Scene:
    """A sphere of radius 1 under `lights`, or if there are none under the usual lamp.

    **Arguments:** `size`: width and height of the image, pixels; `changes`: other
    arguments of `pf.Scene`.
    """
    defaults = {"surface": pf.Sphere(), "camera": pf.OrthographicCamera(size, size)}
    return pf.Scene(**(defaults | changes), lights=lights or lamp(), ambient=ambient)


def usual_subject(material: pf.Material = MATERIAL, *scenes: pf.Scene) -> Subject:
    """A subject of `material`, with `scenes`, or with the usual ball under one lamp."""
    return Subject(scenes or (ball_scene(),), material)


def noisy(level: float = NOISE) -> Photograph:
    """A `Photograph` that adds Gaussian noise of this standard deviation."""
    return lambda light, rng: light + level * rng.normal(size=light.shape)


def clamped(photograph: Photograph) -> Photograph:
    """A `Photograph` that clips the result of another one to [0, 1]."""
    return lambda light, rng: np.clip(photograph(light, rng), 0, 1)
