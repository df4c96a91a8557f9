# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Folders that a result was written into, and how it is written into one, step by step.

`metrics.json` has the status `unfinished` until all other files are there.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slam_graph.files import Files
from slam_graph.results import result_files as names
from slam_graph.results.earlier_result import Kind, make_room, refuse_other_kind
from slam_graph.results.result_files import ResultFolder

logger = logging.getLogger("slam_graph")

GOES_ON = "the {kind} goes on, or was ended before its files were complete"
"""Message of a result with the status `unfinished`."""


class FoldersWritten:
    """Folders that have the files of one result.

    A folder is no longer that of the result when another one was saved there meanwhile, as its
    `metrics.json` tells: that file is another one then. A folder that was renamed still is.
    """

    def __init__(self) -> None:
        self._metrics: dict[Path, tuple[int, int] | None] = {}
        self._set_aside: dict[Path, list[tuple[Path, Path]]] = {}
        self._names: dict[Path, set[str]] = {}

    def __contains__(self, folder: Path) -> bool:
        """Whether the result that a folder has now is this one."""
        found = _identity(folder)
        return found is not None and found in self._metrics.values()

    def begin(self, folder: Path, kind: Kind) -> ResultFolder:
        """The folder of the result, without files of another one; its own stay.

        Args:
            folder: made if it is missing.
            kind: of the result.

        Raises:
            DataError: if it cannot be made, has a result of another kind, or a file cannot be
                removed.
        """
        if folder not in self:
            refuse_other_kind(folder, kind)
            self._names.pop(folder.resolve(), None)
            self._set_aside.setdefault(folder.resolve(), []).extend(make_room(folder))
        return ResultFolder(folder)

    def write_metrics(self, files: ResultFolder, metrics: Mapping[str, Any]) -> None:
        """Write `metrics.json`: from now on the folder is that of the result."""
        files.json(names.METRICS, metrics)
        self._metrics[files.folder.resolve()] = _identity(files.folder)

    @contextmanager
    def complete(
        self, folder: Path, kind: Kind, metrics: Mapping[str, Any]
    ) -> Iterator[ResultFolder]:
        """The folder of the result; the block writes all files but `metrics.json`, which is last.

        What the result wrote there before, and has no more, is removed; but a map is kept.

        Args:
            folder: made if it is missing.
            kind: of the result.
            metrics: of the complete result.

        Raises:
            DataError: as `begin`, or if a file cannot be written.
        """
        files = None
        try:
            files = self.begin(folder, kind)
            status = {"status": "unfinished", "message": GOES_ON.format(kind=kind)}
            self.write_metrics(ResultFolder(folder), {**metrics, **status})
            yield files
            self._remove_older(files)
            self.write_metrics(files, metrics)
        finally:
            if files is not None:
                self._names.setdefault(folder.resolve(), set()).update(_names_of(files))
            self._settle(folder)

    def _remove_older(self, files: ResultFolder) -> None:
        """Remove what the result wrote into the folder before, and has not written now."""
        older = self._names.pop(files.folder.resolve(), set())
        for name in sorted(older - _names_of(files) - {names.METRICS, names.MAP_NAME}):
            with Files.writing(files.folder / name):
                (files.folder / name).unlink(missing_ok=True)

    def _settle(self, folder: Path) -> None:
        """Say what was set aside, and remove that in whose place a new file was written."""
        for old, other in self._set_aside.pop(folder.resolve(), []):
            if old.is_file():
                with Files.writing(other):
                    other.unlink(missing_ok=True)
            else:
                logger.warning("%s: of an earlier result, kept as %s", old, other.name)


def _names_of(files: ResultFolder) -> set[str]:
    """Names of the files that were written, relative to their folder."""
    return {path.relative_to(files.folder).as_posix() for path in files.files}


def _identity(folder: Path) -> tuple[int, int] | None:
    """What tells one `metrics.json` from another: its number and its time in ns; None without."""
    try:
        found = (folder / names.METRICS).stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns
