# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Is a recording fit to run on? Findings about its IMU, frames, ground truth and calibration."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slam_graph.datasets.base import Sequence
from slam_graph.datasets.image_sequence import GroupedSequence
from slam_graph.datasets.imu_checks import ImuSurvey
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.sensors.rig import Rig

Severity = Literal["info", "warning", "error"]

LONG_PAUSE_PERIODS = 3.0
"""A pause between frames longer than this many median periods is worth a word."""

FARTHEST_CAMERA_M = 5.0
"""A camera farther from the IMU than this is more likely a mistake of units than a platform."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was found.

    Attributes:
        severity: ``info`` for a fact, ``warning`` for what a run survives, ``error`` for what makes
            its result worthless.
        what: in one line.
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
    """Go through a whole recording once and tell what is remarkable.

    Args:
        sequence: any recording.
        read_images: decode every image; otherwise only their files are looked for.

    Returns:
        findings, the errors first.
    """
    if isinstance(sequence, GroupedSequence) and not read_images:
        sequence = sequence.without_images()
    opened = dict(sequence.diagnostics.counts)
    with _collecting(sequence) as faults:
        survey, stamps = _go_through(sequence)
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
    findings += [Finding(*found, "imu") for found in survey.findings(sequence.rig.imu)]
    findings += _check_frames(stamps, name)
    findings += _check_groundtruth(truth, stamps)
    findings += _check_calibration(sequence.rig)
    order: tuple[Severity, ...] = ("error", "warning", "info")
    return sorted(findings, key=lambda found: order.index(found.severity))


@contextmanager
def _collecting(sequence: Sequence) -> Iterator[_Collector]:
    """Have a sequence report its faults to a collector for a while."""
    usual, collector = sequence.diagnostics, _Collector()
    sequence.diagnostics = collector
    try:
        yield collector
    finally:
        sequence.diagnostics = usual


def _go_through(sequence: Sequence) -> tuple[ImuSurvey, NDArray[np.int64]]:
    """The IMU and the times of the frames; the IMU alone where there are no frames."""
    survey = ImuSurvey()
    stamps: list[int] = []
    for packet in sequence.packets():
        stamps.append(packet.frame.stamp_ns)
        survey.add(packet.imu)
    if not stamps and isinstance(sequence, GroupedSequence):
        for block in sequence.imu_blocks():
            survey.add(block)
    return survey, np.array(stamps, np.int64)


def _check_frames(stamps: NDArray[np.int64], name: str) -> list[Finding]:
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
    pauses = np.flatnonzero(steps > LONG_PAUSE_PERIODS * period)
    if len(pauses):
        longest = pauses[np.argmax(steps[pauses])]
        what = f"{len(pauses)} pauses between frames, the longest {steps[longest] * 1e-9:.2f} s"
        findings.append(Finding("warning", what, f"after the frame at {stamps[longest]}"))
    return findings


def _check_groundtruth(truth: Trajectory | None, stamps: NDArray[np.int64]) -> list[Finding]:
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
        if distance > FARTHEST_CAMERA_M:
            findings.append(Finding("warning", f"{distance:.1f} m from the IMU; metres?", name))
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
