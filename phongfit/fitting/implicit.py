"""A fit as a function that can be differentiated: from images to the material."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from phongfit.checks import as_floats
from phongfit.edge import checked
from phongfit.fitting.problem.inputs import entries
from phongfit.fitting.problem.parameters import scene_arrays
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.samples import by_channel, join_pixels
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.result import Fit
from phongfit.fitting.solve.solution import solve
from phongfit.material import Material
from phongfit.rendering.pixels import resolve_terms
from phongfit.scene import Scene

MAX_STEPS = 100


@checked
def refit(fit: Fit, scene: Scene | Sequence[Scene], image: Any) -> Material:
    r"""The material for other images or scenes, starting from a finished fit.

    A pure function, which can be `jit`ted, `vmap`ped and differentiated: `jax.grad` of
    any function of the material, in the images or in any array of the scenes. The
    derivative is that of the solution itself (implicit differentiation): with the
    gradient $g(y, x) = 0$ of the cost it is $-(\partial g/\partial y)^{-1} \partial
    g/\partial x$, in the exact second derivative of the cost. No step of the solver is
    differentiated.

    Pixels, weights, noise level, loss, bounds, ties and priors are those of the fit. So
    are the pixels that see the surface or lie in shadow, and the JPEG correction, whose
    dependence on image and scene has no derivative. An unknown at its bound stays
    there, without a derivative.

    **Arguments:**

    - `fit`: a fit of the same kind of scenes and images.
    - `scene`, `image`: as for [`fit`][]; may be traced.

    **Returns:** the [`Material`][], with NaN if the solver fails.

    **Raises:** `ValueError` that names the argument, if number or shape differ from the
    fit's.
    """
    problem = _other_problem(fit, scene, image)
    known = jax.tree.map(_without_derivative, problem)
    found = solve(known, fit.solution.y, MAX_STEPS)
    y = _with_derivative(problem, found.y)
    y = jnp.where(found.converged, y, jnp.nan)
    return problem.unknowns.material(y)


def _without_derivative(leaf: Any) -> Any:
    return jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf


def _other_problem(fit: Fit, scene: Scene | Sequence[Scene], image: Any) -> Problem:
    single = isinstance(scene, Scene)
    scenes = (scene,) if single else tuple(scene)
    images = (image,) if single else entries("image", image)
    old = fit.solution.problem
    views = old.samples.views
    if len(scenes) != len(views) or len(images) != len(views):
        raise ValueError(
            f"scene: expected {len(views)} scenes and images, as the fit had, got "
            f"{len(scenes)} and {len(images)}"
        )
    pixels, targets = [], []
    for k, (view, one, light) in enumerate(zip(views, scenes, images, strict=True)):
        size, came = ((s.camera.height, s.camera.width) for s in (view.scene, one))
        if came != size:
            raise ValueError(f"scene: expected {size} pixels of scene {k}, got {came}")
        shape, light = (*size, 3), as_floats("image", light)
        if light.shape != shape:
            raise ValueError(
                f"image: expected shape {shape} for scene {k}, got {light.shape}"
            )
        pixels.append(resolve_terms(one)[1].select(view.index))
        light = light.astype(old.samples.target.dtype)
        targets.append(light.reshape(-1, 3)[view.index])
    target = jnp.concatenate(targets).T - _lost(fit)
    views = tuple(
        dataclasses.replace(view, scene=one)
        for view, one in zip(views, scenes, strict=True)
    )
    channels = by_channel(join_pixels(pixels))
    samples = dataclasses.replace(
        old.samples, channels=channels, target=target, views=views
    )
    factor, offset = _held(old.unknowns, scenes)
    unknowns = dataclasses.replace(old.unknowns, factor=factor, offset=offset)
    return dataclasses.replace(old, samples=samples, unknowns=unknowns)


def _held(unknowns: Unknowns, scenes: tuple[Scene, ...]) -> tuple[Array, Array]:
    """Factors and offsets that hold nuisances at the values in the scenes."""
    offset = unknowns.offset
    for name, places in unknowns.parts(np.arange(len(offset))).items():
        if name in unknowns.sought:
            continue
        arrays = [scene_arrays(one)[name] for one in scenes[: len(places)]]
        there = jnp.stack([one.ravel() for one in arrays])
        offset = offset.at[places].set(there.astype(offset.dtype))
    return jnp.where(unknowns.table.nuisance, 0, unknowns.factor), offset


def _lost(fit: Fit) -> Float[Array, "3 samples"] | float:
    """The fit's correction of photographs for JPEG compression; 0 without JPEG."""
    old = fit.solution.problem
    if all(film.jpeg is None for film in fit.films):
        return 0.0
    came = (fit.photographs,) if isinstance(fit.scene, Scene) else fit.photographs
    pixels = [
        np.asarray(image).reshape(-1, 3)[np.asarray(view.index)]
        for image, view in zip(came, old.samples.views, strict=True)
    ]
    return jnp.asarray(np.concatenate(pixels).T) - old.samples.target


def _with_derivative(
    problem: Problem, solution: Float[Array, " n"]
) -> Float[Array, " n"]:
    """The solution, with its derivative in the problem by implicit differentiation."""
    unknowns = problem.unknowns
    held = (solution <= unknowns.lower) | (solution >= unknowns.upper)
    held |= unknowns.y_nuisance
    tolerance = float(jnp.finfo(solution.dtype).eps) ** 0.5
    found = optx.root_find(
        _gradient,
        optx.Newton(rtol=tolerance, atol=tolerance),
        solution,
        args=(problem, held, solution),
        max_steps=4,
        throw=False,
    )
    return found.value


def _gradient(
    y: Float[Array, " n"], args: tuple[Problem, Array, Array]
) -> Float[Array, " n"]:
    """Gradient of the cost in free unknowns; distance from `solution` in others."""
    problem, held, solution = args

    def cost(y: Array) -> Array:
        samples = problem.loss.root(problem.residual(jnp.where(held, solution, y)))
        priors = problem.unknowns.prior_residual(jnp.where(held, solution, y))
        count = problem.samples.weight.size
        return (jnp.sum(samples**2) + jnp.sum(priors**2)) / (2 * count)

    return jnp.where(held, y - solution, jax.grad(cost)(y))
