"""How far the back ends of the reach arm are from one another: the same commands, and where they bring the hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import report
from benchmarks.timing import Options, Row, rounded
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.panda import closed_form, mjx_dynamics
from hindrl_jax.envs.reach import FixedParameterizedReach
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.experts.robosuite_arm import RobosuiteArm

TITLE = "Reaching, parity of the back ends"
SEQUENCES = {
    "zero": "zero",
    "constant_x": "constant, 20 mm along x",
    "constant_down": "constant, 20 mm along -z",
    "constant_roll": "constant, 50 mrad about x",
    "constant_yaw": "constant, 50 mrad about z",
    "random": "uniformly random",
    "smooth": "smooth: random walks, scaled to the bounds",
    "expert": "those of the expert",
}
PAIRS = (("closed_form", "robosuite"), ("mjx", "robosuite"), ("closed_form", "mjx"))
NAMES = {"closed_form": "closed form", "mjx": "MJX", "robosuite": "robosuite"}
NUM_STARTS = 10
NUM_STEPS = 100
QUICK_STEPS = 10
NEAR_LIMIT = 0.005  # rad
MEASURED = ("position_mm", "rotation_mrad")


def run(options: Options) -> list[Row]:
    """One row per sequence and pair of back ends: the distance and the angle between their hands. None at all without robosuite."""
    num_starts, num_steps = (1, QUICK_STEPS) if options.quick else (NUM_STARTS, NUM_STEPS)
    print(f"{TITLE}: mean / largest over {num_steps} control steps", flush=True)
    try:
        arm = RobosuiteArm()
    except UserError as error:
        print(f"  left out: {error}", flush=True)
        return []
    env, env_on_mjx = FixedParameterizedReach(), FixedParameterizedReach(backend="mjx")
    starts, commands = sequences(jax.random.key(0), env, num_starts, num_steps)
    joints = {
        "closed_form": simulate(closed_form.control_step, starts, commands, env.compiler_options),
        "mjx": simulate(mjx_dynamics.control_step, starts, commands, env_on_mjx.compiler_options),
        "robosuite": simulate_in_robosuite(arm, starts, commands),
    }
    arm.close()

    away, _ = errors(starts[:, :, None], joints["robosuite"])
    pairs = {pair: errors(joints[pair[0]], joints[pair[1]]) for pair in PAIRS}
    limited = np.asarray(meets_limit(joints["robosuite"]))
    rows = []
    for index, name in enumerate(SEQUENCES):
        for (first, second), both in pairs.items():
            row: Row = {"commands": name, "first": first, "second": second, "steps": num_steps}
            row |= {"starts": num_starts, "starts_at_limit": int(limited[index].sum())}
            row["away_mm"] = rounded(1000.0 * float(away[index].max(axis=1).mean()))
            for what, values in zip(MEASURED, both, strict=True):
                values = 1000.0 * np.asarray(values[index])
                free = values[~limited[index]]
                row |= {what: rounded(values.mean()), f"{what}_max": rounded(values.max()), f"{what}_max_free": rounded(free.max(initial=0.0))}
            pair = f"{NAMES[first]} - {NAMES[second]}"
            print(f"  {name:14s} {pair:24s} {_cell(row, 'position_mm'):>15s} mm {_cell(row, 'rotation_mrad'):>15s} mrad", flush=True)
            rows.append(row)
    return rows


def sequences(key: Array, env: FixedParameterizedReach, num_starts: int, num_steps: int) -> tuple[Array, Array]:
    """Draws the starts and the commands.

    Returns:
      Joints (len(SEQUENCES), N, 7) in rad, and commands (len(SEQUENCES), N, T, 6) in m and rad.
    """
    key_starts, key_random, key_walk, key_expert = jax.random.split(key, 4)
    states, _ = jax.vmap(jax.vmap(env.reset))(jax.random.split(key_starts, (len(SEQUENCES), num_starts)))
    shape = (num_starts, num_steps, env.action_dim)
    x, _, z, roll, _, yaw = jnp.eye(env.action_dim)
    directions = {"zero": jnp.zeros_like(x), "constant_x": x, "constant_down": -z, "constant_roll": roll, "constant_yaw": yaw}
    walk = jnp.cumsum(jax.random.normal(key_walk, shape), axis=1)
    normalised = {name: jnp.broadcast_to(direction, shape) for name, direction in directions.items()} | {
        "random": jax.random.uniform(key_random, shape, minval=-1.0, maxval=1.0),
        "smooth": walk / jnp.max(jnp.abs(walk), axis=1, keepdims=True),
    }
    commands = {name: values * jnp.broadcast_to(env.action_high, shape) for name, values in normalised.items()}

    def by_expert(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], Array]:
        state, key = carry
        key, key_act = jax.random.split(key)
        action = ReachExpert().act(key_act, env, state)
        return (env.step(state, action)[0], key), action

    at_start = jax.tree.map(lambda leaf: leaf[list(SEQUENCES).index("expert")], states)
    play = jax.jit(jax.vmap(lambda state, key: jax.lax.scan(by_expert, (state, key), length=num_steps)[1]))
    commands["expert"] = play(at_start, jax.random.split(key_expert, num_starts))
    return states.joints, jnp.stack([commands[name] for name in SEQUENCES])


def simulate(control_step: Callable[..., tuple[Array, Array]], starts: Array, commands: Array, compiler_options: dict[str, Any]) -> Array:
    """Joints (..., T, 7) after each of the commands (..., T, 6), from rest at joints (..., 7)."""

    def arm(rest: Array, sequence: Array) -> Array:
        def step(carry: tuple[Array, Array], command: Array) -> tuple[tuple[Array, Array], Array]:
            carry = control_step(*carry, rest, command)
            return carry, carry[0]

        return jax.lax.scan(step, (rest, jnp.zeros_like(rest)), sequence)[1]

    flat = starts.reshape(-1, starts.shape[-1]), commands.reshape(-1, *commands.shape[-2:])
    joints = jax.jit(jax.vmap(arm), compiler_options=compiler_options)(*flat)
    return joints.reshape(*commands.shape[:-1], panda.NUM_JOINTS)


def simulate_in_robosuite(arm: RobosuiteArm, starts: Array, commands: Array) -> Array:
    """The same as `simulate`."""
    starts, commands = np.asarray(starts), np.asarray(commands)
    joints = np.zeros((*commands.shape[:-1], panda.NUM_JOINTS), np.float32)
    for index in np.ndindex(commands.shape[:-2]):
        arm.reset(starts[index])
        for t, command in enumerate(commands[index]):
            joints[*index, t], _ = arm.step(command)
    return jnp.asarray(joints)


@jax.jit
def errors(first: Array, second: Array) -> tuple[Array, Array]:
    """Distances (...) in m and angles (...) in rad between the hands at two arrays of joints (..., 7), by the same forward kinematics."""

    def between(first: Array, second: Array) -> tuple[Array, Array]:
        one, other = panda.posture(first), panda.posture(second)
        displacement, turn = other.hand_position - one.hand_position, rotations.between(one.hand_rotation, other.hand_rotation)
        return jnp.sqrt(jnp.sum(jnp.square(displacement))), jnp.sqrt(jnp.sum(jnp.square(turn)))

    return jnp.vectorize(between, signature="(n),(n)->(),()")(first, second)


def meets_limit(joints: Array) -> Array:
    """(...) bool, whether on its way (..., T, 7) any joint comes to the end of its range."""
    chain = panda.chain()
    to_limit = jnp.minimum(joints - jnp.broadcast_to(chain.lower, joints.shape), jnp.broadcast_to(chain.upper, joints.shape) - joints)
    return (to_limit < NEAR_LIMIT).any(axis=(-2, -1))


def versions(options: Options) -> dict[str, str]:
    """Versions of what moves the arm."""
    del options
    return report.installed("mujoco", "mujoco-mjx", "robosuite")


def tables(rows: list[Row]) -> str:
    """A line per sequence, two columns per pair, and the largest of each pair."""
    text = (
        "Distance (mm) and angle (mrad) between the hands that two back ends have moved by the same commands from the same start: mean / largest "
        f"over {rows[0]['steps']} control steps and {rows[0]['starts']} starts, which have the noise of an episode's. How far robosuite's hand gets "
        "away from its start is the mean over the starts. A start is at a limit if a joint of robosuite's arm comes to the end of its range. All "
        "poses come from the joints by `panda.posture`.\n\n"
    )
    names = {pair: f"{NAMES[pair[0]]} - {NAMES[pair[1]]}" for pair in PAIRS}
    header = ["commands", "gets away, mm", "starts at a limit", *(f"{name}, {unit}" for name in names.values() for unit in ("mm", "mrad"))]
    by_case = {(row["commands"], row["first"], row["second"]): row for row in rows}
    lines = []
    for name in dict.fromkeys(row["commands"] for row in rows):
        of_pairs = [by_case[name, *pair] for pair in PAIRS]
        cells = [_cell(row, what) for row in of_pairs for what in MEASURED]
        lines.append([SEQUENCES[name], f"{of_pairs[0]['away_mm']:.0f}", of_pairs[0]["starts_at_limit"], *cells])
    text += report.table(header, lines)
    for pair, name in names.items():
        of_pair = [row for row in rows if (row["first"], row["second"]) == pair]
        largest, free = (
            " and ".join(f"{max(row[f'{what}_{kind}'] for row in of_pair):.3f} {unit}" for what, unit in zip(MEASURED, ("mm", "mrad"), strict=True))
            for kind in ("max", "max_free")
        )
        text += f"\n- {name}, largest of all: {largest}; without the starts at a limit: {free}."
    return text + "\n"


def _cell(row: Row, what: str) -> str:
    return f"{row[what]:.3f} / {row[f'{what}_max']:.3f}"
