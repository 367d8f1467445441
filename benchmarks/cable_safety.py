"""What the cable tasks come to under any commands: kinetic energy, speeds and penetration, the worst of all control steps of many episodes.

An episode is not ended by success, and runs to the end of the horizon. It is the expert's up to a drawn step, so that both heads are held in many of
them when what follows begins, and half of the others begin at once.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import report
from benchmarks.timing import Options, Row, rounded
from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import CableInsertion, CableState, CableTask, Scene, chains, contact, geometry, model
from hindrl_jax.envs.cable.rules import tip_error
from hindrl_jax.experts.cable import CableExpert

TITLE = "Cables, energy and penetration"
MANNERS = ("random", "to and fro", "into each other", "apart", "down", "twisting", "expert")
KINDS = {"random": MANNERS[:1], "hostile": MANNERS[1:6], "expert": MANNERS[6:]}
"""Of commands, with the manners from which one is drawn for each episode."""
NUM_EPISODES = 334  # of each kind, about 1,000 in all
NUM_STEPS = 500  # the expert inserts in about 430, and then goes on pressing
TAKEN_OVER = (150, 450)  # steps, the first and the last at which the expert may be relieved
_CHUNK = 25  # steps that go to the host at once
_SHUT = np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0]), 2)
_TO_EACH_OTHER = np.array([0, -1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0.0])
_CONTACTS = {"pad": "pads_mm", "pin": "pin_mm", "body": "heads_mm"}
"""What the first of two geoms that touch is called in MuJoCo, and what its penetration is called here; all others are those of hands."""
WORST = {
    "energy_J": "kinetic energy, J",
    "hands_m_s": "hands, m/s",
    "heads_m_s": "heads, m/s",
    "stretch_mm": "cables stretched, mm",
    "overlap_mm": "hands overlap, mm",
    "tip_mm": "plug's tip in the socket's walls or bottom, mm",
}
IN_C = {"pads_mm": "pads and grips", "pin_mm": "pin and bore", "heads_mm": "plug and socket outside", "fingers_mm": "hands"}


def run(options: Options) -> list[Row]:
    """A row for each back end and kind of commands: the greatest of all that `WORST` and, in C, `IN_C` name."""
    num, steps = (4, 2 * _CHUNK) if options.quick else (NUM_EPISODES, NUM_STEPS)
    print(f"{TITLE}: worst of {num} episodes of {steps} steps", flush=True)
    rows = []
    for backend in ("closed_form", "mujoco"):
        env = CableInsertion(backend=backend, horizon=steps)
        for index, kind in enumerate(KINDS):
            row = {"backend": backend, "commands": kind, "episodes": num} | worst(jax.random.key(index), env, kind, num)
            print(
                f"  {backend:11s} {kind:7s} " + ", ".join(f"{name} {row[name]:g}" for name in (*WORST, *IN_C, "held_both") if name in row), flush=True
            )
            rows.append(row)
    return rows


def worst(key: Array, env: CableTask, kind: str, num_episodes: int) -> Row:
    """The greatest values over all steps of the episodes, whether all is finite, and in which share of the episodes both heads were held at once."""
    found: dict[str, float] = {}
    held, finite = np.zeros(num_episodes, bool), True
    for before, states in played(key, env, kind, num_episodes):
        held |= np.asarray(states.scene.held).all(axis=2).any(axis=0)
        finite &= all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(states.scene))
        values = _of_scenes(before.scene, states.scene) | _of_physics(env, states)
        found = {name: max(found.get(name, 0.0), value) for name, value in values.items()}
    return {name: rounded(value) for name, value in found.items()} | {"finite": finite, "held_both": rounded(float(held.mean()))}


def played(key: Array, env: CableTask, kind: str, num: int) -> Iterator[tuple[CableState, CableState]]:
    """Plays episodes side by side: pieces, each with the states (num, ...) before it and those of its steps (T, num, ...), without their keys."""
    key_manner, key_half, key_step, key_reset, key_act = jax.random.split(key, 5)
    manners = jnp.asarray([MANNERS.index(manner) for manner in KINDS[kind]])[jax.random.randint(key_manner, (num,), 0, len(KINDS[kind]))]
    begins = jnp.where(jax.random.bernoulli(key_half, shape=(num,)), 0, jax.random.randint(key_step, (num,), *TAKEN_OVER))
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(key_reset, num))[0]
    keys = jax.random.split(key_act, num)
    for _ in range(-(-env.horizon // _CHUNK)):
        before = states.replace(key=None)
        states, piece = _piece(env, states, keys, manners, begins)
        yield jax.device_get((before, piece))


@functools.partial(jax.jit, static_argnums=0)
def _piece(env: CableTask, states: CableState, keys: Array, manners: Array, begins: Array) -> tuple[CableState, CableState]:
    expert = CableExpert()

    def act(state: CableState, key: Array, manner: Array, begin: Array) -> Array:
        by_expert = expert.act(jax.random.fold_in(key, 2 * state.step), env, state)
        is_expert = (manner == MANNERS.index("expert")) | (state.step < begin)
        return jnp.where(is_expert, by_expert, _command(key, manner, state.step) * env.action_high)

    def step(states: CableState, _: None) -> tuple[CableState, CableState]:
        states, _ = jax.vmap(env.step)(states, jax.vmap(act)(states, keys, manners, begins))
        return states, states.replace(key=None)

    return jax.lax.scan(step, states, length=_CHUNK)


def _command(key: Array, manner: Array, step: Array) -> Array:
    """(14,) in [-1, 1]: what is commanded at that step of an episode."""
    now, of_five, of_twenty = (jax.random.fold_in(key, 2 * (step // n) * n + 1) for n in (1, 5, 20))
    shaken = 0.3 * jax.random.normal(now, (14,)) * (np.arange(14) % 7 < 6)
    turned = jnp.sign(jax.random.normal(of_twenty, (14,))) * (np.arange(14) % 7 >= 3) * (np.arange(14) % 7 < 6)
    manners = {
        "random": jax.random.uniform(jax.random.clone(now), (14,), minval=-1.0),
        "to and fro": jnp.sign(jax.random.normal(of_five, (14,))),
        "into each other": _SHUT + _TO_EACH_OTHER + shaken,
        "apart": _SHUT - _TO_EACH_OTHER + shaken,
        "down": _SHUT - np.tile(np.eye(7)[2], 2) + shaken,
        "twisting": _SHUT + turned + shaken,
    }
    return jnp.stack([manners[name] for name in MANNERS[:-1]])[jnp.minimum(manner, len(MANNERS) - 2)]


def _of_scenes(before: Scene, scenes: Scene) -> dict[str, float]:
    """What can be told from where things are, `before` (N, ...) and at each step (T, N, ...)."""
    overlap, tip = jax.jit(jax.vmap(jax.vmap(_overlaps)))(scenes)
    run = scenes.head_positions - geometry.GRIP * scenes.head_rotations[..., 2] - geometry.ANCHORS
    found = {
        "stretch_mm": 1000.0 * (np.linalg.norm(run, axis=-1) - geometry.CABLE_LENGTH),
        "overlap_mm": 1000.0 * np.asarray(overlap),
        "tip_mm": 1000.0 * np.asarray(tip),
    }
    for name, which in (("hands_m_s", "hand_positions"), ("heads_m_s", "head_positions")):
        positions = np.concatenate([getattr(before, which)[None], getattr(scenes, which)])
        found[name] = np.linalg.norm(np.diff(positions, axis=0), axis=-1) / panda.CONTROL_PERIOD
    return {name: float(values.max()) for name, values in found.items()}


def _overlaps(scene: Scene) -> tuple[Array, Array]:
    """() m each: how far the hands are within each other, and the least way of the plug's tip out of what is solid about the socket."""
    overlap = jnp.sqrt(jnp.sum(jnp.square(contact.hands_apart(scene.hand_positions, scene.hand_rotations))))
    socket = scene.head_rotations[1, :, 2]
    offset = tip_error(scene, 0.0)
    height = jnp.sum(offset * socket)
    aside = jnp.sqrt(jnp.sum(jnp.square(offset - height * socket)))
    into_bore = jnp.maximum(aside - geometry.CLEARANCE, -height - geometry.DEPTH)
    way = jnp.minimum(into_bore, jnp.minimum(-height, geometry.SLEEVE_RADIUS + geometry.PIN_RADIUS - aside))
    return overlap, jnp.where(height > -geometry.TIPS[1], jnp.maximum(way, 0.0), 0.0)


