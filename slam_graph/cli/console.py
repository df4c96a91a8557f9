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


_BAR_WIDTH = 28
_TERMINAL_PERIOD_S = 0.1
_LOG_PERIOD_S = 10.0


class ProgressBar:
    """Reports frames a second and the real-time factor; used as a context manager.

    Args:
        start_ns: time of the first frame that is asked for.
        end_ns: time of the last one.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start_ns = start_ns
        self._length_ns = max(end_ns - start_ns, 1)
        self._terminal = sys.stderr.isatty()
        self._period_s = _TERMINAL_PERIOD_S if self._terminal else _LOG_PERIOD_S
        self._began = self._shown = time.monotonic()
        self._frames = 0
        self._line = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._terminal and self._line:
            sys.stderr.write("\r" + self._line + "\n")
            sys.stderr.flush()

    def advance(self, stamp_ns: int, initialized: bool) -> None:
        """Count a frame, and refresh the line if it is due."""
        self._frames += 1
        now = time.monotonic()
        self._line = self._text(stamp_ns - self._start_ns, now - self._began, initialized)
        if now - self._shown < self._period_s:
            return
        self._shown = now
        sys.stderr.write(f"\r{self._line}" if self._terminal else f"{self._line}\n")
        sys.stderr.flush()

    def adjusting(self, done: int, keyframes: int, steps: int) -> None:
        """Show the progress of the final bundle adjustment."""
        now = time.monotonic()
        if now - self._shown < self._period_s:
            return
        self._shown = now
        bar = _bar(done / keyframes) if self._terminal else ""
        text = f"{bar}final BA: {done} of {keyframes} keyframes done, step {steps}"
        sys.stderr.write(f"\r{text:<90}" if self._terminal else f"{text}\n")
        sys.stderr.flush()

    def _text(self, done_ns: int, elapsed_s: float, initialized: bool) -> str:
        """The line."""
        part = min(max(done_ns / self._length_ns, 0.0), 1.0)
        rate = self._frames / max(elapsed_s, 1e-9)
        factor = done_ns * 1e-9 / max(elapsed_s, 1e-9)
        bar = _bar(part) if self._terminal else ""
        state = "" if initialized else ", initialising"
        return (
            f"{bar}{part:4.0%} {self._frames} frames, {rate:.0f} frames/s, "
            f"{factor:.1f} x real time{state:<14}"
        ).rstrip() + (" " * 4 if self._terminal else "")


def _bar(part: float) -> str:
    """A bar of which a part is filled."""
    filled = round(part * _BAR_WIDTH)
    return f"[{'#' * filled}{'.' * (_BAR_WIDTH - filled)}] "
