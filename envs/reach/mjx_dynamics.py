"""The Panda on MJX: the reference for `panda.control_step`, with MuJoCo's own equations in each of its 25 substeps.

Same inverse kinematics; friction, drag, torque and joint limits as MuJoCo has them. Some forty times slower on a CPU, and then only if compiled
with the environment's `compiler_options`.
"""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array
from hindrl_jax.envs.reach import panda


@functools.cache
def _mjx() -> Any:
    """The module, without the lines that it prints about an absent optional package."""
    panda.import_mujoco()
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


@functools.cache
def _model() -> Any:
    with jax.ensure_compile_time_eval():
        return _mjx().put_model(panda.model())


def control_step(joints: Array, velocities: Array, rest: Array, command: Array) -> tuple[Array, Array]:
    """As `panda.control_step`, by `panda.joint_targets` and 25 MJX substeps."""
    mjx, model = _mjx(), _model()
    goal = panda.joint_targets(joints, rest, command, panda.posture(joints))
    limits = model.actuator_ctrlrange

    def substep(data: Any, _: None) -> tuple[Any, None]:
        data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
        wanted = panda.STIFFNESS * (goal - data.qpos) - panda.TRACKING_DAMPING * data.qvel
        torque = mjx.mul_m(model, data, wanted) + data.qfrc_bias
        data = data.replace(ctrl=jnp.clip(torque, limits[:, 0], limits[:, 1]))
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        return mjx.euler(model, mjx.solve(model, data)), None

    data = mjx.make_data(model).replace(qpos=joints, qvel=velocities)
    data, _ = jax.lax.scan(substep, data, length=panda.SUBSTEPS)
    return data.qpos, data.qvel
