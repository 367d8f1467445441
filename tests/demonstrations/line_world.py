"""A small environment, episodes in which every number says where it belongs, and what the tests of files do with them."""

import dataclasses
import re

import h5py
import numpy as np
import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations.hdf5 import save_demonstrations


@dataclasses.dataclass(frozen=True)
class LineWorld:
    """The least that the dataset functions ask of an environment; the achieved goal is the first entry of the observation."""

    name: str = "LineWorld"
    horizon: int = 6
    size: float = 10.0
    start: tuple[int, int] = (0, 1)
    observation_dim: int = 3
    goal_dim: int = 1
    action_dim: int = 2
    state_dim: int = 2

    def achieved_goal(self, observation):
        return observation[..., :1]


def encoded_episodes(lengths, horizon=6, terminated=None):
    """Every number says where it belongs: observation (episode, t, .), action (episode + t / 100), and padding is NaN, so reading it shows."""
    num, time = len(lengths), np.arange(horizon + 1)
    episode = np.arange(num, dtype=np.float32)[:, None] * np.ones(horizon + 1, np.float32)
    observations = np.stack([100 * episode + time, episode, time * np.ones_like(episode)], axis=-1).astype(np.float32)
    actions = np.stack([episode[:, :-1] / 100, time[:-1] / 100 * np.ones_like(episode[:, :-1])], axis=-1).astype(np.float32)
    rewards = (episode[:, :-1] + time[:-1] / 10).astype(np.float32)
    states = np.stack([episode, time * np.ones_like(episode)], axis=-1).astype(np.float32)
    for i, length in enumerate(lengths):
        observations[i, length + 1 :] = np.nan
        actions[i, length:] = np.nan
        rewards[i, length:] = np.nan
    if terminated is None:
        terminated = np.arange(num) % 2 == 0
    desired_goals = np.arange(num, dtype=np.float32)[:, None] + 0.5
    table = Episodes(
        observations=observations,
        actions=actions,
        rewards=rewards,
        lengths=np.array(lengths, np.int32),
        terminated=np.array(terminated),
        desired_goals=desired_goals,
        states=np.where(time[None, :, None] <= np.array(lengths)[:, None, None], states, np.float32(np.nan)),
    )
    return table


def save(path, lengths=(3, 6, 1), env=None, horizon=6, overwrite=False, **changes):
    """Saves the encoded episodes, with fields replaced by `changes`."""
    env = env or LineWorld()
    table = encoded_episodes(lengths, horizon)
    save_demonstrations(
        path,
        table.replace(**changes),
        env=env,
        env_args=dataclasses.asdict(env),
        expert={"name": "scripted"},
        overwrite=overwrite,
    )
    return path


def assert_refused(call, *words):
    """One line that starts with the file, holds all `words`, and says what to do after a semicolon."""
    with pytest.raises(UserError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    assert re.match(r"\S+\.hdf5: ", message), message
    assert "; " in message, message
    for word in words:
        assert word in message, message


def edit(path, change):
    with h5py.File(path, "r+") as file:
        change(file["data"])
