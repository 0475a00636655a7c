"""The least-squares problem: residuals in standard deviations."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.problem.noise import (
    arithmetic_floor,
    clipped_mean,
    film_moments,
)
from phongfit.fitting.problem.samples import Channels, Samples, stacked_lit
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.material import Material
from phongfit.programs import program


class Problem(eqx.Module):
    """The samples, unknowns, noise level and loss of a fit.

    `scatter` is the covariance of the scores, divided by the roots of the diagonal of
    JᵀJ, if samples are not independent. `tolerance` is that of [`fit`][].
    """

    samples: Samples
    unknowns: Unknowns
    sigma: Float[Array, ""]
    loss: AbstractLoss
    clamp: bool = eqx.field(static=True)
    scatter: Float[Array, "n n"] | None = None
    tolerance: float | None = eqx.field(static=True, default=None)

    def noise(self) -> Float[Array, "3 n"]:
        """Standard deviation of each sample before rounding, also of those left out."""
        weight = self.samples.weight
        return self.sigma / jnp.sqrt(jnp.where(weight > 0, weight, 1))

    def light(self, y: Float[Array, " n"]) -> Float[Array, "3 samples"]:
        """Linear light, before the film, that the model predicts for each sample."""
        entries = self.unknowns.entries(y)
        light = self.channels(entries).light(self.unknowns.as_material(entries))
        return light * self.exposure(entries)

    def channels(self, entries: Float[Array, " entries"]) -> Channels:
        """Geometry and light of the samples in the scenes with these entries."""
        if not self.unknowns.of_scene:
            return self.samples.channels
        if not self.unknowns.relights:
            (scene,) = self.unknowns.scenes(entries, (self.samples.views[0].scene,))
            return self.samples.channels.shaped_by(scene.specular_model)
        views, stacked = self.samples.views, self.samples.stacked_views()
        if stacked is not None:
            scenes = self.unknowns.stacked_scenes(entries, stacked.scene, len(views))
            return stacked_lit(stacked, scenes)
        scenes = self.unknowns.scenes(entries, tuple(view.scene for view in views))
        return self.samples.lit(scenes)

    def exposure(
        self, entries: Float[Array, " entries"]
    ) -> Float[Array, "1 samples"] | float:
        """Factor on the light of each sample; 1 if exposures are not unknown."""
        if not self.unknowns.exposed:
            return 1.0
        return self.unknowns.exposures(entries)[self.samples.image][None]

    def deviation(self) -> Float[Array, "3 samples"]:
        """Standard deviation of each sample, rounding included."""
        if self.samples.step is None:
            return self.noise()
        return jnp.sqrt(self.noise() ** 2 + self.samples.step**2 / 12)

    def unclipped(self) -> Bool[Array, "3 samples"]:
        """Samples whose residuals show the noise: neither black nor white.

        All used samples, if too few of them are left.
        """
        used, target = self.samples.weight > 0, self.samples.target
        if not self.clamp:
            return used
        inside = used & (target > 0) & (target < 1)
        return jnp.where(jnp.sum(inside) > self.unknowns.lower.size, inside, used)

    def residual(self, y: Float[Array, " n"]) -> Float[Array, "3 samples"]:
        """(model − image) in standard deviations; 0 where a sample is left out."""
        return self.compare(self.light(y))

    def log_likelihood(self, y: Float[Array, " n"]) -> Float[Array, ""]:
        r"""$-\frac12 \sum_i \big(\rho(r_i^2) + \ln 2\pi\sigma_i^2\big)$ of the samples.

        For the linear loss this is the likelihood of normal noise. Clipped samples are
        compared with the mean after clipping, so it is a quasi-likelihood.
        """
        used = self.samples.weight > 0
        share = self.loss.root(self.residual(y)) ** 2
        share += jnp.log(2 * jnp.pi * self.deviation() ** 2)
        return -jnp.sum(jnp.where(used, share, 0)) / 2

    def log_prior(self, y: Float[Array, " n"]) -> Float[Array, ""]:
        """Logarithm of the normal priors, up to a constant; bounds are not included."""
        return -jnp.sum(self.unknowns.prior_residual(y) ** 2) / 2

    def material(self, y: Float[Array, " n"]) -> Material:
        """The material of a vector of unknowns."""
        return self.unknowns.material(y)

    def compare(self, light: Float[Array, "3 samples"]) -> Float[Array, "3 samples"]:
        """Residuals of a predicted light before the film.

        The model's prediction is the mean of what the film shows.
        """
        shown = clipped_mean(light, self.noise()) if self.clamp else light
        difference = (shown - self.samples.target) / self.deviation()
        return jnp.where(self.samples.weight > 0, difference, 0)

    def costs(self, y: Float[Array, " n"]) -> Float[Array, "materials 3"]:
        """Cost of the samples of each material and channel."""
        cost = self.loss.root(self.residual(y)) ** 2
        return self.members().astype(cost.dtype) @ cost.T

    def members(self) -> Bool[Array, "materials samples"]:
        """True where a sample shows a material."""
        index = self.samples.material_index()
        rows = jnp.arange(self.unknowns.materials, dtype=index.dtype)
        return index[None] == rows[:, None]

    def measure(self, light: Float[Array, "3 samples"]) -> "Evaluation":
        """`Evaluation` of the samples for a predicted light before the film."""
        noise, deviation = self.noise(), self.deviation()
        film = film_moments(light, noise, self.clamp)
        used = self.samples.weight > 0
        difference = jnp.where(used, film.mean - self.samples.target, 0)
        return Evaluation(
            difference,
            difference / deviation,
            jnp.where(used, film.slope, 0) / deviation,
            jnp.where(used, film.drift, 0) * noise / deviation,
            noise,
            deviation,
            jnp.where(used, film.variance_share, 0),
            arithmetic_floor(jnp.where(used, self.samples.target, 0)),
        )

    def group(self) -> Int[Array, " samples"]:
        """Group of each sample: its material, and its image if unknowns differ."""
        material = self.samples.material_index()
        if not self.unknowns.differs_between_images:
            return material
        return material * self.unknowns.images + self.samples.image


class Evaluation(eqx.Module):
    """Residuals at a point and their derivatives, for each sample.

    **Fields:**

    - `difference`: model − image in linear light; 0 where a sample is left out.
    - `residual`: the difference in standard deviations.
    - `slope`: derivative of the residual in the model's light.
    - `drift`: derivative of the prediction, in standard deviations, in the logarithm of
        the noise.
    - `noise`, `deviation`: standard deviations before and after rounding.
    - `variance_share`: variance after clipping over that of the noise, 0 … 1.
    - `floor`: noise level at and below which residuals are rounding errors.
    """

    difference: Float[Array, "3 samples"]
    residual: Float[Array, "3 samples"]
    slope: Float[Array, "3 samples"]
    drift: Float[Array, "3 samples"]
    noise: Float[Array, "3 samples"]
    deviation: Float[Array, "3 samples"]
    variance_share: Float[Array, "3 samples"]
    floor: Float[Array, ""]


@program()
def evaluate(problem: Problem, y: Float[Array, " n"]) -> Evaluation:
    """Differences between model and image at a point, and their standard deviations."""
    return problem.measure(problem.light(y))
