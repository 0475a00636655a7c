"""Nuisance parameters: uncertain arrays of the scenes that are not unknowns."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.layout import covariance_of, make_unknowns
from phongfit.fitting.problem.parameters import is_of_model
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.specification import Specification, as_names
from phongfit.fitting.problem.unknowns import Unknowns, in_units
from phongfit.scene import Scene


class Nuisance(NamedTuple):
    """Uncertain parameters of the scenes that are not unknowns of a fit.

    - `unknowns`: the unknowns of the fit, followed by these parameters.
    - `covariance`: covariance of these parameters, in the user's units.
    """

    unknowns: Unknowns
    covariance: Float[np.ndarray, "m m"]

    def beside(self, problem: Problem, y: Float[Array, " n"]) -> tuple[Problem, Array]:
        """A fit's problem and solution, extended by these parameters as unknowns."""
        own, with_own = problem.unknowns, self.unknowns
        count = len(own.base)
        with_own = with_own.aimed(
            jnp.concatenate([own.base, with_own.base[count:]]),
            jnp.concatenate([own.across, with_own.across[count:]]),
        )
        wider = dataclasses.replace(problem, unknowns=with_own, scatter=None)
        return wider, jnp.concatenate([y, with_own.start[len(y) :]])

    def solver_covariance(
        self, y: Float[Array, " n"], size: int
    ) -> Float[np.ndarray, "k k"]:
        """Covariance of these parameters in the solver's units.

        **Arguments:** `y`: vector of all unknowns; `size`: number of the fit's own.
        """
        slope = np.asarray(in_units(self.unknowns, y)[1], float)
        back = np.linalg.pinv(slope[-len(self.covariance) :, size:])
        return back @ self.covariance @ back.T


def make_nuisance(
    asked: Specification, materials: int, scenes: Sequence[Scene]
) -> Nuisance | None:
    """The parameters that are uncertain and not unknown; `None` if there are none.

    **Raises:** `ValueError` that names the entry that is wrong.
    """
    names = tuple(n for n in asked.uncertain_arrays if n not in asked.unknowns)
    if not names:
        return None
    wider = dataclasses.replace(
        asked,
        unknowns=(*asked.unknowns, *names),
        per_channel=(*asked.per_channel, *names),
        # All images show the same material.
        per_image=(*asked.per_image, *(n for n in names if not is_of_model(n))),
        uncertain={},
    )
    unknowns = make_unknowns(wider, materials, scenes)
    sizes = {one.name: one.size for one in unknowns.parameters}
    blocks = [
        covariance_of(key, given, sum(sizes[name] for name in as_names(key)))
        for key, given in asked.uncertain.items()
        if set(as_names(key)) <= set(names)
    ]
    # Imported here, since SciPy takes long to import and few fits need it.
    from scipy.linalg import block_diag

    return Nuisance(unknowns, np.asarray(block_diag(*blocks)))
