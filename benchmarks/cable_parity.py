"""How far the back ends of the cable tasks are from one another: the same commands from the same states, and whole episodes of the same expert."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import report
from benchmarks.timing import Options, Row, rounded
from hindrl_jax.base.environments import compiler_options
from hindrl_jax.base.types import Array
from hindrl_jax.envs import rotations
from hindrl_jax.envs.cable import BringNear, CableInsertion, CableState, CableTask, Scene, chains, closed_form, geometry
from hindrl_jax.envs.cable.rules import tip_error
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.training.playing import play

TITLE = "Cables, parity of the back ends"
SITUATIONS = {
    "free": "at the start, hands on their way to the grips",
    "grasped": "both heads have just been taken",
    "lifted": "both heads are carried to each other",
    "inserting": "the plug is before the socket or in it",
    "inserting_steadily": "the same, by an expert whose hand is steady there",
}
STEPS = (1, 20)
NAMES = {"closed_form": "closed form", "mjx": "MJX", "mujoco": "C MuJoCo"}
NUM_EPISODES = 100
QUICK_EPISODES = 2
NUM_STARTS = 10
MEASURED = ("hands_mm", "tips_mm", "axes_mrad")


def run(options: Options) -> list[Row]:
    """Rows of two kinds: distances after some steps with the same commands, and successes and lengths of whole episodes."""
    num_starts, num_episodes = (1, QUICK_EPISODES) if options.quick else (NUM_STARTS, NUM_EPISODES)
    print(f"{TITLE}: mean / largest distance from C MuJoCo", flush=True)
    starts, commands = situations(jax.random.key(0), num_starts)
    steady = situations(jax.random.key(0), num_starts, CableExpert(insertion_noise=0.0))
    starts["inserting_steadily"], commands["inserting_steadily"] = (found["inserting"] for found in steady)
    rows: list[Row] = []
    for backend in ("closed_form",) if options.quick else ("closed_form", "mjx"):  # MJX takes minutes to compile
        env = CableInsertion(backend=backend)
        for situation in SITUATIONS:
            begin = starts[situation] if backend == "mjx" else jax.vmap(as_closed_form)(starts[situation])
            away = distances(simulate(env, begin, commands[situation]), simulate(IN_C, starts[situation], commands[situation]))
            for num_steps in STEPS:
                row: Row = {"from": situation, "backend": backend, "steps": num_steps, "starts": num_starts}
                for what, values in away.items():
                    row |= {what: rounded(float(values[:, num_steps - 1].mean())), f"{what}_max": rounded(float(values[:, num_steps - 1].max()))}
                print(f"  {NAMES[backend]:12s} {situation:10s} after {num_steps:2d}: " + ", ".join(_cell(row, what) for what in MEASURED), flush=True)
                rows.append(row)
    for task in (BringNear, CableInsertion):
        for backend in ("closed_form", "mujoco"):
            row = {"task": task.name, "backend": backend} | episodes(task(backend=backend), num_episodes)
            print(f"  {task.name} {NAMES[backend]}: {row['solved']} of {row['episodes']}, median {row['median_steps']} steps", flush=True)
            rows.append(row)
    return rows


IN_C = CableInsertion(backend="mujoco")


def situations(key: Array, num_starts: int, expert: CableExpert | None = None) -> tuple[dict[str, CableState], dict[str, Array]]:
    """States of C MuJoCo, leaves (N, ...), and the expert's commands (N, T, 14) from there on, for each situation."""
    expert = expert or CableExpert()
    key_reset, key_act = jax.random.split(key)

    def episode(key_reset: Array, key_act: Array) -> tuple[CableState, Array]:
        def step(carry: tuple[CableState, Array], _: None) -> tuple[tuple[CableState, Array], tuple[Any, Array]]:
            state, key = carry
            key, key_step = jax.random.split(key)
            action = expert.act(key_step, IN_C, state)
            return (IN_C.step(state, action)[0], key), (state.replace(key=None), action)

        return jax.lax.scan(step, (IN_C.reset(key_reset)[0], key_act), length=500)[1]

    states, actions = jax.jit(jax.vmap(episode))(jax.random.split(key_reset, num_starts), jax.random.split(key_act, num_starts))
    held = np.asarray(states.scene.held).all(axis=2)
    is_before_mouth = np.asarray(jax.vmap(jax.vmap(_is_before_mouth))(states.scene))
    first_held = held.argmax(axis=1)
    begins = {
        "free": np.full(num_starts, 20),
        "grasped": first_held,
        "lifted": first_held + 60,
        "inserting": (held & is_before_mouth).argmax(axis=1),
    }
    pick = {name: begin[:, None] + np.arange(max(STEPS)) for name, begin in begins.items()}
    of = np.arange(num_starts)
    keys = jax.random.split(jax.random.key(0), num_starts)
    found = {name: jax.tree.map(lambda leaf, at=at: leaf[of, at[:, 0]], states).replace(key=keys) for name, at in pick.items()}
    return found, {name: actions[of[:, None], at] for name, at in pick.items()}


