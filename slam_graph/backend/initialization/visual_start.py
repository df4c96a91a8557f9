# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The start without an IMU: two frames whose features have depths, by a second camera or a sensor.

The motion from one frame to the next, by PnP from the points of the first, gives velocity and
angular rate. The world is that of the first camera at the second of them.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.backend.dynamics import bias_covariance
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.first_state import start_from
from slam_graph.backend.initialization.start_diagnosis import Refusal
from slam_graph.backend.visual_motion import depths_within, pose_of_most
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame

_MAX_INTERVAL_NS = 1_000_000_000
"""Two frames that are farther apart tell nothing of the velocity now."""
_VELOCITY_SIGMA, _RATE_SIGMA = 0.5, 0.3
"""Standard deviations of velocity (m/s) and angular rate (rad/s): those at the second frame are not
their means since the first."""


class VisualStart:
    """Starts at the first frame whose motion since the one before is known.

    Attributes:
        outliers: ids (N,) of the features that did not fit it, ascending.
        leaves_frame: whether the start has not used the features of its last frame.
    """

    leaves_frame = True

    def __init__(self, context: EngineContext) -> None:
        self.outliers: IntArray = np.zeros(0, np.int64)
        self._context = context
        self._before: tuple[int, FeatureFrame] | None = None
        self._refusal = Refusal("frames", "two frames")

    def try_to_start(self, stamp_ns: int, frame: FeatureFrame) -> Window | None:
        """Take the next frame and start if it is possible.

        Args:
            stamp_ns: time of the frame on the clock of the dynamics.
            frame: its features.
        """
        before, self._before = self._before, (stamp_ns, frame)
        if before is None or stamp_ns - before[0] > _MAX_INTERVAL_NS:
            return None
        motion = self._motion(before[1], frame)
        if isinstance(motion, Refusal):
            self._refusal = motion
            return None
        state = self._state(stamp_ns, motion, before[0])
        return start_from(state, self._context.config, self._context.calibration)

    def waiting_for(self) -> str:
        """What a start still needs."""
        return self._refusal.needs

    def _state(self, stamp_ns: int, motion: gtsam.Pose3, before_ns: int) -> NavState:
        """The state after a motion start_T_end of the body since a time."""
        seconds = (stamp_ns - before_ns) * 1e-9
        known = self._context.imu.between(before_ns, stamp_ns).rotation(np.zeros(3))
        unknown = known.between(motion.rotation())
        prior = self._context.config.initialization.prior
        world_T_body = self._context.rig.cameras[0].body_T_camera.inverse()
        velocity = motion.rotation().unrotate(motion.translation()) / seconds
        gauge = np.repeat([prior.yaw_rad, prior.position_m, _VELOCITY_SIGMA], 3)
        covariance = np.zeros((15, 15))
        covariance[:9, :9] = np.diag(gauge**2)
        covariance[9:, 9:] = bias_covariance(_RATE_SIGMA)
        return NavState(
            stamp_ns,
            world_T_body,
            np.asarray(world_T_body.rotation().rotate(velocity)),
            accel_bias=np.zeros(3),
            gyro_bias=-gtsam.Rot3.Logmap(unknown) / seconds,
            covariance=covariance,
        )

    def _motion(self, before: FeatureFrame, now: FeatureFrame) -> gtsam.Pose3 | Refusal:
        """The motion before_T_now of the body, or what is missing for it."""
        rig, seen = self._context.rig, now.cameras[0]
        rows, found = depths_within(before, rig).seen(seen.ids)
        count, least = np.count_nonzero(found.located), self._context.config.dynamics.min_points
        if count < least:
            return Refusal(
                "tracks",
                f"{least} features with a depth that last from one frame to the next; there "
                f"are {count} of {len(seen)} (a second camera or a depth image gives the depth)",
            )
        # the body before is the world here
        solved = pose_of_most(rig.cameras[0], found.points, seen.normalized[rows])
        if solved is None:
            return Refusal("fit", "features that fit one motion from one frame to the next")
        self.outliers = np.sort(seen.ids[rows][~solved.fits])
        return solved.world_T_body
