# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Feature frames from tables of tracks: one row for each feature, camera and time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.sequence import FrameStream
from slam_graph.diagnostics import Diagnostics
from slam_graph.files import Files
from slam_graph.sensors import FeatureFrame, FeatureObservations

TRACK_ROW = np.dtype(
    [
        ("stamp", "i8"),
        ("camera", "i8"),
        ("id", "i8"),
        ("pixel", "f8", (2,)),
        ("normalized", "f8", (2,)),
    ]
)
"""One observation: time in ns, index of the camera, id, pixel, and undistorted coordinates."""

TrackTable: TypeAlias = NDArray[np.void]


@dataclass
class StampCounter:
    """Counts frames in a stream of stamps by the rule of `frames_from_tables`.

    Attributes:
        frames: times so far that were later than all before them.
        first_ns, latest_ns: the first and the last of them.
    """

    frames: int = 0
    first_ns: int = 0
    latest_ns: int = 0

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of the next row."""
        if self.frames == 0 or stamp_ns > self.latest_ns:
            self.first_ns = self.first_ns if self.frames else stamp_ns
            self.latest_ns = stamp_ns
            self.frames += 1


def frames_from_tables(
    tables: Iterable[TrackTable], cameras: int, diagnostics: Diagnostics, where: str
) -> FrameStream:
    """Frames of tables in which the rows of a frame follow one another.

    Counted kinds: `frame_out_of_order` (a frame not later than the one before it, dropped),
    `track_not_finite` and `track_duplicate` (an id twice in a camera and frame; the first is kept).

    Args:
        tables: arrays of `TRACK_ROW`; a frame may begin in one and end in the next.
        cameras: number of cameras; rows of others are left out.
        diagnostics: where faults are counted.
        where: name of the file, for the log.
    """
    latest_ns: int | None = None
    for table in _whole_frames(tables):
        stamp_ns = int(table["stamp"][0])
        if latest_ns is not None and stamp_ns <= latest_ns:
            diagnostics.warn(
                "frame_out_of_order",
                f"{where}: frame at {stamp_ns} dropped, it follows {latest_ns}",
            )
            continue
        latest_ns = stamp_ns
        observed = (_observations(table, c, diagnostics, where) for c in range(cameras))
        yield FeatureFrame(stamp_ns, tuple(observed))


def _whole_frames(tables: Iterable[TrackTable]) -> Iterator[TrackTable]:
    """Split tables where the stamp changes; a frame may go on in the next table."""
    rest = np.zeros(0, TRACK_ROW)
    for table in tables:
        joined = np.concatenate([rest, table]) if len(rest) else table
        cuts = np.flatnonzero(np.diff(joined["stamp"])) + 1
        begin = 0
        for end in cuts.tolist():
            yield joined[begin:end]
            begin = end
        rest = joined[begin:]
    if len(rest):
        yield rest


def _observations(
    table: TrackTable, camera: int, diagnostics: Diagnostics, where: str
) -> FeatureObservations:
    """The observations of one camera in one frame, without unusable ones."""
    rows = table[table["camera"] == camera]
    finite = Files.are_measurable(rows["pixel"]).all(axis=1) & Files.are_measurable(
        rows["normalized"]
    ).all(axis=1)
    for row in rows[~finite]:
        diagnostics.warn(
            "track_not_finite", f"{where}: feature {row['id']} at {row['stamp']} dropped"
        )
    rows = rows[finite]
    _, first = np.unique(rows["id"], return_index=True)
    if len(first) != len(rows):
        for row in np.delete(rows, first):
            diagnostics.warn(
                "track_duplicate", f"{where}: feature {row['id']} at {row['stamp']} repeated"
            )
        rows = rows[np.sort(first)]
    return FeatureObservations(
        np.ascontiguousarray(rows["id"]),
        np.ascontiguousarray(rows["pixel"]),
        np.ascontiguousarray(rows["normalized"]),
    )
