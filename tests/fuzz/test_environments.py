"""Environments of Gymnasium drawn at random: what is made of them agrees with a plain loop over the environment, or is refused in one line."""

import contextlib

import gymnasium
import hypothesis.strategies as st
import numpy as np
from fuzzing import COUNTS, accepted, fuzz
from odd_env import FAULTS, SIGNATURES, Odd

import hindrl_jax as hindrl
from hindrl_jax.base.environments import action_from_env, action_to_env
from hindrl_jax.base.steppers import SimulationFailed
from hindrl_jax.tasks.presets import preset
from hindrl_jax.training.recording import record_gymnasium

KIND = "environment"


@st.composite
def environments(draw):
    kind = draw(st.sampled_from(["float32", "float64", "float16", "int8", "int64", "uint8"]))
    low, high = draw(st.sampled_from([(-1, 1), (0, 3), (2, 2), (-5, 5), (0, 1), (3, 9)] + ([] if kind == "uint8" else [(-3, -1)])))
    fault = draw(st.sampled_from([None, None, *(fault for fault in FAULTS if fault != "die")]))
    return dict(
        dims=draw(st.integers(1, 3)),
        action=kind,
        low=0 if low < 0 and kind == "uint8" else low,
        high=high,
        dtype=draw(st.sampled_from(["float32", "float64"])),
        reward=draw(st.sampled_from(["float", "float32", "array"])),
        says=draw(st.sampled_from(["is_success", "success", "reward"])),
        truth=draw(st.sampled_from(["bool", "float", "array", "int", "numpy"])),
        threshold=draw(st.sampled_from([0.35, 0.05, 1e-7, 5.0, None, 0.0])),
        signature=draw(st.sampled_from(["new"] * 6 + list(SIGNATURES))),
        fault=fault,
        when=draw(st.integers(1, 9)),
    )


def plain_loop(arguments, seed, decisions, num_held):
    """(true next observation, whether the goal is reached, whether the episode ends) of each decision, played by hand; ends at a fault."""
    env = gymnasium.wrappers.TimeLimit(Odd(**arguments), 12)
    env.reset(seed=seed)
    for decision in decisions:
        for _ in range(num_held):
            action = decision
            if arguments["action"] in ("int8", "int64", "uint8"):
                action = np.array([round(float(number)) for number in decision])
            action = np.minimum(np.maximum(action, arguments["low"]), arguments["high"]).astype(arguments["action"])
            observation, reward, terminated, truncated, _ = env.step(action)
            if arguments["says"] == "reward":
                reached = abs(float(np.asarray(reward)) - 0.1) < 1e-5
            else:
                reached = bool(env.unwrapped.distance(env.unwrapped.place, env.unwrapped.goal) <= env.unwrapped.radius)
            ended = terminated or truncated or reached
            if ended:
                break
        seen = np.concatenate([observation["observation"], observation["achieved_goal"]]).astype(np.float32)
        yield seen, reached, ended, np.asarray(action, float), observation["desired_goal"].astype(np.float32)
        if ended:
            return


@fuzz(KIND, environments(), st.integers(0, 2**31), st.integers(1, 3))
def test_environments(arguments, seed, num_held, **_):
    def made():
        env = hindrl.make("gymnasium:odd_env:Odd-v0", **arguments)
        _ = env.description
        return env

    env = accepted(KIND, made)
    broken = arguments["signature"] != "new" or (
        arguments["fault"] not in (None, "nan", "nan_goal", "infinite", "no_reset") and arguments["when"] == 1
    )
    if env is None:
        assert broken
        return
    threshold = arguments["threshold"]
    epsilon = preset("hindrl", env=env).goal.epsilon
    assert epsilon is None if threshold is None else 0.999 * threshold <= epsilon * env.goal_dim**0.5 * (1 + 1e-6) <= threshold * (1 + 1e-6)
    policy = np.random.default_rng(seed).uniform(-1, 1, (12, env.action_dim)).astype(np.float32)
    decisions = np.asarray(action_to_env(policy, env))
    varies = np.broadcast_to(np.asarray(env.action_low != env.action_high), policy.shape)
    np.testing.assert_allclose(np.where(varies, action_from_env(decisions, env), 0.0), np.where(varies, policy, 0.0), atol=1e-4)
    stepper, failed = env.stepper(1, num_held=num_held), ""
    with contextlib.closing(stepper):
        expected = plain_loop(arguments, seed, decisions, num_held)
        try:
            stepper.begin(np.array([seed]))
            for decision in decisions:
                outcome = stepper.step(decision[None], autoreset=False)
                seen, reached, ended, _, goal = next(expected)
                np.testing.assert_array_equal(outcome.next_observation[0], seen)
                assert outcome.success[0] == reached
                assert outcome.ended[0] == ended
                assert np.isfinite(seen).all()
                assert np.isfinite(goal).all()
                if ended:
                    break
        except SimulationFailed as error:
            COUNTS[KIND]["fault said"] += 1
            failed = str(error)
    assert not failed or arguments["fault"] is not None
    assert not failed or ("\n" not in failed and "step" in failed)
    if not failed and arguments["fault"] is None and arguments["threshold"] == 5.0:
        demos = record_gymnasium(env, lambda observation, rng: rng.uniform(env.action_low, env.action_high), 1, seed=seed)
        assert np.isfinite(demos.actions).all()
        assert np.abs(demos.actions).max() <= 1.0
