"""How well a fit could know each parameter, before any photograph is taken."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from phongfit.fitting.estimate import estimates
from phongfit.fitting.fit import Setting, set_up
from phongfit.fitting.leaves import LEAVES, is_of_scene, scene_arrays
from phongfit.fitting.losses import Linear
from phongfit.fitting.problem import Problem
from phongfit.fitting.result import errors_as_material
from phongfit.fitting.samples import gather, seen_pixels
from phongfit.fitting.table import parameter_rows
from phongfit.fitting.unknowns import Unknowns
from phongfit.material import Material
from phongfit.rendering.film import Film, decode
from phongfit.rendering.render import render
from phongfit.scene import Scene


@dataclasses.dataclass(frozen=True, repr=False)
class Prediction:
    """Standard errors that a fit would state, in the order of `labels`.

    **Arguments:**

    - `labels`, `values`, `errors`: the unknowns, their true values, and standard
        errors: infinite for what could not be told.
    - `stderr`: a material of these errors.
    - `covariance`: of the estimates; NaN rows for what could not be told.
    - `untold`: true where the images would leave the value open.
    - `warnings`: why, in words.
    - `samples`: pixels times channels that would be used.
    """

    labels: tuple[str, ...]
    values: np.ndarray
    errors: np.ndarray
    stderr: Material
    covariance: np.ndarray
    at_bound: np.ndarray
    untold: np.ndarray
    warnings: tuple[str, ...]
    samples: int

    def __str__(self) -> str:
        rows = parameter_rows(
            self.labels, self.values, self.errors, self.at_bound, self.untold
        )
        words = [f"  ! {warning}" for warning in self.warnings]
        head = f"phongfit: what {self.samples:,} samples could tell"
        return "\n".join([head, "", *rows, *(["", *words] if words else [])])

    def __repr__(self) -> str:
        return str(self)


def predict_errors(
    scene: Scene | Sequence[Scene],
    material: Material,
    noise: Any,
    *,
    film: Film | None = None,
    **options: Any,
) -> Prediction:
    r"""Standard errors that [`fit`][] would state for photographs not yet taken.

    Where nothing is clipped or rounded this is the Cramér-Rao bound $\sigma^2 (J^\top
    J)^{-1}$: no unbiased estimate from these images can be better. So lights and views
    can be compared, and placed well.

    **Arguments:**

    - `scene`: one, or a sequence of scenes of one material; arrays of theirs that will
        be unknown have their true values here.
    - `material`: the true one.
    - `noise`: standard deviation in linear light, as for [`fit`][].
    - `film`: how light will become numbers; default a clamp alone.
    - `options`: of [`fit`][]: `unknowns`, `per_channel`, `per_image`, `bounds`,
        `fixed`, `ties`, `priors`, `mask`, `weights`.

    **Returns:** a [`Prediction`][].

    **Raises:** `ValueError` that names the argument, as [`fit`][] does; `TypeError` for
    an option that is none.
    """
    film = Film() if film is None else film
    single = isinstance(scene, Scene)
    scenes = [scene] if single else list(scene)
    images = [_photograph(one, material, film) for one in scenes]
    setting = set_up(
        scene,
        images[0] if single else images,
        known=material,
        noise=noise,
        film=film,
        **options,
    )
    problem = _problem(setting)
    y = jnp.asarray(_truth(setting.unknowns, material, tuple(scenes)))
    told = estimates(problem, y)
    errors = np.zeros(len(setting.unknowns.entry_labels))
    errors[setting.unknowns.reported] = told.errors
    return Prediction(
        labels=setting.unknowns.labels,
        values=told.values,
        errors=told.errors,
        stderr=errors_as_material(setting.unknowns, errors),
        covariance=told.covariance,
        at_bound=told.at_bound,
        untold=told.untold,
        warnings=told.reasons,
        samples=sum(int(np.count_nonzero(s.weight)) for s in setting.sources),
    )


def _photograph(scene: Scene, material: Material, film: Film) -> np.ndarray:
    """The image without noise, as a file of it would be read."""
    shown = np.asarray(render(scene, material, film=film))
    return np.asarray(decode(shown, film.encoding))


def _problem(setting: Setting) -> Problem:
    sources, unknowns = setting.sources, setting.unknowns
    relight = unknowns.of_scene and not setting.moving
    samples = gather(sources, seen_pixels(sources), relight)
    sigma = jnp.ones((), samples.target.dtype)
    return Problem(samples, unknowns, sigma, Linear(), setting.film.clamp)


def _truth(
    unknowns: Unknowns, material: Material, scenes: tuple[Scene, ...]
) -> np.ndarray:
    """The solver's vector of the truth."""
    parts = []
    for leaf in unknowns.leaves:
        size = (len(leaf.rows), len(leaf.parts))
        if leaf.name in LEAVES:
            value = np.asarray(getattr(material, leaf.name), float)
            if size[1] == 1 and value.shape[-1:] == (3,):
                # One number for three colours: their mean.
                value = value.mean(axis=-1, keepdims=True)
        elif is_of_scene(leaf.name):
            rows = scenes[: size[0]]
            arrays = [np.asarray(scene_arrays(s)[leaf.name], float) for s in rows]
            value = np.stack([array.ravel() for array in arrays])
            if value.shape[1] != size[1]:
                value = value.mean(axis=1, keepdims=True)
        else:
            value = np.ones(())
        parts.append(np.broadcast_to(value, size).ravel())
    return unknowns.position(np.concatenate(parts))
