# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes in Rerun: points with ellipsoids of their covariance, in their own world."""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray
from slam_graph.backend import Estimator
from slam_graph.sensors import AidingData
from slam_graph.visualization.rerun_palette import ORANGE, VERMILLION
from slam_graph.visualization.rerun_progress import ShownFrame
from slam_graph.visualization.rerun_states import ellipsoid_axes
from slam_graph.visualization.rerun_stream import RerunStream

FIXES, FIX_SIGMA = "fixes", "fixes/sigma"
"""Entities, below the world, of the fixes and of their 1σ ellipsoids."""

_POINT_RADIUS, _LINE_RADIUS = -2.6, -0.4
"""In points of the screen."""


class FixLog:
    """Logs fixes as they are, each from the time on that was set when it was added.

    Args:
        stream: where to.
        world: entity of a world that is that of the fixes.
    """

    def __init__(self, stream: RerunStream, world: str) -> None:
        self._stream, self._world, self._styled = stream, world, False

    def add(self, positions: FloatArray, covariances: FloatArray, rejected: BoolArray) -> None:
        """Log fixes.

        Args:
            positions: (N, 3) m.
            covariances: (N, 3, 3) m².
            rejected: (N,) which of them the estimator is known to have rejected.
        """
        if not len(positions):
            return
        self._style()
        rr, axes = self._stream.rr, [ellipsoid_axes(covariance) for covariance in covariances]
        colours = np.where(rejected[:, None], np.array(VERMILLION), np.array(ORANGE))
        colours = colours.astype(np.uint8)
        points = {"positions": positions, "colors": colours}
        self._stream.log_rows(f"{self._world}/{FIXES}", rr.Points3D, **points)
        self._stream.log_rows(
            f"{self._world}/{FIX_SIGMA}",
            rr.Ellipsoids3D,
            centers=positions,
            half_sizes=np.array([sigmas for sigmas, _ in axes]),
            quaternions=np.array([quaternion for _, quaternion in axes]),
            colors=colours,
        )

    def _style(self) -> None:
        """Send once how fixes look."""
        if self._styled:
            return
        self._styled, rr = True, self._stream.rr
        points = rr.Points3D.from_fields(radii=[_POINT_RADIUS])
        self._stream.log(f"{self._world}/{FIXES}", points, static=True)
        lines = rr.Ellipsoids3D.from_fields(line_radii=[_LINE_RADIUS], fill_mode="majorwireframe")
        self._stream.log(f"{self._world}/{FIX_SIGMA}", lines, static=True)


class FixViews:
    """Shows the fixes of a run that is watched, once its world is theirs.

    Args:
        stream: where to.
    """

    def __init__(self, stream: RerunStream) -> None:
        self._stream = stream
        self._waiting = AidingData.empty()
        self._taken: list[tuple[FloatArray, FloatArray, bool]] = []
        self._counts = np.zeros(2, np.int64)
        self.begin("world")

    def begin(self, world: str) -> None:
        """Go on in another world: there all fixes so far are shown again, once it is theirs."""
        self._log, self._sent = FixLog(self._stream, world), 0

    def show(self, frame: ShownFrame, estimator: Estimator) -> None:
        """Log the fixes that came in with a frame; the first time also those before.

        Args:
            frame: that was estimated.
            estimator: after this frame.
        """
        self._take(frame.packet.aiding, estimator)
        due = self._taken[self._sent :]
        if not frame.georeferenced or not due:
            return
        self._sent = len(self._taken)
        positions, covariances, rejected = (np.array(part) for part in zip(*due, strict=True))
        self._log.add(positions, covariances, rejected)

    def _take(self, data: AidingData | None, estimator: Estimator) -> None:
        """Note the fixes up to the last frame that was solved, and whether they were rejected.

        The gate counts only. So they are known to be rejected if it tested as many as there are,
        and rejected all of them; mostly there is no more than one.
        """
        if data is not None:
            fixes = data.fix_stamps_ns, data.fix_positions, data.fix_covariances
            offset_ns = round(estimator.config.gnss.time_offset_s * 1e9)
            later = AidingData.of_fixes(*fixes).shifted(offset_ns)
            self._waiting = AidingData.concatenate([self._waiting, later])
        gate = estimator.aiding.gates["gnss"]
        counts = np.array([gate.tested, gate.rejected])
        tested, rejected = (counts - self._counts).tolist()
        self._counts = counts
        due = self._waiting.within(None, estimator.solved_ns)
        self._waiting = self._waiting.within(estimator.solved_ns, None)
        count = len(due.fix_stamps_ns)
        bad = tested == rejected == count
        for position, covariance in zip(due.fix_positions, due.fix_covariances, strict=True):
            self._taken.append((position, covariance, bad))
