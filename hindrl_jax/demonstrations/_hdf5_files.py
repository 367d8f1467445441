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


def datasets_within(group: h5py.Group, prefix: str = "", texts: set[str] | None = None) -> dict[str, np.ndarray]:
    """All datasets below a group by their path, which gets a prefix; links of any kind are followed, and give copies.

    Args:
      group: of an open file.
      prefix: begins the paths.
      texts: gets the paths of texts of variable length, which are given as bytes of fixed length.

    Raises:
      UserError: a link leads nowhere or in a circle, or a dataset holds what cannot be kept.
    """
    found: dict[str, np.ndarray] = {}

    def visit(group: h5py.Group, path: str, above: tuple[h5py.Group, ...]) -> None:
        for name in group:
            item = _followed(group, name, f"{group.file.filename}: {path}{name}")
            if isinstance(item, h5py.Dataset):
                found[path + name] = as_array(item, f"{group.file.filename}: {path}{name}")
                if texts is not None and h5py.check_string_dtype(item.dtype) and item.dtype.kind == "O":
                    texts.add(path + name)
            elif isinstance(item, h5py.Group):
                if item in above:
                    raise UserError(f"{group.file.filename}: {path}{name} is a link to a group that it lies in, so there is no end; remove it")
                visit(item, f"{path}{name}/", (*above, item))

    visit(group, prefix, (group,))
    return found


def _followed(group: h5py.Group, name: str, where: str) -> Any:
    """What lies in a group under a name, also by a link."""
    try:
        return group[name]
    except (KeyError, OSError) as error:
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.SoftLink | h5py.ExternalLink):
            raise
        target = f"{link.filename}:{link.path}" if isinstance(link, h5py.ExternalLink) else link.path
        raise UserError(f"{where} is a link to {target}, where there is nothing; put that back or remove the link") from error


def as_array(dataset: h5py.Dataset, where: str) -> np.ndarray:
    """A dataset as an array that NumPy keeps by itself, texts as bytes of fixed length.

    Raises:
      UserError: it cannot be.
    """
    value = dataset[()]
    array = np.asarray(value)
    if h5py.check_string_dtype(dataset.dtype):
        array = array.astype("S")
    elif array.dtype.kind == "O" or isinstance(value, h5py.Empty):
        raise UserError(f"{where} holds {dataset.dtype}, which is neither numbers nor texts, and cannot be kept; remove it")
    return array if array.dtype.kind == "V" else array.astype(array.dtype.str)  # without what h5py notes in types


def datasets_beside(file: h5py.File, group: str, texts: set[str] | None = None) -> dict[str, np.ndarray]:
    """All datasets of a file outside a group, by their path, and those that lie right in that group; `texts` as in `datasets_within`."""
    found: dict[str, np.ndarray] = {}
    for name in file:
        item = _followed(file, name, f"{file.filename}: {name}")
        if name == group:
            alone = [below for below in item if isinstance(_followed(item, below, f"{file.filename}: {name}/{below}"), h5py.Dataset)]
            found |= {f"{name}/{below}": as_array(item[below], f"{file.filename}: {name}/{below}") for below in alone}
        elif isinstance(item, h5py.Group):
            found |= datasets_within(item, f"{name}/", texts)
        elif isinstance(item, h5py.Dataset):
            found[name] = as_array(item, f"{file.filename}: {name}")
            if texts is not None and h5py.check_string_dtype(item.dtype) and item.dtype.kind == "O":
                texts.add(name)
    return found


def json_attribute(value: Any) -> np.bytes_ | str:
    """JSON as a string of fixed length, if it fits: on a damaged file, strings of variable length can crash the HDF5 library."""
    text = json.dumps(plain(value)).encode()
    return np.bytes_(text) if len(text) < _LONGEST_FIXED_ATTRIBUTE else text.decode()
