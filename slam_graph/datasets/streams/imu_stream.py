# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""IMU streams: blocks of samples from a CSV file or from memory, without unusable samples."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.datasets.streams.csv_rows import (
    Rows,
    check_times,
    count_rows,
    read_rows,
    require_rows,
)
from slam_graph.datasets.streams.imu_outliers import without_outliers
from slam_graph.datasets.streams.pairing import FOLLOWERS, in_order
from slam_graph.diagnostics import Diagnostics
from slam_graph.files import Files
from slam_graph.sensors import ImuData

_GAP_PERIODS = 5.0
"""A pause longer than this many sampling periods counts as a gap. One or two lost samples do not
hurt preintegration; five are 25 ms at 200 Hz, half the time between two frames."""

_MISSING_PERIODS, _EVEN, _FEWEST_PAUSES = 1.5, 0.1, 16
"""Samples are missing in a pause longer than so many periods, if the median pause differs from the
period by less than this share of it; as seen in blocks of so many pauses or more."""

SAMPLES_PER_BLOCK = 1024
"""Samples in memory that are cleaned at a time."""

_Block = tuple[Callable[[int], str], ImuData]
"""Samples, after a function that gives the place of each."""

INTEGER_STAMPS = [("stamp", "i8"), ("gyro", "f8", (3,)), ("accel", "f8", (3,))]


@dataclass
class _ImuCleaner:
    """Drops samples that cannot be used, counts them, and reports gaps.

    Counted kinds: `imu_not_finite`, `imu_duplicate` (the stamp of the latest sample again),
    `imu_out_of_order`, `imu_gap`, `imu_sample_missing` (fewer than a gap).

    Attributes:
        diagnostics: where faults are counted.
        after_ns: samples before this time are left out and not counted.
        latest_ns: stamp of the last sample that was kept.
        period_ns: median sampling period of the first block, which defines what a gap is.
    """

    diagnostics: Diagnostics
    after_ns: int | None = None
    latest_ns: int | None = None
    period_ns: float = field(default=np.inf)

    def clean(self, data: ImuData, where: Callable[[int], str], following_ns: IntArray) -> ImuData:
        """The usable samples of the next block.

        Args:
            data: samples in the order of the recording, stamps in any order.
            where: gives the place of a sample, such as file and line, for the log.
            following_ns: the first stamps after this block.
        """
        wanted = np.ones(len(data), bool)
        if self.after_ns is not None:
            wanted = data.stamps_ns >= self.after_ns
        finite = Files.are_measurable(np.hstack([data.gyro, data.accel])).all(axis=1)
        finite &= Files.are_times(data.stamps_ns)
        for k in np.flatnonzero(wanted & ~finite):
            self.diagnostics.warn("imu_not_finite", f"{where(int(k))}: dropped, not finite")
        candidates = np.flatnonzero(wanted & finite)
        kept = self._in_order(data.stamps_ns, candidates, where, following_ns)
        if len(kept) == np.count_nonzero(wanted):  # what is dropped is said already
            self._report_missing(data.stamps_ns[kept])
        self._report_gaps(data.stamps_ns[kept], lambda k: where(int(kept[k])))
        return ImuData(data.stamps_ns[kept], data.gyro[kept], data.accel[kept])

    def _in_order(
        self,
        stamps_ns: IntArray,
        candidates: NDArray[np.intp],
        where: Callable[[int], str],
        following_ns: IntArray,
    ) -> NDArray[np.intp]:
        """The candidates whose stamps increase; the others are counted."""
        stamps = stamps_ns[candidates]

        def dropped(k: int, latest: int) -> None:
            sample = f"{where(int(candidates[k]))}: sample at {stamps[k]} dropped"
            if stamps[k] == latest:
                self.diagnostics.warn("imu_duplicate", f"{sample}, there is one of that time")
            else:
                why = "earlier than the one before, or from the future"
                self.diagnostics.warn("imu_out_of_order", f"{sample}, {why}")

        return candidates[in_order(stamps, dropped, self.latest_ns, following_ns)]

    def _report_missing(self, stamps_ns: IntArray) -> None:
        """Count places in which a few samples are not there, if all others come evenly.

        Args:
            stamps_ns: (N,) of a block of which nothing was dropped.
        """
        pauses = np.diff(stamps_ns)
        if len(pauses) < _FEWEST_PAUSES:
            return
        period_ns = float(np.median(pauses))
        if float(np.median(np.abs(pauses - period_ns))) > _EVEN * period_ns:
            return
        few = (pauses > _MISSING_PERIODS * period_ns) & (pauses <= _GAP_PERIODS * period_ns)
        # a stamp that is late makes the next pause as much shorter
        around = np.concatenate([[np.inf], pauses, [np.inf]])
        with_shorter = pauses + np.minimum(around[:-2], around[2:])
        few &= with_shorter > (_MISSING_PERIODS + 1.0) * period_ns
        for k in np.flatnonzero(few):
            count = round(pauses[k] / period_ns) - 1
            what = f"{count} sample{'s' * (count > 1)} of the IMU missing before {stamps_ns[k + 1]}"
            self.diagnostics.warn("imu_sample_missing", what)

    def _report_gaps(self, stamps: IntArray, where: Callable[[int], str]) -> None:
        if len(stamps) == 0:
            return
        if not np.isfinite(self.period_ns) and len(stamps) > 1:
            self.period_ns = float(np.median(np.diff(stamps)))
        latest = stamps[0] if self.latest_ns is None else self.latest_ns
        pauses = np.diff(stamps, prepend=latest)
        for k in np.flatnonzero(pauses > _GAP_PERIODS * self.period_ns):
            self.diagnostics.warn(
                "imu_gap",
                f"{where(int(k))}: no sample for {pauses[k] * 1e-9:.3f} s before {stamps[k]}",
            )
        self.latest_ns = int(stamps[-1])


