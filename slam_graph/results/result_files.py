# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all, and the folder of a result with its `latest` link."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slam_graph.errors import DataError

LATEST = "latest"
"""Name of the link to the newest results."""


@contextmanager
def appearing(path: Path) -> Iterator[Path]:
    """A path to write to, which becomes `path` when the block ends well and vanishes otherwise.

    The content is on the disk before the name is: a crash leaves the old file or the new one.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def refuse_to_replace(path: Path, force: bool) -> None:
    """Make sure that no file is overwritten unless that is asked for.

    Raises:
        DataError: if the path exists without `force`, or is a folder.
    """
    if path.is_dir():
        raise DataError(f"{path}: is a folder; name a file")
    if path.exists() and not force:
        raise DataError(f"{path}: exists already; choose another name, or replace it by --force")


def write_text(path: Path, lines: Iterable[str]) -> None:
    """Write lines (with their line ends) as a whole file."""
    with appearing(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(lines)


class ResultFolder:
    """Writes the files of a result into one folder, each whole or not at all.

    Args:
        folder: made if it is missing.

    Attributes:
        files: written so far, in order.
    """

    def __init__(self, folder: Path | str) -> None:
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        self.files: list[Path] = []

    def path(self, name: str) -> Path:
        """The path of the next file, for a writer that makes it appear whole."""
        self.files.append(self._folder / name)
        return self.files[-1]

    def text(self, name: str, lines: Iterable[str]) -> None:
        """Write lines (with their line ends)."""
        write_text(self.path(name), lines)

    def json(self, name: str, table: Mapping[str, Any]) -> None:
        """Write a table as JSON."""
        self.text(name, [json.dumps(table, indent=2, allow_nan=False), "\n"])


def create_run_folder(root: Path, dataset: str, now: datetime | None = None) -> Path:
    """Make a new folder `root/dataset/<UTC time>`; a number is added where that exists already.

    Raises:
        DataError: if it cannot be made.
    """
    now = now or datetime.now(UTC)
    name = now.astimezone(UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    try:
        (root / dataset).mkdir(parents=True, exist_ok=True)
        for attempt in range(1, 1000):
            folder = root / dataset / (name if attempt == 1 else f"{name}-{attempt}")
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        raise DataError(f"{root / dataset}: cannot make a folder: {error.strerror}") from error
    raise DataError(f"{root / dataset}: too many runs at {name}")


def link_latest(folder: Path) -> Path:
    """Make `latest` beside a folder point at it, replacing an older link in one step.

    The link is relative, so that the results can be moved.

    Raises:
        DataError: if something that is not a link stands in its place.
    """
    link = folder.parent / LATEST
    if link.exists() and not link.is_symlink():
        raise DataError(f"{link}: not a link; move it away, the newest results are in {folder}")
    partial = folder.parent / f".{LATEST}.{os.getpid()}.partial"
    partial.unlink(missing_ok=True)
    partial.symlink_to(folder.name)
    os.replace(partial, link)
    return link
