"""Strict settings for every test: no silent broadcasting between ranks, no random key consumed twice.

Programs here are small and run for an instant, so nearly all of the time goes into compiling them: the compiler is told to take less trouble, in the
processes that tests start, too.
"""

import os

os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true".strip()

import jax

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)
