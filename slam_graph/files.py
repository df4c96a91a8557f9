# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all, and one line where the system refuses to write them.

And how large numbers and times that are read may be, so that arithmetic with them stays finite.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from slam_graph.errors import DataError

if TYPE_CHECKING:  # commands that only say what there is do without NumPy
    from numpy.typing import NDArray

    from slam_graph.arrays import BoolArray, IntArray

__all__ = ["Files"]

_PARTIAL = re.compile(r"\.(?P<name>.+)\.(?P<host>[^.]+)\.(?P<pid>\d+)\.partial$")
"""Names of what is being written: they tell by whom."""

_KEPT_OF_NAME = 100
"""Bytes of a name that the hidden name begins with; systems of files allow 255 in all."""

_ADVICE = {
    errno.ENOSPC: "; free some space or choose another place",
    errno.EDQUOT: "; free some space or choose another place",
    errno.EROFS: "; choose another place",
    errno.EACCES: "; choose another place",
    errno.EPERM: "; choose another place",
    errno.EEXIST: "; a file is in the place of a folder",
    errno.ENOTDIR: "; a file is in the place of a folder",
    errno.EISDIR: "; name a file",
}


def refused(error: OSError) -> str:
    """Why the system refused something, and what to do about it."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    return reason + _ADVICE.get(error.errno or 0, "")


@contextmanager
def writing(path: Path | str, what: str = "") -> Iterator[None]:
    """Say in one line which file cannot be written: full disk, no permission, no such folder.

    Args:
        path: of the file or folder that the block writes.
        what: it is, with a blank behind it.

    Raises:
        DataError: if the block raises an error of the system.
    """
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: {what}cannot be written ({refused(error)})") from error


@contextmanager
def appearing(path: Path) -> Iterator[Path]:
    """A path to write to, which becomes `path` when the block ends well and vanishes otherwise.

    The content is on the disk before the name is: a crash leaves the old file or the new one.
    A device or a pipe, such as `/dev/stdout`, is written to as it is, and never replaced.

    Raises:
        DataError: if it cannot be written.
    """
    with writing(path):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        device = path.exists() and not path.is_file()
    if device:
        with writing(path):
            yield path
        return
    partial = _hidden(path)
    _remove_remains_of(path)
    try:
        with writing(path):
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(partial, path)
    finally:
        _forget(partial)


def _forget(partial: Path) -> None:
    """Remove a file, if it is there; where that cannot be done, it could not be made either."""
    try:
        partial.unlink(missing_ok=True)
    except OSError:
        return


def write_text(path: Path, lines: Iterable[str]) -> None:
    """Write lines (with their line ends) as a whole file.

    Raises:
        DataError: if it cannot be written.
    """
    with appearing(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(lines)


def make_folder(path: Path) -> None:
    """Make a folder, and those around it, where they are missing.

    Raises:
        DataError: if that cannot be done.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot make a folder ({refused(error)})") from error


def partial_folder(path: Path) -> Path:
    """A new hidden folder beside `path`, to be renamed to it when it is complete.

    Raises:
        DataError: if it cannot be made.
    """
    make_folder(path.parent)
    folder = _hidden(path)
    with writing(path):
        if folder.exists():  # of an earlier process with the same number
            shutil.rmtree(folder)
        folder.mkdir()
    return folder


def partial_name(path: Path) -> str | None:
    """The name under which a hidden file or folder is to appear; None if it is none of ours."""
    found = _PARTIAL.match(path.name)
    return found["name"] if found else None


def remove_remains(folder: Path) -> None:
    """Remove what processes of this machine left half written in a folder because they were killed.

    Args:
        folder: of the files; folders in it are not searched.
    """
    for path in folder.glob(".*.partial"):
        _remove_if_left(path)


def _remove_remains_of(path: Path) -> None:
    """Remove what killed processes of this machine left of a file that is written again."""
    try:
        left = [
            found for found in path.parent.glob(".*.partial") if partial_name(found) == path.name
        ]
    except OSError:  # the folder is not there: whoever writes into it says so
        return
    for partial in left:
        _remove_if_left(partial)


def _remove_if_left(path: Path) -> None:
    """Remove a hidden file or folder if the process of this machine that wrote it is gone."""
    found = _PARTIAL.match(path.name)
    if not found or found["host"] != _host() or _lives(int(found["pid"])):
        return
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        _forget(path)


def _hidden(path: Path) -> Path:
    """Where something is written before it appears: the name tells by which machine and process."""
    kept = path.name.encode(errors="surrogateescape")[:_KEPT_OF_NAME].decode(errors="ignore")
    return path.with_name(f".{kept}.{_host()}.{os.getpid()}.partial")


def _host() -> str:
    """This machine, without dots."""
    return socket.gethostname().replace(".", "-") or "localhost"


def _lives(pid: int) -> bool:
    """Whether there is a process with this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def are_measurable(values: NDArray[Any]) -> BoolArray:
    """Which values (...) are finite, and not beyond any measurement."""
    found: BoolArray = abs(values) <= Files.LARGEST
    return found


def are_times(stamps_ns: IntArray) -> BoolArray:
    """Which stamps (N,) are near enough to zero to be times in ns."""
    end_ns = Files.LARGEST_STAMP_NS
    found: BoolArray = (stamps_ns > -end_ns) & (stamps_ns < end_ns)
    return found


class Files:
    """What is done with files.

    Attributes:
        LARGEST: numbers in them are no larger: their squares fit into floating-point numbers of
            32 bits.
        LARGEST_STAMP_NS: times in them are nearer to zero, before the year 2116: differences of two
            of them fit into 64 bits.
    """

    LARGEST: ClassVar[float] = 1e18
    LARGEST_STAMP_NS: ClassVar[int] = 2**62

    appearing = staticmethod(appearing)
    are_measurable = staticmethod(are_measurable)
    are_times = staticmethod(are_times)
    make_folder = staticmethod(make_folder)
    partial_folder = staticmethod(partial_folder)
    partial_name = staticmethod(partial_name)
    refused = staticmethod(refused)
    remove_remains = staticmethod(remove_remains)
    write_text = staticmethod(write_text)
    writing = staticmethod(writing)
