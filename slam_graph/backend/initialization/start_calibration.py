# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Does the calibration fit? Time offset and mounting of the camera, checked in the first motion.

Rotations of the first camera are compared with the gyroscope (`gyro_alignment.py`) until the time
offset is known well enough to say that it fits, or that it does not. At rest nothing is seen, so
that this goes on after a start at rest.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig, CalibrationConfig
from slam_graph.backend.initialization.gyro_alignment import (
    MAX_OFFSET_S,
    GyroAlignment,
    Turns,
    align_gyroscope,
    turns_contradict,
)
from slam_graph.backend.initialization.visual_rotation import MIN_COMMON, visual_rotation
from slam_graph.sensors import FeatureFrame, ImuBuffer, ImuData, Rig

_BASELINE_NS = 400_000_000
"""Time between the two frames of a rotation; the longer, the larger the change of the rate."""
_SPACING_NS = 45_000_000
"""Smallest time between two frames that are used."""
_ENOUGH_COMMON = 40
"""A pair of frames with fewer features in common is replaced by one that is nearer in time."""
_WINDOW_NS = 5_000_000_000
"""Over this time bias and offset are taken to be constant."""
_RETRY_NS = 400_000_000
"""Time between two estimates."""
_RECENT_NS = 6_000_000_000
"""How long frames are kept to begin anew from."""
_SHORTEST_TREND_S = 0.02
"""The motion within a frame is a line fitted to the gyroscope over the readout, or over this."""
_MIN_TURNS = 15
"""Fewest rotations for an estimate."""
_CLEAR, _CLEAR_WAITING = 30.0, 15.0
"""Smallest margin of the minimum: the second best has a probability of exp(-30) of the best. Less
is enough as long as there is no state that could be lost."""
_MAX_MISFIT = 30.0
"""Rotations that fit worse, in units of their information, are of something else than offsets."""
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
    """Compares the first camera with the gyroscope until it is known whether its calibration fits.

    Attributes:
        done: whether there is nothing left to find out.
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
        self._frames: deque[FeatureFrame] = deque()
        self._turns: deque[tuple[int, int, FloatArray, FloatArray]] = deque()
        self._seen, self._tried_ns = 0, 0
        self.done = not config.initialization.check_calibration and self.mounted
        self.waiting_for = "rotation about two axes, to find how the camera is mounted"

    def forget(self) -> None:
        """Forget all frames: those that follow do not continue them."""
        self._frames.clear()
        self._turns.clear()
        self.recent.clear()

    def add(self, frame: FeatureFrame, imu: ImuBuffer, started: bool) -> FoundCalibration | None:
        """Take the next frame.

        Args:
            frame: its features.
            imu: samples so far.
            started: whether there is a state already.

        Returns:
            A calibration that the old one contradicts; None as long as there is none.
        """
        if self.done:
            self.forget()
            return None
        self.recent.append(frame)
        while frame.stamp_ns - self.recent[0].stamp_ns > _RECENT_NS:
            self.recent.popleft()
        if not self._frames or frame.stamp_ns - self._frames[-1].stamp_ns >= _SPACING_NS:
            self._add_turn(self._unrolled(frame, imu))
        if frame.stamp_ns - self._tried_ns < _RETRY_NS:
            return None
        found = self._estimate(imu)
        self._tried_ns = frame.stamp_ns
        self.done = self._seen > _GIVE_UP_TURNS and self.mounted and started
        clear = _CLEAR if started else _CLEAR_WAITING
        if found is None or found.margin < clear or found.misfit > _MAX_MISFIT:
            return None
        return self._judged(found, _ADOPTED_SIGMA_S if started else _WAITING_SIGMA_S)

    def _unrolled(self, frame: FeatureFrame, imu: ImuBuffer) -> FeatureFrame:
        """The frame with the first camera's bearings at the time of its middle row."""
        camera, seen = self._camera, frame.cameras[0]
        if camera.readout_s == 0.0 or not self.mounted or len(seen) == 0:
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

    def _add_turn(self, frame: FeatureFrame) -> None:
        """The rotation since the oldest frame with enough of the same features."""
        while self._frames and frame.stamp_ns - self._frames[0].stamp_ns > _BASELINE_NS:
            self._frames.popleft()
        while self._turns and frame.stamp_ns - self._turns[0][0] > _WINDOW_NS:
            self._turns.popleft()
        now, model = frame.cameras[0], (self._camera.camera, self._config.noise.pixel_sigma)
        for before in self._frames:
            common = len(np.intersect1d(before.cameras[0].ids, now.ids, assume_unique=True))
            if common < (_ENOUGH_COMMON if before is not self._frames[-1] else MIN_COMMON):
                continue
            turn = visual_rotation(before.cameras[0], now, *model, self._expected(frame, before))
            if turn is not None:
                row = (before.stamp_ns, frame.stamp_ns, turn.R, turn.information)
                self._turns.append(row)
                self._seen += 1
            break
        self._frames.append(frame)

    def _expected(self, frame: FeatureFrame, before: FeatureFrame) -> FloatArray | None:
        """The rotation between two frames if the camera turns on as in the last pair."""
        if not self._turns:
            return None
        first_ns, second_ns, R, _ = self._turns[-1]
        ratio = (frame.stamp_ns - before.stamp_ns) / (second_ns - first_ns)
        vector = Rotation.from_matrix(R).as_rotvec() * ratio
        return np.asarray(Rotation.from_rotvec(vector).as_matrix())

    def contradiction(self, imu: ImuBuffer) -> str | None:
        """What of mounting or units the rotations of the last seconds contradict, if anything."""
        covered = None if self.done else self._covered(imu)
        if covered is None or not self.mounted:
            return None
        R = self._camera.body_T_camera.rotation().matrix()
        return turns_contradict(*covered, R, self._camera.clock_offset_s)

    def _estimate(self, imu: ImuBuffer) -> GyroAlignment | None:
        """The alignment of the turns that the gyroscope covers; None if they are too few."""
        covered = self._covered(imu)
        if covered is None:
            return None
        R = self._camera.body_T_camera.rotation().matrix() if self.mounted else None
        return align_gyroscope(*covered, R, self._camera.clock_offset_s)

    def _covered(self, imu: ImuBuffer) -> tuple[Turns, ImuData] | None:
        """The turns that the gyroscope covers, and its samples; None if they are too few."""
        nominal_ns = round(self._camera.clock_offset_s * 1e9)
        around_ns = round(MAX_OFFSET_S * 1e9) + 10_000_000
        newest_ns = imu.newest_ns() - nominal_ns - around_ns
        rows = [t for t in self._turns if t[1] <= newest_ns]
        rows = [t for t in rows if imu.covers(t[0] + nominal_ns - around_ns)]
        if len(rows) < _MIN_TURNS:
            return None
        turns = Turns(
            np.array([t[0] for t in rows]),
            np.array([t[1] for t in rows]),
            np.array([t[2] for t in rows]),
            np.array([t[3] for t in rows]),
        )
        first_ns, last_ns = rows[0][0] + nominal_ns, int(turns.second_ns.max()) + nominal_ns
        return turns, imu.between(first_ns - around_ns, last_ns + around_ns)

    def _judged(self, found: GyroAlignment, largest_sigma_s: float) -> FoundCalibration | None:
        """The new calibration, if what was found is known and contradicts the old one."""
        calibration, sigma_s = self._config.calibration, found.offset_sigma_s
        difference_s = abs(found.offset_s - self._camera.clock_offset_s)
        if not self.mounted:
            known = sigma_s < largest_sigma_s and found.rotation_sigma_rad < _ROTATION_SIGMA_RAD
            return self._adopted(found) if known else None
        if difference_s < _FITS_SIGMAS * sigma_s and sigma_s < _FITS_SIGMA_S:
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
        variables = CalibrationConfig(**{**self._config.calibration.model_dump(), **changes})
        return FoundCalibration(replace(self._rig, cameras=tuple(cameras)), variables, message)
