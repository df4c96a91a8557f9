# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How long each stage of each frame took."""

from __future__ import annotations

import time
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StageTime:
    """Milliseconds a frame of one stage, over the frames in which it ran.

    Attributes:
        mean_ms: arithmetic mean.
        median_ms: middle value.
        p95_ms: 95th percentile.
        frames: number of frames in which the stage ran.
    """

    mean_ms: float
    median_ms: float
    p95_ms: float
    frames: int


class TimingLog:
    """A growing table: one row a frame, one column a stage, in milliseconds.

    Stages may appear at any frame; a stage that did not run in a frame is NaN there.
    """

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._columns: dict[str, array[float]] = {}

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def append(self, stamp_ns: int, milliseconds: Mapping[str, float]) -> None:
        """Add the times of the next frame."""
        for stage in milliseconds.keys() - self._columns.keys():
            self._columns[stage] = array("d", [np.nan] * len(self))
        self._stamps_ns.append(stamp_ns)
        for stage, column in self._columns.items():
            column.append(milliseconds.get(stage, np.nan))

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(N,) times of the frames."""
        return np.array(self._stamps_ns, dtype=np.int64)

    def column(self, stage: str) -> NDArray[np.float64]:
        """(N,) milliseconds of a stage."""
        return np.array(self._columns[stage])

    def stages(self) -> list[str]:
        """Names of all stages, in the order of the alphabet: `a.b` is a part of `a`."""
        return sorted(self._columns)

    def summary(self) -> dict[str, StageTime]:
        """Statistics of each stage."""
        table = {}
        for stage in self.stages():
            values = self.column(stage)
            values = values[np.isfinite(values)]
            if len(values):
                p95 = float(np.percentile(values, 95))
                table[stage] = StageTime(
                    float(values.mean()), float(np.median(values)), p95, len(values)
                )
        return table

    def csv_lines(self) -> Iterator[str]:
        """The table as CSV, empty where a stage did not run."""
        stages = self.stages()
        yield ",".join(["stamp_ns", *(f"{stage}_ms" for stage in stages)]) + "\n"
        columns = [self._columns[stage] for stage in stages]
        for index, stamp_ns in enumerate(self._stamps_ns):
            cells = (column[index] for column in columns)
            text = ("" if np.isnan(cell) else f"{cell:.4f}" for cell in cells)
            yield ",".join([str(stamp_ns), *text]) + "\n"


class Stopwatch:
    """Times the stages of one frame.

    Attributes:
        milliseconds: of each stage, of its parts as `stage.part`, and of all as `total`.
    """

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {"total": 0.0}
        self._since = time.perf_counter()

    def restart(self) -> None:
        """Leave out the time since the last stage ended."""
        self._since = time.perf_counter()

    def lap(self, stage: str, parts: Mapping[str, float] | None = None) -> None:
        """End a stage that began when the stage before it ended.

        Args:
            stage: its name.
            parts: milliseconds of parts of it that were timed elsewhere.
        """
        now = time.perf_counter()
        elapsed_ms = 1e3 * (now - self._since)
        self.milliseconds[stage] = elapsed_ms
        self.milliseconds["total"] += elapsed_ms
        self.milliseconds |= {f"{stage}.{part}": value for part, value in (parts or {}).items()}
        self._since = now


def milliseconds(frame_stats: Mapping[str, float]) -> dict[str, float]:
    """The stages among what a front end counts: the keys that end in `_ms`, without that end."""
    return {
        key.removesuffix("_ms"): value for key, value in frame_stats.items() if key.endswith("_ms")
    }
