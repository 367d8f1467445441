"""`check_environment`: faults planted in a small task, one line each; the project's own tasks have none."""

import dataclasses
import itertools
import sys
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refusal
from toy_env import Corridor

import hindrl_jax as hindrl
from hindrl_jax.base.errors import UserError
from hindrl_jax.envs import BringNear, CableInsertion, FixedGridPickAndPlace, FixedParameterizedReach, GridPickAndPlace, ParameterizedReach
from hindrl_jax.tasks.registry import TASKS

EXAMPLES = Path(__file__).parent.parent.parent / "examples"


@pytest.mark.parametrize(
    "env",
    [
        Corridor(),
        GridPickAndPlace(num_objects=1, strict_order=False, horizon=10),
        FixedGridPickAndPlace(num_objects=1, horizon=40),
        FixedParameterizedReach(horizon=8),
        ParameterizedReach(horizon=8),
        pytest.param(BringNear(horizon=3), marks=pytest.mark.slow),  # 13 s of one core each
        pytest.param(CableInsertion(horizon=3), marks=pytest.mark.slow),
    ],
    ids=lambda env: env.name,
)
def test_the_projects_own_tasks_have_no_fault(env):
    hindrl.check_environment(env)


@pytest.mark.parametrize(("module", "name"), [("two_rooms", "TwoRooms"), ("planar_arm", "PlanarArm")])
def test_the_examples_have_no_fault(monkeypatch, module, name):
    monkeypatch.setattr(sys, "path", [*sys.path, str(EXAMPLES)])
    hindrl.check_environment(hindrl.make(f"{module}:{name}"))
    assert TASKS[name].expert is not None  # and so the task was solved, too


def faulty(arguments=None, **changes):
    """The corridor with other arguments, methods or class variables."""
    kind = dataclasses.dataclass(frozen=True)(type("Faulty", (Corridor,), {"__annotations__": {}, **changes}))
    return kind(**(arguments or {}))


def with_step(change):
    """What becomes of a step: change(state before, state after, time step) -> (state, time step)."""

    def step(self, state, action):
        return change(self, state, *Corridor.step(self, state, action))

    return {"step": step}


def in_python(self, state, action):
    return Corridor.step(self, state, action) if action[0] > 0 else Corridor.step(self, state, -action)


def without_clipping(self, state, action):
    after, time_step = Corridor.step(self, state, action)
    after = after.replace(position=state.position + action[0])
    return after, time_step.replace(observation=self.observe(after))


