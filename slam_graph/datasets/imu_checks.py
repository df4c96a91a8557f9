# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What an IMU stream tells about itself: its rate, and its noise and gravity while it is still."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from slam_graph.sensors.measurements import ImuData
from slam_graph.sensors.rig import ImuNoise

WINDOW_NS = 1_000_000_000
"""Length of the windows among which the calmest is looked for."""

STILL_GYRO = 0.03
"""rad/s: a window whose rates scatter more than this (largest axis, 1σ) is not still."""

STILL_ACCEL = 0.3
"""m/s²: the same for the specific force."""

GRAVITY = 9.81
GRAVITY_TOLERANCE = 0.5
"""m/s²: biases are a few tenths; more hints at wrong units or scale."""

RATE_TOLERANCE = 0.1
"""Largest relative difference of the measured rate from the calibrated one."""

NOISE_RATIO = 30.0
"""Measured noise this many times above the calibrated one deserves a warning; the vibration of a
hovering multicopter makes a factor of ten."""

Found = tuple[Literal["info", "warning", "error"], str]


@dataclass(frozen=True, slots=True)
class _Window:
    """Statistics of one second: standard deviations (largest axis), mean force, largest mean."""

    start_ns: int
    gyro_std: float
    accel_std: float
    gravity: float


@dataclass
class ImuSurvey:
    """Collects statistics over a stream, in constant memory but for one number a second.

    Attributes:
        samples: so far.
        calmest: the window with the least scatter so far.
    """

    samples: int = 0
    calmest: _Window | None = None
    _pending: ImuData = field(default_factory=ImuData.empty)
    _periods: list[float] = field(default_factory=list)

    def add(self, data: ImuData) -> None:
        """Take the next samples."""
        self.samples += len(data)
        self._pending = ImuData.concatenate([self._pending, data])
        while len(self._pending) and self._spanned() >= WINDOW_NS:
            end = self._pending.stamps_ns[0] + WINDOW_NS
            cut = int(np.searchsorted(self._pending.stamps_ns, end))
            self._survey(self._pending[:cut])
            self._pending = self._pending[cut:]

    def findings(self, noise: ImuNoise) -> list[Found]:
        """What the stream tells, compared with the calibration."""
        if self.samples == 0:
            return [("error", "no IMU samples")]
        if not self._periods:
            self._survey(self._pending)
        return [*self._rate(noise), *self._stillness(noise)]

    def _spanned(self) -> int:
        return int(self._pending.stamps_ns[-1] - self._pending.stamps_ns[0])

    def _survey(self, data: ImuData) -> None:
        if len(data) < 3:
            return
        self._periods.append(float(np.median(np.diff(data.stamps_ns))))
        window = _Window(
            int(data.stamps_ns[0]),
            float(np.max(np.std(data.gyro, axis=0))),
            float(np.max(np.std(data.accel, axis=0))),
            float(np.linalg.norm(np.mean(data.accel, axis=0))),
        )
        if self.calmest is None or _scatter(window) < _scatter(self.calmest):
            self.calmest = window

    def _rate(self, noise: ImuNoise) -> list[Found]:
        if not self._periods:
            return [("warning", f"only {self.samples} IMU samples")]
        rate_hz = 1e9 / float(np.median(self._periods))
        found: list[Found] = [("info", f"{self.samples} samples at {rate_hz:.1f} Hz")]
        if abs(rate_hz / noise.rate_hz - 1.0) > RATE_TOLERANCE:
            what = f"measured at {rate_hz:.1f} Hz, the calibration says {noise.rate_hz:.1f} Hz"
            found.append(("warning", what))
        return found

    def _stillness(self, noise: ImuNoise) -> list[Found]:
        calm = self.calmest
        if calm is None or calm.gyro_std > STILL_GYRO or calm.accel_std > STILL_ACCEL:
            return [("info", "never still for a second: gravity and noise are not checked")]
        found: list[Found] = [
            ("info", f"still at {calm.start_ns}: specific force {calm.gravity:.3f} m/s²")
        ]
        if abs(calm.gravity - GRAVITY) > GRAVITY_TOLERANCE:
            what = f"specific force {calm.gravity:.2f} m/s² at rest instead of {GRAVITY}; m/s²?"
            found.append(("error", what))
        root = np.sqrt(noise.rate_hz)
        for name, std, density in (
            ("gyroscope", calm.gyro_std, noise.gyro_noise_density),
            ("accelerometer", calm.accel_std, noise.accel_noise_density),
        ):
            found.append(
                ("info", f"{name} noise at rest {std / root:.2g}, calibrated {density:.2g}")
            )
            if std / root > NOISE_RATIO * density:
                what = (
                    f"{name} noise at rest is {std / root / density:.0f} times the calibrated one"
                )
                found.append(("warning", what))
        return found


def _scatter(window: _Window) -> float:
    return window.gyro_std / STILL_GYRO + window.accel_std / STILL_ACCEL