def clean_blocks(
    blocks: Iterable[_Block],
    diagnostics: Diagnostics,
    after_ns: int | None,
) -> Iterator[ImuData]:
    """Run a stream of blocks through one `_ImuCleaner`.

    Args:
        blocks: samples, each block after a function that gives the place of its samples.
        diagnostics: where faults are counted.
        after_ns: samples before this time are left out; None for all.
    """
    cleaner = _ImuCleaner(diagnostics, after_ns)
    followed = _with_stamps_after(blocks)
    cleaned = (cleaner.clean(data, where, after) for (where, data), after in followed)
    return without_outliers(cleaned, diagnostics)


def _with_stamps_after(blocks: Iterable[_Block]) -> Iterator[tuple[_Block, IntArray]]:
    """Blocks, each with the first stamps of those after it, as many as `in_order` looks at."""
    waiting: deque[_Block] = deque()
    for block in blocks:
        waiting.append(block)
        while len(after := _stamps_after_first(waiting)) == FOLLOWERS:
            yield waiting.popleft(), after
    while waiting:
        after = _stamps_after_first(waiting)
        yield waiting.popleft(), after


def _stamps_after_first(blocks: Iterable[_Block]) -> IntArray:
    """The first stamps of all blocks but the first one."""
    stamps = [data.stamps_ns for _, data in islice(blocks, 1, None)]
    together = np.concatenate([np.zeros(0, np.int64), *stamps])
    times: IntArray = together[Files.are_times(together)]
    return times[:FOLLOWERS]


class ImuSource(Protocol):
    """The samples of an IMU, wherever they are kept."""

    def blocks(self, diagnostics: Diagnostics, after_ns: int | None) -> Iterator[ImuData]:
        """The cleaned samples from `after_ns` on."""
        ...

    def count(self) -> int:
        """Number of samples, before faulty ones are dropped."""
        ...

    def ends_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last sample."""
        ...


@dataclass(frozen=True)
class ImuArrays:
    """The samples of an IMU in memory, an `ImuSource`.

    Attributes:
        data: all samples, also faulty ones.
    """

    data: ImuData

    def blocks(self, diagnostics: Diagnostics, after_ns: int | None) -> Iterator[ImuData]:
        """The cleaned samples from `after_ns` on."""
        starts = range(0, len(self.data), SAMPLES_PER_BLOCK)
        blocks = (
            (partial(_sample, first), self.data[first : first + SAMPLES_PER_BLOCK])
            for first in starts
        )
        return clean_blocks(blocks, diagnostics, after_ns)

    def count(self) -> int:
        """Number of samples, before faulty ones are dropped."""
        return len(self.data)

    def ends_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last sample."""
        return int(self.data.stamps_ns[0]), int(self.data.stamps_ns[-1])


def _sample(first: int, index: int) -> str:
    """The place of a sample in a block that begins with sample `first`."""
    return f"IMU sample {first + index}"


@dataclass(frozen=True)
class ImuFile:
    """The samples of an IMU in a CSV file, an `ImuSource`.

    Raises:
        DataError: if the file cannot be read or has no samples.

    Attributes:
        path: of the file.
        parse: turns its rows into samples.
    """

    path: Path
    parse: Callable[[Rows], ImuData]

    def __post_init__(self) -> None:
        require_rows(self.path)

    def blocks(self, diagnostics: Diagnostics, after_ns: int | None) -> Iterator[ImuData]:
        """The cleaned samples from `after_ns` on."""
        blocks = ((rows.where, self.parse(rows)) for rows in read_rows(self.path))
        return clean_blocks(blocks, diagnostics, after_ns)

    def count(self) -> int:
        """Number of samples, before faulty ones are dropped."""
        return count_rows(self.path)[0]

    def ends_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last sample."""
        _, first, last = count_rows(self.path)
        begin, end = self.parse(Rows(self.path, [first, last], [1, 1])).stamps_ns.tolist()
        return begin, end


def parse_imu_rows(rows: Rows) -> ImuData:
    """Samples of rows (stamp in ns, gyro xyz in rad/s, accel xyz in m/s²): EuRoC's order."""
    table = rows.parse(INTEGER_STAMPS, "stamp [ns], gyro xyz, accel xyz")
    check_times(rows, table["stamp"])
    return ImuData(table["stamp"], table["gyro"], table["accel"])
