# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a recording? All checks, from the plainest to those that need the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from slam_graph.arrays import FloatArray
from slam_graph.datasets import RecordedSequence
from slam_graph.diagnosis.camera_and_gyroscope import compare, refine
from slam_graph.diagnosis.clock_windows import ClockWindows
from slam_graph.diagnosis.finding import CERTAIN_SIGMAS, Finding, in_order, no_surer
from slam_graph.diagnosis.fit_findings import CameraAndGyroscope
from slam_graph.diagnosis.frame_checks import check_images, check_stamps, check_tracks
from slam_graph.diagnosis.gathering import (
    Material,
    Part,
    around,
    finite,
    gather,
    long_enough,
    uninterrupted,
)
from slam_graph.diagnosis.imu_checks import check_sampling, check_units
from slam_graph.diagnosis.motion_checks import check_motion
from slam_graph.diagnosis.run_evidence import Evidence
from slam_graph.diagnosis.stereo_geometry import check_stereo, mended
from slam_graph.diagnosis.stereo_matching import StereoMatches, match_images
from slam_graph.geometry import StateHistory
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData, Rig

SETUP_KINDS = (
    "accelerometer_unit",
    "accelerometer_gravity",
    "accelerometer_constant",
    "accelerometer_sign",
    "accelerometer_axes",
    "gyroscope_constant",
    "gyroscope_unit",
    "gyroscope_scale",
    "gyroscope_axes",
    "mounting",
    "time_offset",
    "time_offset_change",
    "focal_length",
    "stereo_geometry",
    "baseline",
    "baseline_unit",
)
"""Findings about what a run was given: calibration, units and clocks."""
_SURE_WARNINGS = ("baseline", "stereo_geometry")
"""Those that count where they are warnings too; all others where they are errors."""
_ENOUGH_MATCHES = 300
"""Of images of two cameras, at two times at least: SIFT takes a quarter of a second an image."""
_AFTER_CHANGE = SETUP_KINDS[SETUP_KINDS.index("time_offset_change") :]
"""Findings that are less plain than a change of the time offset."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found about a recording.

    Attributes:
        findings: errors first, and among equals the plainest cause first.
    """

    findings: list[Finding]

    Clocks = ClockWindows

    @staticmethod
    def of(recording: RecordedSequence) -> Diagnosis:
        """Judge all that can be judged without an estimate of the trajectory.

        The IMU is read as a whole, images or tracks in up to three parts of 8 s, those in which
        the platform turns most.

        Args:
            recording: images or tracks.
        """
        material = gather(recording)
        found = _judged(material)
        if material.rig.has_imu and material.rig.cameras[0].rotation_known:
            windows = ClockWindows.of(material.rig, material.parts)
            clocks = Diagnosis.of_clocks(windows, recording.info().start_ns)
            return Diagnosis(found).with_clocks(clocks)
        return Diagnosis(in_order(found))

    @staticmethod
    def of_clocks(windows: ClockWindows, first_ns: int) -> Diagnosis:
        """The first change of the time offset that is beyond doubt, if there is one.

        Args:
            windows: of a recording.
            first_ns: time of its first frame.
        """
        change = windows.change(first_ns)
        return Diagnosis([] if change is None else [change])

    def with_clocks(self, clocks: Diagnosis) -> Diagnosis:
        """With a change of the time offset; one offset for the whole recording says less then.

        Args:
            clocks: of the same recording, see `of_clocks`.
        """
        if not clocks.findings:
            return Diagnosis(in_order(self.findings))
        found = [finding for finding in self.findings if finding.kind != "time_offset"]
        at = next((k for k, f in enumerate(found) if f.kind in _AFTER_CHANGE), len(found))
        return Diagnosis(in_order([*found[:at], *clocks.findings, *found[at:]]))

    @staticmethod
    def quick(recording: RecordedSequence) -> Diagnosis:
        """The part that needs no tracks: units, stamps, exposure and sharpness."""
        material = gather(recording, tracked=False)
        return Diagnosis(in_order(_plain(material)[0]))

    @staticmethod
    def of_tracks(
        rig: Rig,
        frames: Sequence[FeatureFrame],
        imu: ImuData,
        pairs: Sequence[CameraFrame] = (),
        lost: Sequence[tuple[int, int]] = (),
    ) -> Diagnosis:
        """The same from features and samples in memory, such as those of a run that failed.

        Args:
            rig: the calibration that the run had.
            frames: features of frames that follow one another, of some 3 to 30 seconds.
            imu: samples over them, as they were recorded.
            pairs: images of the first two cameras now and then, if there are any: features were
                matched under the calibration that is to be judged, and fail where it is far off.
            lost: times in which the estimate of a run was lost, from its last good state to where
                that was noticed, ns. The platform may have been put somewhere else meanwhile, so
                nothing is compared across them, if enough is left.
        """
        material = _remembered(rig, frames, imu, lost)
        material.stereo += _matched(pairs)
        return Diagnosis(in_order(_judged(material)))

    @staticmethod
    def nearby(
        rig: Rig,
        frames: Sequence[FeatureFrame],
        imu: ImuData,
        lost: Sequence[tuple[int, int]] = (),
    ) -> Diagnosis:
        """A quick diagnosis, in a tenth of the time, where the calibration is right or nearly so.

        Units and axes of gyroscope and accelerometer are those with which an estimate came to its
        end, so that nothing else is tried. Arguments are those of `of_tracks`.
        """
        material = _remembered(rig, frames, imu, lost)
        found, factor = check_units(imu)
        parts = _enough(material, factor)
        if not parts:
            return Diagnosis(found)
        now = refine(rig, parts)
        found += now.findings + check_stereo(material.stereo, now.rig)
        if now.fit is not None and not now.has_constant_sensor:
            found += check_motion(now, now.fit, len(rig.cameras) > 1, axes_known=True)
        return Diagnosis(in_order(found))

    @staticmethod
    def of_run(
        innovations: Mapping[str, FloatArray],
        noise_at_limit: float | None,
        causal: StateHistory,
        smoothed: StateHistory | None,
    ) -> Evidence:
        """How consistent a run is by itself, without its recording; see `Evidence.of`."""
        return Evidence.of(innovations, noise_at_limit, causal, smoothed)

    @property
    def faults(self) -> list[Finding]:
        """The findings that are errors or warnings."""
        return [finding for finding in self.findings if finding.severity != "info"]

    @property
    def errors(self) -> list[Finding]:
        """The findings that make a result worthless."""
        return [finding for finding in self.findings if finding.severity == "error"]

    @property
    def setup_faults(self) -> list[Finding]:
        """Errors of calibration, units and clocks, and warnings of the stereo geometry.

        Other warnings do not count: small turns of the camera and errors of the focal length are
        found in good flights too, and a clock that is off by milliseconds spoils nothing. Nor do
        hints, which a few seconds of good flights may give.
        """
        return [
            finding
            for finding in self.faults
            if finding.kind in SETUP_KINDS
            and finding.sure != "hint"
            and (finding.severity == "error" or finding.kind in _SURE_WARNINGS)
        ]

    @property
    def certain_errors(self) -> list[Finding]:
        """Errors of calibration, units and clocks that are certain."""
        return [f for f in self.setup_faults if f.severity == "error" and f.sure == "certain"]

    def rules_out(self, limits: Mapping[str, float]) -> bool:
        """Whether nothing is wrong, and faults of this size would be certain.

        Args:
            limits: logarithms of the factors of ``focal_length`` and ``baseline``, and the turn of
                the ``mounting``, degrees, as far as they are to be ruled out.
        """
        sigmas: dict[str, object] = {}
        for finding in self.findings:
            if finding.kind == "camera_and_gyroscope":
                sigmas["focal_length"] = finding.values["focal_sigma"]
                sigmas["mounting"] = finding.values["turn_sigma_deg"]
            elif finding.kind == "scale":
                sigmas["baseline"] = finding.values["sigma"]
        known = (
            isinstance(sigma := sigmas.get(kind), float) and CERTAIN_SIGMAS * sigma < limit
            for kind, limit in limits.items()
        )
        return not self.faults and all(known)

    def best_guess(self) -> str:
        """The likeliest fault and what mends it, in one line; empty if none was found."""
        return self.faults[0].with_fix if self.faults else ""

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
    parts = _enough(material, factor)
    if not parts:
        return found + check_stereo(material.stereo, material.rig)
    now, stereo, first = _by_cameras(material, parts)
    found += [*first, *now.findings, *stereo]
    if now.fit is not None and not now.has_constant_sensor:
        good = not any(finding.severity == "error" for finding in [*first, *stereo])
        motion = check_motion(now, now.fit, good and len(material.rig.cameras) > 1)
        found += [no_surer(finding, now.findings) for finding in motion]
    return found


