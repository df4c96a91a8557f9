# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rotations of the first camera over the last seconds, for a comparison with the gyroscope."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.initialization.gyro_alignment import MAX_OFFSET_S, MIN_TURNS, Turns
from slam_graph.backend.initialization.visual_rotation import (
    MIN_COMMON,
    Bearings,
    rotation_between,
)
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, RigCamera

_BASELINE_NS = 400_000_000
"""Time between the two frames of a rotation; the longer, the larger the change of the rate."""
_ENOUGH_COMMON = 40
"""A pair of frames with fewer features in common is replaced by one that is nearer in time."""
_WINDOW_NS = 5_000_000_000
"""Over this time bias and offset are taken to be constant."""
_SHORTEST_TREND_S = 0.02
"""The motion within a frame is a line fitted to the gyroscope over the readout, or over this."""


class VisualTurns:
    """The rotations of a camera between pairs of frames, for as long as offsets are constant.

    Args:
        camera: the first of the rig.
        pixel_sigma: standard deviation of an observation, pixels.

    Attributes:
        seen: number of all rotations so far.
    """

    def __init__(self, camera: RigCamera, pixel_sigma: float) -> None:
        self._camera, self._pixel_sigma = camera, pixel_sigma
        self._frames: deque[tuple[int, Bearings]] = deque()  # by their stamps
        self._turns: deque[tuple[int, int, FloatArray, FloatArray]] = deque()
        self.seen = 0

    def forget(self) -> None:
        """Forget all frames: those that follow do not continue them."""
        self._frames.clear()
        self._turns.clear()

    def add(
        self,
        frame: FeatureFrame,
        imu: ImuBuffer,
        mounted: bool,
        spacing_ns: int,
        keep_last: bool = False,
    ) -> None:
        """Take the next frame, unless it follows the last one too soon.

        Args:
            frame: its features.
            imu: samples so far.
            mounted: whether the rotation of the camera on the body is known.
            spacing_ns: smallest time between two frames that are used.
            keep_last: whether a rotation may be over up to twice the usual time, if there is no
                other frame: where the spacing is nearly as long as that.
        """
        if not self._frames or frame.stamp_ns - self._frames[-1][0] >= spacing_ns:
            seen = (at_middle_row(frame, self._camera, imu) if mounted else frame).cameras[0]
            bearings = Bearings.of(seen, self._camera.camera, self._pixel_sigma)
            self._add(frame.stamp_ns, bearings, keep_last)

    def _add(self, stamp_ns: int, now: Bearings, keep_last: bool) -> None:
        """The rotation since the oldest frame with enough of the same features."""
        while self._frames:
            longest_ns = 2 * _BASELINE_NS if keep_last and len(self._frames) == 1 else _BASELINE_NS
            if stamp_ns - self._frames[0][0] <= longest_ns:
                break
            self._frames.popleft()
        while self._turns and stamp_ns - self._turns[0][0] > _WINDOW_NS:
            self._turns.popleft()
        for before_ns, before in self._frames:
            common = np.count_nonzero(is_in(now.ids, np.sort(before.ids)))
            if common < (_ENOUGH_COMMON if before is not self._frames[-1][1] else MIN_COMMON):
                continue
            turn = rotation_between(before, now, self._expected(before_ns, stamp_ns))
            if turn is not None:
                self._turns.append((before_ns, stamp_ns, turn.R, turn.information))
                self.seen += 1
            break
        self._frames.append((stamp_ns, now))

    def _expected(self, before_ns: int, stamp_ns: int) -> FloatArray | None:
        """The rotation between two frames if the camera turns on as in the last pair."""
        if not self._turns:
            return None
        first_ns, second_ns, R, _ = self._turns[-1]
        ratio = (stamp_ns - before_ns) / (second_ns - first_ns)
        vector = gtsam.Rot3.Logmap(gtsam.Rot3(R)) * ratio
        return np.asarray(gtsam.Rot3.Expmap(vector).matrix())

    def covered(self, imu: ImuBuffer, fewest: int = MIN_TURNS) -> tuple[Turns, ImuData] | None:
        """The turns that the gyroscope covers, and its samples; None if they are too few.

        Args:
            imu: recent samples; they count where they reach 0.13 s beyond both frames, under the
                calibrated offset.
            fewest: fewest turns.
        """
        nominal_ns = round(self._camera.clock_offset_s * 1e9)
        around_ns = round(MAX_OFFSET_S * 1e9) + 10_000_000
        newest_ns = imu.newest_ns() - nominal_ns - around_ns
        rows = [t for t in self._turns if t[1] <= newest_ns]
        rows = [t for t in rows if imu.covers(t[0] + nominal_ns - around_ns)]
        if len(rows) < fewest:
            return None
        turns = Turns(
            np.array([t[0] for t in rows]),
            np.array([t[1] for t in rows]),
            np.array([t[2] for t in rows]),
            np.array([t[3] for t in rows]),
        )
        first_ns, last_ns = rows[0][0] + nominal_ns, int(turns.second_ns.max()) + nominal_ns
        return turns, imu.between(first_ns - around_ns, last_ns + around_ns)


def at_middle_row(frame: FeatureFrame, camera: RigCamera, imu: ImuBuffer) -> FeatureFrame:
    """A frame with the bearings of the first camera at the time of its middle row.

    Args:
        frame: its features.
        camera: the first of the rig.
        imu: samples so far.
    """
    seen = frame.cameras[0]
    if camera.readout_s == 0.0 or len(seen) == 0:
        return frame
    around_ns = round(0.5e9 * max(abs(camera.readout_s), _SHORTEST_TREND_S))
    stamp_ns = frame.stamp_ns + round(camera.clock_offset_s * 1e9)
    if not imu.covers(stamp_ns - around_ns):
        return frame
    rate, slope, _ = imu.trend(stamp_ns, around_ns)
    seconds = (camera.row_times_s(seen.pixels[:, 1]) - camera.middle_s)[:, None]
    turn = rate * seconds + 0.5 * slope * seconds**2
    in_camera = turn @ camera.body_T_camera.rotation().matrix()
    rays = np.column_stack([seen.normalized, np.ones(len(seen))])
    rays = Rotation.from_rotvec(in_camera).apply(rays)
    normalized = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
    turned = replace(seen, normalized=normalized)
    return FeatureFrame(frame.stamp_ns, (turned, *frame.cameras[1:]))
