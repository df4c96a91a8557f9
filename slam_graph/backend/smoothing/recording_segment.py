# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Segments of a recording: frames and keyframes, their observations, the IMU samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig, ZeroVelocityConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.cost.zero_velocity import StandstillDetector
from slam_graph.backend.online_calibration import rolling_motion
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.keyframe_aiding import KeyframeAiding
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.geometry import NavState
from slam_graph.sensors import (
    FeatureFrame,
    FeatureObservations,
    ImuBuffer,
    Rig,
    RigCamera,
)

_MAX_INITIAL_ERROR = 30.0
"""Features with a larger root-mean-square reprojection error are left out, in units of σ."""
_PINHOLE_TANGENT = 2.75
"""Longest normalised points that a pinhole in place of a wide lens sees: 70° off the axis. In its
pixels the noise grows with 1 / cos², by 9 there. Those further out are left out."""


def row_motions(states: Sequence[NavState], imu: ImuBuffer, rig: Rig) -> dict[int, FrameMotion]:
    """How the body moves while the rows of rolling shutters are exposed; none for global ones.

    Args:
        states: of frames 0, 1, ….
        imu: samples over all of these times.
        rig: the cameras.
    """
    if not rig.rolling:
        return {}
    lead_ns = round(rig.pose_offset_s * 1e9)
    return {k: rolling_motion(s, s.stamp_ns - lead_ns, imu, rig) for k, s in enumerate(states)}


@dataclass(frozen=True, slots=True, eq=False)
class RecordingSegment:
    """Consecutive frames, numbered from 0; the first and the last are keyframes.

    Attributes:
        stamps_ns: (N,) of all frames, on the clock of the IMU.
        keyframes: (K,) numbers of the frames that are keyframes.
        noise: (N, 2) factors on the white noise of gyroscope and accelerometer.
        still_sigmas: (N,) standard deviations of the velocity from zero at a standstill, m/s; NaN
            where the platform moves.
        imu: all IMU samples.
        seen: all observations; its frame indices are those of the frames.
        aiding: factors of position fixes and odometry on the keyframes.
    """

    stamps_ns: IntArray
    keyframes: IntArray
    noise: FloatArray
    still_sigmas: FloatArray
    imu: ImuBuffer
    seen: Observations
    aiding: KeyframeAiding = field(default_factory=KeyframeAiding)

    @property
    def keyframe_stamps_ns(self) -> IntArray:
        """(K,) on the clock of the IMU."""
        return self.stamps_ns[self.keyframes]

    def seen_by_keyframes(self) -> Observations:
        """The observations of the keyframes; frame indices are those of keyframes."""
        number = np.full(len(self.stamps_ns), -1)
        number[self.keyframes] = np.arange(len(self.keyframes))
        frame = number[self.seen.frame]
        seen = replace(self.seen, frames=tuple(range(len(self.keyframes))), frame=frame)
        return seen.rows(frame >= 0)


def read_segment(
    log: FrameLog, keyframes: IntArray, rig: Rig, standstill: ZeroVelocityConfig
) -> RecordingSegment:
    """Read the frames from the first of some keyframes to the last.

    Args:
        log: the frames of a run.
        keyframes: (K,) consecutive keyframes of it (frame numbers).
        rig: the calibration, which may be better than that of the log.
        standstill: settings of the standstill detector.
    """
    first, stop = int(keyframes[0]), int(keyframes[-1]) + 1
    imu = ImuBuffer()
    imu.add(log.samples(first, stop, rig))
    stamps_ns = log.frames_ns[first:stop] + round(rig.pose_offset_s * 1e9)
    counts, rows = log.features(first, stop)
    image = np.repeat(np.arange(counts.size), counts.ravel())
    frames, cameras = np.divmod(image, counts.shape[1])
    sigmas = _still_sigmas(standstill, imu, stamps_ns, frames, rows, cameras == 0)
    points = _recalibrated(np.hstack([rows["pixel"], rows["normalized"]]), cameras, log, rig)
    return RecordingSegment(
        stamps_ns,
        keyframes - first,
        _smoothed_noise(log.noise[first:stop], np.isfinite(sigmas)),
        sigmas,
        imu,
        _table(rows["id"], frames, cameras, points, len(stamps_ns)),
    )


