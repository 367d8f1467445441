"""Control steps per second of the reach arm by each back end, many arms side by side, and beside them C MuJoCo's physics alone."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from benchmarks import report, timing
from benchmarks.environments import stepper
from benchmarks.timing import Contestant, Options, Row
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda
from hindrl_jax.envs.panda import closed_form, mjx_dynamics
from hindrl_jax.envs.reach import FixedParameterizedReach
from hindrl_jax.experts.robosuite_arm import RobosuiteArm

TITLE = "Reaching, control steps"
WHO = {
    "closed_form": "`closed_form.control_step`: inverse kinematics, controller and arm in closed form",
    "environment": "`FixedParameterizedReach` in closed form, the whole step: with waypoints, observations, rewards and resets, as in training",
    "mjx": "`mjx_dynamics.control_step`: the same inverse kinematics, then controller and arm in 25 steps of MJX",
    "mujoco": "C MuJoCo, `mujoco.rollout`: 25 physics steps towards constant joint targets. It runs no controller: physics alone",
    "robosuite": "robosuite, one arm: its controller, 25 steps of C MuJoCo, its observations",
}
NUM_ENVS = (1, 16, 64, 256, 1024)
NUM_COMMANDS = 64  # random commands per arm, drawn beforehand and given over and over
TURN_SECONDS = 0.3  # of those of the other parts, since there are many contestants
JOINT_NOISE = FixedParameterizedReach().joint_noise

ControlStep = Callable[[Array, Array, Array, Array], tuple[Array, Array]]
"""`closed_form.control_step` or `mjx_dynamics.control_step`."""


def run(options: Options) -> list[Row]:
    """One row per back end and number of arms, milliseconds per control step of one arm."""
    print(f"{TITLE}: uniformly random commands, drawn beforehand", flush=True)
    effort = dataclasses.replace(options.effort, turn_seconds=TURN_SECONDS * options.effort.turn_seconds)
    sizes = NUM_ENVS[1:2] if options.quick else NUM_ENVS
    env, env_on_mjx = FixedParameterizedReach(), FixedParameterizedReach(backend="mjx")
    compiled: dict[tuple[str, int], Contestant] = {}
    for size in sizes:
        compiled["mjx", size] = arms(mjx_dynamics.control_step, size, min(8, max(1, 1024 // size)), env_on_mjx.compiler_options)
        compiled["closed_form", size] = arms(closed_form.control_step, size, min(256, max(16, 4096 // size)), env.compiler_options)
        compiled["environment", size] = stepper(env, size, resets=True, num_actions=16, steps_per_call=4096)
    with ThreadPoolExecutor(options.cores) as pool:  # MJX takes a quarter of a minute to compile, for each number of arms
        list(pool.map(lambda contestant: contestant.turn(1), compiled.values()))
    others = {("mujoco", size): physics(size, min(64, max(4, 1024 // size)), options.cores) for size in sizes}
    try:
        others["robosuite", 1] = robosuite()
    except UserError as error:
        print(f"  without robosuite: {error}", flush=True)

    results = timing.take_turns(compiled | others, effort)
    rows = []
    for who in WHO:
        for (name, size), result in results.items():
            if name == who:
                row = {"who": who, "num_envs": size, "steps_per_second": round(1000.0 / result["wall_ms"])} | result
                print(f"  {who:12s} {size:5d} side by side: {row['steps_per_second']:10,d} control steps per second", flush=True)
                rows.append(row)
    return rows


def starts(num_envs: int) -> Array:
    """(E, 7) the initial joints with noise, in rad."""
    return jnp.asarray(panda.INITIAL_JOINTS)[None] + JOINT_NOISE * jax.random.normal(jax.random.key(0), (num_envs, panda.NUM_JOINTS))


def commands(num_envs: int) -> Array:
    """(NUM_COMMANDS, E, 6) displacements in m and rotation vectors in rad; the second half takes back the first, lest the arms wander off."""
    env = FixedParameterizedReach()
    there = jax.random.uniform(jax.random.key(1), (NUM_COMMANDS // 2, num_envs, env.action_dim), minval=env.action_low, maxval=env.action_high)
    return jnp.concatenate([there, -there])


def arms(control_step: ControlStep, num_envs: int, num_steps: int, compiler_options: dict[str, Any]) -> Contestant:
    """Moves `num_envs` arms by `num_steps` control steps per call, in one compiled loop."""

    def steps(carry: tuple[Array, Array, Array], rest: Array, commands: Array) -> tuple[Array, Array, Array]:
        def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
            joints, velocities, index = carry
            joints, velocities = jax.vmap(control_step)(joints, velocities, rest, commands[index])
            return (joints, velocities, (index + 1) % NUM_COMMANDS), None

        return jax.lax.scan(step, carry, length=num_steps)[0]

    rest = starts(num_envs)
    carry = rest + 0.0, jnp.zeros_like(rest), jnp.zeros((), jnp.int32)  # `rest` itself must outlive the donation
    program = jax.jit(steps, donate_argnums=0, compiler_options=compiler_options)
    return timing.calls(timing.advancing(program, carry, rest, commands(num_envs)), units=num_envs * num_steps)


def physics(num_envs: int, num_steps: int, num_threads: int) -> Contestant:
    """The same arms in C MuJoCo, its motors made position servos as stiff as the controller is; each control step has random targets of its own."""
    model, joints = copy.copy(panda.model()), np.array(starts(num_envs), float)
    inertias = np.diag(panda.mass_matrix(panda.posture(jnp.asarray(panda.INITIAL_JOINTS, jnp.float32))))
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[:, 0] = panda.STIFFNESS * inertias
    model.actuator_biasprm[:, 1] = -panda.STIFFNESS * inertias
    model.actuator_biasprm[:, 2] = -panda.TRACKING_DAMPING * inertias

    targets = joints[:, None] + np.random.default_rng(0).normal(scale=JOINT_NOISE, size=(num_envs, num_steps, panda.NUM_JOINTS))
    targets = np.repeat(targets, panda.SUBSTEPS, axis=1)
    state_size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.zeros((num_envs, num_steps * panda.SUBSTEPS, state_size))  # time, joints, velocities
    states[:, -1, 1 : 1 + panda.NUM_JOINTS] = joints
    pool, data = mujoco.rollout.Rollout(nthread=num_threads), [mujoco.MjData(model) for _ in range(num_threads)]
    return timing.calls(lambda: pool.rollout(model, data, states[:, -1].copy(), targets, state=states), units=num_envs * num_steps)


def robosuite() -> Contestant:
    """One arm in robosuite, a control step per call.

    Raises:
      UserError: if robosuite is missing or unusable.
    """
    arm, given = RobosuiteArm(), np.array(commands(1)[:, 0])
    arm.reset(np.array(starts(1)[0]))
    index = 0

    def call() -> None:
        nonlocal index
        arm.step(given[index])
        index = (index + 1) % NUM_COMMANDS

    return timing.calls(call)


def versions(options: Options) -> dict[str, str]:
    """Versions of what moves the arm."""
    del options
    return report.installed("mujoco", "mujoco-mjx", "robosuite")


def tables(rows: list[Row]) -> str:
    """Control steps per second of wall-clock time, and CPU time per control step."""
    by_case = {(row["who"], row["num_envs"]): row for row in rows}
    sizes = sorted({row["num_envs"] for row in rows})
    header = ["who", *(f"{size:,} side by side" for size in sizes)]

    def lines(cell: Callable[[Row], str]) -> list[list[str]]:
        present = dict.fromkeys(row["who"] for row in rows)
        return [[f"`{who}`", *(cell(by_case[who, size]) if (who, size) in by_case else "" for size in sizes)] for who in present]

    text = "A control step is 50 ms of one arm: 25 steps of 2 ms.\n\n"
    text += "".join(f"- `{who}`: {WHO[who]}.\n" for who in dict.fromkeys(row["who"] for row in rows))
    text += "\nControl steps per second of wall-clock time, all arms together:\n\n"
    text += report.table(header, lines(lambda row: f"{row['steps_per_second']:,}"))
    text += "\nMicroseconds of CPU time per control step of one arm, all threads, median (least .. largest turn):\n\n"
    return text + report.table(header, lines(lambda row: timing.milliseconds(_microseconds(row), "cpu")))


def _microseconds(row: Row) -> Row:
    return {"cpu_ms": 1000.0 * row["cpu_ms"], "cpu_ms_range": [1000.0 * value for value in row["cpu_ms_range"]]}
