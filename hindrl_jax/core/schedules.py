"""What changes along a run."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.config import AgentConfig


class Schedule(struct.PyTreeNode, kw_only=True):
    """What holds for the agent at one moment of a run."""

    learning_rate: Array | float  # () step size of Adam
    target_entropy: Array | float  # () in nats
    actor_average_rate: Array | float  # () share of the actor that moves into its running average
    bc_weight: Array | float  # () weight of the behaviour cloning loss


def linear(start: Any, end: Any, progress: Any) -> Any:
    """Linear interpolation from start to end; constant if end is None.

    Args:
      start, end: numbers, or () arrays where they are swept.
      progress: share of the run that is over, in [0, 1].
    """
    return start if end is None else start + (end - start) * progress


def schedule(progress: Array | float, updates: Array | int, config: AgentConfig, *, action_dim: int) -> Schedule:
    """What holds at one moment of a run.

    Learning rate, target entropy and the weight of cloning move linearly. With a span s, the rate of the actor's average falls like
    1 / (1 + s updates), the polynomial-decay averaging of Shamir and Zhang (stochastic gradient descent for non-smooth optimization, 2013).

    Args:
      progress: share of the run that is over, in [0, 1].
      updates: gradient steps so far.
      config, action_dim: of the agent.
    """
    entropy = -float(action_dim) if config.target_entropy is None else config.target_entropy
    return Schedule(
        learning_rate=linear(config.learning_rate, config.final_learning_rate, progress),
        target_entropy=linear(entropy, config.final_target_entropy, progress),
        actor_average_rate=jnp.minimum(config.actor_average_rate, 1.0 / (1.0 + config.actor_average_span * updates)),
        bc_weight=linear(config.bc_weight, config.final_bc_weight, progress),
    )
