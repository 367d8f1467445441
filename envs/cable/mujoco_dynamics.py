"""Arms and cables in C MuJoCo: the reference. Many episodes are stepped side by side, on all cores, by `mujoco.rollout`.

A control step is a pure function all the same: all that MuJoCo needs is in the state, and a callback from the compiled program hands it over. So
training, evaluation and films work as with the other back ends, though not on a GPU's terms.

MuJoCo's solver begins each control step anew, without the accelerations of the step before (`qacc_warmstart`), with which it would end elsewhere only
by rounding.
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
    shape = jax.ShapeDtypeStruct(physics.positions.shape, jnp.float32)
    positions, velocities = jax.pure_callback(_roll, (shape, shape), physics.positions, physics.velocities, controls, vmap_method="broadcast_all")
    return Joints(positions=positions, velocities=velocities)


def _roll(positions: Any, velocities: Any, controls: Any) -> tuple[np.ndarray, np.ndarray]:
    """Joints and their velocities (..., Q) after a control step; controls (..., 18)."""
    shape, size = positions.shape, positions.shape[-1]
    positions, velocities, controls = (np.asarray(array, np.float64).reshape(-1, array.shape[-1]) for array in (positions, velocities, controls))
    batch = np.concatenate([np.zeros((len(positions), 1)), positions, velocities], axis=1)  # MuJoCo's full physics state begins with the time
    usable = np.isfinite(batch).all(axis=1) & np.isfinite(controls).all(axis=1)
    after = np.full((len(batch), 2 * size), np.nan, np.float32)
    if usable.any():
        with _LOCK:
            model, pool, data = _pool((size - 24) // 4)
            states, _ = pool.rollout(model, data, batch[usable], controls[usable][:, None], nstep=position_actuators.SUBSTEPS, skip_checks=False)
        after[usable] = states[:, -1, 1:]
    return after[:, :size].reshape(shape), after[:, size:].reshape(shape)


@functools.cache
def _pool(num_links: int) -> tuple[Any, Any, list[Any]]:
    """The model, its threads, and the memory of each."""
    mujoco = panda.import_mujoco()
    from mujoco.rollout import Rollout

    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return model(num_links), Rollout(nthread=threads), [mujoco.MjData(model(num_links)) for _ in range(threads)]
