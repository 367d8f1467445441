"""Training on several hosts."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

import jax

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.cli.train_options import ResumeOptions, TrainOptions


@contextlib.contextmanager
def joined_hosts(options: TrainOptions | ResumeOptions) -> Iterator[bool]:
    """Joins the other hosts, if there are any; yields whether this is the host that writes and prints."""
    if isinstance(options, ResumeOptions):
        yield True
        return
    given = {name: getattr(options, name) for name in ("coordinator", "num_hosts", "host")}
    if not options.distributed:
        for name, value in given.items():
            if value is not None:
                raise UserError(f"--{name.replace('_', '-')} is for training on several hosts: add --distributed, or drop it")
        yield True
        return
    coordinator, num_hosts, host = given.values()
    if any(value is None for value in given.values()) and any(value is not None for value in given.values()):
        raise UserError("--coordinator, --num-hosts and --host belong together: give all three, or none where the cluster tells JAX")
    if coordinator is not None and not re.fullmatch(r"\S+:\d+", coordinator):
        raise UserError(f"--coordinator {coordinator} is not an address: write HOST:PORT")
    if num_hosts is not None and not 0 <= host < num_hosts:
        raise UserError(f"--host {host} is not one of --num-hosts {num_hosts}: count hosts from 0")
    jax.config.update("jax_enable_preemption_service", False)  # it would take the signals that are meant to end the run
    try:
        jax.distributed.initialize(coordinator, num_hosts, host)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"cannot join the other hosts ({one_line(error)}): give --coordinator HOST:PORT --num-hosts N --host I on each") from error
    yield jax.process_index() == 0
    jax.distributed.shutdown()  # waits for the others; so after a failure, which they must notice, it is left out
