# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Does the calibration fit? Time offset and mounting of the camera, checked in the first motion.

Rotations of the first camera are compared with the gyroscope (`gyro_alignment.py`) until the time
offset is known well enough to say that it fits, or that it does not. At rest nothing is seen, so
that this goes on after a start at rest. From then on a few rotations a second tell whether the
clock changes (`clock_monitor.py`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice

import gtsam
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.backend_config import BackendConfig, CalibrationConfig
from slam_graph.backend.initialization.clock_change import ClockChange
from slam_graph.backend.initialization.clock_monitor import ClockMonitor
from slam_graph.backend.initialization.epipolar_alignment import align_by_epipolar_errors
from slam_graph.backend.initialization.gyro_alignment import (
    CLEAR,
    GyroAlignment,
    align_gyroscope,
    turns_contradict,
)
from slam_graph.backend.initialization.visual_turns import VisualTurns
from slam_graph.sensors import FeatureFrame, ImuBuffer, Rig

_SPACING_NS, _LATER_SPACING_NS = 45_000_000, 360_000_000
"""Smallest time between two frames that are used, at the start and later."""
_LATER_TURNS = 10
"""Fewest rotations for a test of the clock later."""
_REFINED_NS, _SELDOM_NS = 1_300_000_000, 4_000_000_000
"""Time between two estimates by epipolar errors, which take longer, and that after one which is so
near to the calibration that it would hardly be corrected: the next one has other frames then."""
_NEAR_S, _SETTLED_S, _NEAR_SIGMAS = 16e-3, 8e-3, 2.5
"""An estimate is near if it is within the first of the calibration, its standard deviation counted
so many times. Within the second no other by epipolar errors could correct the calibration: they
are seldom known to 1 ms, and `_ADOPTED_SIGMAS` of that are needed."""
_RESTS_RAD_S = 0.05
"""The platform turns too little for an estimate by epipolar errors where the standard deviation of
the angular rate is below this."""
_RETRY_NS, _LATER_RETRY_NS = 400_000_000, 900_000_000
"""Time between two estimates at the start, and later: between those after one that is near to the
calibration, and between two tests of the clock."""
_LATER_PAUSE_NS, _LONGEST_PAUSE_NS = 5_000_000_000, 60_000_000_000
"""Time after an estimate that shows nothing, and after many of them: each takes 0.1 s."""
_WAIT_NS = 5_000_000_000
"""A start waits so long for an offset that was right before to fit again; then it takes the new."""
_RECENT_NS, _OPEN_NS = 6_000_000_000, 20_000_000_000
"""How long frames are kept to begin anew from, and how long while the calibration is open. What was
estimated before the first of them is lost then."""
_CLEAR_WAITING = 15.0
"""Smallest margin of a minimum as long as there is no state that could be lost."""
_ADOPTED_SIGMAS, _ADOPTED_S = 8.0, 4e-3
"""An offset is adopted if it differs by more standard deviations, and by more. One of some hundred
starts with a right clock came to 6.6."""
_ADOPTED_SIGMA_S, _WAITING_SIGMA_S = 4e-3, 1e-2
"""It must be known to this; and as long as there is no state, to this."""
_FITS_SIGMAS, _FITS_SIGMA_S = 3.0, 1e-3
"""A calibrated offset fits if it is within so many standard deviations, of at most this."""
_PRIOR_SIGMAS = 3.0
"""An offset that is a variable anyway is only corrected beyond so many of its prior's σ."""
_GIVE_UP_TURNS = 1200
"""After so many rotations (60 s) without a decision the calibration is left as it is."""
_ROTATION_SIGMA_RAD = np.deg2rad(1.5)
"""How well an unknown mounting must be known for a start."""
_MIN_SIGMA_S, _MIN_ROTATION_RAD = 1e-3, np.deg2rad(0.5)
"""Standard deviations with which the variables begin are at least these."""
_POSITION_SIGMA_M = 0.05
"""That of the position of a camera with unknown mounting, each axis."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundCalibration:
    """What the first motion says of the rig.

    Attributes:
        rig: with the time offset, and the rotation of the cameras where it was unknown.
        variables: which parameters go on as variables, and how well they are known.
        message: what was found and what the calibration said.
    """

    rig: Rig
    variables: CalibrationConfig
    message: str


class StartCalibration:
    """Compares the first camera with the gyroscope: does its calibration fit, and does it stay so?

    Attributes:
        done: whether it is known if the calibration fits.
        mounted: whether the rotation of the cameras on the body is known, by calibration or now.
        recent: frames of the last seconds, from which one can begin anew.
        waiting_for: what an estimate still needs.
    """

    def __init__(self, rig: Rig, config: BackendConfig) -> None:
        """Begin with no frames."""
        self._rig, self._config = rig, config
        self._camera = rig.cameras[0]
        self.mounted = self._camera.rotation_known
        self.recent: deque[FeatureFrame] = deque()
        self._static: deque[FeatureFrame] = deque()  # the same without what is known to move
        self._turns = VisualTurns(self._camera, config.noise.pixel_sigma)
        self._pause_ns = _LATER_PAUSE_NS
        self._next_ns: int | None = None  # of the next comparison; None: at once
        self._refined_ns: int | None = None  # of the last estimate by epipolar errors
        self._last: GyroAlignment | None = None  # this estimate, if it has found anything
        self._doubted_ns: int | None = None  # since when the clock seems to have changed
        self._checks = config.initialization.check_calibration
        self._monitor = ClockMonitor(self._camera) if self.mounted else None
        self.done = not self._checks and self.mounted
        self.waiting_for = "rotation about two axes, to find how the camera is mounted"

    def forget(self) -> None:
        """Forget all frames: those that follow do not continue them."""
        self._turns.forget()
        self.recent.clear()
        self._static.clear()
        self._doubted_ns = self._next_ns = self._refined_ns = self._last = None

    def needed_since_ns(self, stamp_ns: int) -> int:
        """The earlier one of a time and the first frame to begin anew from, on the IMU's clock."""
        offset_ns = round(self._camera.clock_offset_s * 1e9)
        return min([stamp_ns, *(f.stamp_ns + offset_ns for f in islice(self.recent, 1))])

    def add(
        self, frame: FeatureFrame, imu: ImuBuffer, started: bool, dynamic: IntArray
    ) -> FoundCalibration | ClockChange | None:
        """Take the next frame.

        Args:
            frame: its features.
            imu: samples so far.
            started: whether there is a state already.
            dynamic: ids (D,) of the features that are known so far to move by themselves, which are
                left out.

        Returns:
            A calibration that the old one contradicts, or a change of the clock since then; None as
            long as there is none.
        """
        if self.done and not self._checks:
            return None
        self.recent.append(frame)
        frame = frame.without(dynamic)
        self._static.append(frame)
        _keep(self.recent, _RECENT_NS if self.done else _OPEN_NS)
        _keep(self._static, _RECENT_NS)
        monitor = self._monitor if started else None
        if self.done:
            return self._watch(frame, imu, monitor)
        self._turns.add(frame, imu, self.mounted, _SPACING_NS)
        if self._waits(frame):
            return None
        near = started and self.mounted and self._is_within(_NEAR_S)
        self._next_ns = frame.stamp_ns + (_LATER_RETRY_NS if near else _RETRY_NS)
        covered = self._turns.covered(imu)
        self.done = self._turns.seen > _GIVE_UP_TURNS and self.mounted and started
        if covered is None:
            return None
        R = self._camera.body_T_camera.rotation().matrix() if self.mounted else None
        found = align_gyroscope(*covered, R, self._camera.clock_offset_s)
        margin = CLEAR if started else _CLEAR_WAITING
        if found is None or not (found.is_clear(margin) and self._fits(found)):
            found = self._refined(found, margin, frame, imu, started)
        if found is None or not found.is_clear(margin):
            return None
        change = None if monitor is None else monitor.compare(found, covered, imu)
        if change is not None:
            return change
        if self._monitor is not None and self._monitor.confirms_calibration(found):
            # the clock has changed since, which is said once there is a state
            if self._doubted_ns is None:
                self._doubted_ns = frame.stamp_ns
            if started or frame.stamp_ns - self._doubted_ns < _WAIT_NS:
                return None
        return self._judged(found, _ADOPTED_SIGMA_S if started else _WAITING_SIGMA_S)

    def _refined(
        self,
        coarse: GyroAlignment | None,
        margin: float,
        frame: FeatureFrame,
        imu: ImuBuffer,
        started: bool,
    ) -> GyroAlignment | None:
        """The more certain of two estimates: by rotations of two views, and by epipolar errors.

        Args:
            coarse: the former, if there is one.
            margin: with which a minimum is clear.
            frame: the newest one.
            imu: samples so far.
            started: whether there is a state already.

        Returns:
            None where there is none that is new.
        """
        recent = imu.data.stamps_ns > imu.newest_ns() - _RECENT_NS
        if np.linalg.norm(np.std(imu.data.gyro[recent], axis=0)) < _RESTS_RAD_S:
            return coarse
        clear = coarse if coarse is not None and coarse.is_clear(margin) else None
        if self._refines_later(frame, clear, started):
            if clear is None or self._last is None:  # the last estimate has found nothing
                return None
            return clear if _uncertainty(clear) < _uncertainty(self._last) else None
        self._refined_ns = frame.stamp_ns
        seen = self._static, self._camera, self._config.noise.pixel_sigma
        last, near_s = self._last, None
        if last is not None and self._is_within(_NEAR_S):
            near_s = last.offset_s  # to confirm the calibration; all offsets are tried else
        found = align_by_epipolar_errors(*seen, imu, coarse, self.mounted, near_s)
        self._last = found
        if found is None or clear is None:
            return found
        return min(found, clear, key=_uncertainty)

    def _refines_later(
        self, frame: FeatureFrame, clear: GyroAlignment | None, started: bool
    ) -> bool:
        """Whether the next estimate by epipolar errors is later than a frame.

        Without a state they are not rare, as a wrong calibration may be what the start waits for.
        """
        if self._refined_ns is None:
            return False
        pause_ns = _REFINED_NS
        agrees = clear is None or self._distance_s(clear, -_FITS_SIGMAS) < 0.0
        agrees |= clear is not None and self._distance_s(clear, 0.0) < _ADOPTED_S
        if self.mounted and started and agrees:
            if self._is_within(_SETTLED_S):
                return True
            pause_ns = _SELDOM_NS if self._is_within(_NEAR_S) else pause_ns
        return frame.stamp_ns < self._refined_ns + pause_ns

    def _is_within(self, distance_s: float) -> bool:
        """Whether the last estimate by epipolar errors is so near to the calibration."""
        last = self._last
        if last is None or not last.is_clear():
            return False
        return self._distance_s(last, _NEAR_SIGMAS) < distance_s

    def _distance_s(self, found: GyroAlignment, sigmas: float) -> float:
        """How far the calibrated offset is from an estimate and some of its deviations."""
        return abs(found.offset_s - self._camera.clock_offset_s) + sigmas * found.offset_sigma_s

    def _fits(self, found: GyroAlignment) -> bool:
        """Whether the calibrated offset is known to fit."""
        sigma_s, difference_s = found.offset_sigma_s, self._distance_s(found, 0.0)
        return self.mounted and difference_s < _FITS_SIGMAS * sigma_s and sigma_s < _FITS_SIGMA_S

    def _waits(self, frame: FeatureFrame) -> bool:
        """Whether the next comparison is later than a frame."""
        return self._next_ns is not None and frame.stamp_ns < self._next_ns

    def _watch(
        self, frame: FeatureFrame, imu: ImuBuffer, monitor: ClockMonitor | None
    ) -> ClockChange | None:
        """A change of the clock since the start; few rotations tell whether to estimate it."""
        self._turns.add(frame, imu, self.mounted, _LATER_SPACING_NS, keep_last=True)
        if monitor is None or self._waits(frame):
            return None
        self._next_ns = frame.stamp_ns + _LATER_RETRY_NS
        covered = self._turns.covered(imu, _LATER_TURNS)
        if covered is None:
            return None
        if not monitor.needs_estimate(*covered):
            self._pause_ns = _LATER_PAUSE_NS
            return None
        change = self.clock_change(imu)
        if change is not None or not monitor.contradicted:
            self._next_ns = frame.stamp_ns + self._pause_ns
            if monitor.knows:  # otherwise it is still to be found
                self._pause_ns = min(2 * self._pause_ns, _LONGEST_PAUSE_NS)
        return change

    def clock_change(self, imu: ImuBuffer) -> ClockChange | None:
        """A change of the clock in the last seconds, by all frames that are kept.

        Args:
            imu: samples so far.
        """
        if self._monitor is None or not self._checks:
            return None
        turns = VisualTurns(self._camera, self._config.noise.pixel_sigma)
        for frame in self._static:
            turns.add(frame, imu, self.mounted, _SPACING_NS)
        covered = turns.covered(imu)
        return None if covered is None else self._monitor.estimate(covered, imu)

    def contradiction(self, imu: ImuBuffer) -> str | None:
        """What of mounting or units the rotations of the last seconds contradict, if anything."""
        covered = None if self.done else self._turns.covered(imu)
        if covered is None or not self.mounted:
            return None
        R = self._camera.body_T_camera.rotation().matrix()
        return turns_contradict(*covered, R, self._camera.clock_offset_s)

    def _judged(self, found: GyroAlignment, largest_sigma_s: float) -> FoundCalibration | None:
        """The new calibration, if what was found is known and contradicts the old one."""
        calibration, sigma_s = self._config.calibration, found.offset_sigma_s
        difference_s = abs(found.offset_s - self._camera.clock_offset_s)
        if not self.mounted:
            known = sigma_s < largest_sigma_s and found.rotation_sigma_rad < _ROTATION_SIGMA_RAD
            return self._adopted(found) if known else None
        if self._fits(found):
            self.done = True
            return None
        least_s = _ADOPTED_S
        if calibration.time_offset:
            least_s = max(least_s, _PRIOR_SIGMAS * calibration.time_offset_sigma_s)
        if sigma_s > largest_sigma_s or difference_s < max(_ADOPTED_SIGMAS * sigma_s, least_s):
            return None
        return self._adopted(found)

    def _adopted(self, found: GyroAlignment) -> FoundCalibration:
        """The rig and settings that go on with what was found."""
        self.done = True
        before = self._camera
        change_s = found.offset_s - before.clock_offset_s
        turn = gtsam.Rot3(found.body_R_camera @ before.body_T_camera.rotation().matrix().T)
        cameras = []
        for mounted in self._rig.cameras:
            pose = mounted.body_T_camera
            if not self.mounted:  # all cameras turn with the first
                pose = gtsam.Pose3(turn, np.zeros(3)).compose(pose)
            offset_s = mounted.time_offset_s + change_s
            cameras.append(
                replace(mounted, body_T_camera=pose, time_offset_s=offset_s, rotation_known=True)
            )
        sigma_s = max(found.offset_sigma_s, _MIN_SIGMA_S)
        if self._config.calibration.readout:  # what was found is the time of the middle row
            sigma_s = float(np.hypot(sigma_s, 0.5 * self._config.calibration.readout_sigma_s))
        changes: dict[str, bool | float] = {"time_offset": True, "time_offset_sigma_s": sigma_s}
        message = (
            f"camera-IMU time offset of {1e3 * (before.time_offset_s + change_s):.1f} ± "
            f"{1e3 * found.offset_sigma_s:.1f} ms estimated; "
            f"the calibration says {1e3 * before.time_offset_s:.1f} ms"
        )
        if not self.mounted:
            sigma = max(found.rotation_sigma_rad, _MIN_ROTATION_RAD)
            changes |= {
                "extrinsics": True,
                "rotation_sigma_rad": sigma,
                "position_sigma_m": _POSITION_SIGMA_M,
            }
            message = f"rotation of the camera estimated to {np.rad2deg(sigma):.1f}°; {message}"
            self.mounted = True
        self._camera = cameras[0]
        self._turns = VisualTurns(self._camera, self._config.noise.pixel_sigma)
        self._monitor = ClockMonitor(self._camera, (found.offset_s, found.offset_sigma_s))
        variables = CalibrationConfig(**{**self._config.calibration.model_dump(), **changes})
        return FoundCalibration(replace(self._rig, cameras=tuple(cameras)), variables, message)


def _uncertainty(found: GyroAlignment) -> tuple[float, float]:
    return found.rotation_sigma_rad, found.offset_sigma_s


def _keep(frames: deque[FeatureFrame], last_ns: int) -> None:
    """Forget all frames but the last ones."""
    while frames[-1].stamp_ns - frames[0].stamp_ns > last_ns:
        frames.popleft()
