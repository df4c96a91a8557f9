# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A piece of a recording: its frames and keyframes, their observations, its IMU samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig, ZeroVelocityConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.sensors.imu_buffer import ImuBuffer
from slam_graph.sensors.measurements import FeatureFrame, ImuData
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.smoothing.frame_log import FrameLog

MAX_START_ERROR_SIGMAS = 30.0
"""Features with a larger root mean square reprojection error do not begin, in units of σ."""
RECENT_NS = 10_000_000_000
"""How much of the IMU is looked through for standing still."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Consecutive frames, numbered from 0; the first and the last are keyframes.

    Attributes:
        stamps_ns: (N,) of all frames, on the clock of the IMU.
        keyframes: (K,) numbers of the frames that are keyframes.
        noise: (N, 2) factors on the white noise of gyroscope and accelerometer; one while it moves.
        still: (N,) whether the platform stands still.
        imu: all samples.
        seen: all observations of all frames; frame f of it is frame f.
    """

    stamps_ns: IntArray
    keyframes: IntArray
    noise: FloatArray
    still: BoolArray
    imu: ImuBuffer
    seen: Observations

    @property
    def keyframe_stamps_ns(self) -> IntArray:
        """(K,) on the clock of the IMU."""
        return self.stamps_ns[self.keyframes]

    def seen_by_keyframes(self) -> Observations:
        """The observations of the keyframes; frame k of it is keyframe k."""
        number = np.full(len(self.stamps_ns), -1)
        number[self.keyframes] = np.arange(len(self.keyframes))
        frame = number[self.seen.frame]
        seen = replace(self.seen, frames=tuple(range(len(self.keyframes))), frame=frame)
        return seen.rows(frame >= 0)


def read_piece(
    log: FrameLog, keyframes: IntArray, rig: Rig, standstill: ZeroVelocityConfig
) -> Piece:
    """Read the frames from the first of some keyframes to the last.

    Args:
        log: of a run.
        keyframes: (K,) consecutive ones of its keyframes.
        rig: may be calibrated better than it was during the run.
        standstill: when the platform stands still.
    """
    first, stop = int(keyframes[0]), int(keyframes[-1]) + 1
    offset_ns = round(rig.cameras[0].time_offset_s * 1e9)
    detector, recent = StandstillDetector(standstill), ImuBuffer()
    samples, stamps, still = [], [], []
    columns: list[tuple[IntArray, ...]] = []
    points: list[FloatArray] = []
    for number, packet in enumerate(log.packets(first, stop)):
        frame = packet.frame
        assert isinstance(frame, FeatureFrame)
        samples.append(packet.imu)
        recent.add(packet.imu)
        stamps.append(frame.stamp_ns + offset_ns)
        still.append(detector.is_still(recent, stamps[-1], frame))
        recent.forget_before(stamps[-1] - RECENT_NS)
        for c, seen in enumerate(frame.cameras):
            columns.append((seen.ids, np.full(len(seen), number), np.full(len(seen), c)))
            points.append(np.hstack([seen.pixels, seen.normalized]))
    imu = ImuBuffer()
    imu.add(ImuData.concatenate(samples))
    ids, frames, cameras = (np.concatenate(column) for column in zip(*columns, strict=True))
    places = np.concatenate(points)
    return Piece(
        np.array(stamps),
        keyframes - first,
        _over_the_flight(log.noise[first:stop], np.array(still)),
        np.array(still),
        imu,
        _table(ids, frames, cameras, _recalibrated(places, cameras, log, rig), len(stamps)),
    )


def _over_the_flight(noise: FloatArray, still: BoolArray) -> FloatArray:
    """Factors (N, 2) on the noise of the IMU without the delay with which they were learned.

    A causal estimate learns after some seconds that an airframe has begun to shake, and forgets it
    at every calm moment. Here all of the motion is known: it is given the root mean square.
    """
    noise, moving = noise.copy(), ~still
    if moving.any():
        noise[moving] = np.sqrt(np.mean(noise[moving] ** 2, axis=0))
    return noise


