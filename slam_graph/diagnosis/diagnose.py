# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a recording? All checks, from the plainest to those that need the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from slam_graph.datasets import RecordedSequence
from slam_graph.diagnosis.camera_and_gyroscope import compare
from slam_graph.diagnosis.finding import Finding, in_order
from slam_graph.diagnosis.frame_checks import check_images, check_stamps, check_tracks
from slam_graph.diagnosis.gathering import Material, Part, around, gather
from slam_graph.diagnosis.imu_checks import check_sampling, check_units
from slam_graph.diagnosis.motion_checks import check_motion
from slam_graph.diagnosis.stereo_geometry import check_stereo
from slam_graph.diagnosis.stereo_matching import StereoMatches
from slam_graph.sensors import FeatureFrame, ImuData, Rig

_FEWEST_SAMPLES, _FEWEST_FRAMES = 50, 10
"""Samples and frames that a comparison needs at least."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found about a recording.

    Attributes:
        findings: errors first, and among equals the plainest cause first.
    """

    findings: list[Finding]

    @staticmethod
    def of(recording: RecordedSequence) -> Diagnosis:
        """Look at all that can be judged without an estimate of the trajectory.

        The IMU is read as a whole, images or tracks in up to three parts of 8 s, those in which
        the platform turns most.

        Args:
            recording: images or tracks.
        """
        return Diagnosis(in_order(_judged(gather(recording))))

    @staticmethod
    def quick(recording: RecordedSequence) -> Diagnosis:
        """The part that needs no tracks: units, stamps, exposure and sharpness."""
        material = gather(recording, tracked=False)
        return Diagnosis(in_order(_plain(material)[0]))

    @staticmethod
    def of_tracks(rig: Rig, frames: Sequence[FeatureFrame], imu: ImuData) -> Diagnosis:
        """The same from features and samples in memory, such as those of a run that failed.

        Args:
            rig: the calibration that the run had.
            frames: features of frames that follow one another, of some 3 to 30 seconds.
            imu: samples over them, as they were recorded.
        """
        frames = [frame.usable(len(rig.cameras))[0] for frame in frames]
        material = Material(rig, imu, [])
        if frames:
            part = Part(frames, around(imu, frames[0].stamp_ns, frames[-1].stamp_ns))
            material.parts.append(part)
            if len(rig.cameras) > 1:
                step = max(1, len(frames) // 8)
                material.stereo = [StereoMatches.of_tracks(f) for f in frames[::step]]
        return Diagnosis(in_order(_judged(material)))

    @property
    def faults(self) -> list[Finding]:
        """The findings that are errors or warnings."""
        return [finding for finding in self.findings if finding.severity != "info"]

    @property
    def errors(self) -> list[Finding]:
        """The findings that make a result worthless."""
        return [finding for finding in self.findings if finding.severity == "error"]

    def best_guess(self) -> str:
        """The likeliest fault and what mends it, in one line; empty if none was found."""
        if not self.faults:
            return ""
        first = self.faults[0]
        return f"{first.what}; {first.fix}" if first.fix else first.what

    def as_dict(self) -> Mapping[str, object]:
        """As it is printed by `--json`."""
        return {
            "errors": len(self.errors),
            "warnings": len(self.faults) - len(self.errors),
            "findings": [asdict(finding) for finding in self.findings],
        }


def _plain(material: Material) -> tuple[list[Finding], float]:
    """What shows without tracks, and the factor that makes the forces m/s²."""
    found: list[Finding] = []
    factor = 1.0
    if material.rig.has_imu:
        found, factor = check_units(material.imu)
        found = found + check_sampling(material.imu, material.rig.imu, material.stamps_ns)
    found += check_stamps(material.stamps_ns)
    if material.images is not None:
        found += check_images(material.images)
    for kind, count in material.faults.items():
        found.append(Finding(f"reader_{kind}", "info", f"{kind}: {count} times in what was read"))
    return found, factor


def _judged(material: Material) -> list[Finding]:
    """All findings, the plainest causes first."""
    plain, factor = _plain(material)
    units = [f for f in plain if f.kind.startswith("accelerometer")]
    found = units + [f for f in plain if f not in units]
    counts = [len(f.cameras[0]) for part in material.parts for f in part.frames if f.cameras]
    found += check_tracks(counts)
    parts = [_in_si(part, factor) for part in material.parts]
    parts = [
        part
        for part in parts
        if len(part.imu) >= _FEWEST_SAMPLES and len(part.frames) > _FEWEST_FRAMES
    ]
    if not parts:
        return found + check_stereo(material.stereo, material.rig)
    now = compare(material.rig, parts)
    stereo = check_stereo(material.stereo, now.rig)
    found += now.findings + stereo
    if now.fit is not None:
        good = not any(finding.severity == "error" for finding in stereo)
        found += check_motion(now, now.fit, good and len(material.rig.cameras) > 1)
    return found


def _in_si(part: Part, factor: float) -> Part:
    """A part with forces in m/s², samples that are finite, and the frames that they cover."""
    imu = part.imu
    good = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
    imu = ImuData(imu.stamps_ns[good], imu.gyro[good], factor * imu.accel[good])
    if not len(imu):
        return Part([], imu)
    first_ns, last_ns = imu.stamps_ns[0], imu.stamps_ns[-1]
    return Part([f for f in part.frames if first_ns <= f.stamp_ns <= last_ns], imu)
