"""Films along a run: what the policy does while it is learnt."""

from __future__ import annotations

import warnings
from pathlib import Path

import jax
import jax.numpy as jnp

from hindrl_jax.base.compilation import in_float32
from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.core.agent import policy
from hindrl_jax.runs.reader import Run
from hindrl_jax.runs.spec import FILMS, FROM_PYTHON, RunSpec
from hindrl_jax.tasks.registry import is_drawn
from hindrl_jax.training.result import Result


class Films:
    """Films the same episode again and again along a run, each time with the policy of that moment and its mean actions."""

    def __init__(self, directory: Path, env: Environment, every: int, *, index: int = 0):
        """Only checks; nothing is written before the first film.

        Args:
          directory: the run's; films are in its folder films/, named after the step.
          env: what is filmed.
          every: steps between two films, as `Result.steps_done` counts them.
          index: which of the result's runs.

        Raises:
          UserError: if nothing draws the environment, or several hosts train, or `every` is no positive number.
        """
        if every < 1:
            raise UserError(f"--render-every {every} is too few: give the number of steps between two films, or leave it out")
        if not is_drawn(env):
            raise UserError(f"nothing draws {env.name}, so there is no film of it: leave out --render-every")
        if jax.process_count() > 1:
            raise UserError("with several hosts nothing is filmed along the run: leave out --render-every")
        self.folder, self.every, self.index = directory / FILMS, every, index
        self._filmed: int | None = None

    @in_float32
    def film_when_due(self, result: Result) -> None:
        """Films an episode if another `every` steps are over. One that cannot be drawn is a warning: the run is worth more.

        A run that is resumed goes on with the films after its checkpoint.
        """
        due = result.steps_done // self.every
        if self._filmed is None:
            self._filmed = due
        if due == self._filmed:
            return
        self._filmed = due
        name = f"step_{result.steps_done:0{len(str(result.config.num_steps))}}.gif"
        try:
            self.folder.mkdir(exist_ok=True)
            _run_of(result, self.index, self.folder).render(self.folder / name)
        except (UserError, OSError) as error:
            warnings.warn(f"no film {name}: {one_line(error)}", stacklevel=2)


def _run_of(result: Result, index: int, path: Path) -> Run:
    """One of the runs as it is now, as if it had been saved and read back."""
    learnt = (result.state.agent, result.guidance.behavioural_goals)
    agent, goals = jax.tree.map(lambda leaf: jnp.asarray(jax.device_get(leaf[index : index + 1])), learnt)  # on one device
    spec = RunSpec(env=result.env, config=result.configs[index], demos=FROM_PYTHON, seeds=(result.seeds[index],))
    return Run(path=path, spec=spec, policies=policy(agent, spec.config, average=True), behavioural_goals=goals)
