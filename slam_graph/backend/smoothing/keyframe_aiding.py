# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes, known poses and odometry between the keyframes of a segment of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.aiding.fix_calibration import FixVariables, SeenFixes
from slam_graph.backend.aiding.fix_factors import Fix, PositionFix, fixes_of, pose_key
from slam_graph.backend.aiding.odometry_factors import odometry_factor
from slam_graph.backend.aiding.world_alignment import enough_fixes
from slam_graph.backend.backend_config import BackendConfig, OdometryConfig
from slam_graph.backend.smoothing.calibrated_fixes import CalibratedFixes
from slam_graph.geometry import Trajectory, interpolate
from slam_graph.sensors import AidingData

_NEAR_NS = 50_000_000
"""The velocity at a fix is the mean of so long before and after it."""
_LONGEST_GAP_S = 1.0
"""Poses farther apart are not interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownPose:
    """What is known of the pose of a keyframe from the segment before, in the world of fixes.

    Attributes:
        stamp_ns: of the keyframe.
        world_T_body: its pose.
        covariance: (6, 6) of it, rotation before position, in axes of the body.
        until_ns: fixes up to this time are in it.
    """

    stamp_ns: int
    world_T_body: gtsam.Pose3
    covariance: FloatArray
    until_ns: int


_Source = tuple[
    AidingData, Trajectory, BackendConfig, AidingData.Calibration | None, KnownPose | None
]


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeAiding:
    """Factors on keyframes.

    Attributes:
        fixes: absolute ones whose lever arm and clock are held, and a known pose; with `calibrated`
            they determine the world of the segment.
        odometry: between consecutive keyframes.
        source: what they were made of; None for nothing.
        calibrated: fixes whose lever arm or clock is a variable; None where they are held.
    """

    fixes: tuple[gtsam.NonlinearFactor, ...] = ()
    odometry: tuple[gtsam.NonlinearFactor, ...] = ()
    source: _Source | None = None
    calibrated: CalibratedFixes | None = None

    @property
    def absolute(self) -> bool:
        """Whether there are fixes or a known pose, which determine the world."""
        return len(self.fixes) > 0 or self.calibrated is not None

    def shared(self) -> FloatArray:
        """Clock (s) and lever arm (m) to begin with (n,), as far as they are variables."""
        return np.zeros(0) if self.calibrated is None else self.calibrated.first()

    def at(self, stamps_ns: IntArray) -> KeyframeAiding:
        """The same on some of the keyframes, by their times (K,)."""
        return self if self.source is None else aiding_of_keyframes(stamps_ns, *self.source)


def aiding_of_keyframes(
    stamps_ns: IntArray,
    data: AidingData,
    causal: Trajectory,
    config: BackendConfig,
    found: AidingData.Calibration | None = None,
    known: KnownPose | None = None,
) -> KeyframeAiding:
    """The factors of fixes, known poses and odometry.

    A fix counts at the nearest keyframe, moved there by the causal estimate. With too few fixes
    for a world there are none, and with orientations alone, as nothing tells the position then;
    unless the pose of a keyframe is known.

    Args:
        stamps_ns: (K,) of the keyframes.
        data: of the recording; fixes only if the causal estimate is in their world.
        causal: the causal estimate.
        config: lever arms, time offsets, noise.
        found: lever arm and clock of the fixes, if they are variables; `data` has the times that
            they were found to have.
        known: the pose of one of the keyframes.
    """
    if not len(data):
        return KeyframeAiding()
    source = data, causal, config, found, known
    near = config.on_the_clock(data).within(int(stamps_ns[0]), int(stamps_ns[-1]))
    measured = fixes_of(near, config, None if found is None else found.lever_arm_m)
    fixes_ns = np.array([fix.stamp_ns for fix in measured], dtype=np.int64)
    middles = stamps_ns[:-1] + np.diff(stamps_ns) // 2
    keyframes = np.searchsorted(middles, fixes_ns).tolist()
    then, at = _poses_at(causal, fixes_ns), _poses_at(causal, stamps_ns)
    odometry = _odometry(stamps_ns, at, data, config.odometry) if config.odometry.enabled else []
    used: list[Fix] = []
    fixes: list[gtsam.NonlinearFactor] = []
    free: list[tuple[PositionFix, tuple[gtsam.Pose3, gtsam.Pose3], int]] = []
    for fix, pose, k in zip(measured, then, keyframes, strict=True):
        here = at[k]
        used_before = known is not None and fix.stamp_ns <= known.until_ns
        if pose is not None and here is not None and not used_before:
            used.append(fix)
            if found is not None and isinstance(fix, PositionFix) and fix.is_timed:
                free.append((fix, (pose, here), k))
                continue
            fixes.append(fix.moved(pose, here).factor(pose_key(k), robust=True))
    located = any(isinstance(fix, PositionFix) for fix in used)
    if known is None and not (located and enough_fixes(used)):
        fixes, free = [], []
    if known is not None:
        k = int(np.searchsorted(stamps_ns, known.stamp_ns))
        noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance)
        fixes.append(gtsam.PriorFactorPose3(pose_key(k), known.world_T_body, noise))
    calibrated = None
    if found is not None and free:
        calibrated = _calibrated(free, causal, FixVariables(config.gnss), found)
    return KeyframeAiding(tuple(fixes), tuple(odometry), source, calibrated)


def _odometry(
    stamps_ns: IntArray,
    poses: Sequence[gtsam.Pose3 | None],
    data: AidingData,
    config: OdometryConfig,
) -> list[gtsam.NonlinearFactor]:
    """Factors of the odometry between consecutive keyframes.

    Args:
        stamps_ns: (K,) of the keyframes.
        poses: causal ones of them; None where there is none.
        data: of the recording.
        config: noise of the odometry.
    """
    factors = []
    for k, (ends, (a, b)) in enumerate(
        zip(pairwise(stamps_ns.tolist()), pairwise(poses), strict=True)
    ):
        moved = data.odometry_between(*ends)
        if moved is not None:
            way_m = float(np.linalg.norm(moved[1])) if a is None or b is None else a.range(b)
            factors.append(odometry_factor((k, k + 1), moved, way_m, config))
    return factors


def _calibrated(
    free: list[tuple[PositionFix, tuple[gtsam.Pose3, gtsam.Pose3], int]],
    causal: Trajectory,
    variables: FixVariables,
    found: AidingData.Calibration,
) -> CalibratedFixes:
    """Fixes with the poses of the body then and at their keyframes, and the numbers of these."""
    fixes = [fix for fix, _, _ in free]
    stamps_ns = np.array([fix.stamp_ns for fix in fixes], np.int64)
    before, after = (_poses_at(causal, stamps_ns + sign * _NEAR_NS) for sign in (-1, 1))
    velocities = np.zeros((len(fixes), 3))
    for row, (fix, (then, _), _) in enumerate(free):
        first, last = before[row] or then, after[row] or then  # one-sided at ends of the path
        sides = (before[row] is not None) + (after[row] is not None)
        velocities[row] = fix.velocity(first, last, 1e-9 * _NEAR_NS * max(sides, 1))
    seen = SeenFixes.of(fixes, [poses for _, poses, _ in free], velocities, found.time_offset_s)
    roots = np.linalg.inv(np.linalg.cholesky(np.array([fix.covariance for fix in fixes])))
    keyframes = np.array([k for _, _, k in free], np.int64)
    return CalibratedFixes(seen, roots, keyframes, variables, found.values)


def _poses_at(trajectory: Trajectory, stamps_ns: IntArray) -> list[gtsam.Pose3 | None]:
    """Poses at times (N,), ascending or not; None where the trajectory has none near."""
    order = np.argsort(stamps_ns, kind="stable")
    near, valid = interpolate(trajectory, stamps_ns[order], _LONGEST_GAP_S)
    poses: list[gtsam.Pose3 | None] = [None] * len(stamps_ns)
    rotations = Rotation.from_quat(near.quaternions).as_matrix()
    for n, R, position in zip(order[valid].tolist(), rotations, near.positions, strict=True):
        poses[n] = gtsam.Pose3(gtsam.Rot3(R), position)
    return poses
