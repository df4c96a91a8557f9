# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Progress over all recordings of a batch, on stderr."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar as Bar
from rich.table import Table
from rich.text import Text

_REFRESH_HZ = 4
_BAR_WIDTH = 30
_MOST_LINES = 12
"""Runs that are shown at a time; a cluster may have more."""


class BatchProgress:
    """Shows what is done and what is being run; used as a context manager.

    Args:
        live: whether to show it in place, in a terminal; otherwise a line for each run that ended.
    """

    def __init__(self, live: bool) -> None:
        self._began = time.monotonic()
        self._count = self._total = self._failed = 0
        self._parts: dict[str, float] = {}
        self._over: set[str] = set()
        self._live = None
        if live:
            console = Console(stderr=True)
            self._live = Live(
                get_renderable=self._shown,
                console=console,
                refresh_per_second=_REFRESH_HZ,
                transient=True,
            )

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def ended(self, name: str, failure: str | None, count: int, total: int) -> None:
        """A run has ended; see `batch`."""
        self._count, self._total = count, total
        self._failed += failure is not None
        self._over.add(name)
        self._parts.pop(name, None)
        reason = "" if failure is None else failure.removeprefix(f"{name}: ")
        line = f"{count}/{total} {name}" + (f": failed: {reason}" if reason else "")
        if self._live is None:
            typer.echo(line, err=True)
        elif failure is not None:
            self._live.console.print(Text(line, style="red"))

    def running(self, parts: Mapping[str, float], total: int) -> None:
        """Which recordings are being run, and what part of each is done; see `batch`."""
        self._total = total
        # results are complete a moment before their process has ended, which counts
        known = dict.fromkeys(self._parts, 1.0) | dict(parts)
        self._parts = {name: part for name, part in known.items() if name not in self._over}

    def _shown(self) -> Group | Text:
        """What is shown now."""
        if not self._total:
            return Text("looking for recordings …")
        done = min(self._count + sum(self._parts.values()), self._total)
        failed = f", {self._failed} failed" if self._failed else ""
        lines = Table.grid(padding=(0, 1))
        title = f"{self._count} of {self._total} done{failed}"
        lines.add_row(title, _bar(done / self._total), self._time(done))
        for name, part in list(self._parts.items())[:_MOST_LINES]:
            lines.add_row(f"  {name}", _bar(part), f"{part:.0%}")
        return Group(lines)

    def _time(self, done: float) -> str:
        """How long it has taken, and how long it will still take."""
        passed_s = time.monotonic() - self._began
        if done < 0.05:
            return _clock(passed_s)
        return f"{_clock(passed_s)}, {_clock(passed_s * (self._total - done) / done)} left"


def _bar(part: float) -> Bar:
    return Bar(total=1.0, completed=part, width=_BAR_WIDTH)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
