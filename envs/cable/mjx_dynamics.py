"""Arms and cables in MJX: MuJoCo's equations in JAX, for GPUs. On a CPU it is slower than C, and takes more than a minute to compile."""

from __future__ import annotations

import functools
from typing import Any

import jax

from hindrl_jax.base.types import Array
from hindrl_jax.envs.cable import chains
from hindrl_jax.envs.cable.chains import Joints, compact, completed, scene, start
from hindrl_jax.envs.cable.model import model
from hindrl_jax.envs.panda import position_actuators
from hindrl_jax.envs.panda.mjx_dynamics import compiler_options, import_mjx

__all__ = ["compact", "compiler_options", "completed", "control_step", "scene", "start"]


@functools.cache
def _model(num_links: int) -> Any:
    with jax.ensure_compile_time_eval():
        return import_mjx().put_model(model(num_links))


def control_step(physics: Joints, rest: Array, finger_targets: Array, command: Array) -> Joints:
    """One control step: 10 substeps of MJX. Arguments are those of `closed_form.control_step`."""
    mjx, on_device = import_mjx(), _model(chains.num_links(physics))
    data = mjx.make_data(on_device).replace(qpos=physics.positions, qvel=physics.velocities, qacc_warmstart=physics.accelerations)
    data = data.replace(ctrl=chains.controls(physics, rest, finger_targets, command))
    data = jax.lax.fori_loop(0, position_actuators.SUBSTEPS, lambda _, data: mjx.step(on_device, data), data)
    return Joints(positions=data.qpos, velocities=data.qvel, accelerations=data.qacc_warmstart)
