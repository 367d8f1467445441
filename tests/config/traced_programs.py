"""The training program of a config as it is traced, to be compared with that of another config."""

import contextlib
import itertools
import re

import jax
import numpy as np
from flax.errors import FlaxError
from jax.experimental.key_reuse._core import check_key_reuse_jaxpr
from jax.interpreters import partial_eval
from toy_env import Corridor, corridor_demonstrations

from hindrl_jax.config import sweepable_value, with_traced_values
from hindrl_jax.config.sweeps import SWEEPABLE
from hindrl_jax.core import agent, imitation, train
from hindrl_jax.core.guidance import guidance

ENV, DEMONSTRATIONS = Corridor(), corridor_demonstrations()


def swept(config):
    """The fields that are arguments of the program, and their values; those that are None choose another program."""
    values = {name: sweepable_value(config, name) for name in SWEEPABLE}
    return {name: np.float32(value) for name, value in values.items() if value is not None}


class Stages:
    """From demonstrations to the policy that is evaluated and saved, as `fit` goes about it. Stages take the values of swept fields first."""

    def __init__(self, config):
        self.config = config

    def given(self, values):
        return dict(env=ENV, config=with_traced_values(self.config, values))

    def take(self, values, key, demonstrations):
        return key, guidance(demonstrations, ENV, with_traced_values(self.config, values))

    def begin(self, values, key, data):
        return train.init(key, data, **self.given(values)), data

    def collect(self, values, state, data):
        return train.collect(state, data, **self.given(values), num_iterations=train.warm_up_iterations(ENV, self.config)), data

    def imitate(self, values, state, data):
        practice = imitation.no_practice(ENV)
        for index in range(self.config.practice_rounds + 1):
            state, _ = imitation.imitate(state, data, practice, **self.given(values))
            if index < self.config.practice_rounds:
                practice, _ = imitation.practise(state, data, practice, **self.given(values))
        return state, data

    def clone(self, values, state, data):
        return agent.policy(train.clone(state, data, **self.given(values), num_iterations=2)[0].agent, self.config, average=True)

    def learn(self, values, state, data):
        return agent.policy(train.learn(state, data, **self.given(values), num_iterations=2)[0].agent, self.config, average=True)

    def draw(self, values, state, data):
        """The first half of what `learn` does after a step of the environments."""
        return train.draw_batches(state.key, state, data, **self.given(values)), state

    def descend(self, values, batches, state):
        """The second half."""
        return agent.policy(train.gradient_steps(state.key, state, batches, **self.given(values))[0].agent, self.config, average=True)

    def whole(self, values, key, demonstrations):
        carry = self.begin(values, *self.take(values, key, demonstrations))
        if not self.config.learns_from_rollouts:
            return self.clone(values, *carry)
        carry = self.collect(values, *carry)
        return self.learn(values, *(self.imitate(values, *carry) if self.config.imitation_steps else carry))

    def parts(self):
        """Most of the same, in parts."""
        names = ("take", "begin", "clone") if not self.config.learns_from_rollouts else ("take", "begin", "collect", "imitate", "draw", "descend")
        return {name: getattr(self, name) for name in names if name != "imitate" or self.config.imitation_steps}


class Traced:
    """A function of swept values and others, traced; `text` is what leads to its used outputs, which are named by their paths.

    Raises:
      KeyReuseError: if it consumes a random key twice.
    """

    def __init__(self, function, values, arguments, used_outputs=None):
        closed, self.shapes = jax.make_jaxpr(function, return_shape=True)(values, *arguments)
        check_key_reuse_jaxpr(closed.jaxpr)
        outputs = paths(self.shapes)
        self.closed, self.inputs = closed, [*values, *paths(arguments)]
        self.keep(set(outputs) if used_outputs is None else used_outputs, outputs)

    def keep(self, used_outputs, outputs=None):
        is_used = [output in used_outputs for output in outputs or paths(self.shapes)]
        alive, used_constants, used_inputs = partial_eval.dce_jaxpr_consts(self.closed.jaxpr, is_used)
        constants = [np.asarray(value).tolist() for value, is_used in zip(self.closed.consts, used_constants, strict=True) if is_used]
        # Newer JAX writes down which Python structures a loop was called with, unused parts included.
        self.text, self.used_outputs = re.sub(r"\n\s*ft_(in|out)=.*", "", f"{alive} {constants}"), used_outputs
        self.used_inputs = {name for name, is_used in zip(self.inputs, used_inputs, strict=True) if is_used}


def paths(tree):
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]


class Program:
    """A config's program, to be compared with others."""

    ARGUMENTS = (jax.random.key(0), DEMONSTRATIONS)

    def __init__(self, config):
        self.values = dict(sorted(swept(config).items()))
        self.whole = Traced(Stages(config).whole, self.values, self.ARGUMENTS)
        self.used_values = self.whole.used_inputs & self.values.keys()
        self.parts, self.given, arguments = {}, {}, self.ARGUMENTS
        for name, part in Stages(config).parts().items():
            self.given[name] = arguments
            self.parts[name] = Traced(part, self.values, arguments)
            arguments = self.parts[name].shapes
        for part, following in reversed(list(itertools.pairwise(self.parts.values()))):
            part.keep(following.used_inputs - self.values.keys())

    def is_that_of(self, config):
        return Traced(Stages(config).whole, self.values, self.ARGUMENTS).text == self.whole.text

    def differs_from(self, config, first=()):
        """The opposite, found out part by part, since most changes show early; what shows in no part is looked for in the whole.

        The parts named `first` come before the others, given what they are given here: where a change shows in them, it is as good as found.
        """
        for name in self.parts.keys() & set(first):
            with contextlib.suppress(TypeError, ValueError, FlaxError):  # it wants other shapes
                if Traced(getattr(Stages(config), name), self.values, self.given[name], self.parts[name].used_outputs).text != self.parts[name].text:
                    return True
        arguments = self.ARGUMENTS
        for name, part in Stages(config).parts().items():
            own = self.parts.get(name)
            other = Traced(part, self.values, arguments, own and own.used_outputs)
            if own and other.text != own.text:
                return True
            arguments = other.shapes
        return not self.is_that_of(config)
