# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the stages of a run have in common: three calls, and the frame that each of them is given.

Tracking and estimation make an `EstimatedFrame` of every packet of a recording. Each stage is given
every frame. After the last frame the stages finish in order, so that a later stage finds the
results of the earlier ones in the `RunResult`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import SlamGraphError
from slam_graph.frontend import Feedback
from slam_graph.geometry import NavState
from slam_graph.sensors import AidingData, CameraFrame, FeatureFrame, ImuData, Packet, Rig

if TYPE_CHECKING:
    from slam_graph.backend import Estimator, ObjectFrame

COMPLETED = ("ok", "suspect", "low_coverage")
"""Run statuses after which loops are closed and a map is built (not after Ctrl-C)."""

_MESSAGE_LENGTH = 200
"""Messages of other libraries are cut to this many characters."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class EstimatedFrame:
    """A frame of the recording, with what the front end and the estimator made of it.

    Attributes:
        packet: the frame and the IMU samples before it, as read.
        features: what the front end found in the frame.
        state: the causal estimate at its time, or None before initialisation.
        landmark_ids: (N,) ids of the features whose positions are estimated now.
        landmarks: (N, 3) their positions in the world, m.
        rejected: (M,) ids of the features that the χ² gate rejected.
        imu_noise: factors on the white noise of gyroscope and accelerometer that are assumed now.
        initialized: whether the estimator has started.
        corrected_rig: the calibration, where the estimator has corrected it; None otherwise.
        restarted: whether the estimator began anew at this frame, in another world.
        world_motion: new_T_old, if all states of the segment have moved with their world.
        world_scale: by which the path of the camera was scaled before that.
        waits: whether this frame waits for IMU samples, and the state is that of an earlier one.
        milliseconds: of each stage, of its parts as `stage.part`, and of all as `total`.
        counts: what the front end counts, by name.
        georeferenced: whether the world of the estimate is that of position fixes.
        fix_offset_s: added to the times of the fixes, beyond the given offset.
        fix_calibration: lever arm and clock of the fixes, where they are estimated with the states.
        objects: what moves; None where moving objects are not estimated.
        imu_noise_at_limit: whether a noise density of the IMU was raised as far as it may be.
        rig_on_raw_clock: the calibration against the IMU samples of packets as they come now.
        clock_changes: of that clock so far; states are on the clock of the beginning.
        dynamic: (D,) ids of the tracked features that the estimator knows to move by themselves.
    """

    packet: Packet
    features: FeatureFrame
    state: NavState | None
    landmark_ids: IntArray
    landmarks: FloatArray
    rejected: IntArray
    imu_noise: tuple[float, float]
    initialized: bool
    corrected_rig: Rig | None = None
    restarted: bool = False
    world_motion: gtsam.Pose3 | None = None
    world_scale: float = 1.0
    waits: bool = False
    milliseconds: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, float] = field(default_factory=dict)
    georeferenced: bool = False
    fix_offset_s: float = 0.0
    fix_calibration: AidingData.Calibration | None = None
    objects: ObjectFrame | None = None
    imu_noise_at_limit: bool = False
    rig_on_raw_clock: Rig | None = None
    clock_changes: Estimator.ClockChanges | None = None
    dynamic: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def image(self) -> np.ndarray | None:
        """The image of the first camera, if there is one."""
        frame = self.packet.frame
        return frame.images[0] if isinstance(frame, CameraFrame) else None

    @property
    def imu(self) -> ImuData:
        """The IMU samples since the frame before, on the clock of the beginning."""
        samples = self.packet.imu
        return samples if self.clock_changes is None else self.clock_changes.corrected(samples)

    def feedback(self) -> Feedback:
        """What the front end is told about the features, on the clock of its IMU samples."""
        state, changes = self.state, self.clock_changes
        if state is not None and changes:
            state = replace(state, stamp_ns=state.stamp_ns + round(changes.shift_s * 1e9))
        return Feedback.of(
            state, self.rejected, self.landmark_ids, self.landmarks, self.rig_on_raw_clock
        )


class Stage:
    """One part of a run. This base class does nothing: a stage overrides what it needs."""

    def begin(self, resources: ExitStack) -> None:
        """Called once, before the first frame.

        Args:
            resources: closed when the run is over, however it ends.
        """

    def frame(self, frame: EstimatedFrame) -> None:
        """Called for each frame, in the order of time."""

    def finish(self) -> None:
        """Called once, when the last frame is done, however the run ended."""


class NoObjects(Stage):
    """Moving objects are not estimated.

    Attributes:
        moved: ids (N,) of all features that were found to move so far, ascending.
    """

    def __init__(self) -> None:
        self.moved: IntArray = np.zeros(0, np.int64)

    def noted(self, frame: EstimatedFrame) -> EstimatedFrame:
        """The frame with what was found to move in it."""
        return frame

    def feedback(self, feedback: Feedback) -> Feedback:
        """What the front end is told, with what is known of moving objects."""
        return feedback


@contextmanager
def warn_on_failure(diagnostics: Diagnostics, kind: str, consequence: str) -> Iterator[None]:
    """Turn a failure of the block into a counted warning: the causal result is not lost by it.

    Args:
        diagnostics: counts the warning.
        kind: of the warning.
        consequence: begins the message: what the run lacks now.

    Raises:
        KeyboardInterrupt: if that ended the block; it is counted as well.
    """
    try:
        yield
    except KeyboardInterrupt:
        diagnostics.warn(kind, f"{consequence}: interrupted")
        raise
    except Exception as error:
        if not isinstance(
            error, SlamGraphError | cv2.error | RuntimeError | np.linalg.LinAlgError | OSError
        ):
            logger.exception("internal error")
        reason = " ".join(str(error).split())[:_MESSAGE_LENGTH]
        diagnostics.warn(kind, f"{consequence}: {reason}")
