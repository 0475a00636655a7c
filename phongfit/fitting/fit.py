"""`fit`: images and geometry in, a material with error bars out."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from phongfit.checks import untraced
from phongfit.edge import checked
from phongfit.fitting.encodings import with_encoding_doubts
from phongfit.fitting.problem.inputs import (
    is_number,
)
from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.problem.noise import find_plateau
from phongfit.fitting.problem.posing import FitData, set_up
from phongfit.fitting.problem.samples import gather, seen_pixels
from phongfit.fitting.problem.specification import (
    DEFAULT_PER_CHANNEL,
    DEFAULT_UNKNOWNS,
    Specification,
    Tie,
    Uncertain,
)
from phongfit.fitting.problem.unknowns import Unknowns, in_units
from phongfit.fitting.result import Fit
from phongfit.fitting.solve.edges import keep_off_edges
from phongfit.fitting.solve.guesses import guess_places, look, moves_lights
from phongfit.fitting.solve.jpeg import restore
from phongfit.fitting.solve.search import SearchResult, search
from phongfit.fitting.solve.solution import polish
from phongfit.fitting.solve.start import (
    NEAR,
    ROBUST_NEAR,
    ROBUST_SUBSET,
    SUBSET,
    choose_few,
)
from phongfit.fitting.summary import FittedImage, summarize
from phongfit.fitting.uncertainty.statistics import sandwich_sums
from phongfit.fitting.uncertainty.tiles import (
    Measured,
    Tiles,
    sum_over_tiles,
    tile_side,
)
from phongfit.material import Material
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import PixelTerms, resolve_terms
from phongfit.scene import Scene


@checked
def fit(
    scene: Scene | Sequence[Scene],
    image: Any,
    *,
    unknowns: Sequence[str] | None = DEFAULT_UNKNOWNS,
    per_channel: Sequence[str] | None = DEFAULT_PER_CHANNEL,
    known: Material | None = None,
    per_image: Sequence[str] | None = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fixed: Mapping[str, Any] | None = None,
    ties: Mapping[str, Tie] | None = None,
    priors: Mapping[str, tuple[Any, float]] | None = None,
    uncertain: Uncertain | None = None,
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
    film: Film | Sequence[Film] | None = None,
    loss: str | AbstractLoss = "linear",
    max_steps: int = 200,
) -> Fit:
    r"""The material that explains one or several images, with standard errors.

    Minimises $\sum_i w_i\, \rho\big((I_i(\rho_a, \rho_d, \rho_s, f) - t_i)^2 /
    \sigma^2\big)$ in a box, by a bounded Levenberg-Marquardt solver that starts from
    the best of a scan over $\log f$: no starting guess is needed.

    **Arguments:**

    - `scene`: a scene, or a sequence of scenes (lights, views) of one material.
    - `image`: (height, width, 3) linear light where white is 1, or a sequence of these,
        one a scene.
    - `unknowns`: parameters of the material to fit. If the surface is made of M
        materials, each has its own, and the result has parameters of shape (M, 3) or
        (M, 1). Further, arrays of the scene by their paths, such as
        `"scene.lights[0].direction"`, `"scene.fog.density"`, or a parameter of the
        specular model, `"scene.specular_model.roughness"`. They start from the values
        in the scene. Directions are sought on the whole sphere. A camera's `rotation`
        is three angles: degrees about its x, y and z axes, from the rotation in the
        scene. A spot's `cutoff` is refused. Pixels next to an edge that an unknown
        moves (an outline, the rim of a spot, a cast shadow) are left out, since light
        is discontinuous there.
        `"exposure"`: a factor on the light of each image.
    - `per_channel`: the unknowns with separate values for red, green and blue; other
        colours have one value for all three.
    - `per_image`: unknown arrays of the scenes with a separate value for each image.
    - `known`: a material with the values of the other parameters; default: reflectances
        and emission 0, exponent 32.
    - `bounds`: name or label → (low, high), in place of 0 … 1 for reflectances and
        emission, 1 … 1000 for shininess, and a specular model's bounds for its
        parameters. Labels are those of the result:
        `"diffuse.red"`, `"exposure[1]"`, `"scenes[1].lights[0].position.x"`.
    - `fixed`: name or label → the value at which it is held.
    - `ties`: name or label → another name or label, whose value it takes, or (factor,
        other), for a multiple of it; both stay within their bounds.
    - `priors`: name or label → (mean, standard deviation), in the user's units: a
        normal prior, which counts as one more measurement.
    - `uncertain`: array of the scenes, such as `"scene.lights[0].direction"` → its
        covariance over all images and components, image by image (a colour has three
        components), or a standard deviation for all or one for each. Arrays with
        correlated errors share one covariance, array by array:
        `("scene.lights[0].position", "scene.lights[0].attenuation")` → covariance. This
        is a normal prior around the values in the scenes. An array that is not among
        the `unknowns` is refined: it takes the value that fits prior and images best,
        which is in the result's scenes, and its remaining uncertainty is part of the
        errors of the unknowns.
    - `mask`: (height, width) or (height, width, 3), true where a sample is used; with
        several scenes a sequence. Pixels that see no surface are never used.
    - `weights`: relative inverse variances, shaped as `mask`; 0 leaves a sample out.
    - `noise`: standard deviation of the sensor's noise in linear light, a number or as
        `weights`; default estimated from the residuals.
    - `film`: how light became numbers (clamp, encoding, bits, JPEG), one or one an
        image. By default clamp and rounding are detected in the values: if some are
        exactly 1 and others negative, white was cut off, and negative values count as
        black. The compression of a JPEG file is not detected: [`read_film`][] reads it
        from the file.
    - `loss`: `"linear"`, `"huber"`, `"soft_l1"`, `"cauchy"`, `"tukey"`, or an
        [`AbstractLoss`][].
    - `max_steps`: limit on the solver's steps, in each of its passes.

    **Returns:** a [`Fit`][]. Numerical failure is reported in its `converged` and
    `warnings`; nothing is raised.

    **Raises:** `ValueError` that names the argument: wrong shapes, NaN or infinite
    pixels, a mask that leaves nothing, no more samples than unknowns, ambient and
    emission both unknown where they are degenerate; arrays that JAX traces
    (see [`refit`][] for derivatives of a fit).
    """
    single = isinstance(scene, Scene)
    if not single and isinstance(image, Iterable):
        # The images are read twice, which a generator does not allow.
        image = list(image)
    untraced(
        "fit once outside, and differentiate refit(fit, scene, image), which starts "
        "from that fit",
        scene=scene,
        image=image,
        known=known,
        bounds=bounds,
        fixed=fixed,
        ties=ties,
        priors=priors,
        uncertain=list((uncertain or {}).values()),
        mask=mask,
        weights=weights,
        noise=noise,
    )
    specification = Specification(
        unknowns=unknowns,
        per_channel=per_channel,
        per_image=per_image,
        known=known,
        bounds=bounds,
        fixed=fixed,
        ties=ties,
        priors=priors,
        uncertain=uncertain,
        film=film,
        loss=loss,
        max_steps=max_steps,
    )
    data = {"mask": mask, "weights": weights, "noise": noise}
    found = _fit_once(specification, scene, image, **data)

    def fit_again(images: tuple[np.ndarray, ...], film: Film) -> Fit:
        other = dataclasses.replace(specification, film=film)
        same = data | {"noise": None}
        return _fit_once(other, scene, images[0] if single else images, **same)

    return with_encoding_doubts(found, fit_again)


def _fit_once(
    specification: Specification,
    scene: Scene | Sequence[Scene],
    image: Any,
    *,
    mask: Any,
    weights: Any,
    noise: Any,
) -> Fit:
    """The fit of checked options, whose warnings do not compare encodings."""
    single, max_steps = isinstance(scene, Scene), specification.max_steps
    setting = set_up(
        specification, scene, image, mask=mask, weights=weights, noise=noise
    )
    layout, sources, films = setting.unknowns, setting.sources, setting.films
    plateau = find_plateau([source.used() for source in sources])
    seen, loss = seen_pixels(sources), specification.loss
    near, most = (ROBUST_NEAR, ROBUST_SUBSET) if loss.robust else (NEAR, SUBSET)
    looks = guesses = None
    if moves_lights(layout):
        looks = [look(*one) for one in zip(sources, seen, strict=True)]
        guesses = guess_places(layout, looks, sources)
    bright = None if looks is None else [one.excess for one in looks]
    few = choose_few(sources, seen, near, most, bright)
    found = search(
        None if few is None else gather(sources, few),
        lambda: gather(sources, seen),
        layout,
        loss,
        films[0].clamp,
        noise is not None,
        max_steps,
        guesses,
    )
    rival = found.rival
    found, sources, at_edges = keep_off_edges(
        found, sources, seen, noise is not None, max_steps
    )
    side = max(tile_side(*source.mask.shape) for source in sources)
    noise_given, drawn = noise is not None, None
    if any(film.jpeg is not None for film in films):
        found, sources, drawn = restore(
            found, sources, films, noise_given, max_steps, side
        )
    found = dataclasses.replace(found, y=polish(found.problem, found.y))
    setting = dataclasses.replace(setting, sources=sources)
    given = {"mask": mask, "weights": weights, "noise": noise}
    # Directions are now relative to those of the best start.
    layout = found.problem.unknowns
    # JAX dispatches these asynchronously, until a value is read.
    in_user_units = in_units(layout, found.y)
    scenes = layout.scenes(in_user_units[0], tuple(source.scene for source in sources))
    fitted_images = [
        _fitted_image(setting, k, scene, in_user_units[0], found, side)
        for k, scene in enumerate(scenes)
    ]
    sums = sandwich_sums(found.problem, found.y)
    return summarize(
        found,
        in_user_units,
        sums,
        specification=specification,
        films=films,
        scenes=scenes,
        # Copies, since the caller may change the arrays.
        photographs=[
            np.array(one, found.y.dtype) for one in ([image] if single else image)
        ],
        images=fitted_images,
        side=side,
        single=single,
        noise_given=noise_given,
        arrays=tuple(name for name, value in given.items() if not is_number(value)),
        at_edges=at_edges,
        plateau=plateau,
        drawn=drawn,
        rival=rival,
    )


def _fitted_image(
    setting: FitData,
    which: int,
    scene: Scene,
    entries: Array,
    found: SearchResult,
    side: int,
) -> FittedImage:
    """Fitted image and residuals of one image, and sums over tiles of `side` pixels."""
    source, unknowns = setting.sources[which], setting.unknowns
    mask, view = source.mask, source.pixels
    if unknowns.of_scene:
        mask, view = resolve_terms(scene)
    step = None if source.step is None else jnp.asarray(source.step)
    fitted, residual, tiles = _expose(
        Measured(source.image, source.weight, step, found.problem.sigma),
        mask,
        view,
        unknowns,
        entries,
        np.int32(which),
        scene.background,
        found.problem.loss,
        setting.films[which].clamp,
        side,
    )
    return FittedImage(fitted, residual, tiles)


@program("clamp", "side")
def _expose(
    measured: Measured,
    mask: Array,
    view: PixelTerms,
    unknowns: Unknowns,
    entries: Array,
    which: np.int32 | Int[Array, ""],
    background: Array,
    loss: AbstractLoss,
    clamp: bool,
    side: int,
) -> tuple[Array, Array, Tiles]:
    material = unknowns.as_material(entries)
    exposure = unknowns.exposures(entries)[which]
    light = view.radiance(material) * exposure
    basis = view.basis(material.shininess)
    shapes = basis[..., 1], basis[..., 2]
    tiles = sum_over_tiles(measured, light, *shapes, loss, clamp, side)
    light = jnp.clip(light, 0, 1) if clamp else light
    fitted = jnp.where(mask[..., None], light, background[None, None])
    residual = jnp.where(measured.weight > 0, measured.image - fitted, 0)
    return fitted, residual, tiles
