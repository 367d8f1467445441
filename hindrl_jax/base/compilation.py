"""How programs are compiled: in float32, soon, and kept on disk, so that a second start takes seconds."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import jax
from jax.experimental.compilation_cache import compilation_cache

P = ParamSpec("P")
R = TypeVar("R")


def in_float32(function: Callable[P, R]) -> Callable[P, R]:
    """The function, in which JAX computes with 32 bits, as all of this project does, also where it is set to 64 (JAX_ENABLE_X64)."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return wrapped


def without_fusion_emitters() -> dict[str, Any]:
    """Options with which XLA compiles a program in half the time on CPUs, without its newer code that fuses operations.

    What plays episodes runs as fast or faster then, and so does cloning; the gradient steps of reinforcement learning run slower
    (`benchmarks/compilation.py`). There are none where XLA_FLAGS says something about it, and from jaxlib 0.11.1 on, whose XLA has no such option.
    """
    option = "xla_cpu_use_fusion_emitters"
    is_chosen = option in os.environ.get("XLA_FLAGS", "")
    return {} if is_chosen or jax.default_backend() != "cpu" or jax.__version_info__ >= (0, 11, 1) else {option: False}


def keep_compiled_programs() -> None:
    """Keeps compiled programs in the user's cache folder, unless the user has chosen another one or turned that off.

    JAX_COMPILATION_CACHE_DIR names another folder, JAX_ENABLE_COMPILATION_CACHE=false turns it off.
    """
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]  # defined while jax starts
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hindrl_jax"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    compilation_cache.reset_cache()  # JAX remembers from its first program on that it has none
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
