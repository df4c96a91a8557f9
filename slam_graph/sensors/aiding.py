# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements that aid cameras and IMU: position fixes (GNSS), known poses, odometry of wheels.

All are few beside images and samples of an IMU, and come with the packet of the first frame that
is not earlier. Their times are on the clock of the IMU, or of the cameras where there is no IMU.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from slam_graph.arrays import BoolArray, FloatArray, IntArray

_MAX_ODOMETRY_GAP_S = 0.5
"""Odometry is not interpolated between samples that are farther apart."""


@dataclass(frozen=True, slots=True, eq=False)
class AidingData:
    """Position fixes, known poses and odometry of a stretch of time.

    Attributes:
        fix_stamps_ns: (N,) int64, ascending.
        fix_positions: (N, 3) of the antenna in a local world whose axes point east, north and up,
            m.
        fix_covariances: (N, 3, 3) of the positions, m².
        datum: latitude, longitude (degrees) and height above the ellipsoid (m) of the origin of
            that world on WGS84; None where it is not known.
        odometry_stamps_ns: (M,) int64, ascending.
        odometry_positions: (M, 3) of the body in the frame of the odometry, which drifts, m.
        odometry_quaternions: (M, 4) its orientation there, x y z w.
        pose_stamps_ns: (K,) int64, ascending; of known poses.
        pose_positions: (K, 3) of their sensor in the world of the fixes, m.
        pose_quaternions: (K, 4) its orientation there, x y z w.
        pose_sigmas: (K, 6) standard deviations along and about the axes of the world: position (m),
            then orientation (rad); infinite where the three of either were not measured.
    """

    @dataclass(frozen=True, slots=True, eq=False)
    class Calibration:
        """Lever arm and clock of the position fixes.

        Attributes:
            time_offset_s: what is to be added to the times of the fixes, beyond the given offset.
            lever_arm_m: (3,) position of the antenna in the body frame.
            covariance: (4, 4) of time offset (s), then lever arm (m); zero where one is held.
        """

        time_offset_s: float
        lever_arm_m: FloatArray
        covariance: FloatArray

        @property
        def values(self) -> FloatArray:
            """(4,) time offset and lever arm."""
            return np.append(self.time_offset_s, self.lever_arm_m)

        @property
        def sigmas(self) -> FloatArray:
            """(4,) standard deviations."""
            return np.asarray(np.sqrt(np.diag(self.covariance)))

        def table(self) -> dict[str, object]:
            """As it is written to `metrics.json`."""
            return {
                "fix_offset_s": self.time_offset_s,
                "fix_offset_sigma_s": float(self.sigmas[0]),
                "lever_arm_m": self.lever_arm_m.tolist(),
                "lever_arm_sigma_m": self.sigmas[1:].tolist(),
            }

    fix_stamps_ns: IntArray
    fix_positions: FloatArray
    fix_covariances: FloatArray
    datum: tuple[float, float, float] | None
    odometry_stamps_ns: IntArray
    odometry_positions: FloatArray
    odometry_quaternions: FloatArray
    pose_stamps_ns: IntArray
    pose_positions: FloatArray
    pose_quaternions: FloatArray
    pose_sigmas: FloatArray

    @staticmethod
    def empty() -> AidingData:
        """Nothing."""
        none = np.zeros(0, np.int64)
        fixes = none, np.zeros((0, 3)), np.zeros((0, 3, 3))
        poses = none, np.zeros((0, 3)), np.zeros((0, 4))
        return AidingData(*fixes, None, *poses, *poses, np.zeros((0, 6)))

    @staticmethod
    def of_fixes(
        stamps_ns: IntArray,
        positions: FloatArray,
        covariances: FloatArray,
        datum: tuple[float, float, float] | None = None,
    ) -> AidingData:
        """Position fixes alone; see the attributes."""
        return replace(
            AidingData.empty(),
            fix_stamps_ns=stamps_ns,
            fix_positions=positions,
            fix_covariances=covariances,
            datum=datum,
        )

    def with_odometry(
        self, stamps_ns: IntArray, positions: FloatArray, quaternions: FloatArray
    ) -> AidingData:
        """The same with odometry; see the attributes."""
        return replace(
            self,
            odometry_stamps_ns=stamps_ns,
            odometry_positions=positions,
            odometry_quaternions=quaternions,
        )

    def with_poses(
        self,
        stamps_ns: IntArray,
        positions: FloatArray,
        quaternions: FloatArray,
        sigmas: FloatArray,
    ) -> AidingData:
        """The same with known poses; see the attributes."""
        return replace(
            self,
            pose_stamps_ns=stamps_ns,
            pose_positions=positions,
            pose_quaternions=quaternions,
            pose_sigmas=sigmas,
        )

    def without_fixes(self) -> AidingData:
        """The same without position fixes."""
        names = "fix_stamps_ns", "fix_positions", "fix_covariances"
        return replace(self, **{name: getattr(self, name)[:0] for name in names})

    def without_poses(self) -> AidingData:
        """The same without known poses."""
        none = AidingData.empty()
        return self.with_poses(
            none.pose_stamps_ns, none.pose_positions, none.pose_quaternions, none.pose_sigmas
        )

    def without_odometry(self) -> AidingData:
        """The same without odometry."""
        none = AidingData.empty()
        return self.with_odometry(
            none.odometry_stamps_ns, none.odometry_positions, none.odometry_quaternions
        )

    def __len__(self) -> int:
        """Number of fixes, of known poses and of samples of odometry."""
        return sum(
            len(part) for part in (self.fix_stamps_ns, self.pose_stamps_ns, self.odometry_stamps_ns)
        )

    @staticmethod
    def concatenate(parts: Iterable[AidingData]) -> AidingData:
        """Stretches that follow one another; the datum is that of the first that has one."""
        parts = [AidingData.empty(), *parts]
        datum = next((part.datum for part in parts if part.datum is not None), None)
        names = [name for name in AidingData.__slots__ if name != "datum"]
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return AidingData(**joined, datum=datum)

    def within(self, after_ns: int | None, until_ns: int | None) -> AidingData:
        """What is later than one time, and not later than another; None for no limit."""

        def rows(stamps: IntArray) -> BoolArray:
            inside = np.ones(len(stamps), np.bool_)
            if after_ns is not None:
                inside &= stamps > after_ns
            if until_ns is not None:
                inside &= stamps <= until_ns
            return inside

        fixes, odometry = rows(self.fix_stamps_ns), rows(self.odometry_stamps_ns)
        poses = rows(self.pose_stamps_ns)
        return AidingData(
            self.fix_stamps_ns[fixes],
            self.fix_positions[fixes],
            self.fix_covariances[fixes],
            self.datum,
            self.odometry_stamps_ns[odometry],
            self.odometry_positions[odometry],
            self.odometry_quaternions[odometry],
            self.pose_stamps_ns[poses],
            self.pose_positions[poses],
            self.pose_quaternions[poses],
            self.pose_sigmas[poses],
        )

    def shifted(self, fixes_ns: int, poses_ns: int = 0) -> AidingData:
        """The same with fixes, and known poses, that are later by so much."""
        return replace(
            self,
            fix_stamps_ns=self.fix_stamps_ns + fixes_ns,
            pose_stamps_ns=self.pose_stamps_ns + poses_ns,
        )

    def odometry_covers_s(self, from_ns: int, to_ns: int) -> float:
        """How much of a time the odometry covers, s."""
        stamps_ns = self.within(from_ns - 1, to_ns).odometry_stamps_ns
        steps_s = np.diff(stamps_ns) * 1e-9
        return float(np.sum(steps_s[steps_s <= _MAX_ODOMETRY_GAP_S]))

    def odometry_between(self, from_ns: int, to_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """How the body moved by its odometry; None where that does not cover both times.

        Returns:
            Rotation vector (3,) and translation (3,) of from_T_to.
        """
        stamps, ends = self.odometry_stamps_ns, np.array([from_ns, to_ns])
        if len(stamps) < 2 or from_ns < stamps[0] or to_ns > stamps[-1]:
            return None
        first = np.searchsorted(stamps, from_ns, "right") - 1
        last = np.searchsorted(stamps, to_ns)
        if np.diff(stamps[first : last + 1]).max(initial=0) > _MAX_ODOMETRY_GAP_S * 1e9:
            return None
        near = slice(int(first), int(last) + 1)
        seconds, at = (stamps[near] - from_ns) * 1e-9, (ends - from_ns) * 1e-9
        turns = Slerp(seconds, Rotation.from_quat(self.odometry_quaternions[near]))(at)
        columns = self.odometry_positions[near].T
        places = np.stack([np.interp(at, seconds, column) for column in columns], axis=1)
        moved = turns[0].inv()
        return (moved * turns[1]).as_rotvec(), moved.apply(places[1] - places[0])
