"""How a specular model depends on its parameters, from JAX's trace of it."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from phongfit.fitting.problem.parameters import OF_MODEL
from phongfit.reflectance import AbstractSpecular

_UP = np.array([0.0, 0.0, 1.0])


def own_names(model: AbstractSpecular) -> list[str]:
    """Names of the model's float parameters, as unknowns of a fit."""
    found = jax.tree_util.tree_leaves_with_path(eqx.filter(model, eqx.is_inexact_array))
    names = (jax.tree_util.keystr(path).removeprefix(".") for path, _ in found)
    return [OF_MODEL + name for name in names]


def moves_cosine(model: AbstractSpecular) -> bool:
    """Whether the model's parameters change its cosine or its diffuse scale."""
    own, rest = eqx.partition(model, eqx.is_inexact_array)

    def fixed(own: AbstractSpecular) -> Any:
        whole = eqx.combine(own, rest)
        return whole.cosine(*_vectors()), whole.diffuse_scale()

    return _depends(fixed, own)


def takes_exponent(model: AbstractSpecular) -> bool:
    """Whether the lobe depends on the material's exponent."""
    exponent = np.ones((), jnp.result_type(float))
    return _depends(lambda f: model.lobe(model.cosine(*_vectors()), f), exponent)


def check_shape(unknowns: Sequence[str], model: AbstractSpecular) -> None:
    """Check that an unknown exponent shapes the highlight.

    **Raises:** `ValueError` that names the parameters which do, if it does not.
    """
    # Most models have no parameters, and this check would slow a fit down.
    if "shininess" not in unknowns or not jax.tree.leaves(model):
        return
    own = own_names(model)
    if own and not takes_exponent(model):
        raise ValueError(
            f"unknowns: shininess shapes no highlight of this {type(model).__name__}; "
            f"expected {' or '.join(own)} in its place, or neither"
        )


def _vectors() -> list[jax.Array]:
    return [jnp.asarray(_UP, jnp.result_type(float))] * 3


def _depends(function: Callable[[Any], Any], argument: Any) -> bool:
    """Whether any value of a function depends on the arrays of its argument."""
    traced = jax.make_jaxpr(function)(argument).jaxpr
    used = [one for step in traced.eqns for one in step.invars] + list(traced.outvars)
    return any(one is given for one in used for given in traced.invars)