def _of_physics(env: CableTask, states: CableState) -> dict[str, float]:
    """Kinetic energy in J, and in C how far geoms are within each other where MuJoCo lets them touch; states (T, N, ...)."""
    mujoco = panda.import_mujoco()
    compiled = model.model(env.num_links)
    data = mujoco.MjData(compiled)
    in_c = isinstance(states.physics, chains.Joints)
    positions, velocities, more = _for_mujoco(states)
    greatest = {"energy_J": 0.0} | (dict.fromkeys(IN_C, 0.0) if in_c else {})
    names = _contact_names(env.num_links)
    for qpos, qvel, of_heads in zip(positions, velocities, more, strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(compiled, data)
        mujoco.mj_energyVel(compiled, data)
        greatest["energy_J"] = max(greatest["energy_J"], data.energy[1] + of_heads)
        if in_c and data.ncon:
            for pair, distance in zip(data.contact.geom, data.contact.dist, strict=True):
                greatest[names[pair[0]]] = max(greatest[names[pair[0]]], -1000.0 * distance)
    return greatest


def _for_mujoco(states: CableState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K, Q) positions and velocities of the model's joints, and (K,) J of what does not move with them: the closed form's heads."""
    physics = states.physics
    if isinstance(physics, chains.Joints):
        positions, velocities = (np.asarray(leaf, float).reshape(-1, leaf.shape[-1]) for leaf in (physics.positions, physics.velocities))
        return positions, velocities, np.zeros(len(positions))
    num = physics.joints.shape[0] * physics.joints.shape[1]
    fingers, speeds = np.asarray(physics.fingers)[..., None], np.asarray(physics.finger_speeds)[..., None]
    arms = [np.concatenate([a, b, -b], axis=-1).reshape(num, 18) for a, b in ((physics.joints, fingers), (physics.velocities, speeds))]
    cables = np.zeros((num, model.model(CableInsertion().num_links).nq - 18))
    of_heads = 0.5 * (np.sum(np.square(physics.head_speeds), axis=-1) @ (geometry.HEAD_MASSES + geometry.CABLE_MASS / 3)).reshape(num)
    return np.concatenate([arms[0], cables], axis=1), np.concatenate([arms[1], cables], axis=1), of_heads


@functools.cache
def _contact_names(num_links: int) -> list[str]:
    """For each geom of the model what its penetration is called, where it is the first of a pair."""
    compiled = model.model(num_links)
    parts = [compiled.geom(index).name.rpartition("_")[2] for index in range(compiled.ngeom)]
    return [_CONTACTS.get(part.rstrip("0123456789"), _CONTACTS["pin"] if part[:4] in ("wall", "slan", "bott") else "fingers_mm") for part in parts]


def versions(options: Options) -> dict[str, str]:
    """Versions of what moves arms and cables."""
    del options
    return report.installed("mujoco")


def tables(rows: list[Row]) -> str:
    """What all back ends have, and the penetrations in MuJoCo."""
    text = (
        f"The greatest values at any step's end, {rows[0]['episodes']} episodes for each line; in how many of them both heads were held at once.\n\n"
    )
    lines = [
        [
            f"`{row['backend']}`",
            row["commands"],
            "all finite" if row["finite"] else "**not finite**",
            f"{row['held_both']:.0%}",
            *(f"{row[k]:.3g}" for k in WORST),
        ]
        for row in rows
    ]
    text += report.table(["back end", "commands", "", "both held", *WORST.values()], lines)
    in_c = [row for row in rows if "pads_mm" in row]
    text += "\nHow far geoms are within each other in C MuJoCo, mm:\n\n"
    return text + report.table(["commands", *IN_C.values()], [[row["commands"], *(f"{row[k]:.3g}" for k in IN_C)] for row in in_c])
