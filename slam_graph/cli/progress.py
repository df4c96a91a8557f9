# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Progress of a run on stderr: a bar in a terminal, a line every few seconds in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self

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
