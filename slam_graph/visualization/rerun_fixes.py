# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes and known poses in Rerun, with ellipsoids of their covariance, in their own world.

A known pose whose position was not measured is nowhere, and is not shown.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend import Estimator
from slam_graph.sensors import AidingData
from slam_graph.visualization.rerun_palette import AXES, ORANGE, VERMILLION
from slam_graph.visualization.rerun_progress import ShownFrame
from slam_graph.visualization.rerun_states import ellipsoid_axes
from slam_graph.visualization.rerun_stream import RerunStream

FIXES, FIX_SIGMA = "fixes", "fixes/sigma"
"""Entities, below the world, of the fixes and of their 1σ ellipsoids."""
POSES, POSE_SIGMA, POSE_AXES = "known_poses", "known_poses/sigma", "known_poses/axes"
"""The same of known poses, and the axes of their sensor."""

_POINT_RADIUS, _LINE_RADIUS, _AXIS_RADIUS = -2.6, -0.4, -0.8
"""In points of the screen."""
_AXIS_M = 0.1
"""Length of the axes of a known pose."""


class FixLog:
    """Logs fixes as they are, each from the time on that was set when it was added.

    Args:
        stream: where to.
        world: entity of a world that is that of the fixes.
        names: entities of points and ellipsoids below it.
    """

    def __init__(
        self, stream: RerunStream, world: str, names: tuple[str, str] = (FIXES, FIX_SIGMA)
    ) -> None:
        self._stream, self._styled = stream, False
        self._points, self._sigma = (f"{world}/{name}" for name in names)

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
        self._stream.log_rows(self._points, rr.Points3D, **points)
        self._stream.log_rows(
            self._sigma,
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
        self._stream.log(self._points, points, static=True)
        lines = rr.Ellipsoids3D.from_fields(line_radii=[_LINE_RADIUS], fill_mode="majorwireframe")
        self._stream.log(self._sigma, lines, static=True)


class KnownPoseLog:
    """Logs known poses as they are: places with ellipsoids, and the axes of their sensor.

    Args:
        stream: where to.
        world: entity of a world that is that of the poses.
    """

    def __init__(self, stream: RerunStream, world: str) -> None:
        self._stream, self._axes = stream, f"{world}/{POSE_AXES}"
        self._places = FixLog(stream, world, (POSES, POSE_SIGMA))

    def add(self, data: AidingData, rejected: BoolArray) -> None:
        """Log the known poses of a stretch of time.

        Args:
            data: K known poses among others.
            rejected: (K,) which positions the estimator is known to have rejected.
        """
        measured = np.isfinite(data.pose_sigmas)
        placed, turned = np.all(measured[:, :3], axis=1), np.all(measured[:, 3:], axis=1)
        squares = np.square(data.pose_sigmas[placed, :3])
        covariances = squares[:, :, None] * np.eye(3)
        self._places.add(data.pose_positions[placed], covariances, rejected[placed])
        shown = placed & turned
        if not shown.any():
            return
        rr, count = self._stream.rr, int(np.sum(shown))
        axes = Rotation.from_quat(data.pose_quaternions[shown]).as_matrix()
        self._stream.log_rows(
            self._axes,
            rr.Arrows3D,
            origins=np.repeat(data.pose_positions[shown], 3, axis=0),
            vectors=_AXIS_M * axes.transpose(0, 2, 1).reshape(-1, 3),
            colors=np.tile(np.array(AXES, np.uint8), (count, 1)),
            radii=np.full(3 * count, _AXIS_RADIUS),
        )


class FixViews:
    """Shows fixes and known poses of a run that is watched, once its world is theirs.

    Args:
        stream: where to.
    """

    def __init__(self, stream: RerunStream) -> None:
        self._stream = stream
        self._waiting = AidingData.empty()
        self._taken: list[tuple[AidingData, bool, bool]] = []
        self._counts: dict[str, IntArray] = {}
        self.begin("world")

    def begin(self, world: str) -> None:
        """Go on in another world: there all of them are shown again, once it is theirs."""
        self._fixes, self._sent = FixLog(self._stream, world), 0
        self._poses = KnownPoseLog(self._stream, world)

    def show(self, frame: ShownFrame, estimator: Estimator) -> None:
        """Log what came in with a frame; the first time also what came before.

        Args:
            frame: that was estimated.
            estimator: after this frame.
        """
        self._take(frame.packet.aiding, estimator)
        due = self._taken[self._sent :]
        if not frame.georeferenced or not due:
            return
        self._sent = len(self._taken)
        data = AidingData.concatenate(part for part, _, _ in due)
        fixes = [np.full(len(part.fix_stamps_ns), bad) for part, bad, _ in due]
        poses = [np.full(len(part.pose_stamps_ns), bad) for part, _, bad in due]
        self._fixes.add(data.fix_positions, data.fix_covariances, np.concatenate(fixes))
        self._poses.add(data, np.concatenate(poses))

    def _take(self, data: AidingData | None, estimator: Estimator) -> None:
        """Note what was measured up to the last frame that was solved, and what was rejected."""
        if data is not None:
            later = estimator.config.on_the_clock(data.without_odometry())
            self._waiting = AidingData.concatenate([self._waiting, later])
        solved_ns = _solved_ns(estimator)
        due = self._waiting.within(None, solved_ns)
        self._waiting = self._waiting.within(solved_ns, None)
        placed = int(np.sum(np.isfinite(due.pose_sigmas[:, :3]).all(axis=1)))
        bad = self._rejected("gnss", len(due.fix_stamps_ns), estimator)
        bad_poses = self._rejected("poses", placed, estimator)
        if len(due.fix_stamps_ns) or len(due.pose_stamps_ns):
            self._taken.append((due, bad, bad_poses))

    def _rejected(self, source: str, count: int, estimator: Estimator) -> bool:
        """Whether so many measurements of a source are known to have been rejected.

        The gate counts only. So they are if it tested as many as there are, and rejected all of
        them; mostly there is no more than one.
        """
        gate = estimator.aiding.gates[source]
        counts = np.array([gate.tested, gate.rejected])
        tested, rejected = counts - self._counts.get(source, np.zeros(2, np.int64))
        self._counts[source] = counts
        return bool(tested == rejected == count)


def _solved_ns(estimator: Estimator) -> int:
    """Time of the state at the last frame that was solved; measurements are on its clock, too."""
    stamp_ns, offset_ns = estimator.solved_ns, round(estimator.rig.pose_offset_s * 1e9)
    # before the first frame the stamp is the least there is
    later_ns = max(stamp_ns + offset_ns, int(np.iinfo(np.int64).min))
    return estimator.times_ns.get(stamp_ns, later_ns)
