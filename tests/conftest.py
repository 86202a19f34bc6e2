"""Settings of every test: strict JAX, and a private cache of compiled maps shared by the whole test run."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax

jax.config.update("jax_numpy_rank_promotion", "raise")
