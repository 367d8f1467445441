"""Strict settings for every test: no silent broadcasting between ranks, and, where programs are looked at, no random key consumed twice.

Programs of tests are small and run for an instant, so that most of the time goes into compiling them. A program is compiled once for all tests, test
processes and processes that tests start, and kept in `.pytest_cache` for later runs; in the fast tests the compiler is set to optimise it little.
"""

import contextlib
import ctypes
import gc
import mmap
import os
import time
from pathlib import Path

import jax
import jaxlib
import psutil
import pytest
import shared_programs

jax.config.update("jax_numpy_rank_promotion", "raise")

QUICK = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
# Without the emitters, programs compile in a third of the time and memory, and in one piece a seventh sooner than in many. Not every version of the
# compiler knows these two flags, and it stops at one that it does not know.
WHERE_KNOWN = ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
FUNCTIONS = ("core", "envs", "experts")  # folders of tests that call single functions; whole programs are looked at in tests/config
LONGEST = [f"test_{name}.py" for name in ("notebooks", "docs", "devices", "options", "golden", "checkpoints", "solves_a_task")]
ENOUGH = 1e9  # bytes of a test process
KEPT = 14 * 24 * 3600  # seconds after which a compiled program that no test used is deleted


def known_to_the_compiler(flag):
    for library in Path(jaxlib.__file__).parent.glob("libjax_common.*"):
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return content.find(flag.removeprefix("--").partition("=")[0].encode()) >= 0
    return False


def compiled_programs(config):
    """The folder of compiled programs, without those of old."""
    folder = config.cache.mkdir("compiled")
    for program in folder.iterdir():
        with contextlib.suppress(OSError):
            if time.time() - program.stat().st_atime > KEPT:
                program.unlink()
    return folder


def pytest_configure(config):
    if not hasattr(config, "workerinput"):  # the processes of pytest-xdist are given what stands in the environment
        if config.pluginmanager.hasplugin("cacheprovider"):
            os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(compiled_programs(config)))
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        if "not slow" in config.option.markexpr:
            flags = [os.environ.get("XLA_FLAGS", ""), *QUICK, *filter(known_to_the_compiler, WHERE_KNOWN)]
            os.environ["XLA_FLAGS"] = " ".join(flags).strip()  # read when JAX makes its first array
    jax.config.update("jax_compilation_cache_dir", os.environ.get("JAX_COMPILATION_CACHE_DIR"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that no process is left with one at the end."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


def pytest_collection_finish():
    """Equal programs are compiled once. Python looks for garbage less often, and not among modules and tests, which stay: tracing makes many objects
    and hardly any cycles.
    """
    shared_programs.install()
    gc.freeze()
    gc.set_threshold(20_000, 50, 100)


@pytest.fixture(scope="module", autouse=True)
def random_keys_are_consumed_once(request):
    """Takes a quarter of the time of a test that trains, as each call of a compiled program is slow then."""
    jax.config.update("jax_debug_key_reuse", request.path.parent.name in FUNCTIONS)


@pytest.fixture(scope="module", autouse=True)
def memory_is_given_back():
    """A compiled program takes 2 MB, however small, and a process has thousands in the end: it forgets them from time to time, since those that are
    wanted again are on disk. What the compiler has freed lies in pieces that glibc keeps until it is asked for them.
    """
    yield
    if psutil.Process().memory_info().rss > ENOUGH:
        shared_programs.forget()
        jax.clear_caches()
        gc.collect()
    with contextlib.suppress(AttributeError):  # other C libraries have no such function
        ctypes.CDLL(None).malloc_trim(0)
