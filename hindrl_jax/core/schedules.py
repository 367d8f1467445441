"""What changes along a run."""

from __future__ import annotations

from typing import Any

from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.config import AgentConfig


class Schedule(struct.PyTreeNode, kw_only=True):
    """What holds for the agent at one moment of a run."""

    target_entropy: Array | float  # () in nats, of the whole action
    actor_average_rate: Array | float  # () share of the actor that moves into its running average


def linear(start: Any, end: Any, progress: Any) -> Any:
    """Linear interpolation from start to end; constant if end is None.

    Args:
      start, end: numbers, or () arrays where they are swept.
      progress: share of the run that is over, in [0, 1].
    """
    return start if end is None else start + (end - start) * progress


def schedule(progress: Array | float, updates: Array | int, config: AgentConfig, *, action_dim: int) -> Schedule:
    """What holds at one moment of a run.

    The target entropy moves linearly. With a span s, the rate of the actor's average falls like 1 / (1 + s updates), the polynomial-decay
    averaging of Shamir and Zhang (stochastic gradient descent for non-smooth optimization, 2013).

    Args:
      progress: share of the run that is over, in [0, 1].
      updates: gradient steps so far.
      config, action_dim: of the agent.
    """
    return Schedule(
        target_entropy=action_dim * linear(config.target_entropy, config.final_target_entropy, progress),
        actor_average_rate=1.0 / (1.0 + config.actor_average_span * updates),
    )
