"""Files: written whole or not at all, and what the disk refuses in one line."""

from __future__ import annotations

import contextlib
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hindrl_jax.base.errors import UserError, one_line


def write_atomically(path: Path, content: bytes | memoryview, *, overwrite: bool) -> None:
    """Writes a file that afterwards holds either all of the content or what it held before.

    Raises:
      UserError: it exists and `overwrite` is off, or it cannot be written.
    """
    temporary = path.with_name(f".{path.name[:40]}.{os.getpid()}.tmp")  # a name may be as long as the disk allows
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else a power cut soon after the renaming could leave an empty file under the final name
        check_can_write(path, overwrite=overwrite)  # somebody else may have been quicker
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({one_line(error)}); check the folder, its permissions and the free space") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


DAMAGED_ARCHIVE = (
    *(OSError, ValueError, EOFError, KeyError, TypeError, RuntimeError, SyntaxError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""What NumPy raises for archives that are damaged, or are none."""


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive of NumPy's; nothing is unpickled.

    Raises:
      one of `DAMAGED_ARCHIVE`.
    """
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def check_can_write(path: Path, *, overwrite: bool) -> None:
    """Makes sure, before any work is done, that demonstrations can be saved under this name.

    Raises:
      UserError: if not.
    """
    if os.path.isdir(path):  # unlike Path's methods, these also answer for names that are too long
        raise UserError(f"{path}: is a folder; name a file")
    check_free(path, f"{path}", overwrite=overwrite, otherwise="choose another place")


def check_free(path: Path, where: str, *, overwrite: bool, otherwise: str) -> None:
    """Makes sure that a file or folder can be put in this place.

    Args:
      path: the place.
      where: begins the message.
      overwrite: whether what is there may be replaced.
      otherwise: what to do about a folder that cannot be written to.

    Raises:
      UserError: if not.
    """
    if os.path.exists(path) and not overwrite:
        raise UserError(f"{where}: exists already; replace it with --overwrite (overwrite=True), or choose another name")
    reason = why_unwritable(path.absolute().parent)
    if reason is None and len(os.fsencode(path.name)) > 255:
        reason = "its name is longer than 255 bytes"
    if reason:
        raise UserError(f"{where}: cannot be written, since {reason}; {otherwise}")


def why_unwritable(folder: Path) -> str | None:
    """What is in the way of files in a folder, which may have to be made first; None if nothing is."""
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        return "its name is not UTF-8"
    existing = next(place for place in (folder, *folder.absolute().parents) if os.path.exists(place))
    if not existing.is_dir():
        return f"{existing} is a file"
    if not os.access(existing, os.W_OK):
        return f"{existing} is read-only"
    longest, longest_path = (os.pathconf(existing, limit) for limit in ("PC_NAME_MAX", "PC_PATH_MAX"))
    if any(len(os.fsencode(part)) > longest for part in folder.parts):
        return f"a name in it is longer than {longest} bytes"
    if len(os.fsencode(folder.absolute())) + _ROOM_BELOW > longest_path:
        return f"it is longer than {longest_path - _ROOM_BELOW} bytes"
    return None


_ROOM_BELOW = 300
"""Bytes for the names of what is put into a folder, checkpoints being the longest of them."""


def check_is_file(path: Path) -> None:
    """Raises a UserError where there is no file of that name."""
    if not os.path.exists(path):
        raise UserError(f"{path}: no such file; check the name or record demonstrations there")
    if not os.path.isfile(path):
        raise UserError(f"{path}: is not a file; name a file of demonstrations")


@contextlib.contextmanager
def disk_trouble(path: Path) -> Iterator[None]:
    """Turns what the disk refuses into one line for the user."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {path} ({error.strerror or error}): free some space or choose another place") from error


def write_text_atomically(path: Path, text: str) -> None:
    temporary = path.with_suffix(path.suffix + ".partial")
    temporary.write_text(text)
    os.replace(temporary, path)
