"""Gradient steps of hindrl_jax, for `gradient_step` to time: a worker that speaks like those in `peers`.

    python -m benchmarks.worker_ours --who ours --setting grid

It prints `ready` when it has compiled; each line that it then reads is a number of gradient steps (a multiple of the setting's `steps_per_call`),
and it answers with one line of JSON, {"steps": 20, "cpu_ms": 54.1, "wall_ms": 28.2}, milliseconds per gradient step. It ends where its input ends.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import Any

import jax

from benchmarks import passes, timing
from benchmarks.loop import Loop, first_seed
from benchmarks.settings import SETTINGS, Setting
from hindrl_jax.base.types import Array, Transition
from hindrl_jax.core import agent as agents
from hindrl_jax.core.agent import AgentState
from hindrl_jax.core.batch import sample_batch
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.schedules import schedule
from hindrl_jax.core.train import TrainState


def whole_loop(setting: Setting) -> Callable[[], None]:
    """`train.learn`: environment steps, insertion into the replay, sampling and relabelling included."""
    return Loop(setting.config).learner(setting.steps_per_call)


def update_alone(setting: Setting) -> Callable[[], None]:
    """`agent.update` on one batch that stays the same."""
    config, loop = setting.config, Loop(setting.config)
    now = schedule(0.0, 0, config.agent, action_dim=loop.env.action_dim)

    @jax.jit
    def prepare(state: TrainState, data: Guidance) -> Transition:
        state, data = first_seed((state, data))
        return sample_batch(jax.random.key(0), state.replay, data, state.env_steps, loop.env, config)

    def updates(agent: AgentState, key: Array, batch: Transition) -> tuple[AgentState, Any]:
        def one(agent: AgentState, key: Array) -> tuple[AgentState, Any]:
            return agents.update(key, agent, batch, now, config)

        return jax.lax.scan(one, agent, jax.random.split(key, setting.steps_per_call))

    agent, key, batch = first_seed(loop.state.agent), jax.random.key(1), prepare(loop.state, loop.data)
    compiled = jax.jit(updates, donate_argnums=0).lower(agent, key, batch).compile()

    def call() -> None:
        nonlocal agent
        agent, metrics = compiled(agent, key, batch)
        jax.block_until_ready((agent, metrics))

    return call


def network_passes(setting: Setting, *, own: bool) -> Callable[[], None]:
    """See `passes`."""
    dims, config, batch_size = setting.dims(), setting.config.agent, setting.config.batch.batch_size
    form = passes.own(config, dims["action_dim"], batch_size) if own else passes.plain(dims["action_dim"])
    return passes.stepper(form, config, **dims, batch_size=batch_size, num_steps=setting.steps_per_call)


CONTESTANTS: dict[str, Callable[[Setting], Callable[[], None]]] = {
    "ours": whole_loop,
    "ours-update": update_alone,
    "passes": lambda setting: network_passes(setting, own=False),
    "passes-own": lambda setting: network_passes(setting, own=True),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--who", choices=CONTESTANTS, required=True)
    parser.add_argument("--setting", choices=SETTINGS, required=True)
    arguments = parser.parse_args()
    setting = SETTINGS[arguments.setting]
    contestant = timing.calls(CONTESTANTS[arguments.who](setting), units=setting.steps_per_call)
    contestant.turn(1)
    print("ready", flush=True)
    for request in sys.stdin:
        steps = int(request)
        cost = contestant.turn(steps // contestant.units)
        print(json.dumps({"steps": steps, "cpu_ms": 1000.0 * cost.cpu / steps, "wall_ms": 1000.0 * cost.wall / steps}), flush=True)


if __name__ == "__main__":
    main()
