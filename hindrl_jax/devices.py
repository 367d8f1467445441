"""The seed axis spread over devices. Seeds never talk to each other: every device runs the same program on its own share of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hindrl_jax.errors import UserError

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


def shapes_on(tree: Any, mesh: Mesh) -> Any:
    """Shapes and dtypes of a tree with leaves (S, ...), placed on the mesh; to compile a program before its arguments exist."""
    sharding = NamedSharding(mesh, _SEEDS)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), tree)


def spread(tree: Any, mesh: Mesh) -> Any:
    """Puts numpy arrays (S, ...), the same on every host, onto the devices; each host hands over the seeds of its own."""
    sharding = NamedSharding(mesh, _SEEDS)
    return jax.tree.map(lambda leaf: jax.make_array_from_callback(leaf.shape, sharding, lambda index: leaf[index]), tree)


def gather(tree: Any) -> Any:
    """Numpy arrays (S, ...) of all seeds, on every host."""
    return jax.device_get(tree) if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)
