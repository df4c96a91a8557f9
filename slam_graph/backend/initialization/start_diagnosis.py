# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Why is there no start? What an attempt lacked, and the likeliest cause in one line.

What the data themselves show comes first (IMU, units, calibration, number of tracks); what the last
attempt lacked comes after it, because a wrong calibration looks like features that do not fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slam_graph.backend.backend_config import NoiseConfig
from slam_graph.sensors import FeatureFrame, ImuBuffer

MIN_FEATURES = 10
"""Smallest number of features that a start in motion is computed from."""
_FORCE_RATIO = (0.6, 1.7)
"""Mean specific force beyond these factors of gravity is in another unit, or without gravity."""
_HARDLY_PX = 4.0
"""A camera whose features move less over the window hardly moves."""
_RECENT_NS = 1_500_000_000
"""Samples and frames of so long before the last frame are looked at."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why an attempt to start was refused.

    Attributes:
        kind: what is missing: frames or IMU samples, features that last, motion that shows what
            must be known, or features and IMU that fit one another; `rest` is for a standstill.
        needs: the same in words, with the numbers of the attempt.
        lasting: whether it is not to be expected that a few more frames bring it.
    """

    kind: Literal["frames", "tracks", "motion", "fit", "rest"]
    needs: str
    lasting: bool = False


def likeliest_cause(
    refusal: Refusal,
    frames: list[FeatureFrame],
    latest: FeatureFrame,
    imu: ImuBuffer,
    stamp_ns: int,
    noise: NoiseConfig,
    calibration: str | None,
) -> str:
    """The likeliest cause and what to do about it; empty as long as there is none to see.

    Args:
        refusal: of the last attempt.
        frames: of the last attempt, in the order of time.
        latest: the last frame.
        imu: samples so far.
        stamp_ns: time of the last frame on the clock of the IMU.
        noise: gravity, and what counts as a gap.
        calibration: what contradicts the calibration, if something does.
    """
    cause = _of_imu(imu, stamp_ns, noise) or calibration
    if cause:
        return cause
    features = len(latest.cameras[0])
    if refusal.kind == "tracks" or (refusal.kind == "frames" and features < MIN_FEATURES):
        first = frames[0] if frames else latest
        lasting = len(np.intersect1d(first.cameras[0].ids, latest.cameras[0].ids))
        return (
            f"too few tracks: {features} features in the last frame, {lasting} of them over the "
            f"window, {MIN_FEATURES} are needed; look at the images with `slam-graph frontend`"
        )
    if refusal.kind == "frames" or not frames:
        return ""
    moved_px = _median_motion_px(frames[0], latest)
    if refusal.kind in ("rest", "motion") and moved_px < _HARDLY_PX:
        return (
            f"the camera hardly moves ({moved_px:.1f} px in the median over the window) but is not "
            "seen to stand still; move it, or raise backend.zero_velocity.max_disparity_px"
        )
    return {
        "rest": "the platform moves; use backend.initialization.mode=auto to start in motion",
        "motion": "too little acceleration, so that the scale is not observable; accelerate in "
        "several directions, use two cameras, or give a start state",
        "fit": "the tracks do not fit one motion of the IMU; moving objects, wrong matches, or a "
        "wrong calibration (focal length, T_cam_imu, time offset)",
    }[refusal.kind]


def _of_imu(imu: ImuBuffer, stamp_ns: int, noise: NoiseConfig) -> str:
    """What is wrong with the IMU samples of the last time; empty if nothing."""
    samples = imu.data
    recent = np.abs(samples.stamps_ns - stamp_ns) < _RECENT_NS
    if not np.any(recent):
        return "no IMU samples at the times of the frames; compare the clocks of both"
    begin_ns = max(stamp_ns - _RECENT_NS, int(samples.stamps_ns[0]))
    gap_s = imu.largest_gap_s(begin_ns, min(stamp_ns, imu.newest_ns()))
    if gap_s > noise.max_imu_gap_s:
        return (
            f"IMU samples are missing ({gap_s:.2f} s between two); for an IMU as slow as that "
            "raise backend.noise.max_imu_gap_s"
        )
    force = float(np.mean(np.linalg.norm(samples.accel[recent], axis=1)))
    if not _FORCE_RATIO[0] < force / noise.gravity < _FORCE_RATIO[1]:
        return (
            f"the accelerometer measures {force:.2f} m/s² in the mean where gravity alone is "
            f"{noise.gravity:g}; check its unit, and that gravity is not removed"
        )
    return ""


def _median_motion_px(before: FeatureFrame, after: FeatureFrame) -> float:
    """Median motion of the features that two frames share; infinite without any."""
    one, two = before.cameras[0], after.cameras[0]
    _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
    if not len(i):
        return float("inf")
    return float(np.median(np.linalg.norm(two.pixels[j] - one.pixels[i], axis=1)))
