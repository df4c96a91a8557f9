# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What commands print: tables or JSON on stdout, progress on stderr, and the log of a run.

Progress of a run on stderr: a bar in a terminal, a line every few seconds in a log.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

import typer


def echo_json(value: Any) -> None:
    """Print JSON on stdout."""
    typer.echo(json.dumps(value, indent=2, allow_nan=False))


def echo_table(rows: Iterable[Sequence[str]], indent: str = "") -> None:
    """Print rows with aligned columns on stdout; rows may have fewer cells than others."""
    table = [list(row) for row in rows]
    columns = max((len(row) for row in table), default=0)
    widths = [max(len(row[i]) for row in table if len(row) > i) for i in range(columns)]
    for row in table:
        cells = (f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        typer.echo((indent + "  ".join(cells)).rstrip())


_WIDTH = 100
"""Tables are no wider, also where the output is no terminal."""

_TEXT_COLUMNS = ("recording", "algorithm", "status")


def echo_rich_table(
    titles: Sequence[str], rows: Iterable[Sequence[str]], heading: str, caption: str = ""
) -> None:
    """Print a table of numbers on stdout, at most 100 columns wide.

    Args:
        titles: of the columns.
        rows: cells, as many as titles.
        heading: above the table.
        caption: below the table.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=Text(heading, style="bold"),
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    for title in titles:
        text = title in _TEXT_COLUMNS
        table.add_column(Text(title), justify="left" if text else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    terminal = Console()
    console = Console(width=min(terminal.width, _WIDTH) if terminal.is_terminal else _WIDTH)
    console.print(table)
    if caption:
        console.print(Text(caption))


def number(value: float | None, digits: int = 4) -> str:
    """A number with so many decimals, or a dash for none."""
    return "-" if value is None else f"{value:.{digits}f}"


class _ListHandler(logging.Handler):
    """Keeps formatted lines."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.INFO)
        self.lines = lines
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record) + "\n")


class _WarningHandler(logging.Handler):
    """Prints warnings on stderr as it is at that time: above a bar, if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        typer.echo(self.format(record), err=True)


@contextmanager
def collected_log() -> Iterator[list[str]]:
    """Collect what the package logs, and show its warnings on stderr."""
    lines: list[str] = []
    shown = _WarningHandler()
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


_BAR_WIDTH = 28
_LOG_PERIOD_S = 10.0


class ProgressBar:
    """Reports how far a run is, and for how long it will go on; used as a context manager.

    Args:
        start_ns: time of the first frame that is asked for.
        end_ns: time of the last one.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start_ns = start_ns
        self._length_ns = max(end_ns - start_ns, 1)
        self._shown = _Bars() if sys.stderr.isatty() else _Lines()
        self._began = time.monotonic()
        self._frames = 0

    def __enter__(self) -> Self:
        self._shown.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._shown.stop(complete=kind is None)

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Count a frame."""
        self._frames += 1
        done_ns = stamp_ns - self._start_ns
        elapsed_s = max(time.monotonic() - self._began, 1e-9)
        self._shown.show(
            "frames",
            min(max(done_ns / self._length_ns, 0.0), 1.0),
            f"{self._frames} frames, {self._frames / elapsed_s:.0f} frames/s, "
            f"{done_ns * 1e-9 / elapsed_s:.1f} x real time"
            + ("" if initialized else ", initialising"),
        )

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Show the progress of the final bundle adjustment."""
        self._shown.show("final BA", done / keyframes, f"{keyframes} keyframes, step {steps}")


class _Lines:
    """A line every few seconds, for a log."""

    def __init__(self) -> None:
        self._last = time.monotonic()
        self._began: dict[str, float] = {}

    def start(self) -> None:
        """Print nothing yet."""

    def show(self, name: str, part: float, text: str) -> None:
        """Print a line if it is due.

        Args:
            name: of what is being done.
            part: of it that is done.
            text: what else there is to say.
        """
        now = time.monotonic()
        began = self._began.setdefault(name, now)
        if now - self._last < _LOG_PERIOD_S:
            return
        self._last = now
        left = f", {(now - began) * (1.0 - part) / part:.0f} s left" if part > 0.0 else ""
        typer.echo(f"{name} {part:4.0%} {text}{left}", err=True)

    def stop(self, complete: bool) -> None:
        """Print nothing more."""


class _Bars:
    """A bar for each part of a run, for a terminal, with the time that is left."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            Progress,
            TaskID,
            TaskProgressColumn,
            TextColumn,
            TimeRemainingColumn,
        )

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(_BAR_WIDTH),
            TaskProgressColumn(),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[text]}", markup=False),
            console=Console(stderr=True),
        )
        self._tasks: dict[str, TaskID] = {}

    def start(self) -> None:
        """Begin to draw."""
        self._progress.start()

    def show(self, name: str, part: float, text: str) -> None:
        """Move a bar; arguments as for `_Lines.show`."""
        if name not in self._tasks:
            self._freeze()
            self._tasks[name] = self._progress.add_task(name, total=1.0, text=text)
        self._progress.update(self._tasks[name], completed=part, text=text)

    def stop(self, complete: bool) -> None:
        """Leave the last state on the screen; the last bar is full if all went well."""
        if complete and self._tasks:
            self._progress.update(list(self._tasks.values())[-1], completed=1.0)
        self._freeze()
        self._progress.stop()

    def _freeze(self) -> None:
        """Stop the clocks of the bars so far."""
        for task in self._tasks.values():
            self._progress.stop_task(task)
