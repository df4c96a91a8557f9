# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the back end did in every frame: features, poses, cost, NIS; written as `frames.csv`."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import FloatArray, GrowingTable, IntArray
from slam_graph.sensors import FeatureFrame

if TYPE_CHECKING:
    from slam_graph.backend import Estimator

_MAX_COSTS = 8
"""Of more Gauss-Newton steps in one frame, the last ones are left out."""

COUNTS = ("tracked", "tracked_other_cameras", "estimated", "poses_in_state")
REJECTED = ("rejected_ransac", "rejected_gate", "rejected_stereo")
INNOVATION = ("nis", "nis_dof", "nis_expected")
COSTS = ("cost_before", *(f"cost_after_{k}" for k in range(1, _MAX_COSTS)))
NEES = ("nees_position", "nees_orientation")
KEYFRAME = "keyframe"
STATE = "state_ns"
"""Times of the states: a column only where they are not the stamps of the frames."""
_CELLS = (*COUNTS, "features_in_state", *REJECTED, *INNOVATION)
_WHOLE = (*COUNTS, "features_in_state", *REJECTED, "nis_dof")
_OF_STATES = [_CELLS.index(name) for name in INNOVATION]
_UNKNOWN = array("f", [math.nan])


class FrameTable:
    """A growing table with a row for each frame."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._times_ns = array("q")  # of the states, as far as they are known
        self._cells = GrowingTable(len(_CELLS), np.float32)  # as many digits as are written
        self._costs: list[array[float]] = []  # a column for each, as many as a frame ever had
        self._row_of: dict[int, int] = {}
        self._keyframe_rows: set[int] = set()

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def append(
        self,
        features: FeatureFrame,
        estimated: int,
        estimator: Estimator,
        counts: Mapping[str, float],
    ) -> None:
        """Add a frame.

        Args:
            features: of the frame.
            estimated: number of the features whose positions are estimated.
            estimator: after this frame.
            counts: of the front end, by name.
        """
        seen = [len(camera) for camera in features.cameras]
        window, found = estimator.window, estimator.report.innovations
        past, held = (0, 0) if window is None else (len(window.past), len(window.state_features))
        tested = bool(found.passed_dof)
        row: list[float] = [seen[0], sum(seen[1:]), estimated, past, held]
        row += [counts.get(REJECTED[0], 0.0), found.rejected, counts.get(REJECTED[2], 0.0)]
        row += [found.passed_distance, found.passed_dof, found.expected] if tested else 3 * [np.nan]
        self._cells.append(row)
        self._note_costs(estimator.report.costs[:_MAX_COSTS])
        if window is not None:
            self._row_of = {n: r for n, r in self._row_of.items() if n in window.past}
            self._row_of[window.frame] = self._row_solved(estimator.solved_ns, features.stamp_ns)
            self._keyframe_rows |= {self._row_of[n] for n in window.keyframes if n in self._row_of}
        later_ns = self._times_ns[-1] - self._stamps_ns[-1] if len(self) else 0
        self._times_ns.append(features.stamp_ns + later_ns)
        self._stamps_ns.append(features.stamp_ns)

    def note_times(self, times_ns: Mapping[int, int]) -> None:
        """Note when the states at frames are, by the stamps of these.

        The clock of the states is ahead of that of the frames by an offset, which may be estimated
        on the way. A frame that waits has its state later than others have theirs.
        """
        for stamp_ns, time_ns in times_ns.items():
            row = bisect_left(self._stamps_ns, stamp_ns)
            if row < len(self) and self._stamps_ns[row] == stamp_ns:
                self._times_ns[row] = time_ns

    def first_stamp_ns(self, time_ns: int) -> int:
        """Stamp of the first frame with a state at or after a time; if there is none, any later."""
        first = bisect_left(self._times_ns, time_ns)
        return self._stamps_ns[first] if first < len(self) else int(np.iinfo(np.int64).max)

    def forget_from(self, time_ns: int) -> None:
        """Forget what is said of states at and after a time; counts of frames stay.

        Frames of the window are numbered anew after this.
        """
        first = bisect_left(self._times_ns, time_ns)
        self._cells.fill(first, _OF_STATES, math.nan)
        for column in self._costs:
            column[first:] = _UNKNOWN * (len(self) - first)
        self._row_of = {}
        self._keyframe_rows = {row for row in self._keyframe_rows if row < first}

    @property
    def stamps_ns(self) -> IntArray:
        """(F,) times of the frames."""
        return np.array(self._stamps_ns, dtype=np.int64)

    @property
    def times_ns(self) -> IntArray:
        """(F,) times of the states at the frames, whether there is one or not."""
        return np.array(self._times_ns, dtype=np.int64)

    @property
    def keyframes_ns(self) -> IntArray:
        """(K,) times of the states at the frames that the algorithm has made keyframes."""
        return self.times_ns[sorted(self._keyframe_rows)]

    def csv_lines(
        self, keyframes_ns: IntArray, nees: tuple[IntArray, FloatArray] | None
    ) -> Iterator[str]:
        """The table as CSV, empty where something is not known.

        Args:
            keyframes_ns: (K,) times of the states at keyframes.
            nees: times (N,) and NEES (N, 2) of position and orientation, if there is a truth.
        """
        times_ns, table = self.times_ns, self._table().astype(np.float64)
        errors = np.full((len(self), 2), np.nan)
        if nees is not None:
            _, rows, found = np.intersect1d(times_ns, nees[0], return_indices=True)
            errors[rows] = nees[1][found]
        always = len(_CELLS)  # the cost before the steps
        last = max([always, *np.flatnonzero(np.isfinite(table).any(axis=0)).tolist()])
        titles = (*_CELLS, *COSTS)[: last + 1]
        marks = np.isin(times_ns, keyframes_ns).astype(np.int64)
        firsts = {"stamp_ns": self.stamps_ns, STATE: times_ns, KEYFRAME: marks}
        if self._times_ns == self._stamps_ns:
            del firsts[STATE]
        yield ",".join([*firsts, *titles, *NEES]) + "\n"
        whole = [name in _WHOLE for name in titles]
        columns = zip(*(column.tolist() for column in firsts.values()), strict=True)
        for first, row, error in zip(columns, table, errors, strict=True):
            cells = [_cell(v, w) for v, w in zip(row[: last + 1].tolist(), whole, strict=True)]
            cells += [_cell(value, False) for value in error.tolist()]
            yield ",".join([*map(str, first), *cells]) + "\n"

    def _row_solved(self, solved_ns: int, stamp_ns: int) -> int:
        """The row of the frame that was solved last: the new one's, unless that waits."""
        return len(self) if solved_ns == stamp_ns else bisect_left(self._stamps_ns, solved_ns)

    def _note_costs(self, costs: Sequence[float]) -> None:
        """Note the costs of the next frame; those that it does not have are not known."""
        while len(self._costs) < len(costs):
            self._costs.append(_UNKNOWN * len(self))
        for k, column in enumerate(self._costs):
            column.append(costs[k] if k < len(costs) else math.nan)

    def _table(self) -> NDArray[np.float32]:
        """(F, columns) a copy of all cells, with at least one cost."""
        return np.column_stack([self._cells.rows(), *(self._costs or [_UNKNOWN * len(self)])])


def _cell(value: float, whole: bool) -> str:
    if math.isnan(value):
        return ""
    return str(int(value)) if whole else f"{value:.6g}"
