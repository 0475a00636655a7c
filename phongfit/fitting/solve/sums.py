r"""The Jacobian of a fit without its zeros, and $J^\top J$ from it.

A reflectance of one material and channel affects only the samples of that material and
channel. So one derivative serves all unknowns that have no sample in common: ten
unknowns of an RGB image need four, and those of 24 materials need no more.

??? cite "Source"
    Curtis, Powell and Reid, *On the estimation of sparse Jacobian matrices*, J. Inst.
    Maths Applics 13, 1974.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS
from phongfit.fitting.problem.problem import Evaluation, Problem
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.programs import program


def colours(unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Colouring of the unknowns: unknowns of one colour share a derivative.

    **Returns:**

    - (colours, n): ones for the unknowns of a colour.
    - (groups, 3, colours, n): one where samples of that group and channel depend on
        this unknown of the colour.
    """
    cells = moved_samples(unknowns)
    taken: list[np.ndarray] = []
    colour_of = np.zeros(len(cells), int)
    for k, cell in enumerate(cells):
        free = [c for c, used in enumerate(taken) if not (used & cell).any()]
        if not free:
            taken.append(np.zeros_like(cell))
            free = [len(taken) - 1]
        colour_of[k] = free[0]
        taken[free[0]] |= cell
    tangents = np.zeros((len(taken), len(cells)))
    tangents[colour_of, np.arange(len(cells))] = 1
    select = tangents * np.moveaxis(cells, 0, -1)[:, :, None, :]
    return tangents, select


def moved_samples(unknowns: Unknowns) -> np.ndarray:
    """Groups and channels of samples that depend on each unknown, (n, groups, 3)."""
    images = unknowns.images if unknowns.differs_between_images else 1
    size = unknowns.lower.size
    cells = np.zeros((size, unknowns.materials, images, 3), bool)
    names, rows = unknowns.table.parameter, unknowns.table.row
    per_image = unknowns.table.per_image
    for entry, source in enumerate(unknowns.source):
        if unknowns.fixed[entry]:
            continue
        channel = unknowns.table.channel[entry]
        channels = slice(None) if channel < 0 else slice(channel, channel + 1)
        material = slice(None)
        if names[entry] in MATERIAL_PARAMETERS and unknowns.materials > 1:
            material = slice(rows[entry], rows[entry] + 1)
        image = slice(None)
        if per_image[entry]:
            image = slice(rows[entry], rows[entry] + 1)
        index = unknowns.y_index[source]
        count = 2 if unknowns.table.form[source] == "direction" else 1
        cells[index : index + count, material, image, channels] = True
    return cells.reshape(size, -1, 3)


# A GPU would otherwise multiply in reduced precision.
EXACT = jax.lax.Precision.HIGHEST


