"""Gradient steps of sb3_contrib.TQC (PyTorch on the CPU), for `protocol` to time.

What is called is `model.train(gradient_steps, batch_size)`, as `learn` calls it. It is a Python loop with a fresh replay batch at every step, so
`--steps-per-call` makes no difference to it. Nothing waits in the background when it returns: PyTorch on the CPU computes eagerly.

Both critics run one after the other (a list of networks); truncation sorts all quantiles of both target critics and drops the highest
drop * num_critics of them.

Two settings of the environment change what is measured. Both are left to the caller, because their defaults are what a user of SB3 gets:

- MALLOC_MMAP_THRESHOLD_=2000000000 MALLOC_TRIM_THRESHOLD_=4000000000 (glibc): at batch 4096 the tensors of the pairwise loss take 38 MB each, and
  glibc by default hands such memory back to the system and fetches it again at every use. With these two a step takes a third of the time (110 ms in
  place of 360 on two cores) and yields the same numbers bit for bit.
- OMP_WAIT_POLICY=passive: PyTorch's threads by default spin while they wait for work, and CPU time counts that, many times over if they wait for a
  core that something else keeps busy. Passive ones sleep; CPU time falls a little and wall-clock time rises.
"""

import argparse
from collections.abc import Callable, Iterable

import protocol
import torch
from sb3_contrib import TQC

PACKAGES = ["torch", "sb3-contrib", "stable-baselines3", "gymnasium", "numpy"]


def build(arguments: argparse.Namespace) -> Callable[[int], None]:
    """Returns `train(gradient_steps)` of a model with these sizes and a full replay buffer."""
    model = TQC(**protocol.tqc_settings(arguments, activation=torch.nn.ReLU))
    protocol.check_sizes(arguments, actor=count(model.actor.parameters()), critics=count(model.critic.parameters()))
    protocol.prepare(model)

    def train(gradient_steps: int) -> None:
        model.train(gradient_steps=gradient_steps, batch_size=arguments.batch_size)

    return train


def count(parameters: Iterable[torch.Tensor]) -> int:
    return sum(parameter.numel() for parameter in parameters)


if __name__ == "__main__":
    protocol.run(build, description=__doc__, packages=PACKAGES)