def _by_cameras(
    material: Material, parts: list[Part]
) -> tuple[CameraAndGyroscope, list[Finding], list[Finding]]:
    """What camera and gyroscope say, what both cameras say, and what explains the former.

    Exchanged cameras look like another mounting of the first one, too: with the cameras as they
    should be there is none.
    """
    now = compare(material.rig, parts)
    stereo = check_stereo(material.stereo, now.rig)
    for finding in stereo:
        rig = mended(material.rig, finding)
        if rig is not None and _faults(now):
            right = compare(rig, parts)
            if right.fit is not None and _faults(right) < _faults(now):
                return right, [other for other in stereo if other is not finding], [finding]
    return now, [no_surer(finding, now.findings) for finding in stereo], []


def _faults(now: CameraAndGyroscope) -> int:
    return sum(finding.severity != "info" for finding in now.findings)


def _matched(pairs: Sequence[CameraFrame]) -> list[StereoMatches]:
    """Matches between images of two cameras, of the latest pair and as many others as it takes."""
    found: list[StereoMatches] = []
    for pair in reversed(pairs):
        first, second = pair.images[:2]
        if first is not None and second is not None:
            found.append(match_images(pair.stamp_ns, first, second))
        if len(found) > 1 and sum(len(matches.first) for matches in found) >= _ENOUGH_MATCHES:
            break
    return found


