"""One of our grid tasks as an environment of robomimic, and demonstrations of it in files that robomimic itself writes.

`python tests/interop/robomimic_grid.py FOLDER`, where robomimic is installed, makes the file of which tests/data/robomimic_low_dim.hdf5 is a copy.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import robomimic.envs.env_base as env_base
import robomimic.utils.env_utils as env_utils
from robomimic.scripts.dataset_states_to_obs import dataset_states_to_obs
from robomimic.scripts.split_train_val import split_train_val_from_hdf5

from hindrl_jax.base.environments import action_to_env
from hindrl_jax.demonstrations.hdf5 import read_recording
from hindrl_jax.tasks.registry import make

KEYS = ("objects", "goal", "delivered", "held")
"""Modalities that together, in this order, are the observation of the grid tasks."""


class RobomimicGrid(env_base.EnvBase):
    """A grid task behind robomimic's interface: the observation in parts, states as vectors, actions in [-1, 1]."""

    def __init__(self, env_name, render=False, render_offscreen=False, use_image_obs=False, postprocess_visual_obs=True, **kwargs):
        self._env, self._kwargs = make(env_name, **kwargs), kwargs
        self._step = jax.jit(self._env.step)
        self.reset()

    def reset(self):
        self._state, _ = self._env.reset(jax.random.key(0))
        self._solved = False
        return self.get_observation()

    def reset_to(self, state):
        self._state = self._env.vector_to_state(jax.random.key(0), jnp.asarray(state["states"]))
        self._solved = bool(self._env.is_solved(self._state))
        return self.get_observation()

    def step(self, action):
        self._state, time_step = self._step(self._state, action_to_env(jnp.asarray(action, jnp.float32), self._env))
        self._solved = bool(time_step.terminated)
        return self.get_observation(), self.get_reward(), self.is_done(), {}

    def get_observation(self, obs=None):
        observation, count = np.asarray(self._env.observe(self._state)), self._env.num_objects
        return dict(zip(KEYS, np.split(observation, np.cumsum([2 * count, 2, count])), strict=True))

    def get_state(self):
        return {"states": np.asarray(self._env.state_to_vector(self._state))}

    def get_reward(self):
        return float(self._solved)

    def get_goal(self):
        return self.get_observation()

    def set_goal(self, **kwargs):
        raise NotImplementedError

    def is_done(self):
        return self._solved

    def is_success(self):
        return {"task": self._solved}

    def render(self, mode="human", height=None, width=None, camera_name=None):
        raise NotImplementedError

    def serialize(self):
        return {"env_name": self._env.name, "type": self.type, "env_kwargs": self._kwargs}

    @classmethod
    def create_for_data_processing(cls, env_name, camera_names, camera_height, camera_width, reward_shaping, **kwargs):
        return cls(env_name, **kwargs)

    @property
    def action_dimension(self):
        return self._env.action_dim

    @property
    def name(self):
        return self._env.name

    @property
    def type(self):
        return env_base.EnvType.GYM_TYPE

    @property
    def version(self):
        return "1"

    @property
    def rollout_exceptions(self):
        return ()

    @property
    def base_env(self):
        return self._env


def tell_robomimic():
    """Lets robomimic's tools find the environment, as one would add a new kind to its env_utils."""
    env_utils.get_env_class = lambda env_meta=None, env_type=None, env=None: RobomimicGrid


def write_raw(recorded: Path, raw: Path) -> None:
    """States and actions of one of our files alone, as robosuite's collecting script and robomimic's conversion of its file leave them."""
    recording = read_recording(recorded)
    with h5py.File(raw, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": recording.env_name, "type": 2, "env_kwargs": recording.env_kwargs}, indent=4)
        for n, demo in enumerate(recording.demonstrations, start=1):
            group = data.create_group(f"demo_{n}")
            group.create_dataset("states", data=demo.states[:-1])
            group.create_dataset("actions", data=demo.actions)
            group.attrs["num_samples"] = len(demo)
        data.attrs["total"] = sum(map(len, recording.demonstrations))


def write_low_dim(raw: Path, name: str, **changes) -> Path:
    """robomimic's own low_dim file of a raw one, beside it, with its filter keys train and valid."""
    tell_robomimic()
    options = dict(
        dataset=str(raw),
        output_name=name,
        n=None,
        shaped=False,
        camera_names=[],
        camera_height=84,
        camera_width=84,
        done_mode=0,
        copy_rewards=False,
        copy_dones=False,
        exclude_next_obs=False,
        compress=False,
    )
    dataset_states_to_obs(argparse.Namespace(**(options | changes)))
    random.seed(0)
    np.random.seed(0)
    split_train_val_from_hdf5(str(raw.parent / name), val_ratio=0.5)
    return raw.parent / name


if __name__ == "__main__":
    from hindrl_jax import cli

    folder = Path(sys.argv[1])
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--out", str(folder / "recorded.hdf5")])
    write_raw(folder / "recorded.hdf5", folder / "raw.hdf5")
    write_low_dim(folder / "raw.hdf5", "robomimic_low_dim.hdf5")