def _still_sigmas(
    config: ZeroVelocityConfig,
    imu: ImuBuffer,
    stamps_ns: IntArray,
    frames: IntArray,
    rows: NDArray[np.void],
    compared: BoolArray,
) -> FloatArray:
    """Standard deviations (N,) of the velocity of frames from zero, m/s; NaN where they move.

    The detector sees only frames that may stand still, and those before them that it compares
    them with: in flight there are hardly any.

    Args:
        config: settings of the detector.
        imu: samples over all of these times.
        stamps_ns: (N,) of the frames.
        frames: (M,) the frame of each observation.
        rows: (M,) see `FrameLog.features`.
        compared: (M,) which observations are those of the first camera.
    """
    sigmas = np.full(len(stamps_ns), np.nan)
    if not config.enabled:
        return sigmas
    rows, frames = rows[compared], frames[compared]
    begins = frames.searchsorted(np.arange(len(stamps_ns) + 1))
    ids, pixels, normalized = (
        np.ascontiguousarray(rows[key]) for key in ("id", "pixel", "normalized")
    )
    detector, last = StandstillDetector(config), -1
    still = np.flatnonzero(detector.may_stand(stamps_ns, frames, ids, pixels))
    window_ns = round(config.window_s * 1e9)
    # the noise of the tracks in a frame is that of it and of the two before
    first = stamps_ns.searchsorted(stamps_ns[still] - window_ns, side="right") - 3
    needed = np.zeros(len(stamps_ns) + 1, np.int64)
    np.add.at(needed, np.maximum(first, 0), 1)
    np.subtract.at(needed, still + 1, 1)
    for k, is_needed in enumerate((np.cumsum(needed[:-1]) > 0).tolist()):
        if not is_needed and len(detector.dynamic) == 0:
            continue
        if k != last + 1:
            detector = StandstillDetector(config)
        own, stamp_ns, last = slice(begins[k], begins[k + 1]), int(stamps_ns[k]), k
        seen = FeatureObservations(ids[own], pixels[own], normalized[own])
        sigma = detector.add_frame(imu, stamp_ns, FeatureFrame(stamp_ns, (seen,)))
        sigmas[k] = np.nan if sigma is None else sigma
    return sigmas


def _smoothed_noise(noise: FloatArray, still: BoolArray) -> FloatArray:
    """Noise factors (N, 2) of the IMU without the delay of the causal estimate.

    The causal estimate follows vibration with a delay of seconds, and forgets it at every calm
    moment. In hindsight all frames in motion get the root mean square of their factors.
    """
    noise, moving = noise.copy(), ~still
    if moving.any():
        noise[moving] = np.sqrt(np.mean(noise[moving] ** 2, axis=0))
    return noise


def with_gtsam_cameras(rig: Rig) -> Rig:
    """The rig with a pinhole camera in place of each model that GTSAM does not have.

    Its focal lengths are those of the camera at its optical axis.
    """
    return replace(rig, cameras=tuple(_gtsam_camera(mounted) for mounted in rig.cameras))


def _gtsam_camera(mounted: RigCamera) -> RigCamera:
    camera = mounted.camera
    if camera.gtsam_calibration() is not None:
        return mounted
    middle, slope = (values[0] for values in camera.distort(np.zeros((1, 2))))
    fx, fy, cx, cy = slope[0, 0], slope[1, 1], middle[0], middle[1]
    pinhole = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion="none", coefficients=())
    return replace(mounted, camera=pinhole)


def _recalibrated(points: FloatArray, cameras: IntArray, log: FrameLog, rig: Rig) -> FloatArray:
    """(N, 4) pixels of cameras that GTSAM has, and normalised coordinates, by a new calibration."""
    for c, (mounted, supported) in enumerate(
        zip(rig.cameras, with_gtsam_cameras(rig).cameras, strict=True)
    ):
        rows = cameras == c
        if rig is not log.rig:
            points[rows, 2:] = mounted.camera.undistort(points[rows, :2])
        if supported is not mounted:
            points[rows, :2] = supported.camera.distort(points[rows, 2:])[0]
            if mounted.camera.model.sees_sideways:
                points[rows & (np.linalg.norm(points[:, 2:], axis=1) > _PINHOLE_TANGENT)] = np.nan
    return points


def _table(
    ids: IntArray, frames: IntArray, cameras: IntArray, points: FloatArray, count: int
) -> Observations:
    """The finite observations in `count` frames, sorted by feature, frame and camera.

    Rows must be sorted by frame and camera already.
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    order = finite[np.argsort(ids[finite], kind="stable")]
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
    """Feature (V,) and frame (V,) of each view: a feature in a frame, by any camera; sorted."""
    new = np.ones(len(seen), np.bool_)
    new[1:] = (np.diff(seen.feature) != 0) | (np.diff(seen.frame) != 0)
    return seen.feature[new], seen.frame[new]


def longest_tracks(seen: Observations, per_keyframe: int, least: int) -> BoolArray:
    """(J,) which features to use: those of the longest tracks, until every keyframe has enough.

    Args:
        seen: all observations.
        per_keyframe: features that each keyframe gets, if it has as many.
        least: keyframes in which a feature must be seen.
    """
    feature, frame = views(seen)
    lengths = np.bincount(feature, minlength=len(seen.ids))
    starts = np.cumsum(lengths) - lengths
    counts = np.zeros(len(seen.frames), np.int64)
    chosen = np.zeros(len(seen.ids), np.bool_)
    for j in np.argsort(-lengths, kind="stable"):
        if lengths[j] < least:
            break
        frames = frame[starts[j] : starts[j] + lengths[j]]
        if counts[frames].min() < per_keyframe:
            chosen[j] = True
            counts[frames] += 1
    return chosen


def triangulated(
    obs: Observations,
    poses: tuple[FloatArray, FloatArray],
    projection: RigProjection,
    backend: BackendConfig,
) -> tuple[FloatArray, BoolArray]:
    """Triangulated points (J, 3) of features, and which of them (J,) are usable.

    Args:
        obs: at least two observations of every feature.
        poses: world_R_body (F, 3, 3) and world_p_body (F, 3) of the frames of `obs`.
        projection: of the rig.
        backend: noise and thresholds.
    """
    found = triangulate(obs, projection, *poses, backend.triangulation)
    limit_px = _MAX_INITIAL_ERROR * backend.noise.pixel_sigma
    return found.points, found.good & (found.reprojection_px < limit_px)
