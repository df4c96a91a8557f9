# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a recording: findings about its IMU, frames, ground truth and calibration.

Of the IMU the rate is compared with the calibration, and noise and gravity in the calmest second,
if the platform was at rest then.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.datasets.sequence import Sequence
from slam_graph.datasets.streams.image_sequence import GroupedSequence
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import Trajectory
from slam_graph.sensors import CameraFrame, DepthSensor, FeatureFrame, ImuData, ImuNoise, Rig

_WINDOW_NS = 1_000_000_000
"""Length of the windows of which the calmest is used."""

_STILL_GYRO = 0.03
"""rad/s: largest standard deviation of the rates (any axis) of a window at rest."""

_STILL_ACCEL = 0.3
"""m/s²: the same for the specific force."""

GRAVITY = 9.81
_GRAVITY_TOLERANCE = 0.5
"""m/s²: biases are a few tenths; a larger difference is a sign of wrong units or scale."""

_RATE_TOLERANCE = 0.1
"""Largest relative difference of the measured rate from the calibrated one."""

_NOISE_RATIO = 30.0
"""Measured noise this many times the calibrated one gives a warning; the vibration of a hovering
multicopter makes a factor of ten."""

_Found = tuple[Literal["info", "warning", "error"], str]


@dataclass(frozen=True, slots=True)
class _Window:
    """Statistics of one second: standard deviations (largest axis), mean force, largest mean."""

    start_ns: int
    gyro_std: float
    accel_std: float
    gravity: float


@dataclass
class _ImuSurvey:
    """Collects statistics of a stream, in constant memory except for one number per second.

    Attributes:
        samples: so far.
        calmest: the window with the smallest standard deviations so far.
    """

    samples: int = 0
    calmest: _Window | None = None
    _pending: ImuData = field(default_factory=ImuData.empty)
    _periods: list[float] = field(default_factory=list)

    def add(self, data: ImuData) -> None:
        """Take the next samples."""
        self.samples += len(data)
        self._pending = ImuData.concatenate([self._pending, data])
        while len(self._pending) and self._spanned() >= _WINDOW_NS:
            end = self._pending.stamps_ns[0] + _WINDOW_NS
            cut = int(np.searchsorted(self._pending.stamps_ns, end))
            self._survey(self._pending[:cut])
            self._pending = self._pending[cut:]

    def findings(self, noise: ImuNoise) -> list[_Found]:
        """What was found, compared with the calibration."""
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

    def _rate(self, noise: ImuNoise) -> list[_Found]:
        if not self._periods:
            return [("warning", f"only {self.samples} IMU samples")]
        rate_hz = 1e9 / float(np.median(self._periods))
        found: list[_Found] = [("info", f"{self.samples} samples at {rate_hz:.1f} Hz")]
        if abs(rate_hz / noise.rate_hz - 1.0) > _RATE_TOLERANCE:
            what = f"measured at {rate_hz:.1f} Hz, the calibration says {noise.rate_hz:.1f} Hz"
            found.append(("warning", what))
        return found

    def _stillness(self, noise: ImuNoise) -> list[_Found]:
        calm = self.calmest
        if calm is None or calm.gyro_std > _STILL_GYRO or calm.accel_std > _STILL_ACCEL:
            return [("info", "never still for a second: gravity and noise are not checked")]
        found: list[_Found] = [
            ("info", f"still at {calm.start_ns}: specific force {calm.gravity:.3f} m/s²")
        ]
        if abs(calm.gravity - GRAVITY) > _GRAVITY_TOLERANCE:
            what = (
                f"specific force {calm.gravity:.2f} m/s² at rest, expected {GRAVITY}; wrong unit?"
            )
            found.append(("error", what))
        root = np.sqrt(noise.rate_hz)
        for name, std, density in (
            ("gyroscope", calm.gyro_std, noise.gyro_noise_density),
            ("accelerometer", calm.accel_std, noise.accel_noise_density),
        ):
            found.append(
                ("info", f"{name} noise at rest {std / root:.2g}, calibrated {density:.2g}")
            )
            if std / root > _NOISE_RATIO * density:
                what = (
                    f"{name} noise at rest is {std / root / density:.0f} times the calibrated one"
                )
                found.append(("warning", what))
        return found


