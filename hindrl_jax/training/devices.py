"""The seed axis spread over devices. Seeds never talk to each other: every device runs the same program on its own share of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import psutil
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hindrl_jax.base.errors import UserError

_SEEDS = PartitionSpec("seed")


def seed_mesh(num_seeds: int) -> Mesh:
    """The devices that share S seeds: as many of each host as divide its seeds evenly.

    Raises:
      UserError: if the hosts cannot share the seeds evenly.
    """
    hosts = jax.process_count()
    if num_seeds % hosts:
        raise UserError(f"{num_seeds} seeds cannot be shared evenly between {hosts} hosts: make --seeds a multiple of {hosts}")
    of_each = [[device for device in jax.devices() if device.process_index == host] for host in range(hosts)]
    used = max(n for n in range(1, min(map(len, of_each)) + 1) if num_seeds // hosts % n == 0)
    return Mesh(np.asarray([device for devices in of_each for device in devices[:used]]), ("seed",))


def over_seeds(function: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """Maps a function of one seed over the leading axis (S, ...) of its arguments, each device computing its own seeds."""

    def mapped(*arguments: Any) -> Any:
        if jax.tree.leaves(arguments)[0].shape[0] > 1:
            return jax.vmap(function)(*arguments)
        # One seed alone needs no batching, which takes as long to trace as the function itself.
        result = function(*jax.tree.map(lambda leaf: leaf[0], arguments))
        return jax.tree.map(lambda leaf: leaf[None], result)

    if mesh.size == 1:
        return mapped
    # The check would ask every loop inside to say which of its constants vary between devices; there is no communication to get wrong.
    return jax.shard_map(mapped, mesh=mesh, in_specs=_SEEDS, out_specs=_SEEDS, check_vma=False)


def by_seed(mesh: Mesh) -> NamedSharding:
    """Where arrays (S, ...) lie on the mesh, for `jax.device_put`."""
    return NamedSharding(mesh, _SEEDS)


def shapes_on(tree: Any, mesh: Mesh) -> Any:
    """Shapes and dtypes of a tree with leaves (S, ...), placed on the mesh; to compile a program before its arguments exist."""
    sharding = by_seed(mesh)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree)


def spread(tree: Any, mesh: Mesh) -> Any:
    """Puts numpy arrays (S, ...), the same on every host, onto the devices; each host hands over the seeds of its own."""
    sharding = by_seed(mesh)
    return jax.tree.map(lambda leaf: jax.make_array_from_callback(leaf.shape, sharding, lambda index: leaf[index]), tree)


def gather(tree: Any) -> Any:
    """Numpy arrays (S, ...) of all seeds, on every host."""
    return jax.device_get(tree) if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)


def tree_bytes(tree: Any) -> int:
    """What the arrays of a tree, or their shapes, take in memory."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def free_memory(mesh: Mesh) -> int | None:
    """Bytes that the mesh's devices of this host have free, all together; None where they do not say."""
    devices = [device for device in mesh.devices.flat if device.process_index == jax.process_index()]
    if devices[0].platform == "cpu":
        return _free_host_memory()
    stats = [device.memory_stats() for device in devices]
    return sum(s["bytes_limit"] - s["bytes_in_use"] for s in stats) if all(s and "bytes_limit" in s for s in stats) else None


def _free_host_memory() -> int:
    """What the machine has free, and no more than the control group of this process, a container for one, may still take (Linux)."""
    free, group = psutil.virtual_memory().available, Path("/sys/fs/cgroup")
    try:
        limit, used = int((group / "memory.max").read_text()), int((group / "memory.current").read_text())
        kept_files = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())["inactive_file"]
        return min(free, limit - used + int(kept_files))
    except (OSError, ValueError, KeyError):  # no such group, or no limit, which is the word max
        return free