def with_native_cameras(rig: Rig) -> Rig:
    """The rig with a pinhole in place of each camera that GTSAM has no model of.

    Its focal lengths are those of the camera near its axis.
    """
    return replace(rig, cameras=tuple(_native(mounted) for mounted in rig.cameras))


def _native(mounted: RigCamera) -> RigCamera:
    camera = mounted.camera
    if camera.gtsam_calibration() is not None:
        return mounted
    middle, slope = (values[0] for values in camera.distort(np.zeros((1, 2))))
    fx, fy, cx, cy = slope[0, 0], slope[1, 1], middle[0], middle[1]
    pinhole = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion="none", coefficients=())
    return replace(mounted, camera=pinhole)


def _recalibrated(points: FloatArray, cameras: IntArray, log: FrameLog, rig: Rig) -> FloatArray:
    """Pixels of native cameras, and normalised coordinates by the calibration of a rig (N, 4)."""
    for c, (mounted, native) in enumerate(
        zip(rig.cameras, with_native_cameras(rig).cameras, strict=True)
    ):
        rows = cameras == c
        if rig is not log.rig:
            points[rows, 2:] = mounted.camera.undistort(points[rows, :2])
        if native is not mounted:
            points[rows, :2] = native.camera.distort(points[rows, 2:])[0]
    return points


def _table(
    ids: IntArray, frames: IntArray, cameras: IntArray, points: FloatArray, count: int
) -> Observations:
    """The observations in `count` frames that are finite, by feature, then frame, then camera."""
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    order = finite[np.lexsort((cameras[finite], frames[finite], ids[finite]))]
    features, feature = np.unique(ids[order], return_inverse=True)
    points = points[order]
    return Observations(
        features,
        tuple(range(count)),
        feature,
        frames[order],
        cameras[order],
        points[:, :2],
        points[:, 2:],
    )


def views(seen: Observations) -> tuple[IntArray, IntArray]:
    """Which feature (V,) was seen in which frame (V,) by any camera, sorted by feature."""
    new = np.ones(len(seen), np.bool_)
    new[1:] = (np.diff(seen.feature) != 0) | (np.diff(seen.frame) != 0)
    return seen.feature[new], seen.frame[new]


def longest_tracks(seen: Observations, per_keyframe: int, least: int) -> BoolArray:
    """Which features (J,) to use: the longest, until every keyframe has enough.

    Args:
        seen: all observations.
        per_keyframe: how many features each keyframe is given, if it has as many.
        least: how many keyframes a feature must be seen in.
    """
    feature, frame = views(seen)
    lengths = np.bincount(feature, minlength=len(seen.ids))
    starts = np.cumsum(lengths) - lengths
    given = np.zeros(len(seen.frames), np.int64)
    chosen = np.zeros(len(seen.ids), np.bool_)
    for j in np.argsort(-lengths, kind="stable"):
        if lengths[j] < least:
            break
        frames = frame[starts[j] : starts[j] + lengths[j]]
        if given[frames].min() < per_keyframe:
            chosen[j] = True
            given[frames] += 1
    return chosen


def triangulated(
    obs: Observations,
    poses: tuple[FloatArray, FloatArray],
    projection: RigProjection,
    backend: BackendConfig,
) -> tuple[FloatArray, BoolArray]:
    """Points (J, 3) of features, and which of them (J,) are usable.

    Args:
        obs: at least two observations of every feature.
        poses: world_R_body (F, 3, 3) and world_p_body (F, 3) of the frames of `obs`.
        projection: of the rig.
        backend: noise and thresholds.
    """
    found = triangulate(obs, projection, *poses, backend.triangulation)
    limit_px = MAX_START_ERROR_SIGMAS * backend.noise.pixel_sigma
    return found.points, found.good & (found.reprojection_px < limit_px)