def _remembered(
    rig: Rig, frames: Sequence[FeatureFrame], imu: ImuData, lost: Sequence[tuple[int, int]]
) -> Material:
    """Features and samples in memory, in parts without interruption."""
    frames = [frame.usable(len(rig.cameras))[0] for frame in frames]
    material = Material(rig, imu, [], lost=lost)
    if frames:
        whole = Part(frames, around(imu, frames[0].stamp_ns, frames[-1].stamp_ns))
        material.parts = uninterrupted(whole)
        if len(rig.cameras) > 1:
            step = max(1, len(frames) // 8)
            material.stereo = [StereoMatches.of_tracks(f) for f in frames[::step]]
    return material


def _enough(material: Material, factor: float) -> list[Part]:
    """Pieces without interruption that can be compared, with forces in m/s²."""
    parts = [Part(part.frames, finite(part.imu, factor)) for part in material.parts]

    def enough(lost: Sequence[tuple[int, int]]) -> list[Part]:
        pieces = [_covered(piece) for part in parts for piece in uninterrupted(part, lost)]
        return long_enough(pieces)

    return enough(material.lost) or enough(())


def _covered(part: Part) -> Part:
    """A part with the frames that its samples cover."""
    stamps = part.imu.stamps_ns
    if not len(stamps):
        return Part([], part.imu)
    return Part([f for f in part.frames if stamps[0] <= f.stamp_ns <= stamps[-1]], part.imu)
