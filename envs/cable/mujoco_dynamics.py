"""Arms and cables in C MuJoCo: the reference. Many episodes are stepped side by side, on all cores, by `mujoco.rollout`.

A control step is a pure function all the same: all that MuJoCo needs is in the state, and a callback from the compiled program hands it over. So
training, evaluation and films work as with the other back ends, though not on a GPU's terms.

Its solver begins each control step with the accelerations with which the last one ended, taken from the velocities, since `rollout` does not say
where the solver itself ended (`qacc_warmstart`).
"""

from __future__ import annotations

import functools
import os
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import chains
from hindrl_jax.envs.cable.chains import Joints, compact, completed, scene, start
from hindrl_jax.envs.cable.model import model
from hindrl_jax.envs.panda import position_actuators

__all__ = ["compact", "completed", "control_step", "scene", "start"]

_LOCK = threading.Lock()  # one batch at a time, whichever of JAX's devices asks


def control_step(physics: Joints, rest: Array, finger_targets: Array, command: Array) -> Joints:
    """One control step: 10 substeps of MuJoCo. Arguments are those of `closed_form.control_step`.

    What is not finite stays so, and MuJoCo never sees it.
    """
    controls = chains.controls(physics, rest, finger_targets, command)
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32), physics)
    return jax.pure_callback(_roll, shapes, physics, controls, vmap_method="broadcast_all")


def _roll(physics: Any, controls: Any) -> Any:
    """Joints, leaves (..., Q), after a control step; controls (..., 18)."""
    shape, size = physics.positions.shape, physics.positions.shape[-1]
    given = (physics.positions, physics.velocities, physics.accelerations, controls)
    positions, velocities, accelerations, controls = (np.asarray(array, np.float64).reshape(-1, array.shape[-1]) for array in given)
    batch = np.concatenate([np.zeros((len(positions), 1)), positions, velocities], axis=1)  # MuJoCo's full physics state begins with the time
    usable = np.isfinite(np.concatenate([batch, accelerations, controls], axis=1)).all(axis=1)
    after = np.full((3, len(batch), size), np.nan, np.float32)
    if usable.any():
        with _LOCK:
            model, pool, data = _pool(chains.num_links(physics))
            options = {"nstep": position_actuators.SUBSTEPS, "initial_warmstart": accelerations[usable]}
            states, _ = pool.rollout(model, data, batch[usable], controls[usable][:, None], **options)
        speeds = states[:, -2:, 1 + size :]
        after[:, usable] = states[:, -1, 1 : 1 + size], speeds[:, 1], (speeds[:, 1] - speeds[:, 0]) / position_actuators.SUBSTEP
    positions, velocities, accelerations = after.reshape(3, *shape)
    return Joints(positions=positions, velocities=velocities, accelerations=accelerations)


@functools.cache
def _pool(num_links: int) -> tuple[Any, Any, list[Any]]:
    """The model, its threads, and the memory of each."""
    mujoco = panda.import_mujoco()
    from mujoco.rollout import Rollout

    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return model(num_links), Rollout(nthread=threads), [mujoco.MjData(model(num_links)) for _ in range(threads)]