def _scatter(window: _Window) -> float:
    return window.gyro_std / _STILL_GYRO + window.accel_std / _STILL_ACCEL


Severity = Literal["info", "warning", "error"]

_LONG_PAUSE_PERIODS = 3.0
"""A pause between frames longer than this many median periods gives a warning."""

_MOST_FRAMES = 0.9
"""A smaller share of frames with a depth image gives a warning."""

_FEW_DEPTHS = 0.1
"""A smaller share of pixels with a depth gives a warning: wrong unit, or out of range."""

_FARTHEST_CAMERA_M = 5.0
"""A camera farther from the IMU than this is probably a mistake of units."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was found.

    Attributes:
        severity: ``info`` for a fact, ``warning`` for a fault that a run survives, ``error`` for
            one that makes its result worthless.
        what: the finding, in one line.
        where: file, sensor or time.
    """

    severity: Severity
    what: str
    where: str


@dataclass
class _Collector(Diagnostics):
    """Keeps the first message of each kind instead of logging it."""

    messages: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__init__()

    def warn(self, kind: str, message: str) -> None:
        self.counts[kind] += 1
        self.messages.setdefault(kind, message)


def check_sequence(sequence: Sequence, read_images: bool = False) -> list[Finding]:
    """Read a whole recording once and report what is remarkable.

    Args:
        sequence: any recording.
        read_images: decode every image; otherwise only check that the files exist.

    Returns:
        The findings, errors first.
    """
    if isinstance(sequence, GroupedSequence) and not read_images:
        sequence = sequence.without_images()
    opened = dict(sequence.diagnostics.counts)
    with _collecting(sequence) as faults:
        survey, depths, stamps = _go_through(sequence)
        truth = sequence.groundtruth()
    name = sequence.info().name
    findings = [
        Finding("warning", f"{kind}: {count} times, first: {faults.messages[kind]}", name)
        for kind, count in faults.counts.items()
    ]
    findings += [
        Finding("warning", f"{kind}: {count} times, counted before the check", name)
        for kind, count in opened.items()
    ]
    if sequence.rig.has_imu:
        findings += [Finding(*found, "imu") for found in survey.findings(sequence.rig.imu)]
    else:
        findings.append(Finding("info", "no IMU", "imu"))
    findings += depths.findings(sequence)
    findings += _check_frames(stamps, name)
    offset_ns = round(sequence.rig.pose_offset_s * 1e9)
    findings += _check_groundtruth(truth, stamps, offset_ns)
    findings += _check_calibration(sequence.rig)
    order: tuple[Severity, ...] = ("error", "warning", "info")
    return sorted(findings, key=lambda found: order.index(found.severity))


@contextmanager
def _collecting(sequence: Sequence) -> Iterator[_Collector]:
    """Let a sequence report its faults to a collector inside the block."""
    previous, collector = sequence.diagnostics, _Collector()
    sequence.diagnostics = collector
    try:
        yield collector
    finally:
        sequence.diagnostics = previous


@dataclass
class _DepthSurvey:
    """What the frames of a recording have of depth: shares of pixels or features with one."""

    shares: list[float] = field(default_factory=list)
    medians_m: list[float] = field(default_factory=list)

    def add(self, frame: CameraFrame | FeatureFrame, sensor: DepthSensor | None) -> None:
        """Take the next frame."""
        if sensor is None:
            return
        if isinstance(frame, CameraFrame):
            depth: NDArray[Any] | None = frame.depth
        else:
            depth = frame.cameras[sensor.camera].depth_m
        if depth is None or depth.size == 0:
            return
        valid = np.isfinite(depth)
        self.shares.append(float(np.mean(valid)))
        if valid.any():
            self.medians_m.append(float(np.median(depth[valid])))

    def findings(self, sequence: Sequence) -> list[Finding]:
        """What was found."""
        info = sequence.info()
        if sequence.rig.depth is None:
            return []
        found = []
        if info.content == "images":
            share = info.depth_frames / max(info.frames, 1)
            severity: Severity = "info" if share > _MOST_FRAMES else "warning"
            what = f"{info.depth_frames} of {info.frames} frames have a depth image"
            found.append(Finding(severity, what, "depth"))
        if self.shares:
            mean = float(np.mean(self.shares))
            what = f"{mean:.0%} of the {'pixels' if info.content == 'images' else 'features'}"
            median = f"{np.median(self.medians_m):.2f} m" if self.medians_m else "no depth at all"
            severity = "info" if mean > _FEW_DEPTHS else "warning"
            found.append(Finding(severity, f"{what} have a depth, the median is {median}", "depth"))
        return found


