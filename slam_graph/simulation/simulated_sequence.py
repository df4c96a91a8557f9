# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A simulation as a sequence: read and run like any recording, or written to a folder."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal

import gtsam
import numpy as np
import yaml
from numpy.typing import NDArray

from slam_graph.arrays import IntArray
from slam_graph.datasets import (
    EurocWriter,
    ReaderOptions,
    RecordedSequence,
    SequenceInfo,
    TrackRecorder,
)
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState, Trajectory
from slam_graph.sensors import AidingData, CameraFrame, FeatureFrame, ImuData, Rig
from slam_graph.simulation.aiding_simulation import simulated_aiding
from slam_graph.simulation.depth_rendering import DepthRendering
from slam_graph.simulation.imu_simulation import ImuSource
from slam_graph.simulation.landmarks import Landmarks, MovingBoard, SmoothView
from slam_graph.simulation.motion import Motion
from slam_graph.simulation.moving_bodies import LandmarksOnBodies, MovingBody, moving_bodies
from slam_graph.simulation.path_report import PathReport
from slam_graph.simulation.rendering import Renderer
from slam_graph.simulation.simulation_config import SimulationConfig, random_stream
from slam_graph.simulation.textures import paint
from slam_graph.simulation.track_simulation import TrackSimulator
from slam_graph.simulation.world import World

_SETTINGS_FILE = "simulation.yaml"
_PATH_FILE = "recorded_path.json"

Progress = Callable[[int], None]
"""Called with the time of every frame that has been written, ns."""


@dataclass(frozen=True, eq=False)
class Flight:
    """The ground truth of a simulated flight.

    Attributes:
        rig: cameras and noise of the IMU.
        motion: of the platform.
        imu: the IMU samples and their true biases.
        world: the walls.
        exposures_ns: (N,) times of the frames on the clock of the IMU.
        report: how a recorded path was made consistent with its IMU; None if it was not.
    """

    rig: Rig
    motion: Motion
    imu: ImuSource
    world: World
    exposures_ns: IntArray
    report: PathReport | None = None