COUNTER = itertools.count()
FAULTS = {
    "integer observation": ({"observe": lambda self, state: jnp.ones(3, jnp.int32)}, "the observation of reset is of int32, not float32: convert it"),
    "observation_dim": ({"observation_dim": 4}, r"the observation of reset has shape \(3,\), and observation_dim says \(4,\): correct one of them"),
    "goal_dim": ({"goal_dim": 2}, r"achieved_goal of observations \(3,\) has shape \(1,\), and goal_dim says \(2,\)"),
    "unbatched goal": ({"achieved_goal": lambda self, observation: observation[2:]}, r"observations \(2, 3, 3\) has shape \(0, 3, 3\), and goal_dim"),
    "task goal": ({"task_goal": lambda self: jnp.array([jnp.nan])}, r"task_goal\(\) is not finite"),
    "state_dim": ({"state_dim": 9}, r"state_to_vector\(state\) has shape \(3,\), and state_dim says \(9,\)"),
    "horizon": ({"arguments": {"horizon": 2.5}}, "horizon = 2.5 is no whole number of at least 1"),
    "infinite bounds": ({"action_high": np.inf}, "the bounds of its actions are not finite: give action_low and action_high finite numbers"),
    "bounds the wrong way round": ({"action_low": 3.0}, "action_low is not below action_high: correct the bounds"),
    "too many bounds": ({"action_low": (0.0, 0.0, 0.0)}, "action_low is not 2 numbers, or one for all"),
    "not hashable": ({"arguments": {"width": jnp.array(3.0)}}, "it is not hashable .* make it a frozen dataclass"),
    "python branch": (
        {"step": in_python},
        r"step\(state, action\) fails \(TracerBoolConversionError.* write jnp.where or jax.lax.cond in place of `if`",
    ),
    "numpy": ({"observe": lambda self, state: jnp.asarray(np.array([state.start, 0, 0]))}, r"reset\(key\) fails .* write jnp in place of np"),
    "no time step": (
        {"step": lambda self, state, action: (state, 0.0, False, {})},
        r"step\(state, action\) returns no state and hindrl_jax.TimeStep",
    ),
    "type of the state": (
        with_step(lambda self, before, after, step: (after.replace(step=after.step * 1.0), step)),
        r"state.step is int32 \(\) after reset and float32 \(\) after step: a scan needs both alike",
    ),
    "type of the reward": (
        with_step(lambda self, before, after, step: (after, step.replace(reward=step.terminated))),
        "the reward is of bool, not float32",
    ),
    "numpy's randomness": (
        with_step(lambda self, before, after, step: (after.replace(position=after.position + np.random.default_rng().uniform()), step)),
        "step is another function each time that it is compiled: draw from the key, not from NumPy or a clock",
    ),
    "a counter": (
        {"reset": lambda self, key: Corridor.reset(self, jax.random.fold_in(key, next(COUNTER)))},
        "reset is another function each time that it is compiled",
    ),
    "lost state": (
        {"vector_to_state": lambda self, key, vector: Corridor.vector_to_state(self, key, vector.at[1].set(0.0))},
        "entry 1 of a state's vector is .* make vector_to_state the inverse of state_to_vector",
    ),
    "steps that are not written down": (
        {
            "state_dim": 2,
            "state_to_vector": lambda self, state: jnp.stack([state.start, state.position]),
            "vector_to_state": lambda self, key, vector: Corridor.vector_to_state(self, key, jnp.append(vector, 0.0)),
        },
        r"observation\[1\] after step 2 is 2, and 1 where the state before has gone through its vector: write all of the state but its key",
    ),
    "stale observation": (
        with_step(lambda self, before, after, step: (after, step.replace(observation=self.observe(before)))),
        r"observation\[1\] of step 1 is 0, and observe\(state\) says 1: return self.observe\(state\) of the new state in step",
    ),
    "no clipping": ({"step": without_clipping}, "actions beyond the bounds do more than those at them: clip them in step"),
    "not finite": (
        with_step(lambda self, before, after, step: (after, step.replace(observation=step.observation.at[0].set(jnp.inf)))),
        r"observation\[0\] is inf after 1 steps, which is not finite: look for divisions by 0",
    ),
    "end without reward": (
        {"arguments": {"width": 0.5}, **with_step(lambda self, before, after, step: (after, step.replace(reward=jnp.zeros(()))))},
        "the reward is 0 after . steps of an episode, where terminated is True: give 1 at the step that solves the task",
    ),
    "reward without end": (
        with_step(lambda self, before, after, step: (after, step.replace(reward=jnp.ones(())))),
        "the reward is 1 after 1 steps of an episode, where terminated is False",
    ),
    "both ends": (
        {"arguments": {"width": 0.5}, **with_step(lambda self, before, after, step: (after, step.replace(truncated=step.terminated)))},
        "terminated and truncated are both true after . steps of an episode",
    ),
    "early end": (
        with_step(lambda self, before, after, step: (after, step.replace(truncated=(after.step >= 2) & ~step.terminated))),
        "an episode is truncated after 2 steps of an episode, and the horizon is 5: truncate where the steps reach the horizon",
    ),
    "no end": (
        {"arguments": {"width": 99.0}, **with_step(lambda self, before, after, step: (after, step.replace(truncated=jnp.zeros((), bool))))},
        "an episode goes on after 5 steps, its horizon: let truncated be true there",
    ),
    "beyond the bounds of observations": ({"observation_high": 2.0}, r"observation\[.\] is .* beyond observation_low or observation_high"),
}


@pytest.mark.parametrize(("changes", "message"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_one_line_with_its_cause(changes, message):
    with pytest.raises(UserError, match=f"^Corridor: .*{message}") as error:
        hindrl.check_environment(faulty(**changes))
    assert "\n" not in str(error.value)


def test_what_is_missing_is_named():
    class Half:
        name = "Half"
        horizon = 3

    with pytest.raises(UserError, match=r"Half lacks .*reset.*step.*vector_to_state.*RestorableEnvironment"):
        hindrl.check_environment(Half())


def test_a_start_that_never_differs_is_a_warning():
    env = faulty(reset=lambda self, key: Corridor.reset(self, jax.random.wrap_key_data(jnp.array([0, 1], jnp.uint32))))
    with pytest.warns(UserWarning, match="Corridor: reset begins in the same state whatever its key is"):
        hindrl.check_environment(env)


@dataclasses.dataclass(frozen=True)
class EndlessCorridor(Corridor):
    """Forgets its horizon."""

    name: ClassVar[str] = "EndlessCorridor"

    def step(self, state, action):
        state, time_step = super().step(state, action)
        return state, time_step.replace(truncated=jnp.zeros((), bool))


def test_training_a_task_of_ones_own_checks_it_before_anything_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(TASKS, "EndlessCorridor", None)
    hindrl.register(EndlessCorridor)
    line = refusal(capsys, "train", "--env", f"{__name__}:EndlessCorridor", "--width", "99", "--demos", "1", "--out", tmp_path / "run")
    assert "EndlessCorridor: an episode goes on after 5 steps, its horizon" in line
    assert not (tmp_path / "run").exists()
