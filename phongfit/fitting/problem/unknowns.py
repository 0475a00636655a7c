"""The unknowns of a fit as one vector, and back.

The solver sees every unknown at order 1 and inside a box: reflectances as they are, an
exponent as its logarithm, numbers of the scene relative to their first values, a
direction as two coordinates around a base, a rotation as three angles from its start.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.charts import on_sphere, turned
from phongfit.fitting.problem.parameters import (
    EXPOSURE,
    MATERIAL_PARAMETERS,
    Entries,
    Parameter,
    is_of_model,
    is_of_scene,
    list_entries,
    moves_geometry,
    with_arrays,
)
from phongfit.material import Material
from phongfit.programs import program
from phongfit.scene import Scene


class Unknowns(eqx.Module):
    r"""The unknown parameters, their ties and priors, and the solver's box.

    The numbers of all parameters, one after the other, are the *entries*, in the user's
    units. An entry has its own number in the solver's vector y, is tied to another's or
    is fixed: $\theta_i = o_i + c_i\,\phi_{s(i)}(y)$.
    """

    parameters: tuple[Parameter, ...] = eqx.field(static=True)
    materials: int = eqx.field(static=True)
    images: int = eqx.field(static=True)
    # The entry to which each number of y belongs; for a direction, its first.
    entry_of_y: tuple[int, ...] = eqx.field(static=True)
    # For each entry: the entry that it is tied to (or itself), and the index in y of
    # its first number.
    source: tuple[int, ...] = eqx.field(static=True)
    y_index: tuple[int, ...] = eqx.field(static=True)
    fixed: tuple[bool, ...] = eqx.field(static=True)
    has_prior: tuple[bool, ...] = eqx.field(static=True)
    # Whether a change of unknowns changes the lighting of points, not only lobes.
    relights: bool = eqx.field(static=True)
    known: Material
    factor: Float[Array, " entries"]
    offset: Float[Array, " entries"]
    scale: Float[Array, " entries"]
    # Base directions of the unknown directions, and two unit vectors perpendicular to
    # each.
    base: Float[Array, "directions 3"]
    across: Float[Array, "directions 2 3"]
    # First values of the unknown rotations.
    turn: Float[Array, "rotations 3 3"]
    prior_mean: Float[Array, " entries"]
    prior_deviation: Float[Array, " entries"]
    # Whitening matrix of the entries with a prior.
    prior_root: Float[Array, "priors priors"]
    # y of the values in the scenes; parameters of the material have no first value.
    start: Float[Array, " n"]
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters' names."""
        return tuple(parameter.name for parameter in self.parameters)

    @functools.cached_property
    def sought(self) -> tuple[str, ...]:
        """Names of the parameters that a result lists: all but nuisances."""
        return tuple(one.name for one in self.parameters if not one.nuisance)

    @property
    def table(self) -> Entries:
        """The entries of all parameters, with their properties as columns."""
        return list_entries(self.parameters)

    @functools.cached_property
    def y_nuisance(self) -> np.ndarray:
        """True for numbers of y that belong to nuisance parameters."""
        return self.table.nuisance[self.y_entry]

    @functools.cached_property
    def reported(self) -> np.ndarray:
        """Entries that a result lists: neither fixed nor nuisances."""
        return np.flatnonzero(~np.array(self.fixed) & ~self.table.nuisance)

    @functools.cached_property
    def labels(self) -> tuple[str, ...]:
        """A name for every reported entry: `diffuse.red`, or `ambient[2].red`."""
        return tuple(self.table.label[self.reported].tolist())

    @functools.cached_property
    def tied(self) -> np.ndarray:
        """True for reported entries that are tied to another one."""
        return ~self._own[self.reported]

    @functools.cached_property
    def bounds(self) -> np.ndarray:
        """(reported, 2): lower and upper bounds in the user's units."""
        edges = np.stack([self.lower, self.upper], axis=-1).astype(float)
        edges = edges[np.array(self.y_index)]
        scale = np.asarray(self.scale, float)[:, None]
        forms = self.table.form[:, None]
        # Only logarithms are exponentiated, since other entries could overflow.
        powers = np.exp(np.where(forms == "logarithm", edges, 0))
        edges = np.where(forms == "logarithm", powers, scale * edges)
        edges = np.where(forms == "direction", [[-1.0, 1.0]], edges)
        factor, offset = (np.asarray(a, float) for a in (self.factor, self.offset))
        followed = edges[np.array(self.source)][self.reported]
        with np.errstate(invalid="ignore"):
            followed = followed * factor[self.reported, None]
        # A factor of 0 gives 0 also for infinite bounds.
        followed = np.where(np.isnan(followed), 0, followed)
        edges = np.sort(offset[self.reported, None] + followed, axis=1)
        # In single precision exp(log 1000) is 1000.00012.
        digits = 6 if self.lower.dtype == np.float32 else 14
        values, place = np.unique(edges, return_inverse=True)
        values = np.array([float(f"{x:.{digits}g}") for x in values])
        return values[place.reshape(edges.shape)]

    @functools.cached_property
    def y_entry(self) -> np.ndarray:
        """The entry to which each number of y belongs; for a direction, its first."""
        return np.array(self.entry_of_y)

    @functools.cached_property
    def _own(self) -> np.ndarray:
        """True for entries that are not tied to another one."""
        return np.arange(len(self.source)) == np.array(self.source)

    @functools.cached_property
    def n_priors(self) -> int:
        """Number of priors, without those of nuisances."""
        return int(np.count_nonzero(np.array(self.has_prior)[self.reported]))

    @functools.cached_property
    def y_parameter(self) -> np.ndarray:
        """The name of the parameter that each number of y belongs to."""
        return self.table.parameter[self.y_entry]

    @functools.cached_property
    def y_material(self) -> np.ndarray:
        """Index of the material to which each number of y belongs; 0 if to none."""
        rows = np.where(
            np.isin(self.table.parameter, MATERIAL_PARAMETERS), self.table.row, 0
        )
        return rows[self.y_entry]

    @functools.cached_property
    def y_channel(self) -> np.ndarray:
        """The channel that each number of y belongs to; −1 where shared by all."""
        return self.table.channel[self.y_entry]

    @functools.cached_property
    def y_labels(self) -> tuple[str, ...]:
        """A label for every number of y, such as `log_shininess` for a logarithm."""
        return tuple(
            f"log_{label}" if logarithmic else label
            for label, logarithmic in zip(
                self.free_labels, self.logarithmic, strict=True
            )
        )

    @functools.cached_property
    def free_labels(self) -> tuple[str, ...]:
        """Label of the entry of every number of y; one for both of a direction."""
        pairs = zip(*(c[self.y_entry].tolist() for c in self.table[:2]), strict=True)
        return tuple(
            label.removesuffix(".x") if form == "direction" else label
            for label, form in pairs
        )

    @functools.cached_property
    def logarithmic(self) -> np.ndarray:
        """True for numbers of y that are logarithms."""
        return self.table.form[self.y_entry] == "logarithm"

    @functools.cached_property
    def shapes(self) -> np.ndarray:
        """True for numbers of y that shape highlights: exponents, model parameters."""
        own = np.array([is_of_model(name) for name in self.y_parameter], bool)
        closed = np.isfinite(self.lower) & np.isfinite(self.upper)
        return self.logarithmic | (own & np.asarray(closed))

    @functools.cached_property
    def of_scene(self) -> bool:
        """Whether any parameter of the scenes is unknown."""
        return any(is_of_scene(name) for name in self.names)

    @functools.cached_property
    def exposed(self) -> bool:
        """Whether the images' exposures are unknown."""
        return EXPOSURE in self.names

    @functools.cached_property
    def differs_between_images(self) -> bool:
        """Whether there are entries that belong to a single image."""
        return bool(self.table.per_image.any())

    @functools.cached_property
    def moves_geometry(self) -> bool:
        """Whether rays must be traced again whenever unknowns change."""
        return any(moves_geometry(name) for name in self.names)

    @functools.cached_property
    def moves_lights(self) -> bool:
        """Whether lights are sought, so that shadows may move."""
        places = ("position", "direction", "axis")
        return any(is_of_scene(n) and n.endswith(places) for n in self.sought)

    def entries(self, y: Float[Array, " n"]) -> Float[Array, " entries"]:
        """All entries in the user's units."""
        numbers = jnp.where(
            self._own & ~np.array(self.fixed), y[np.array(self.y_index)], 0
        )
        logarithm = self.table.form == "logarithm"
        # Only logarithms are exponentiated, since other entries could overflow.
        powers = jnp.exp(jnp.where(logarithm, numbers, 0))
        own = jnp.where(logarithm, powers, self.scale * numbers)
        first = self.direction_entries
        if first.size:
            index = np.array(self.y_index)[first]
            there = jax.vmap(on_sphere)(
                self.base, self.across, y[index[:, None] + np.arange(2)]
            )
            own = own.at[first[:, None] + np.arange(3)].set(there)
        return self.offset + self.factor * own[np.array(self.source)]

    @functools.cached_property
    def direction_entries(self) -> np.ndarray:
        """Indices of the first entry of each direction."""
        return np.flatnonzero(self.table.form == "direction")[::3]

    def aimed(
        self,
        base: Float[Array, "directions 3"],
        across: Float[Array, "directions 2 3"],
    ) -> "Unknowns":
        """A copy with other base directions for the unknown directions."""
        return dataclasses.replace(self, base=base, across=across)

    def position(self, entries: np.ndarray) -> np.ndarray:
        """The y of these entries, clipped to the box; directions keep their start."""
        own = entries[self.y_entry].astype(float)
        scaled = own / np.asarray(self.scale, float)[self.y_entry]
        logarithm = np.log(np.where(self.logarithmic, np.maximum(own, 1e-30), 1))
        y = np.where(self.logarithmic, logarithm, scaled)
        direction = self.table.form[self.y_entry] == "direction"
        y = np.where(direction, np.asarray(self.start, float), y)
        y = np.clip(y, np.asarray(self.lower), np.asarray(self.upper))
        return y.astype(self.lower.dtype)

    def values(self, y: Float[Array, " n"]) -> Float[Array, " reported"]:
        """Reported entries in the user's units."""
        return self.entries(y)[self.reported]

    def parts(self, entries: Any) -> dict[str, Any]:
        """The entries cut into parameters, each (rows, parts)."""
        ends = np.cumsum([parameter.size for parameter in self.parameters])
        return {
            parameter.name: entries[end - parameter.size : end].reshape(
                len(parameter.rows), -1
            )
            for parameter, end in zip(self.parameters, ends, strict=True)
        }

    def material(self, y: Float[Array, " n"]) -> Material:
        """The material of a vector y."""
        return self.as_material(self.entries(y))

    def as_material(self, entries: Any) -> Material:
        """A material with the unknown parameters from entries in the user's units."""
        parts = {
            n: p for n, p in self.parts(entries).items() if n in MATERIAL_PARAMETERS
        }
        if self.materials == 1:
            # One material: (3,), or () for one number.
            parts = {n: p[0] if p.shape[1] > 1 else p[0, 0] for n, p in parts.items()}
        return eqx.tree_at(
            lambda material: [getattr(material, name) for name in parts],
            self.known,
            [jnp.asarray(part) for part in parts.values()],
        )

    def scenes(self, entries: Any, scenes: tuple[Scene, ...]) -> tuple[Scene, ...]:
        """The scenes with their unknown arrays set from the entries."""
        if not self.of_scene:
            return scenes
        parts = self._scene_parts(entries)

        def of(k: int) -> dict[str, Array]:
            return {n: part[min(k, len(part) - 1)] for n, part in parts.items()}

        return tuple(with_arrays(scene, of(k)) for k, scene in enumerate(scenes))

    def stacked_scenes(self, entries: Any, scenes: Scene, images: int) -> Scene:
        """Scenes, stacked along a first axis, with unknown arrays set from entries."""
        parts = {
            name: jnp.broadcast_to(part, (images, *part.shape[1:]))
            for name, part in self._scene_parts(entries).items()
        }
        return eqx.filter_vmap(with_arrays)(scenes, parts)

    def _scene_parts(self, entries: Any) -> dict[str, Array]:
        """Unknown arrays of the scenes by name: a row for each scene, or for all."""
        parts = {n: p for n, p in self.parts(entries).items() if is_of_scene(n)}
        done = 0
        for parameter in self.parameters:
            if parameter.form == "rotation":
                start = self.turn[done : done + len(parameter.rows)]
                parts[parameter.name] = jax.vmap(turned)(start, parts[parameter.name])
                done += len(parameter.rows)
        return parts

    def exposures(self, entries: Any) -> Float[Array, " images"]:
        """The factor on the light of each image."""
        parts = self.parts(entries)
        if EXPOSURE not in parts:
            return jnp.ones((self.images,), entries.dtype)
        return parts[EXPOSURE].reshape(-1)

    def prior_residual(self, y: Float[Array, " n"]) -> Float[Array, " priors"]:
        """Deviations of the entries from their priors, in standard deviations."""
        wanted = np.flatnonzero(np.array(self.has_prior))
        off = self.entries(y)[wanted] - self.prior_mean[wanted]
        return jnp.matmul(self.prior_root, off, precision="highest")


@program()
def in_units(unknowns: Unknowns, y: Float[Array, " n"]) -> tuple[Array, Array]:
    """All entries in the user's units, and the derivative of those reported in y."""
    return unknowns.entries(y), jax.jacfwd(unknowns.values)(y)
