"""Strict settings for every test: no silent broadcasting between ranks, no random key consumed twice.

The programs of the fast tests are small and run for an instant, so the compiler is set to optimise them little, also in processes that
tests start.
"""

import os

import jax

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)


def pytest_configure(config):
    if "not slow" in config.option.markexpr:
        quick = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {quick}".strip()  # read when JAX makes its first array
