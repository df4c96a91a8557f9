# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Logs of every frame of a run: times, steps, innovations, estimated calibration, counts."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import get_type_hints

import numpy as np

from slam_graph.arrays import FloatArray, GrowingTable, IntArray
from slam_graph.backend import Innovations
from slam_graph.results.frame_table import FrameTable
from slam_graph.sensors import CalibrationEstimate, Rig


class StepLog:
    """A growing table with a row for each frame in which Gauss-Newton steps were taken."""

    def __init__(self) -> None:
        self._numbers = GrowingTable(3, np.int64)  # stamp, steps, columns
        self._costs = GrowingTable(2)

    def __len__(self) -> int:
        return len(self._numbers)

    def append(self, stamp_ns: int, costs: Sequence[float], columns: int) -> None:
        """Add a frame.

        Args:
            stamp_ns: its time.
            costs: before the first step and after each; at least one.
            columns: dimension of the state.
        """
        self._numbers.append((stamp_ns, len(costs) - 1, columns))
        self._costs.append((costs[0], costs[-1]))

    def forget_from(self, stamp_ns: int) -> None:
        """Forget the frames at and after a time."""
        kept = int(self.stamps_ns.searchsorted(stamp_ns))
        self._numbers.cut(kept)
        self._costs.cut(kept)

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) times of the frames."""
        return self._numbers.rows()[:, 0]

    @property
    def steps(self) -> IntArray:
        """(N,) numbers of steps that were taken."""
        return self._numbers.rows()[:, 1]

    @property
    def columns(self) -> IntArray:
        """(N,) dimensions of the state while the steps were taken."""
        return self._numbers.rows()[:, 2]

    @property
    def costs(self) -> FloatArray:
        """(N, 2) cost before the first step and after the last."""
        return self._costs.rows()


_KINDS = get_type_hints(Innovations)
_COUNTS = tuple(name for name, kind in _KINDS.items() if kind is int)
_SUMS = tuple(name for name in _KINDS if name not in _COUNTS)
_counts_of, _sums_of = attrgetter(*_COUNTS), attrgetter(*_SUMS)


class InnovationLog:
    """A growing table with a row for each frame whose features were tested by the gate."""

    def __init__(self) -> None:
        self._counts = GrowingTable(1 + len(_COUNTS), np.int64)  # stamp, counts
        self._sums = GrowingTable(len(_SUMS), np.float32)
        self._tested = self._rejected = 0

    def __len__(self) -> int:
        return len(self._counts)

    def append(self, stamp_ns: int, innovations: Innovations) -> None:
        """Add a frame, unless no feature was tested in it."""
        if innovations.tested:
            self._counts.append((stamp_ns, *_counts_of(innovations)))
            self._sums.append(_sums_of(innovations))
            self._tested += innovations.tested
            self._rejected += innovations.rejected

    def forget_from(self, stamp_ns: int) -> None:
        """Forget the frames at and after a time."""
        kept = int(self.stamps_ns.searchsorted(stamp_ns))
        self._counts.cut(kept)
        self._sums.cut(kept)
        columns = self.columns()
        self._tested, self._rejected = (int(columns[k].sum()) for k in ("tested", "rejected"))

    @property
    def totals(self) -> tuple[int, int]:
        """How many features were tested, and how many of them rejected."""
        return self._tested, self._rejected

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) times of the frames."""
        return self._counts.rows()[:, 0]

    def columns(self) -> dict[str, FloatArray]:
        """(N,) values of each attribute of `Innovations`, by its name."""
        counts = self._counts.rows()[:, 1:].astype(np.float64)
        sums = self._sums.rows().astype(np.float64)
        columns = dict(zip((*_COUNTS, *_SUMS), (*counts.T, *sums.T), strict=True))
        return {name: columns[name] for name in _KINDS}


