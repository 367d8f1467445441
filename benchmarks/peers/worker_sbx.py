"""Gradient steps of sbx.TQC (Stable-Baselines in JAX), for `protocol` to time.

What is called is `model.train(gradient_steps, batch_size)`, as `learn` calls it. It draws the batches of all its gradient steps at once and runs
them in one compiled loop (`jax.lax.fori_loop`), the faster the more steps share a call: at batch 4096 on two cores, 100 ms per step with 1 (the
default of `learn`), 60 with 5 or 10, 54 with 20. The number of steps is compiled in, and another number means compiling again; therefore every call
here makes `--steps-per-call` steps, the warm-up included.

SBX has exactly two critics, as two separate networks; its `n_critics` only enters the number of quantiles that are kept. Truncation sorts all
quantiles of both target critics and drops the highest drop * 2 of them.

JAX chooses the device; JAX_PLATFORMS=cpu keeps it on the CPU where it has a choice.
"""

import argparse
from collections.abc import Callable
from typing import Any

import jax
import protocol
from flax import linen
from sbx import TQC

PACKAGES = ["jax", "jaxlib", "flax", "optax", "torch", "sbx-rl", "stable-baselines3", "gymnasium", "numpy"]


def build(arguments: argparse.Namespace) -> Callable[[int], None]:
    """Returns `train(gradient_steps)` of a model with these sizes and a full replay buffer."""
    model = TQC(**protocol.tqc_settings(arguments, activation=linen.relu))
    policy = model.policy
    critics = [policy.qf1_state.params, policy.qf2_state.params]
    protocol.check_sizes(arguments, actor=count(policy.actor_state.params), critics=count(critics))
    protocol.prepare(model)

    def train(gradient_steps: int) -> None:
        model.train(gradient_steps=gradient_steps, batch_size=arguments.batch_size)
        jax.block_until_ready((policy.actor_state, policy.qf1_state, policy.qf2_state, model.ent_coef_state))

    return train


def count(parameters: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(parameters))


if __name__ == "__main__":
    protocol.run(build, description=__doc__, packages=PACKAGES)