class Jacobian(eqx.Module):
    """Derivatives of the samples' residuals, one for each colour of unknowns."""

    local: Float[Array, "3 colours samples"]
    priors: Float[Array, "priors n"]
    select: Float[Array, "groups 3 colours n"]
    member: Float[Array, "materials samples"] | None
    images: int = eqx.field(static=True)

    def gram(self, weight: Float[Array, "3 samples"] | None = None) -> Array:
        r"""$J^\top W J$ of the samples, (n, n)."""
        if self._grouped:
            return self.grams(weight)[0]
        left = self.local if weight is None else self.local * weight[:, None]
        products = jnp.einsum("ckn,cln->ckl", left, self.local, precision=EXACT)
        return self._spread(products[None, :, None])[0]

    def grams(self, *weights: Float[Array, "3 samples"] | None) -> Array:
        """$J^\top W J$ for several weights at once, (weights, n, n)."""
        one = jnp.ones_like(self.local[:, 0])
        each = [one if weight is None else weight for weight in weights]
        return self._spread(self._products(jnp.stack(each, axis=1), self.local))

    def pull(self, residual: Float[Array, "3 samples"]) -> Float[Array, " n"]:
        r"""$J^\top r$ of the samples."""
        if self._grouped:
            one = jnp.ones_like(residual[:, None])
            sums = self._products(one, residual[:, None])[:, :, 0, :, 0]
        else:
            sums = jnp.einsum("ckn,cn->ck", self.local, residual, precision=EXACT)[None]
        return jnp.einsum("gcki,gck->i", self.select, sums, precision=EXACT)

    def change(self, step: Float[Array, " n"]) -> Float[Array, "3 samples"]:
        """$J p$ of the samples, for a step p."""
        shares = jnp.einsum("gcki,i->gck", self.select, step, precision=EXACT)
        if not self._grouped:
            return jnp.einsum("ckn,ck->cn", self.local, shares[0], precision=EXACT)
        return jnp.einsum(
            "ckn,gck,gn->cn", self.local, shares, self.members(), precision=EXACT
        )

    def members(self) -> Float[Array, "groups samples"]:
        """One where a sample belongs to a group: a material, or one in an image."""
        count, kind = self.local.shape[-1], self.local.dtype
        material = jnp.ones((1, count), kind) if self.member is None else self.member
        own = np.repeat(np.eye(self.images), count // self.images, axis=1)
        each = material[:, None] * jnp.asarray(own, kind)[None]
        return each.reshape(-1, count)

    @property
    def _grouped(self) -> bool:
        """Whether there is more than one group."""
        return self.member is not None or self.images > 1

    def _spread(
        self, products: Float[Array, "groups 3 weights colours colours"]
    ) -> Float[Array, "weights n n"]:
        """Convert sums of products of colours to those of unknowns."""
        half = jnp.einsum("gcwkl,gclj->gcwkj", products, self.select, precision=EXACT)
        return jnp.einsum("gcki,gcwkj->wij", self.select, half, precision=EXACT)

    def _products(
        self,
        weights: Float[Array, "3 weights samples"],
        others: Float[Array, "3 rows samples"],
    ) -> Float[Array, "groups 3 weights colours rows"]:
        """Sums over each group's samples of colours times weights times others.

        Image by image, since each has its own samples, and block by block, so that
        weighted values stay in the processor's cache.
        """
        _, colours, count = self.local.shape
        materials = 1 if self.member is None else len(self.member)
        rows, size = materials * weights.shape[1] * colours, count // self.images
        block = _block(size, rows)

        def add(total: Array, begin: Array) -> tuple[Array, None]:
            def part(whole: Array) -> Array:
                return jax.lax.dynamic_slice_in_dim(whole, begin, block, axis=-1)

            # As rows of one matrix, since further axes would be slow.
            left = part(weights)[:, :, None] * part(self.local)[:, None]
            left = left.reshape(3, -1, block)
            if self.member is not None:
                each = part(self.member)[None, :, None] * left[:, None]
                left = each.reshape(3, -1, block)
            more = jnp.einsum("ckn,cln->ckl", left, part(others), precision=EXACT)
            return total + more, None

        def of_image(begin: Array) -> Array:
            none = jnp.zeros((3, rows, others.shape[1]), self.local.dtype)
            return jax.lax.scan(add, none, begin + jnp.arange(0, size, block))[0]

        total = jax.lax.map(of_image, jnp.arange(0, count, size))
        groups = (materials, weights.shape[1], colours, others.shape[1])
        total = jnp.moveaxis(total.reshape(self.images, 3, *groups), 2, 0)
        return total.reshape(-1, *total.shape[2:])

    def columns(self) -> np.ndarray:
        """The whole matrix, (n, 3, samples), in double precision."""
        local, select = np.asarray(self.local, float), np.asarray(self.select, float)
        if not self._grouped:
            return np.einsum("cki,ckn->icn", select[0], local)
        group = np.argmax(np.asarray(self.members()), axis=0)
        return np.einsum("ncki,ckn->icn", select[group], local)


def _block(count: int, rows: int) -> int:
    """Size of a block of samples: a power of two, small but without too many blocks."""
    block = count & -count
    while block > 2048 and count < 64 * block:
        block //= 2
    # With many rows, smaller blocks limit the memory.
    while block > 64 and rows * block > 2**20:
        block //= 2
    return block


class Linearization(eqx.Module):
    """Residuals of samples and priors at a point, and their derivatives."""

    at: Evaluation
    priors: Float[Array, " priors"]
    jacobian: Jacobian


def linearize(problem: Problem, y: Float[Array, " n"]) -> Linearization:
    """Residuals of samples and priors, and their Jacobian."""
    tangents, select = colours(problem.unknowns)
    kind = y.dtype
    light, push = jax.linearize(problem.light, y)
    # The film acts on each sample alone, so one slope serves all unknowns.
    at = problem.measure(light)
    moved = jax.vmap(push, out_axes=1)(jnp.asarray(tangents, kind))
    local = moved * at.slope[:, None]
    priors = problem.unknowns.prior_residual(y)
    slopes = jax.jacfwd(problem.unknowns.prior_residual)(y)
    unknowns, member = problem.unknowns, None
    if unknowns.materials > 1:
        member = problem.members().astype(kind)
    images = unknowns.images if unknowns.differs_between_images else 1
    jacobian = Jacobian(local, slopes, jnp.asarray(select, kind), member, images)
    return Linearization(at, priors, jacobian)


linearized = program()(linearize)
"""[`linearize`][], compiled alone."""


def in_double(add: Callable[..., Any], *parts: Any) -> Any:
    """Sums over the samples, added up in double precision."""

    def wide(leaf: Any) -> Any:
        inexact = eqx.is_inexact_array(leaf)
        return jnp.asarray(np.asarray(leaf), float) if inexact else leaf

    with jax.enable_x64(True):
        return add(*jax.tree.map(wide, parts))


class ResidualSums(eqx.Module):
    """Sums over the residuals at a point, for an estimate of the noise level.

    **Arguments:**

    - `squares`: weighted sum of squared differences in linear light.
    - `share`: number of samples, each times the fraction of its variance after
        clipping.
    - `floor`: noise level at and below which residuals are rounding errors.
    """

    squares: Float[Array, ""]
    share: Float[Array, ""]
    floor: Float[Array, ""]


class Sums(eqx.Module):
    """Cost, gradient and curvature for a Gauss-Newton method, at one point."""

    hessian: Float[Array, "n n"]
    gradient: Float[Array, " n"]
    cost: Float[Array, ""]
    residual_sums: ResidualSums


def sums(problem: Problem, y: Float[Array, " n"]) -> Sums:
    r"""Cost $\sum \rho(r^2)$, half its gradient, and half its curvature.

    The curvature is $J^\top W J$ with $W = \psi'(r)$, but at least a tenth of the usual
    weight $\psi(r)/r$, where the loss is not convex.
    """
    return add_up(problem, linearize(problem, y))


@program()
def add_up(problem: Problem, found: Linearization) -> Sums:
    """[`sums`][] of a linearization."""
    residual, priors, jacobian = found.at.residual, found.priors, found.jacobian
    slopes, loss = jacobian.priors, problem.loss
    if not loss.robust:
        hessian, gradient = jacobian.gram(), jacobian.pull(residual)
        cost = jnp.sum(residual**2)
    else:
        score, bend = loss.score(residual)
        usual = score / jnp.where(residual == 0, 1, residual)
        hessian = jacobian.gram(jnp.maximum(bend, 0.1 * usual))
        gradient = jacobian.pull(score)
        cost = jnp.sum(loss.root(residual) ** 2)
    at = found.at
    squares = jnp.sum(at.difference**2 * problem.samples.weight)
    return Sums(
        hessian + slopes.T @ slopes,
        gradient + slopes.T @ priors,
        cost + jnp.sum(priors**2),
        ResidualSums(squares, jnp.sum(at.variance_share), at.floor),
    )
