"""HDF5 files of any layout: made in memory, opened, and whatever is damaged in them reported in one line."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import check_is_file
from hindrl_jax.demonstrations.recording import RECORD_AGAIN, plain

_LONGEST_FIXED_ATTRIBUTE = 60_000  # HDF5's limit is 64 KiB


def hdf5_bytes(write: Callable[[h5py.File], None]) -> io.BytesIO:
    """An HDF5 file in memory. The HDF5 library may crash the whole process when a disk is full, so plain Python writes the bytes."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        write(file)
    return content


@contextlib.contextmanager
def opened(path: Path, content: io.BytesIO | None = None) -> Iterator[h5py.File]:
    """A file to read, from disk, or from its `content` before that is written to `path`.

    Raises:
      UserError: it is missing, no HDF5 file, or damaged in a place that is read.
    """
    if content is None:
        check_is_file(path)
    with (
        damage_reported(f"{path}", "is not an HDF5 file, or is cut off or damaged"),
        h5py.File(path if content is None else content, "r", locking="best-effort") as file,
    ):
        yield file


@contextlib.contextmanager
def damage_reported(where: str, what: str) -> Iterator[None]:
    """Turns whatever h5py raises on a damaged file into a UserError; which exception it is depends on the place of the damage."""
    try:
        yield
    except UserError:
        raise
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, MemoryError) as error:
        raise UserError(f"{where}: {what} ({one_line(error)}); fetch the file again or {RECORD_AGAIN}") from error


def datasets_within(group: h5py.Group, prefix: str = "") -> dict[str, np.ndarray]:
    """All datasets below a group by their path, which gets a prefix; texts as bytes of fixed length."""
    found = {}

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            array = np.asarray(item[()])
            found[prefix + name] = array.astype("S" if array.dtype.kind == "O" else array.dtype.str)  # without what h5py notes in types

    group.visititems(visit)
    return found


def datasets_beside(file: h5py.File, group: str) -> dict[str, np.ndarray]:
    """All datasets in the other groups of a file, by their path."""
    others = (name for name in file if name != group and isinstance(file[name], h5py.Group))
    return {path: array for name in others for path, array in datasets_within(file[name], f"{name}/").items()}


def json_attribute(value: Any) -> np.bytes_ | str:
    """JSON as a string of fixed length, if it fits: on a damaged file, strings of variable length can crash the HDF5 library."""
    text = json.dumps(plain(value)).encode()
    return np.bytes_(text) if len(text) < _LONGEST_FIXED_ATTRIBUTE else text.decode()
