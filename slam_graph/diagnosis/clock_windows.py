# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Does the time offset between camera and IMU change in the course of a recording?

It is estimated for one window of some seconds after another, together with the gyroscope bias;
mounting and focal length are held. Windows in which it differs belong to different clocks, whatever
the calibration says, and whatever an estimator has made of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.diagnosis.camera_and_gyroscope import CLEARLY, FEWEST_PAIRS
from slam_graph.diagnosis.finding import Finding
from slam_graph.diagnosis.fit_findings import BAD_OFFSET_S, SIGMAS
from slam_graph.diagnosis.frame_pairs import frame_pairs
from slam_graph.diagnosis.gathering import (
    PART_S,
    Part,
    around,
    finite,
    long_enough,
    uninterrupted,
)
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.diagnosis.kinematics import Kinematics
from slam_graph.diagnosis.rotation_fit import RotationFit, RotationProblem
from slam_graph.sensors import FeatureFrame, ImuData, Rig, RigCamera

_LEAST_RATE = 0.05
"""Standard deviation of the angular rate, rad/s, below which a window does not show an offset to
some milliseconds."""
_LEAST_SIGMA_S = 1e-3
"""No offset of a window is known better than this."""
_PRECISION = 0.1
"""Steps end where they are smaller than 3 ms and 5 mrad/s; where the offset differs they go on."""
_BIASES = ("bx", "by", "bz")


@dataclass(frozen=True, eq=False)
class ClockWindow:
    """What a window of a recording says of the clocks.

    Attributes:
        begin_ns, end_ns: times of its first and its last frame.
        offset_s: t_imu - t_camera, as in the calibration (`time_offset_s`).
        sigma_s: its standard deviation.
        bias: (3,) of the gyroscope, rad/s.
        noise_px: robust standard deviation of the epipolar distances.
        differs: whether most of its features also fit this offset better than that of the windows
            before, where the two are far apart. Those that differ themselves do not count: the
            offset may have changed within them.
    """

    begin_ns: int
    end_ns: int
    offset_s: float
    sigma_s: float
    bias: FloatArray
    noise_px: float
    differs: bool = False

    @property
    def middle_ns(self) -> int:
        """Time of its middle."""
        return (self.begin_ns + self.end_ns) // 2

    @staticmethod
    def of(
        rig: Rig,
        frames: Sequence[FeatureFrame],
        imu: ImuData,
        before: Sequence[ClockWindow] = (),
    ) -> ClockWindow | None:
        """Estimate the offset of a window; None where too little is seen to do so.

        Args:
            rig: the calibration; its first camera is looked at.
            frames: of the window.
            imu: samples over them.
            before: the windows before this one.
        """
        if not frames:
            return None
        begin_ns, end_ns = frames[0].stamp_ns, frames[-1].stamp_ns
        imu = around(finite(imu), begin_ns, end_ns)
        if len(imu) < 2 or float(np.max(np.std(imu.gyro, axis=0))) < _LEAST_RATE:
            return None
        parts = long_enough(uninterrupted(Part(list(frames), imu)))
        gyroscopes, camera = [Gyroscope(part.imu) for part in parts], rig.cameras[0]
        pairs = frame_pairs(parts, gyroscopes, camera, turns=False)
        if len(pairs) < FEWEST_PAIRS:
            return None
        known = _mean([window for window in before if not window.differs])
        R, offset_s = camera.body_T_camera.rotation().matrix(), camera.clock_offset_s
        bias = before[-1].bias if before else np.zeros(3)
        if known is not None:
            offset_s = known.offset_s + camera.middle_s
        start = Kinematics(offset_s, 1.0, camera.readout_s, R, bias)
        problem = RotationProblem(pairs, gyroscopes, camera)
        try:
            fit = problem.solve(start, ("offset", *_BIASES), _PRECISION)
            if known is None or abs(fit.values.offset_s - offset_s) < BAD_OFFSET_S:
                return ClockWindow._fitted(begin_ns, end_ns, fit, camera)
            fit = problem.solve(fit.values, ("offset", *_BIASES))
            held = problem.solve(start, _BIASES)
        except np.linalg.LinAlgError:
            return None
        differs = fit.noise_px * CLEARLY < held.noise_px
        return replace(ClockWindow._fitted(begin_ns, end_ns, fit, camera), differs=differs)

    @staticmethod
    def _fitted(begin_ns: int, end_ns: int, fit: RotationFit, camera: RigCamera) -> ClockWindow:
        """What a fit says of a window."""
        at, sigma_s = fit.values, max(float(fit.sigmas[0]), _LEAST_SIGMA_S)
        offset_s = at.offset_s - camera.middle_s
        return ClockWindow(begin_ns, end_ns, offset_s, sigma_s, at.bias, fit.noise_px)