class CalibrationLog:
    """A growing table with a row for each frame; empty where nothing is calibrated.

    Attributes:
        latest: the last estimate, None before the first.
    """

    def __init__(self) -> None:
        self.latest: CalibrationEstimate | None = None
        self._rows: list[tuple[int, list[float]]] = []
        self._estimates: list[CalibrationEstimate] = []

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, estimate: CalibrationEstimate) -> None:
        """Add the estimate at the next frame."""
        self.latest = estimate
        self._estimates.append(estimate)
        parameters = estimate.parameters()
        values = [parameter.value for parameter in parameters]
        self._rows.append((estimate.stamp_ns, values + [p.sigma for p in parameters]))

    def forget_from(self, stamp_ns: int) -> None:
        """Forget the estimates at and after a time; where none is left, the last one too."""
        kept = bisect_left(self._estimates, stamp_ns, key=lambda estimate: estimate.stamp_ns)
        del self._rows[kept:], self._estimates[kept:]
        self.latest = self._estimates[-1] if kept else None

    def rig(self, given: Rig) -> Rig:
        """A rig with the cameras of the last estimate; without one as it was given.

        The estimator has one camera more where depth is measured.
        """
        if self.latest is None:
            return given
        return replace(given, cameras=self.latest.rig.cameras[: len(given.cameras)])

    def table(self) -> dict[str, dict[str, float]] | None:
        """The last estimate: start, value and standard deviation of each parameter by its name."""
        return None if self.latest is None else self.latest.table()

    def csv_lines(self) -> Iterator[str]:
        """The table as CSV: values of all parameters, then their standard deviations."""
        if self.latest is None:
            return
        names = [parameter.name for parameter in self.latest.parameters()]
        yield ",".join(["stamp_ns", *names, *(f"sigma_{name}" for name in names)]) + "\n"
        for stamp_ns, row in self._rows:
            yield ",".join([str(stamp_ns), *(f"{value:.9g}" for value in row)]) + "\n"


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
        self._stamps_ns = GrowingTable(1, np.int64)
        self._columns: dict[str, array[float]] = {}

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def append(self, stamp_ns: int, milliseconds: Mapping[str, float]) -> None:
        """Add the times of the next frame."""
        for stage in milliseconds.keys() - self._columns.keys():
            self._columns[stage] = array("f", [np.nan] * len(self))
        self._stamps_ns.append(stamp_ns)
        for stage, column in self._columns.items():
            column.append(milliseconds.get(stage, np.nan))

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) times of the frames."""
        return self._stamps_ns.rows()[:, 0]

    def column(self, stage: str) -> FloatArray:
        """(N,) milliseconds of a stage."""
        return np.array(self._columns[stage], dtype=np.float64)

    def stages(self) -> list[str]:
        """Names of all stages, sorted; `a.b` is a part of `a`."""
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
        for index, stamp_ns in enumerate(self.stamps_ns.tolist()):
            cells = (column[index] for column in columns)
            text = ("" if np.isnan(cell) else f"{cell:.4f}" for cell in cells)
            yield ",".join([str(stamp_ns), *text]) + "\n"


@dataclass(eq=False, repr=False)
class RunLogs:
    """All logs of a run.

    Attributes:
        timing: milliseconds of every stage of every frame.
        steps: Gauss-Newton steps of every frame, and the cost before and after.
        innovations: normalised innovations of every frame.
        calibration: estimated calibration at every frame, if any of it is estimated.
        by_frame: what the back end did in every frame.
        frames: number of frames that were read.
        features: sums over all frames of what the front end counts, by name.
        last_frame_ns: time of the last frame that was read.
    """

    timing: TimingLog = field(default_factory=TimingLog)
    steps: StepLog = field(default_factory=StepLog)
    innovations: InnovationLog = field(default_factory=InnovationLog)
    calibration: CalibrationLog = field(default_factory=CalibrationLog)
    by_frame: FrameTable = field(default_factory=FrameTable)
    frames: int = 0
    features: Counter[str] = field(default_factory=Counter)
    last_frame_ns: int | None = None

    def forget_states(self, since_ns: int | None) -> None:
        """Forget what is said of states from a time on; times and counts of frames stay.

        Args:
            since_ns: the time, on the clock of the states; None for all.
        """
        since_ns = int(np.iinfo(np.int64).min) if since_ns is None else since_ns
        first_ns = self.by_frame.first_stamp_ns(since_ns)
        self.steps.forget_from(first_ns)
        self.innovations.forget_from(first_ns)
        self.calibration.forget_from(since_ns)
        self.by_frame.forget_from(since_ns)

    def count_frame(
        self, stamp_ns: int, milliseconds: Mapping[str, float], frame_stats: Mapping[str, float]
    ) -> None:
        """Note that a frame is done.

        Args:
            stamp_ns: its time.
            milliseconds: of each stage.
            frame_stats: what the front end counts.
        """
        self.frames += 1
        self.last_frame_ns = stamp_ns
        self.timing.append(stamp_ns, milliseconds)
        for name, count in frame_stats.items():
            if not name.endswith("_ms"):
                self.features[name] += int(count)

    def frontend_milliseconds(self) -> dict[str, float]:
        """Milliseconds a frame of the front end, in total and of each of its parts."""
        if not len(self.timing):
            return {}
        found = {"total": float(np.mean(self.timing.column("frontend")))}
        for stage in self.timing.stages():
            if stage.startswith("frontend."):
                total = float(np.nansum(self.timing.column(stage)))
                found[stage.removeprefix("frontend.")] = total / len(self.timing)
        return found
