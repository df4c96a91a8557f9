# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings whose calibration or IMU is wrong, as users give them to a run by mistake."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import gtsam
import numpy as np

from slam_graph.datasets.sequence import FrameStream, ReaderOptions, RecordedSequence, SequenceInfo
from slam_graph.datasets.streams.imu_stream import clean_blocks
from slam_graph.geometry import Trajectory
from slam_graph.sensors import Camera, FeatureFrame, FeatureObservations, ImuData, Rig, RigCamera

Change = Callable[[Rig], Rig]


@dataclass(frozen=True, slots=True)
class WrongSetup:
    """What is wrong.

    Attributes:
        calibration: what it makes of the calibration.
        gyro, accel: factors on what the IMU measures.
        cameras: how many cameras it takes.
    """

    calibration: Change = lambda rig: rig
    gyro: float = 1.0
    accel: float = 1.0
    cameras: int = 1


def _mounted(change: Callable[[RigCamera], RigCamera]) -> Change:
    return lambda rig: Rig(tuple(change(c) for c in rig.cameras), rig.imu)


def _lens(change: Callable[[Camera], Camera]) -> WrongSetup:
    return WrongSetup(_mounted(lambda c: replace(c, camera=change(c.camera))))


def focal_length(factor: float) -> WrongSetup:
    """Focal lengths of all cameras too long by a factor."""
    return _lens(lambda lens: replace(lens, fx=factor * lens.fx, fy=factor * lens.fy))


def principal_point(pixels: float) -> WrongSetup:
    """Principal points of all cameras too far to the right."""
    return _lens(lambda lens: replace(lens, cx=lens.cx + pixels))


def baseline(factor: float) -> WrongSetup:
    """The second camera too far from the first by a factor."""

    def longer(rig: Rig) -> Rig:
        first, second = rig.cameras[:2]
        origin, pose = first.body_T_camera.translation(), second.body_T_camera
        place = origin + factor * (pose.translation() - origin)
        moved = replace(second, body_T_camera=gtsam.Pose3(pose.rotation(), place))
        return Rig((first, moved), rig.imu)

    return WrongSetup(longer, cameras=2)


def turned(degrees: float) -> WrongSetup:
    """All cameras turned on the IMU, about a slanted axis."""
    turn = gtsam.Rot3.Expmap(np.deg2rad(degrees) * np.array([1.0, 2.0, 2.0]) / 3.0)

    def turn_camera(c: RigCamera) -> RigCamera:
        return replace(c, body_T_camera=gtsam.Pose3(turn, np.zeros(3)) * c.body_T_camera)

    return WrongSetup(_mounted(turn_camera))


def clock(seconds: float) -> WrongSetup:
    """A calibrated time offset that is too large."""
    return WrongSetup(_mounted(lambda c: replace(c, time_offset_s=c.time_offset_s + seconds)))


def _less_noise(rig: Rig) -> Rig:
    imu = rig.imu
    names = (
        "gyro_noise_density",
        "gyro_random_walk",
        "accel_noise_density",
        "accel_random_walk",
    )
    return Rig(rig.cameras, replace(imu, **{n: 0.1 * getattr(imu, n) for n in names}))


def _seen_by(lens: Camera, seen: FeatureObservations) -> FeatureObservations:
    """Features as a lens sees them: none beyond its edge."""
    normalized, inside = lens.visible(seen.pixels)
    return replace(seen, normalized=normalized).select(inside)


def _exchanged(rig: Rig) -> Rig:
    first, second = rig.cameras[:2]
    return Rig((second, first), rig.imu)


WRONG_SETUPS: dict[str, WrongSetup] = {
    "baseline × 0.8": baseline(0.8),
    "baseline × 1.2": baseline(1.2),
    "baseline × 2": baseline(2.0),
    "focal length × 0.7": focal_length(0.7),
    "focal length × 0.9": focal_length(0.9),
    "focal length × 0.97": focal_length(0.97),
    "focal length × 1.03": focal_length(1.03),
    "focal length × 1.1": focal_length(1.1),
    "focal length × 1.3": focal_length(1.3),
    "cameras turned by 2°": turned(2.0),
    "cameras turned by 5°": turned(5.0),
    "cameras turned by 10°": turned(10.0),
    "extrinsics inverted": WrongSetup(
        _mounted(lambda c: replace(c, body_T_camera=c.body_T_camera.inverse()))
    ),
    "clock off by 20 ms": clock(0.02),
    "clock off by -20 ms": clock(-0.02),
    "clock off by 50 ms": clock(0.05),
    "clock off by -50 ms": clock(-0.05),
    "gyroscope in °/s": WrongSetup(gyro=float(np.rad2deg(1.0))),
    "accelerometer in g": WrongSetup(accel=1.0 / 9.81),
    "noise of the IMU × 0.1": WrongSetup(_less_noise),
    "principal point off by 20 px": principal_point(20.0),
    "cameras exchanged": WrongSetup(_exchanged, cameras=2),
}
"""By what is said of them."""


class WronglySetUp(RecordedSequence):
    """A recording with a wrong set-up.

    Args:
        recording: as it is right.
        wrong: what is wrong.
    """

    format: ClassVar[str] = "wrong"

    def __init__(self, recording: RecordedSequence, wrong: WrongSetup) -> None:
        super().__init__(recording.name, wrong.calibration(recording.rig), ReaderOptions())
        self.diagnostics = recording.diagnostics
        self._recording, self._wrong = recording, wrong

    @property
    def has_groundtruth(self) -> bool:
        """Whether `groundtruth()` gives one."""
        return self._recording.has_groundtruth

    def measure(self) -> SequenceInfo:
        """What the recording holds."""
        return self._recording.info()

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        """The frames; points of tracks are normalised by the wrong lenses, if they see them."""
        for frame in self._recording.frames(start_ns, end_ns):
            if isinstance(frame, FeatureFrame):
                seen = zip(frame.cameras, self.rig.cameras, strict=True)
                cameras = tuple(_seen_by(mounted.camera, points) for points, mounted in seen)
                yield FeatureFrame(frame.stamp_ns, cameras)
            else:
                yield frame

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The samples in the wrong units, cleaned as a reader does."""
        gyro, accel = self._wrong.gyro, self._wrong.accel
        blocks = (
            (str, ImuData(block.stamps_ns, gyro * block.gyro, accel * block.accel))
            for block in self._recording.imu_blocks()
        )
        return clean_blocks(blocks, self.diagnostics, after_ns)

    def groundtruth(self) -> Trajectory | None:
        """The true trajectory."""
        return self._recording.groundtruth()