def _is_before_mouth(scene: Scene) -> Array:
    """() bool, whether the plug's tip has come to within 4 mm of the socket's, in line with it."""
    plug, socket = scene.head_rotations[:, :, 2]
    return (jnp.sum(tip_error(scene, 0.0) * socket) < 0.004) & (rotations.angle(plug, -socket) < 0.1)


def as_closed_form(state: CableState) -> CableState:
    """The closed form's state at a state of MuJoCo: as it is held there, a head is held; free heads are at rest."""
    scene = state.scene
    joints, _ = chains.arms(state.physics)
    velocities = state.physics.velocities[:18].reshape(2, 9)[:, :7]
    in_hand = jnp.swapaxes(scene.hand_rotations, 1, 2)
    physics = closed_form.start(jax.random.key(0), joints, randomised=False).replace(
        velocities=velocities,
        fingers=scene.fingers,
        held=scene.held,
        grasp_positions=jnp.sum(in_hand * (scene.head_positions - scene.hand_positions)[:, None, :], axis=2),
        grasp_rotations=jnp.sum(in_hand[:, :, :, None] * scene.head_rotations[:, None], axis=2),
        head_positions=scene.head_positions,
        head_rotations=scene.head_rotations,
    )
    return state.replace(physics=physics, scene=closed_form.scene(physics))


def simulate(env: CableTask, starts: CableState, commands: Array) -> Scene:
    """Scenes, leaves (N, T, ...), after each of the commands (N, T, 14)."""

    def episode(state: CableState, commands: Array) -> Scene:
        def step(state: CableState, command: Array) -> tuple[CableState, Scene]:
            state, _ = env.step(state, command)
            return state, state.scene

        return jax.lax.scan(step, state, commands)[1]

    return jax.jit(jax.vmap(episode), compiler_options=compiler_options(env))(starts, commands)


def distances(first: Scene, second: Scene) -> dict[str, np.ndarray]:
    """What lies between two scenes, the greater of both arms: of hands and tips in mm, and of the heads' axes in mrad, each (N, T)."""
    tips = [_tips(scene) for scene in (first, second)]
    axes = [np.asarray(scene.head_rotations[..., 2], float) for scene in (first, second)]
    angles = 2 * np.arcsin(np.clip(0.5 * np.linalg.norm(axes[0] - axes[1], axis=-1), 0.0, 1.0))
    hands = np.linalg.norm(np.asarray(first.hand_positions) - np.asarray(second.hand_positions), axis=-1)
    away = {"hands_mm": hands, "tips_mm": np.linalg.norm(tips[0] - tips[1], axis=-1), "axes_mrad": angles}
    return {what: 1000.0 * values.max(axis=-1) for what, values in away.items()}


def _tips(scene: Scene) -> np.ndarray:
    return np.asarray(scene.head_positions) + np.array([[geometry.to_tip(0)], [geometry.to_tip(1)]]) * np.asarray(scene.head_rotations[..., 2])


def episodes(env: CableTask, num_episodes: int) -> Row:
    """How the noisy expert fares."""

    def act(key: Array, state: CableState, observation: Array) -> Array:
        return CableExpert().act(key, env, state)

    played = jax.jit(lambda key: play(key, env, act, num_episodes))(jax.random.key(0))
    solved, lengths = np.asarray(played.terminated), np.asarray(played.lengths)
    found: Row = {"episodes": num_episodes, "solved": int(solved.sum())}
    quantiles = np.percentile(lengths[solved], (50, 95, 100)) if solved.any() else np.full(3, np.nan)
    return found | {f"{name}_steps": rounded(float(value)) for name, value in zip(("median", "p95", "most"), quantiles, strict=True)}


def versions(options: Options) -> dict[str, str]:
    """Versions of what moves arms and cables."""
    del options
    return report.installed("mujoco", "mujoco-mjx")


def tables(rows: list[Row]) -> str:
    """One table of distances, and one of episodes."""
    apart = [row for row in rows if "from" in row]
    text = (
        "Distance from C MuJoCo after the same commands, those of the expert, from the same states, of the arm or head that is farther off: mean / "
        f"largest over {apart[0]['starts']} starts.\n\n"
    )
    lines = [[NAMES[row["backend"]], SITUATIONS[row["from"]], row["steps"], *(_cell(row, what) for what in MEASURED)] for row in apart]
    text += report.table(["back end", "from", "control steps", "hands, mm", "tips, mm", "axes of the heads, mrad"], lines)
    text += "\nThe noisy expert from fresh starts:\n\n"
    lines = [
        [row["task"], NAMES[row["backend"]], f"{row['solved']} of {row['episodes']}", *(row[f"{name}_steps"] for name in ("median", "p95", "most"))]
        for row in rows
        if "task" in row
    ]
    return text + report.table(["task", "back end", "solved", "steps, median", "95%", "most"], lines)


def _cell(row: Row, what: str) -> str:
    return f"{row[what]:.3f} / {row[f'{what}_max']:.3f}"
