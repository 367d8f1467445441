"""Demonstrations in the formats of other tools: what they hold, and conversions to and from our own files.

NAME.hdf5           ours, or of robomimic or robosuite; which of them, the file says
NAME.npz            see `hindrl_jax.demonstrations.npz`
minari:NAME-v0      a Minari dataset, see `hindrl_jax.demonstrations.minari`
"""

from __future__ import annotations

import os
from pathlib import Path

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import check_can_write, write_atomically
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations import minari, npz, robomimic
from hindrl_jax.demonstrations.episodes import as_episodes
from hindrl_jax.demonstrations.foreign import ForeignRecording, Interpretation
from hindrl_jax.demonstrations.hdf5 import check_recording, load_demonstrations, read_recording, write_recording
from hindrl_jax.demonstrations.interpret import interpret, redeclared
from hindrl_jax.demonstrations.recording import Recording
from hindrl_jax.tasks.registry import TASKS, make

_HDF5 = (".hdf5", ".h5")
_NPZ = ".npz"
MINARI_PREFIX = minari.PREFIX


def open_source(source: str) -> ForeignRecording | Recording:
    """What a file or dataset holds: a recording if it says all that we need to know, else what is still to be interpreted.

    Raises:
      UserError: it is missing or damaged, or of a kind that is not known.
    """
    if source.startswith(MINARI_PREFIX):
        return minari.read(source.removeprefix(MINARI_PREFIX))
    path = Path(source)
    if path.suffix == _NPZ:
        found = npz.read(path)
        if isinstance(found, Recording):
            check_recording(found, path)
        return found
    return read_recording(path) if robomimic.is_ours(path) else robomimic.read(path)


def read(source: str, meaning: Interpretation | None = None, env: Environment | None = None, *, as_env: bool = False) -> Recording:
    """Reads demonstrations of any format.

    Args:
      source: a file, or minari:NAME-v0.
      meaning: what the modalities of a file of another tool are; of no use for files that hindrl_jax has written.
      env: the environment of the task, if it is one that we know and the file does not say so.
      as_env: whether the demonstrations are declared to be of `env`, whatever the file says.

    Raises:
      UserError: it cannot be read, or does not hold what is needed; the message says what to do.
    """
    return understand(open_source(source), source, meaning, env, as_env=as_env)


def understand(
    found: ForeignRecording | Recording,
    source: str,
    meaning: Interpretation | None = None,
    env: Environment | None = None,
    *,
    as_env: bool = False,
) -> Recording:
    """The second half of `read`, for what `open_source` has found."""
    declared = env is not None and (as_env or env.name == found.env_name.rpartition(":")[2])  # or it names the same task without its module
    if isinstance(found, Recording):
        if meaning not in (None, Interpretation()):
            raise UserError(
                f"{source}: was written by hindrl_jax, which has said what is what; leave out the options about keys, actions and success"
            )
        if env is None:
            return found
        if not declared:
            raise UserError(f"{source}: {_says_itself(found)}")
        recording = redeclared(found, env, source)
        check_recording(recording, source)
        return recording
    if found.env_name in TASKS and not declared:
        if env is not None:
            raise UserError(f"{source}: {_says_itself(found)}")
        env = make(found.env_name, **found.env_kwargs)
    recording = interpret(found, meaning or Interpretation(), env)
    check_recording(recording, source)
    return recording


def _says_itself(found: ForeignRecording | Recording) -> str:
    return f"says itself that it is of {found.env_name}; leave out --env, or declare it to be of another task with --as-env"


def load(source: str, env: Environment, *, num_demos: int | None = None) -> Episodes:
    """Demonstrations of any format to learn from in `env`, as `load_demonstrations` gives them.

    A file of another tool must have the usual names (observation, and perhaps desired_goal); else convert it first.

    Raises:
      UserError: as `read` and `load_demonstrations`.
    """
    if not source.startswith(MINARI_PREFIX) and Path(source).suffix != _NPZ and robomimic.is_ours(Path(source)):
        return load_demonstrations(source, env, num_demos=num_demos)
    found = open_source(source)
    if isinstance(found, ForeignRecording):
        if found.env_name.startswith(minari.GYMNASIUM) and found.env_name.rpartition(":")[2] != env.name.rpartition(":")[2]:  # modules apart
            raise UserError(f"{source}: was recorded in {found.env_name}, not in {env.name}; train in the former")
        try:
            found = understand(found, source, env=None if found.env_name in TASKS else env)
        except UserError as error:
            raise UserError(f"{error} (an option of `hindrl demos convert`, which makes a file to learn from)") from error
    return as_episodes(found, env, where=source, num_demos=num_demos)


def check_target(target: str, *, overwrite: bool) -> None:
    """Makes sure, before any work is done, that `write` can write there.

    Raises:
      UserError: if not.
    """
    if target.startswith(MINARI_PREFIX):
        minari.check_writable(target.removeprefix(MINARI_PREFIX), overwrite=overwrite)
    else:
        _suffix(target)
        check_can_write(Path(target), overwrite=overwrite)


def write(target: str, recording: Recording, *, overwrite: bool = False) -> None:
    """Writes demonstrations in the format that the name says. Afterwards the target holds either all of them or what it held before.

    Args:
      target: NAME.hdf5 for a file of ours, NAME.npz, or minari:NAME-v0.
      recording: from `read`.
      overwrite: whether something that is there may be replaced.

    Raises:
      UserError: it cannot be written.
    """
    if target.startswith(MINARI_PREFIX):
        minari.write(target.removeprefix(MINARI_PREFIX), recording, overwrite=overwrite)
    elif _suffix(target) == _NPZ:
        write_atomically(Path(target), npz.content(recording), overwrite=overwrite)
    else:
        write_recording(target, recording, overwrite=overwrite)


def restore(target: str | os.PathLike[str], recording: Recording, *, source: str, overwrite: bool = False) -> None:
    """Writes the robomimic file that a recording, read from `source`, was converted from.

    Raises:
      UserError: it was not, or the file cannot be written.
    """
    if _suffix(str(target)) not in _HDF5:
        raise UserError(f"{target}: a robomimic file ends in .hdf5; name it so")
    write_atomically(Path(target), robomimic.restored(recording, source), overwrite=overwrite)


def _suffix(target: str) -> str:
    """The ending that says the format of a file to write."""
    suffix = Path(target).suffix
    if suffix not in (*_HDF5, _NPZ):
        raise UserError(f"{target}: its name does not say a format; end it in .hdf5 or .npz, or write minari:NAME-v0")
    return suffix


def left_out(target: str, recording: Recording) -> list[str]:
    """What of a recording does not go into this target, a line for each; nothing for a file."""
    if not target.startswith(MINARI_PREFIX):
        return []
    return minari.left_out(recording)