class SimulatedSequence(RecordedSequence):
    """The measurements of a simulated flight, generated while they are read.

    Where the rig has a time offset, frames are stamped by the clock of its first camera; where its
    shutter rolls, the exposures of the flight are those of the middle row.

    Attributes:
        config: all settings.
        flight: the ground truth.
    """

    format: ClassVar[str] = "simulation"

    def __init__(
        self,
        name: str,
        config: SimulationConfig,
        flight: Flight,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        super().__init__(name, flight.rig, ReaderOptions(diagnostics=diagnostics or Diagnostics()))
        self.config = config
        self.flight = flight
        self._offset_ns = round(flight.rig.pose_offset_s * 1e9)

    @property
    def has_groundtruth(self) -> bool:
        """Always true."""
        return True

    def measure(self) -> SequenceInfo:
        """Number of frames and IMU samples, and the time of the first and last frame."""
        stamps = self.flight.exposures_ns - self._offset_ns
        return self.holding(len(stamps), int(stamps[0]), int(stamps[-1]), self.flight.imu.samples)

    def imu_blocks(self, after_ns: int | None = None) -> Iterator[ImuData]:
        """The IMU samples from `after_ns` on."""
        return self.flight.imu.blocks(after_ns)

    def read_aiding(self) -> AidingData:
        """Position fixes, known poses and odometry, as far as there are any."""
        stamps = self.flight.exposures_ns
        span_ns = int(stamps[0]), int(stamps[-1])
        return simulated_aiding(self.flight.motion, span_ns, self.config)

    def groundtruth(self) -> Trajectory:
        """The ground truth at the times of the frames, on the clock of the IMU."""
        stamps, motion = self.flight.exposures_ns, self.flight.motion
        gyro_biases, accel_biases = self.flight.imu.biases(stamps)
        return Trajectory(
            stamps,
            motion.positions(stamps).copy(),  # not the whole of what they are columns of
            motion.rotations(stamps).as_quat(),
            motion.velocities(stamps).copy(),
            accel_biases=accel_biases,
            gyro_biases=gyro_biases,
        )

    def initial_state(self) -> NavState:
        """The state at the first frame: the truth, or with an error drawn from its covariance."""
        start, first = self.config.known_start, self.flight.exposures_ns[:1]
        sigmas = (
            start.rotation_rad,
            start.position_m,
            start.velocity,
            start.accel_bias,
            start.gyro_bias,
        )
        standard_deviations, error = np.repeat(sigmas, 3), np.zeros(15)
        if start.error:
            rng = np.random.default_rng(random_stream(self.config.seed, "start"))
            error = rng.normal(size=15) * standard_deviations
        motion = self.flight.motion
        R = gtsam.Rot3(motion.rotations(first).as_matrix()[0])
        gyro_biases, accel_biases = self.flight.imu.biases(first)
        return NavState(
            int(first[0]),
            gtsam.Pose3(R, motion.positions(first)[0]).retract(error[:6]),
            motion.velocities(first)[0] + error[6:9],
            accel_bias=accel_biases[0] + error[9:12],
            gyro_bias=gyro_biases[0] + error[12:],
            covariance=np.diag(standard_deviations**2),
        )

    @cached_property
    def bodies(self) -> tuple[MovingBody, ...]:
        """The moving objects."""
        flight, config = self.flight, self.config
        mounting = flight.rig.cameras[0].body_T_camera.matrix()
        view = SmoothView(flight.motion, mounting[:3, :3], mounting[:3, 3])
        return moving_bodies(config.objects, view, int(flight.exposures_ns[0]), config.seed)

    def object_truth(self) -> dict[int, Trajectory]:
        """True poses of the objects by their numbers, at the stamps of the frames."""
        stamps = self.flight.exposures_ns
        truth = {body.number: body.trajectory(stamps) for body in self.bodies}
        on_cameras = stamps - self._offset_ns
        return {number: replace(path, stamps_ns=on_cameras) for number, path in truth.items()}

    def save(self, path: str | Path, progress: Progress | None = None) -> None:
        """Write the simulation to a new folder, completely or not at all, with its settings.

        Args:
            path: the folder. Tracks become a recording (`datasets/formats/track_recording.py`),
                images an EuRoC (ASL) folder with the calibration in Kalibr's format beside it.
            progress: called after every frame.

        Raises:
            DataError: if the folder exists already, or cannot be written.
        """
        settings = self.config.model_dump(mode="json")
        notes = {_SETTINGS_FILE: yaml.safe_dump(settings, sort_keys=False)}
        if self.flight.report is not None:
            notes[_PATH_FILE] = json.dumps(self.flight.report.as_dict(), indent=2) + "\n"
        notes |= self.object_truth_file()
        self._write(Path(path), notes, progress if progress is not None else _ignore)

    @abstractmethod
    def _write(self, path: Path, notes: Mapping[str, str], progress: Progress) -> None:
        """Write measurements, calibration, ground truth and notes."""


class SimulatedTracks(SimulatedSequence):
    """Feature tracks of landmarks."""

    content: ClassVar[Literal["images", "tracks"]] = "tracks"

    def __init__(
        self,
        name: str,
        config: SimulationConfig,
        flight: Flight,
        landmarks: Landmarks,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        super().__init__(name, config, flight, diagnostics)
        if config.objects.count:
            on_bodies = LandmarksOnBodies(self.bodies, config.seed)
            landmarks = replace(landmarks, bodies=on_bodies)
        self.landmarks = landmarks

    def frames(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Generator[FeatureFrame, None, None]:
        """Frames of features; those before `start_ns` are simulated too, but left out."""
        flight, config = self.flight, self.config
        simulator = TrackSimulator(
            flight.rig,
            flight.world,
            self.landmarks,
            config.tracks,
            config.seed,
            config.place_seed,
            config.depth.noise_scale,
            config.objects.masks,
        )
        stamps = flight.exposures_ns - self._offset_ns
        until = flight.exposures_ns[self.within(stamps, None, end_ns)]
        for frame in simulator.frames(flight.motion, until, self._offset_ns):
            if start_ns is None or frame.stamp_ns >= start_ns:
                yield frame

    def _write(self, path: Path, notes: Mapping[str, str], progress: Progress) -> None:
        truth, start = self.groundtruth(), self.initial_state()
        with TrackRecorder(path, self.rig, self.name, truth, start, notes) as recorder:
            for packet in self.packets():
                assert isinstance(packet.frame, FeatureFrame)
                recorder.write(packet.imu, packet.frame, packet.aiding)
                progress(packet.frame.stamp_ns)


class SimulatedImages(SimulatedSequence):
    """Rendered images of a textured world."""

    content: ClassVar[Literal["images", "tracks"]] = "images"

    @cached_property
    def renderer(self) -> Renderer:
        """The renderer; textures are generated on first use."""
        flight, config = self.flight, self.config
        board, bodies = self.board, self.bodies
        sizes = [panel.size for panel in flight.world.panels]
        texels_m = [config.images.texel_m] * len(sizes)
        for body in bodies:
            sizes += [panel.size for panel, _ in body.panels]
            texels_m += [config.objects.texel_m] * len(body.panels)
        if board is not None:
            sizes.append(board.size)
            texels_m.append(board.config.texel_m)
        atlas = paint(sizes, texels_m, config.place_seed)
        depth = None
        if flight.rig.depth is not None:
            depth = DepthRendering(flight.rig.depth, config.depth.noise_scale, config.seed)
        renderer = Renderer(
            flight.rig, flight.world, atlas, config.images, config.seed, board, depth
        )
        renderer.bodies = bodies
        return renderer

    @cached_property
    def board(self) -> MovingBoard | None:
        """The moving object, if there is one."""
        flight, config = self.flight, self.config.moving_object
        if config is None:
            return None
        mounting = flight.rig.cameras[0].body_T_camera.matrix()
        began_ns = int(flight.exposures_ns[0])
        return MovingBoard.ahead_of(config, flight.motion, mounting, began_ns, self.config.seed)

    @property
    def masks(self) -> int:
        """Number of label images: one for each frame, if they are wanted."""
        wanted = bool(self.bodies) and self.config.objects.masks
        return len(self.flight.exposures_ns) if wanted else 0

    def label_image(self, stamp_ns: int) -> NDArray[np.uint16] | None:
        """The label image (height, width) of the first camera in a frame, rendered."""
        if self.masks == 0:
            return None
        return self.renderer.labels(self.flight.motion, stamp_ns + self._offset_ns)

    def frames(
        self, start_ns: int | None = None, end_ns: int | None = None
    ) -> Generator[CameraFrame, None, None]:
        """Frames of images."""
        exposures = self.flight.exposures_ns
        wanted = exposures[self.within(exposures - self._offset_ns, start_ns, end_ns)]
        for exposure_ns in wanted.tolist():
            yield self.renderer.frame(self.flight.motion, exposure_ns, self._offset_ns)

    def _write(self, path: Path, notes: Mapping[str, str], progress: Progress) -> None:
        truth, rate_hz = self.groundtruth(), self.config.frame_rate_hz
        with EurocWriter(
            path, self.rig, truth, "simulated", rate_hz, with_imu=self.has_imu, notes=notes
        ) as writer:
            writer.write_aiding(self.aiding)
            for packet in self.packets():
                assert isinstance(packet.frame, CameraFrame)
                writer.write_imu(packet.imu)
                writer.write_frame(packet.frame)
                labels = self.label_image(packet.frame.stamp_ns)
                if labels is not None:
                    writer.write_mask(packet.frame.stamp_ns, labels)
                progress(packet.frame.stamp_ns)


def _ignore(stamp_ns: int) -> None:
    """No progress is shown."""
