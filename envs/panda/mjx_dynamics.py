"""The motion of the Panda on MJX: the reference for `closed_form`, with MuJoCo's own equations in each of its 25 substeps.

The controller is the same; friction, drag, torque and joint limits are MuJoCo's. It is some forty times slower on a CPU, and then only if compiled
with the environment's `compiler_options`.
"""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any

import jax
import jax.numpy as jnp

from hindrl_jax.base.compilation import without_fusion_emitters
from hindrl_jax.base.types import Array
from hindrl_jax.envs.panda import controller, robot
from hindrl_jax.envs.panda.kinematics import posture


def compiler_options() -> dict[str, Any]:
    """Options for XLA programs with MJX in them. On CPUs, XLA's concurrent scheduler can leave large batches of MJX waiting for ever, and its newer
    fusion code made MJX several hundred times slower (both seen with jaxlib 0.10.2); from 0.11.1 on, MJX is fast with that code, and XLA no longer
    knows the option that turns it off."""
    if jax.default_backend() != "cpu":
        return {}
    return {"xla_cpu_enable_concurrency_optimized_scheduler": False} | without_fusion_emitters()


@functools.cache
def import_mjx() -> Any:
    """The module, without the lines that it prints about an absent optional package."""
    robot.import_mujoco()
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


@functools.cache
def _model() -> Any:
    with jax.ensure_compile_time_eval():
        return import_mjx().put_model(robot.model())


def control_step(joints: Array, velocities: Array, rest: Array, command: Array) -> tuple[Array, Array]:
    """One control step: `controller.joint_targets`, then 25 substeps of MJX. Arguments and result are those of `closed_form.control_step`."""
    mjx, model = import_mjx(), _model()
    goal = controller.joint_targets(joints, rest, command, posture(joints))
    limits = model.actuator_ctrlrange

    def substep(data: Any, _: None) -> tuple[Any, None]:
        data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
        wanted = controller.STIFFNESS * (goal - data.qpos) - controller.TRACKING_DAMPING * data.qvel
        torque = mjx.mul_m(model, data, wanted) + data.qfrc_bias
        data = data.replace(ctrl=jnp.clip(torque, limits[:, 0], limits[:, 1]))
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        return mjx.euler(model, mjx.solve(model, data)), None

    data = mjx.make_data(model).replace(qpos=joints, qvel=velocities)
    data, _ = jax.lax.scan(substep, data, length=controller.SUBSTEPS)
    return data.qpos, data.qvel