class ClockWindows:
    """The windows of a recording, in their order.

    Attributes:
        LENGTH_NS: of a window.
    """

    LENGTH_NS: ClassVar[int] = round(PART_S * 1e9)

    def __init__(self) -> None:
        self._windows: list[ClockWindow] = []

    def __iter__(self) -> Iterator[ClockWindow]:
        return iter(self._windows)

    @staticmethod
    def of(rig: Rig, parts: Sequence[Part]) -> ClockWindows:
        """Windows of parts of a recording; the last one of a part may be half as long.

        Args:
            rig: the calibration.
            parts: with frames.
        """
        found = ClockWindows()
        length_ns = ClockWindows.LENGTH_NS
        for part in parts:
            stamps = np.array([frame.stamp_ns for frame in part.frames], np.int64)
            begin_ns = int(stamps[0])
            while 2 * (int(stamps[-1]) - begin_ns) >= length_ns:
                inside = (stamps >= begin_ns) & (stamps < begin_ns + length_ns)
                frames = [part.frames[k] for k in np.flatnonzero(inside)]
                found.add(rig, frames, part.imu)
                begin_ns += length_ns
        return found

    def add(self, rig: Rig, frames: Sequence[FeatureFrame], imu: ImuData) -> None:
        """Estimate the offset of the next window, if enough is seen to do so.

        Args:
            rig: the calibration; its first camera is looked at.
            frames: of the window.
            imu: samples over them.
        """
        window = ClockWindow.of(rig, frames, imu, self._windows)
        if window is not None:
            self._windows.append(window)

    def forget_after(self, stamp_ns: int) -> None:
        """Forget the windows that end after a time, as the estimate was lost then.

        Those that are added later are compared with the others only.
        """
        self._windows = [window for window in self._windows if window.end_ns <= stamp_ns]

    def change(self, first_ns: int) -> Finding | None:
        """The first change of the time offset that is beyond doubt.

        Args:
            first_ns: time of the first frame of the recording.
        """
        alike: list[ClockWindow] = []
        for window in self._windows:
            before = _mean(alike)
            if not window.differs:
                alike.append(window)
            elif before is not None and _are_apart(before, window):
                middles_ns = alike[-1].middle_ns, window.middle_ns
                between_s = [(at_ns - first_ns) * 1e-9 for at_ns in middles_ns]
                return _found(before, window, between_s)
        return None


def _found(before: ClockWindow, after: ClockWindow, between_s: list[float]) -> Finding:
    """The finding of a change.

    A window may have a part of the other offset, so the change is somewhere between the middle of
    the last window that is like those before and that of the first one that differs beyond doubt.
    """
    change_s, sigma_s = _difference(before, after)
    what = (
        f"the time offset between camera and IMU changes by {1e3 * change_s:.1f} ± "
        f"{1e3 * sigma_s:.1f} ms between t = {between_s[0]:.0f} and {between_s[1]:.0f} s, from "
        f"{1e3 * before.offset_s:.1f} to {1e3 * after.offset_s:.1f} ms"
    )
    fix = "look for late or jumping stamps of the IMU or the camera; run the parts apart"
    values = {
        "between_s": between_s,
        "change_s": change_s,
        "sigma_s": sigma_s,
        "before_s": before.offset_s,
        "after_s": after.offset_s,
    }
    sigmas = abs(change_s) / sigma_s
    return Finding.measured("time_offset_change", "error", what, fix, sigmas, values)


def _mean(windows: Sequence[ClockWindow]) -> ClockWindow | None:
    """One window for several, its offset the weighted mean; None for none."""
    if not windows:
        return None
    weights = np.array([window.sigma_s**-2 for window in windows])
    offset_s = float(np.average([window.offset_s for window in windows], weights=weights))
    sigma_s = max(float(weights.sum()) ** -0.5, _LEAST_SIGMA_S)
    first, last = windows[0], windows[-1]
    noise_px = max(window.noise_px for window in windows)
    return ClockWindow(first.begin_ns, last.end_ns, offset_s, sigma_s, last.bias, noise_px)


def _difference(before: ClockWindow, after: ClockWindow) -> tuple[float, float]:
    """How much later the clock of the IMU is, and the standard deviation of that, s."""
    return after.offset_s - before.offset_s, float(np.hypot(before.sigma_s, after.sigma_s))


def _are_apart(before: ClockWindow, after: ClockWindow) -> bool:
    """Whether the offsets differ by so much that it spoils a run, and beyond doubt.

    Where tracks are noisy, or the calibration is wrong, it takes more.
    """
    change_s, sigma_s = _difference(before, after)
    noisier = max(1.0, before.noise_px, after.noise_px) ** 2
    return abs(change_s) > max(BAD_OFFSET_S * noisier, SIGMAS * sigma_s)
