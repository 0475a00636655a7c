"""The suite runs once in float32 and once in float64: see `python -m tests`."""

import jax
import matplotlib
from hypothesis import settings

matplotlib.use("agg")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compilation makes the first example slow, which says nothing about the code.
settings.register_profile("phongfit", deadline=None, derandomize=True)
settings.load_profile("phongfit")
