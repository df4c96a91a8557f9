# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The log of a command: collected for its `run.log`, with warnings on stderr."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class _ListHandler(logging.Handler):
    """Keeps formatted lines."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.INFO)
        self.lines = lines
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record) + "\n")


@contextmanager
def collected_log() -> Iterator[list[str]]:
    """Collect what the package logs, and show its warnings on stderr."""
    lines: list[str] = []
    shown = logging.StreamHandler(sys.stderr)
    shown.addFilter(lambda record: record.levelno == logging.WARNING)
    shown.setFormatter(logging.Formatter("warning: %(message)s"))
    logger = logging.getLogger("slam_graph")
    logger.setLevel(logging.INFO)
    handlers = (shown, _ListHandler(lines))
    for handler in handlers:
        logger.addHandler(handler)
    try:
        yield lines
    finally:
        for handler in handlers:
            logger.removeHandler(handler)


def remove_if_empty(folder: Path) -> None:
    """Remove the folder of a run that wrote nothing, and that of its data set if it is empty."""
    for empty in (folder, folder.parent):
        if empty.is_dir() and not any(empty.iterdir()):
            empty.rmdir()
