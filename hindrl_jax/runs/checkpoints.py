"""Checkpoints: all that an experiment needs to go on, bit for bit, after it was stopped or killed.

A checkpoint is a folder `STEPS`, or `practice-ROUNDS` of clones that practise before there are steps. Orbax writes it under another name and renames
it when it is complete, so that half a checkpoint is never read:

arrays      parameters, optimisers, replay, environment states and keys of all seeds, each array under its path in the tree
progress    JSON: the evaluations so far, counters and times

Next to the checkpoints lies `demonstrations.npz`, what the experiment was given. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import DAMAGED_ARCHIVE, read_arrays, write_atomically
from hindrl_jax.base.types import Episodes
from hindrl_jax.training.result import Practising, Result, Row

LAYOUT = 3
DEMONSTRATIONS = "demonstrations.npz"
_ARRAYS = ("guidance", "state", "key", "kept")
_COUNTERS = ("env_steps", "updates", "train_seconds")
_OF_RUNS = ("cloned_success", "practised_success", "practice_steps")
"""What a result has of each run, if it has it."""
_NAME = re.compile(r"(practice-)?[0-9]+")


class Checkpoints:
    """The checkpoints of one experiment, in a folder of their own. The newest is kept.

        checkpoints = Checkpoints("runs/mine/checkpoint", seconds=60)
        hindrl.fit(env, demonstrations, config, report=checkpoints.save_when_due, restore=checkpoints.restore)

    goes on where an earlier call with the same arguments was stopped, if it was.
    """

    def __init__(self, folder: str | os.PathLike[str], *, seconds: float = 60.0):
        """Writes nothing.

        Args:
          folder: where they are kept; made when the first one is written.
          seconds: time between two checkpoints, 0 for as often as there is something new.
        """
        self.folder, self.seconds = Path(folder).absolute(), seconds
        self._newest: Path | None = None  # that was written or read here
        self._saved_at = time.monotonic()

    def save_when_due(self, result: Result) -> None:
        """For `fit`'s `report`: saves if there is something to lose, and the last checkpoint is old enough."""
        if self._saved_at + self.seconds <= time.monotonic():
            self.save(result)

    def save(self, result: Result) -> None:
        """Saves an experiment under way, then removes the checkpoint before. Of one that has neither learnt nor practised, or is finished, nothing is
        saved.

        Raises:
          UserError: if the disk refuses; the checkpoint before is still there.
        """
        name = _name_of(result)
        if name is None or result.final_success is not None or (self._newest is not None and self._newest.name == name):
            return
        if not all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(result.state.agent) if jnp.issubdtype(leaf.dtype, jnp.floating)):
            return  # the next chunk's metrics will say so, and the checkpoint before is worth more
        ocp, arrays = _orbax(), {name: _plain(leaf) for name, leaf in _leaves(result).items()}
        progress = {
            "layout": LAYOUT,
            "shapes": _shapes(arrays),
            "rows": [dataclasses.asdict(row) for row in result.rows],
            "chunks": [{name: [float(value) for value in values] for name, values in chunk.items()} for chunk in result.chunks],
            "evaluation_steps": [] if result.evaluation_steps is None else result.evaluation_steps.tolist(),
            **{name: None if (values := getattr(result, name)) is None else values.tolist() for name in _OF_RUNS},
            "imitation_seconds": result.imitation_seconds,
            "practising": None if result.practising is None else {name: _as_json(value) for name, value in vars(result.practising).items()},
            **{name: getattr(result, name) for name in _COUNTERS},
        }
        path = self.folder / name
        with self._disk_trouble():
            # The keeper of checkpoints would wait for other hosts and threads; one file after the other is all that is needed here.
            self.folder.mkdir(parents=True, exist_ok=True)
            with _plainly_named(path) as named, ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
                items = {"arrays": ocp.args.StandardSave(arrays), "progress": ocp.args.JsonSave(progress)}
                checkpointer.save(named, args=ocp.args.Composite(**items), force=True)
            self._remove_folders(but=path)
        self._newest, self._saved_at = path, time.monotonic()

    def restore(self, begun: Result) -> Result | None:
        """For `fit`'s `restore`: the newest checkpoint, on the devices on which the experiment will go on; None if there is none.

        Raises:
          UserError: if it is damaged, or does not belong to this experiment or to this version of hindrl_jax.
        """
        complete = self._complete()
        if not complete:
            return None
        ocp, path = _orbax(), complete[-1]
        shapes = _leaves(begun)
        target = {name: _plain_shape(leaf) for name, leaf in shapes.items()}
        with self._damage(path), _plainly_named(path) as named, ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            progress = checkpointer.restore(named, args=ocp.args.Composite(progress=ocp.args.JsonRestore())).progress
            layout, found = progress["layout"], dict(progress["shapes"])
        if layout != LAYOUT:
            raise UserError(f"{path} has layout {layout}, and this version of hindrl_jax reads {LAYOUT}: go on with the version that wrote it")
        _check_shapes(path, found, _shapes(target))
        if not all(isinstance(progress[name], int | float) for name in _COUNTERS):
            raise UserError(f"{path} is damaged (its counters are no numbers): remove it to begin again")
        with self._damage(path), _plainly_named(path) as named, ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            arrays = checkpointer.restore(named, args=ocp.args.Composite(arrays=ocp.args.StandardRestore(target))).arrays
            leaves = [_as(shapes[name], arrays[name]) for name in shapes]
            guidance, state, key, kept = jax.tree.unflatten(jax.tree.structure(_trees(begun)), leaves)
            of_runs: dict[str, Any] = {name: None if progress.get(name) is None else np.asarray(progress[name]) for name in _OF_RUNS}
            restored = dataclasses.replace(
                begun,
                guidance=guidance,
                state=state,
                key=key,
                kept=kept,
                evaluation_steps=np.asarray(progress["evaluation_steps"], np.int64) if progress["evaluation_steps"] else None,
                **of_runs,
                rows=[Row(**row) for row in progress["rows"]],
                chunks=[{name: np.asarray(values, np.float32) for name, values in chunk.items()} for chunk in progress["chunks"]],
                imitation_seconds=progress.get("imitation_seconds", 0.0),
                practising=_practising(progress.get("practising")),
                **{name: progress[name] for name in _COUNTERS},
            )
        self._newest, self._saved_at = path, time.monotonic()
        return restored

    @property
    def newest(self) -> str | None:
        """What the newest checkpoint that was written or read here is of, as in: of step 400. None if there is none."""
        return None if self._newest is None else _when(self._newest)

    def remove(self) -> None:
        """Removes all of them."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def save_demonstrations(self, tables: list[Episodes]) -> None:
        """Keeps what the experiment was given, so that it can go on without the file or the expert: tables that agree in their shapes.

        Raises:
          UserError: if the disk refuses.
        """
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *tables)
        fields = {field.name: getattr(stacked, field.name) for field in dataclasses.fields(Episodes)}
        content = io.BytesIO()
        np.savez(content, **{name: array for name, array in fields.items() if array is not None})
        with content.getbuffer() as whole:
            write_atomically(self.folder / DEMONSTRATIONS, whole, overwrite=True)

    @property
    def has_demonstrations(self) -> bool:
        """Whether `save_demonstrations` was called."""
        return (self.folder / DEMONSTRATIONS).exists()

    def load_demonstrations(self) -> list[Episodes]:
        """What `save_demonstrations` kept.

        Raises:
          UserError: if they are missing or damaged.
        """
        path = self.folder / DEMONSTRATIONS
        try:
            known = {field.name for field in dataclasses.fields(Episodes)}
            fields: dict[str, Any] = {name: array for name, array in read_arrays(path).items() if name in known}
            stacked = Episodes(**fields)
            return [stacked.replace(**{name: leaf[i] for name, leaf in fields.items()}) for i in range(len(stacked.lengths))]
        except (*DAMAGED_ARCHIVE, IndexError) as error:
            raise UserError(f"{path} is damaged ({one_line(error)}): train again") from error

    def _remove_folders(self, *, but: Path | None) -> None:
        """Removes older checkpoints and what was not finished."""
        for path in self.folder.iterdir() if self.folder.is_dir() else ():
            if path.is_dir() and path != but:
                _remove_folder(path)

    def _complete(self) -> list[Path]:
        """The folders of complete checkpoints, the newest last."""
        found = self.folder.iterdir() if self.folder.is_dir() else ()
        return sorted((path for path in found if _NAME.fullmatch(path.name) and path.is_dir()), key=_order)

    @contextlib.contextmanager
    def _disk_trouble(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:  # the library beneath Orbax says ValueError of a full disk
            complete = self._complete()
            before = f"; the checkpoint {_when(complete[-1])} is intact" if complete else ""
            self._remove_folders(but=complete[-1] if complete else None)
            raise UserError(f"cannot write a checkpoint to {self.folder} ({one_line(error)}): free some space{before}") from error

    @contextlib.contextmanager
    def _damage(self, path: Path) -> Iterator[None]:
        """What goes wrong here says that the checkpoint is damaged; and of the arrays that are still being read then, nobody hears."""
        try:
            with _unheard_when_late():
                yield
        except UserError:
            raise
        except Exception as error:  # what libraries say of bytes that make no sense
            raise UserError(f"{path} is damaged ({one_line(error)[:200]}): remove it to begin again") from error


@contextlib.contextmanager
def _plainly_named(path: Path) -> Iterator[Path]:
    """A path within a folder that exists, if need be by another way, since Orbax takes brackets and asterisks in it for patterns.

    It would then write checkpoints that cannot be read, and say nothing.
    """
    if re.fullmatch(r"[\w/.,=+-]{1,500}", str(path), re.ASCII):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="hindrl_") as place:
        link = Path(place) / "folder"
        link.symlink_to(path.parent, target_is_directory=True)
        yield link / path.name


def _name_of(result: Result) -> str | None:
    """The folder of its checkpoint; None where there is nothing to lose yet."""
    if result.steps_done:
        return str(result.steps_done)
    return f"practice-{result.practising.rounds}" if result.practising is not None and result.practising.rounds else None


def _order(path: Path) -> tuple[bool, int]:
    """Whether a checkpoint is of learning, which comes after practice, and of which step or round."""
    return path.name.isdecimal(), int(path.name.rpartition("-")[2])


def _when(path: Path) -> str:
    """What it is of, as in: the checkpoint of step 400."""
    has_learnt, number = _order(path)
    return f"of step {number}" if has_learnt else f"after {number} round{'s' * (number > 1)} of practice"


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _practising(saved: dict[str, Any] | None) -> Practising | None:
    if saved is None:
        return None
    values: dict[str, Any] = {name: np.asarray(value) if isinstance(value, list) else value for name, value in saved.items()}
    return Practising(**values)


def _remove_folder(path: Path, *, patience: float = 5.0) -> None:
    """Removes a folder into which threads of a failed save may still be writing; what is left after `patience` seconds, the next save removes."""
    until = time.monotonic() + patience
    shutil.rmtree(path, ignore_errors=True)
    while path.exists() and time.monotonic() < until:
        time.sleep(0.05)
        shutil.rmtree(path, ignore_errors=True)


def _orbax() -> Any:
    """The library, loaded when it is needed, without its chatter; what it fails at is said in one line here."""
    import orbax.checkpoint as ocp

    logging.getLogger("absl").setLevel(logging.CRITICAL)
    return ocp


@contextlib.contextmanager
def _unheard_when_late() -> Iterator[None]:
    """Orbax reads all arrays at once, and when one fails gives the others up: what they then say to its closed loop is not printed.

    They may say it at any later time, so after a failure this lasts.
    """
    hook = sys.unraisablehook

    def report(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            hook(unraisable)

    sys.unraisablehook, failed = report, False
    try:
        yield
    except Exception:
        failed = True
        raise
    finally:
        if not failed:
            sys.unraisablehook = hook


def _trees(result: Result) -> tuple[Any, ...]:
    return tuple(getattr(result, name) for name in _ARRAYS)


def _leaves(result: Result) -> dict[str, Any]:
    """The arrays of an experiment by their paths, in the order of the tree."""
    found = jax.tree_util.tree_leaves_with_path(dict(zip(range(len(_ARRAYS)), _trees(result), strict=True)))
    return {_ARRAYS[path[0].key] + jax.tree_util.keystr(path[1:]): leaf for path, leaf in found}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> Any:
    """Random keys as the numbers that they consist of."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _plain_shape(leaf: Any) -> Any:
    """What Orbax is to read; numpy arrays as such."""
    if isinstance(leaf, np.ndarray):
        return leaf
    plain = jax.eval_shape(_plain, leaf)
    return jax.ShapeDtypeStruct(plain.shape, plain.dtype, sharding=leaf.sharding)


def _as(shape: Any, array: Any) -> Any:
    return jax.random.wrap_key_data(array) if _is_key(shape) else array


def _shapes(arrays: dict[str, Any]) -> dict[str, str]:
    """As in float32[8,256], by name."""
    return {name: f"{leaf.dtype}[{','.join(map(str, leaf.shape))}]" for name, leaf in arrays.items()}


def _check_shapes(path: Path, found: dict[str, str], expected: dict[str, str]) -> None:
    """Names the first array that is missing, unknown or of another shape."""
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            raise UserError(
                f"{path} holds {found.get(name, 'nothing')} as {name}, and {expected.get(name, 'nothing')} is needed: the configuration, the "
                "demonstrations or the version of hindrl_jax is not the one that wrote it; put that back, or train again"
            )
