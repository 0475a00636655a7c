"""`fit`: images and geometry in, a material with error bars out."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Unpack

import numpy as np

from phongfit.checks import untraced
from phongfit.edge import checked
from phongfit.fitting.encodings import with_encoding_doubts
from phongfit.fitting.problem.posing import set_up
from phongfit.fitting.problem.specification import (
    Specification,
    SpecificationOptions,
    specified,
)
from phongfit.fitting.result import Fit
from phongfit.fitting.solve.minimum import find_minimum
from phongfit.fitting.summary import describe
from phongfit.rendering.film import Film
from phongfit.scene import Scene

_INSTEAD = (
    "fit once outside, and differentiate refit(fit, scene, image), which starts from "
    "that fit"
)


@checked
def fit(
    scene: Scene | Sequence[Scene],
    image: Any,
    specification: Specification | None = None,
    *,
    mask: Any = None,
    weights: Any = None,
    noise: Any = None,
    **options: Unpack[SpecificationOptions],
) -> Fit:
    r"""The material that explains one or several images, with standard errors.

    Minimises $\sum_i w_i\, \rho\big((I_i(\rho_a, \rho_d, \rho_s, f) - t_i)^2 /
    \sigma^2\big)$ in a box, by a bounded Levenberg-Marquardt solver that starts from
    the best of a scan over $\log f$: no starting guess is needed.

    **Arguments:**

    - `scene`: a scene, or a sequence of scenes (lights, views) of one material.
    - `image`: (height, width, 3) linear light where white is 1, or a sequence of these,
        one a scene.
    - `specification`: all options below but `mask`, `weights` and `noise`, for several
        calls. Those that are given beside it replace its own.
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
    - `tolerance`: the solver ends where a step changes the unknowns (reflectances,
        log f, arrays relative to their first values) and the residuals, relative to
        their root mean square, by less; default $10^{-8}$, or $1.4 \cdot 10^{-5}$ in
        single precision.

    **Returns:** a [`Fit`][]. Numerical failure is reported in its `converged` and
    `warnings`; nothing is raised.

    **Raises:** `ValueError` that names the argument: wrong shapes, NaN or infinite
    pixels, a mask that leaves nothing, no more samples than unknowns, ambient and
    emission both unknown where they are degenerate; arrays that JAX traces
    (see [`refit`][] for derivatives of a fit).
    """
    if not isinstance(scene, Scene) and isinstance(image, Iterable):
        # The images are read twice, which a generator does not allow.
        image = list(image)
    single, data = isinstance(scene, Scene), {"mask": mask, "weights": weights}
    untraced(_INSTEAD, scene=scene, image=image, noise=noise, **data)
    specification = specified(specification, options, _INSTEAD)
    posed = set_up(specification, scene, image, noise=noise, **data)
    found = describe(posed, find_minimum(posed))

    def fit_again(images: tuple[np.ndarray, ...], film: Film) -> Fit:
        other = dataclasses.replace(specification, film=film)
        posed = set_up(other, scene, images[0] if single else images, **data)
        return describe(posed, find_minimum(posed))

    return with_encoding_doubts(found, fit_again)
