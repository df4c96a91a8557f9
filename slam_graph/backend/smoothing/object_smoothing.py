# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The whole way of an object as one bundle adjustment, after that of the platform.

In the frame of an object the platform moves (`relative_motion.py`), so its recording is one of
cameras without an IMU, and the adjustment is that of every recording: poses of all frames, all of
its points, and constant velocity of the object for the dynamics. The smoothed motion of the
platform is given at first; at last platform and objects take a step together (`joint_objects.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.objects.ego_motion import motion_samples
from slam_graph.backend.objects.moving_objects import MovingObjects
from slam_graph.backend.objects.object_history import ObjectHistory
from slam_graph.backend.objects.object_state import ObjectState
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.relative_motion import object_settings
from slam_graph.backend.smoothing.final_adjustment import FinalBa, adjust_recording
from slam_graph.backend.smoothing.frame_log import FrameLog
from slam_graph.backend.smoothing.joint_objects import joined
from slam_graph.backend.smoothing.object_log import ObjectLog
from slam_graph.backend.smoothing.smoothed_objects import smoothed_states
from slam_graph.backend.smoothing.smoothing_config import FinalBaConfig
from slam_graph.backend.solve.single_thread import on_one_thread
from slam_graph.errors import EstimationError
from slam_graph.geometry import NavState, StateHistory, Trajectory, interpolate
from slam_graph.sensors import FeatureFrame, ImuData, Rig

_ROUNDS = 4
"""The noise of the dynamics is estimated this many times at most."""
_SAME_FACTOR = 1.2
"""Noise densities whose ratio is below this are the same."""
_LEAST_NOISE = 0.01
"""Smallest factor on the densities of the settings in one round."""
_LEAST_SHARE = 0.5
"""Share of the observations of an object that a minimum fits which is right."""
_DENSITIES = ("accel_density", "angular_accel_density")


class ObjectSmoother:
    """Keeps the tracks of the objects of a run, and adjusts every object as a whole at its end.

    Args:
        backend: settings of the estimator of the platform.
        objects: settings of objects.
    """

    def __init__(self, backend: BackendConfig, objects: ObjectsConfig) -> None:
        self._settings = backend, objects
        self._log: ObjectLog | None = None

    @contextmanager
    def recorded(self, rig: Rig, folder: Path) -> Iterator[None]:
        """Keep what is added inside of the block, so that `smooth` can be called after it.

        Args:
            rig: the cameras.
            folder: for files.
        """
        with ObjectLog.recording(rig, self._settings[1].window_s, folder) as log:
            self._log = log
            yield

    def add(self, frame: FeatureFrame, members: Mapping[int, int]) -> None:
        """Take a frame, as `ObjectLog.add` does."""
        if self._log is not None:
            self._log.add(frame, members)

    @on_one_thread
    def smooth(
        self, objects: MovingObjects, rig: Rig, platform: FinalBa, config: FinalBaConfig
    ) -> tuple[FinalBa, list[str]]:
        """Adjust every object as a whole, and then all of them together with the platform.

        Args:
            objects: as they were estimated on the way; they are given the smoothed ones.
            rig: the best calibration available.
            platform: its smoothed trajectory.
            config: settings of the adjustment.

        Returns:
            The platform by what the objects say of it, too, and what went wrong, for each object
            that is not smoothed for a reason.
        """
        if self._log is None:
            return platform, []
        task = _ObjectAdjustment(rig, platform, *self._settings, config)
        tracks, failures = self._log.tracks(), []
        found: dict[int, FinalBa] = {}
        for number in objects.numbers:
            frames = self._log.frames(tracks.get(number, np.zeros(0, np.int64)))
            try:
                adjusted = task.adjusted(objects.states(number), frames)
            except (EstimationError, RuntimeError, np.linalg.LinAlgError) as error:
                failures.append(f"object {number} is not smoothed: {error}")
                continue
            if adjusted is not None:
                found[number] = adjusted
        platform, together = joined(platform, found)
        smoothed = ObjectHistory(objects.classes)
        for number, item in together.items():
            try:
                states = smoothed_states(objects.states(number), item, task.offset_ns)
            except (RuntimeError, np.linalg.LinAlgError) as error:
                failures.append(f"object {number} is not smoothed: {error}")
                continue
            smoothed.note(states, ())
        objects.smoothed = smoothed
        return platform, failures


@dataclass(frozen=True, eq=False)
class _ObjectAdjustment:
    """Adjusts an object as a whole.

    Attributes:
        rig: the best calibration available.
        platform: its smoothed trajectory, on the clock of the IMU.
        backend: noise and triangulation.
        objects: noise of the object's acceleration.
        config: settings of the adjustment.
    """

    rig: Rig
    platform: FinalBa
    backend: BackendConfig
    objects: ObjectsConfig
    config: FinalBaConfig

    def adjusted(
        self, states: Sequence[ObjectState], frames: Iterable[FeatureFrame]
    ) -> FinalBa | None:
        """The platform in the frame of an object, from its first to its last state.

        Args:
            states: as they were estimated on the way, in the order of time.
            frames: all observations of its tracks.

        Returns:
            None if there are too few observations to improve on these.

        Raises:
            EstimationError: if no minimum fits the observations.
        """
        with TemporaryDirectory(prefix="slam_graph_") as folder:
            rig = self.rig.without_imu()
            with FrameLog.recording(rig, self.config, Path(folder), motion_known=True) as log:
                self._record(log, (f for f in frames if f.stamp_ns >= states[0].stamp_ns))
            return self._minimum(log, self._initial(states), rig)

    def _minimum(self, log: FrameLog, initial: Trajectory, rig: Rig) -> FinalBa | None:
        """The minimum under the noise of the object's acceleration that it shows itself.

        Raises:
            EstimationError: if the minimum fits less than half of the observations.
        """
        found, objects = None, self.objects
        # tracks of points at another time of the way may be of the other side of the object
        config = self.config.model_copy(update={"fuse_features": False})
        joint = self.platform.equations is not None
        for _ in range(_ROUNDS):
            backend = object_settings(self.backend, objects)
            found = adjust_recording(
                log, initial, rig, backend, config, lambda *_: None, _LEAST_NOISE, joint
            )
            if found is None:
                return None
            if found.summary.observations < _LEAST_SHARE * log.observations:
                raise EstimationError("it fits less than half of the observations")
            factors = np.array([found.noise.accel, found.noise.gyro_walk])
            if np.all(np.abs(np.log(factors)) < np.log(_SAME_FACTOR)):
                break
            densities = factors * [objects.accel_density, objects.angular_accel_density]
            changed = dict(zip(_DENSITIES, densities.tolist(), strict=True))
            objects, initial = objects.model_copy(update=changed), found.trajectory
        return found

    @property
    def offset_ns(self) -> int:
        """From stamps of frames to the clock of the poses."""
        return round(self.rig.pose_offset_s * 1e9)

    def _record(self, log: FrameLog, frames: Iterable[FeatureFrame]) -> None:
        """Write the frames at whose time the platform is known, with its motion between them."""
        path = self.platform.trajectory
        before: NavState | None = None
        for frame in frames:
            stamps_ns = np.array([frame.stamp_ns + self.offset_ns])
            there, valid = interpolate(path, stamps_ns)
            if not valid[0]:
                continue
            now = _state(int(stamps_ns[0]), there.pose(0), np.asarray(there.velocities)[0])
            samples = ImuData(stamps_ns, np.zeros((1, 3)), np.zeros((1, 3)))
            if before is not None:
                samples = motion_samples(before, now)
            log.add(samples, frame, (1.0, 1.0))
            before = now

    def _initial(self, states: Sequence[ObjectState]) -> Trajectory:
        """Poses of the platform in the frame of the object as they were estimated."""
        poses = [s.world_T_object.inverse().compose(s.world_T_body) for s in states]
        stamps_ns = np.array([s.stamp_ns for s in states])
        positions = np.array([pose.translation() for pose in poses])
        velocities = np.zeros_like(positions)
        if len(states) > 1:
            velocities = np.gradient(positions, (stamps_ns - stamps_ns[0]) * 1e-9, axis=0)
        history = StateHistory(level=False)
        for stamp_ns, pose, velocity in zip(stamps_ns.tolist(), poses, velocities, strict=True):
            history.append(_state(stamp_ns + self.offset_ns, pose, velocity))
        return history.trajectory()


def _state(stamp_ns: int, pose: gtsam.Pose3, velocity: FloatArray) -> NavState:
    return NavState(stamp_ns, pose, velocity, accel_bias=np.zeros(3), gyro_bias=np.zeros(3))
