"""`fit`: images and geometry in, a material with error bars out."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from phongfit.fitting.inputs import Photograph, as_photographs
from phongfit.fitting.losses import AbstractLoss, as_loss
from phongfit.fitting.noise import find_film, rounding_steps
from phongfit.fitting.result import Fit
from phongfit.fitting.samples import gather
from phongfit.fitting.search import search
from phongfit.fitting.summary import summarize
from phongfit.fitting.unknowns import Unknowns, make_unknowns
from phongfit.geometry.surfaces import GBuffer
from phongfit.material import Material
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import PixelTerms, pixel_terms
from phongfit.scene import Scene


def fit(
    scene: Scene | Sequence[Scene],
    image: Any,
    *,
    unknowns: Sequence[str] = ("ambient", "diffuse", "specular", "shininess"),
    per_channel: Sequence[str] = ("ambient", "diffuse", "specular"),
    known: Material | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
    film: Film | None = None,
    loss: str | AbstractLoss = "linear",
    max_steps: int = 200,
) -> Fit:
    r"""The material that explains one or several images, with standard errors.

    Minimises $\sum_i w_i\, \rho\big((I_i(\rho_a, \rho_d, \rho_s, f) - t_i)^2 /
    \sigma^2\big)$ in a box, by a bounded Levenberg-Marquardt solver that starts from
    the best of a scan over $\log f$: no starting guess is needed.

    **Arguments:**

    - `scene`: one, or a sequence of scenes (lights, views) of one material.
    - `image`: (height, width, 3) linear light where white is 1, or a sequence of these,
        one a scene.
    - `unknowns`: leaves of the material to be found; where the surface is made of M
        materials, of each of them: the leaves that come back have shape (M, 3) or
        (M, 1).
    - `per_channel`: those of them with one value for each of red, green and blue; the
        others have one for all.
    - `known`: values of the leaves that are not unknown; default no reflectance, no
        emission and an exponent of 32.
    - `bounds`: name → (low, high), in place of 0 … 1 for reflectances and emission and
        1 … 1000 for shininess.
    - `mask`: (height, width) or (height, width, 3), true where a sample is used; with
        several scenes a sequence. Pixels that see no surface are never used.
    - `weights`: relative inverse variances, shaped as `mask`; 0 leaves a sample out.
    - `noise`: standard deviation of the sensor's noise in linear light, a number or as
        `weights`; default estimated from the residuals.
    - `film`: how light became numbers (clamp, encoding, bits). By default its clamp and
        rounding are found from the values themselves.
    - `loss`: `"linear"`, `"huber"`, `"soft_l1"`, `"cauchy"`, `"tukey"`, or an
        [`AbstractLoss`][].
    - `max_steps`: of the solver, in each of its passes.

    **Returns:** a [`Fit`][]. Numerical failure is told in its `converged` and
    `warnings`; nothing is raised.

    **Raises:** `ValueError` that names the argument: wrong shapes, NaN or infinite
    pixels, a mask that leaves nothing, fewer samples than unknowns, ambient and
    emission both unknown where no pixel can tell them apart.
    """
    photographs = as_photographs(scene, image, mask, weights, noise)
    known = Material(0.0, 0.0, 32.0, 0.0) if known is None else known
    materials = photographs[0].scene.surface.materials
    layout = make_unknowns(unknowns, per_channel, known, bounds or {}, materials)
    film = _checked_film(film, photographs)
    loss = as_loss(loss)

    geometry = [_resolve(p.scene) for p in photographs]
    views = [view for _, view in geometry]
    weighted = [_weights(p, g) for p, (g, _) in zip(photographs, geometry, strict=True)]
    _check_samples(weighted, layout)
    _check_constants(layout, views)
    samples = gather(
        views,
        [p.image for p in photographs],
        weighted,
        [rounding_steps(p.image, film) for p in photographs],
    )
    found = search(samples, layout, loss, film.clamp, noise is not None, max_steps)
    used = [weight > 0 for weight in weighted]
    material = layout.with_leaves(layout.values(np.asarray(found.y)))
    fitted = [
        _shown(g, s, p.scene, material, film.clamp)
        for p, (g, s) in zip(photographs, geometry, strict=True)
    ]
    residuals = [
        np.where(mask, p.image - shown, 0)
        for p, shown, mask in zip(photographs, fitted, used, strict=True)
    ]
    return summarize(
        found,
        film=film,
        fitted=fitted,
        residuals=residuals,
        used=used,
        single=isinstance(scene, Scene),
        noise_given=noise is not None,
    )


def _resolve(scene: Scene) -> tuple[GBuffer, PixelTerms]:
    gbuffer = scene.trace()
    return gbuffer, pixel_terms(scene, gbuffer)


@eqx.filter_jit
def _expose(view: PixelTerms, material: Material, clamp: bool) -> Array:
    light = view.radiance(material)
    return jnp.clip(light, 0, 1) if clamp else light


def _shown(
    gbuffer: GBuffer,
    view: PixelTerms,
    scene: Scene,
    material: Material,
    clamp: bool,
) -> np.ndarray:
    """The fitted image in linear light."""
    light = np.asarray(_expose(view, material, clamp))
    mask = np.asarray(gbuffer.mask)[..., None]
    return np.where(mask, light, np.asarray(scene.background))


def _checked_film(film: Film | None, photographs: list[Photograph]) -> Film:
    images = [p.image[p.weight > 0] for p in photographs]
    if film is None:
        return find_film(images)
    for p, values in zip(photographs, images, strict=True):
        if film.clamp and values.size and not 0 <= values.min() <= values.max() <= 1:
            raise ValueError(
                f"{p.name}: values from {values.min():.4g} to {values.max():.4g} came, "
                "a clamped film holds [0, 1]; say film=Film(clamp=False)"
            )
    return film


def _weights(photograph: Photograph, gbuffer: GBuffer) -> np.ndarray:
    """Weights of the pixels that see the surface; the others have none."""
    seen = np.asarray(gbuffer.mask)[..., None]
    return np.where(seen, photograph.weight, 0).astype(photograph.image.dtype)


def _check_samples(weights: list[np.ndarray], unknowns: Unknowns) -> None:
    count = sum(int(np.count_nonzero(weight)) for weight in weights)
    if count == 0:
        raise ValueError("mask: it leaves no pixel that sees the surface")
    if count <= len(unknowns.labels):
        raise ValueError(
            f"mask: {count} samples are left for {len(unknowns.labels)} unknowns; more "
            "samples than unknowns are wanted"
        )


def _check_constants(unknowns: Unknowns, views: list[PixelTerms]) -> None:
    """Ambient and emission are one constant wherever the ambient light is the same."""
    if not {"ambient", "emission"} <= set(unknowns.names):
        return
    light = np.concatenate([np.asarray(v.terms.ambient).reshape(-1, 3) for v in views])
    if np.all(np.ptp(light, axis=0) <= 1e-6 * np.abs(light).max()):
        raise ValueError(
            "unknowns: ambient and emission both came, but under constant ambient "
            "light they are one constant; leave one out"
        )