def _go_through(sequence: Sequence) -> tuple[_ImuSurvey, _DepthSurvey, IntArray]:
    """Statistics of the IMU and of depths, and the times (N,) of the frames."""
    survey, depths = _ImuSurvey(), _DepthSurvey()
    stamps: list[int] = []
    for packet in sequence.packets():
        stamps.append(packet.frame.stamp_ns)
        survey.add(packet.imu)
        depths.add(packet.frame, sequence.rig.depth)
    if not stamps and isinstance(sequence, GroupedSequence):
        for block in sequence.imu_blocks():
            survey.add(block)
    return survey, depths, np.array(stamps, np.int64)


def _check_frames(stamps: IntArray, name: str) -> list[Finding]:
    if len(stamps) < 2:
        return [Finding("warning", f"{len(stamps)} frames: nothing to run on", name)]
    steps = np.diff(stamps)
    if np.any(steps <= 0):
        return [Finding("error", "frames do not follow one another in time", name)]
    period = float(np.median(steps))
    duration = (stamps[-1] - stamps[0]) * 1e-9
    findings = [
        Finding("info", f"{len(stamps)} frames in {duration:.1f} s, {1e9 / period:.1f} Hz", name)
    ]
    pauses = np.flatnonzero(steps > _LONG_PAUSE_PERIODS * period)
    if len(pauses):
        longest = pauses[np.argmax(steps[pauses])]
        what = f"{len(pauses)} pauses between frames, the longest {steps[longest] * 1e-9:.2f} s"
        findings.append(Finding("warning", what, f"after the frame at {stamps[longest]}"))
    return findings


def _check_groundtruth(truth: Trajectory | None, stamps: IntArray, offset_ns: int) -> list[Finding]:
    """Whether a truth covers the frames, whose times on its clock are later by an offset."""
    stamps = stamps + offset_ns
    if truth is None:
        return [Finding("info", "no ground truth", "ground truth")]
    first, last = int(truth.stamps_ns[0]), int(truth.stamps_ns[-1])
    if len(stamps) == 0:
        return [Finding("info", f"{(last - first) * 1e-9:.1f} s of poses", "ground truth")]
    covered = float(np.mean((stamps >= first) & (stamps <= last)))
    if covered == 0.0:
        what = f"covers no frame: it spans {first} to {last}, frames {stamps[0]} to {stamps[-1]}"
        return [Finding("error", what, "ground truth")]
    severity: Severity = "info" if covered > 0.95 else "warning"
    return [Finding(severity, f"covers {100 * covered:.1f} % of the frames", "ground truth")]


def _check_calibration(rig: Rig) -> list[Finding]:
    findings = []
    for index, mounted in enumerate(rig.cameras):
        camera, name = mounted.camera, mounted.name or f"camera {index}"
        if not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height):
            what = (
                f"principal point ({camera.cx:.1f}, {camera.cy:.1f}) lies outside the image "
                f"({camera.width}x{camera.height})"
            )
            findings.append(Finding("error", what, name))
        if not 0.1 < camera.fx / camera.fy < 10:
            what = f"focal lengths {camera.fx:.1f} and {camera.fy:.1f} do not go together"
            findings.append(Finding("error", what, name))
        distance = float(np.linalg.norm(mounted.body_T_camera.translation()))
        if distance > _FARTHEST_CAMERA_M:
            findings.append(
                Finding("warning", f"{distance:.1f} m from the IMU; is it in metres?", name)
            )
    if not rig.has_imu:
        return findings
    noise = rig.imu
    values = (
        noise.gyro_noise_density,
        noise.gyro_random_walk,
        noise.accel_noise_density,
        noise.accel_random_walk,
    )
    if min(values) <= 0:
        findings.append(Finding("error", "a noise density is not positive", "imu calibration"))
    return findings
