# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The motion of the platform relative to one object, by the engine that estimates the platform.

The points of a rigid object are static in its own frame. There it is the platform that moves, with
the pose Y = L⁻¹ X, where X is its pose in the world and L that of the object. So an object is
estimated by an estimator of its own, without an IMU, whose world is the object: every algorithm is
the same for both. The observations depend on Y and on the points alone, not on X. So what the
images say of Y is independent of what they say of X, and L = X Y⁻¹ has the errors of both.

In the hybrid formulation of Bârsan et al. and DynoSAM the same observation is written as
π(X⁻¹ L m), with X and L for variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slam_graph.arrays import FloatArray, IntArray, ascending_union
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.selection_policies import FEATURE_POLICIES
from slam_graph.backend.estimator import Estimator
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.object_start import first_state
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.backend.objects.track_window import TrackWindow
from slam_graph.backend.policies import AlgorithmConfig
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import EstimationError
from slam_graph.sensors import FeatureFrame, Rig


@dataclass(frozen=True, eq=False)
class RelativeStep:
    """The platform in the frame of an object, at two times.

    Attributes:
        before_ns, now_ns: times of the two frames, on the clock of the cameras.
        before, now: object_T_body.
        covariance: (12, 12) of both, before first, in their tangents: rotation (rad), translation
            (m), body axes.
    """

    before_ns: int
    now_ns: int
    before: gtsam.Pose3
    now: gtsam.Pose3
    covariance: FloatArray

    def body_motion(self) -> tuple[gtsam.Pose3, FloatArray]:
        """Motion before_T_now of the platform relative to the object, and its covariance (6, 6)."""
        return motion_between(self.before, self.now, self.covariance)


def motion_between(
    before: gtsam.Pose3, now: gtsam.Pose3, covariance: FloatArray
) -> tuple[gtsam.Pose3, FloatArray]:
    """Motion before_T_now between two poses, and its covariance (6, 6) in its tangent.

    Args:
        before: the first one.
        now: the second one.
        covariance: (12, 12) of both, before first, in their tangents: rotation (rad), translation
            (m), body axes.
    """
    motion = before.between(now)
    J = np.hstack([-motion.inverse().AdjointMap(), np.eye(6)])
    return motion, J @ covariance @ J.T


class RelativeMotion:
    """Estimates the motion of the platform in the frame of one object.

    Args:
        rig: the cameras.
        algorithm: the policies.
        backend: settings of the estimator; those of IMU and calibration do not count.
        config: the noise of the object's acceleration.
        length_s: how long past poses are kept.
    """

    def __init__(
        self,
        rig: Rig,
        algorithm: AlgorithmConfig,
        backend: BackendConfig,
        config: ObjectsConfig,
        length_s: float,
    ) -> None:
        self._estimator = Estimator(
            rig.without_imu(),
            object_policies(algorithm),
            object_settings(backend, config),
            Diagnostics(),
        )
        self._rig, self._config = rig.without_imu(), config
        self._prior = backend.initialization.prior
        self._length_ns = round(length_s * 1e9)
        self._offset_ns = round(rig.pose_offset_s * 1e9)
        self.known: IntArray = np.zeros(0, np.int64)  # ids of all features so far, ascending
        self.taken_ns = 0  # motion of the platform after this has not been added
        self._frames: dict[int, int] = {}  # index in the estimator of the frame with a stamp
        self.poses: dict[int, gtsam.Pose3] = {}  # object_T_body by stamp, as known now

    @property
    def rejected(self) -> IntArray:
        """Ids (N,) of the features that the gate rejected in the last frame, ascending."""
        return self._estimator.rejected

    def add(
        self, frame: FeatureFrame, ego: EgoMotion, earlier: Sequence[FeatureFrame] = ()
    ) -> bool:
        """Take the features of the object in the next frame.

        Args:
            frame: its features.
            earlier: past frames, in the order of time. What they saw of the features that are new
                to the object counts as well.
            ego: the motion of the platform in the world. An object of constant velocity is an
                inertial frame, in which the platform has the same acceleration and rate; those of
                the object are the noise.

        Returns:
            Whether there is a pose for it.

        Raises:
            EstimationError: if the equations cannot be solved: the object is lost.
        """
        self._add_motion(frame.stamp_ns, ego)
        if not self.poses and not self._begun(frame, ego):
            return False
        self._add_earlier(frame, earlier)
        self.known = ascending_union(self.known, frame.ids)
        try:
            state = self._estimator.add_frame(frame)
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise EstimationError(
                f"the motion of an object cannot be solved for: {error}"
            ) from None
        window = self._estimator.window
        if state is None or window is None:
            return False
        self._frames[frame.stamp_ns] = window.frame
        self.poses[frame.stamp_ns] = state.world_T_body
        for stamp in [s for s in self.poses if s < frame.stamp_ns - self._length_ns]:
            del self.poses[stamp]
            del self._frames[stamp]
        values, past = window.state.frames, set(window.past)
        for stamp, i in self._frames.items():
            if i in past:
                self.poses[stamp] = values.atPose3(X(i))
        return True

    def _begun(self, frame: FeatureFrame, ego: EgoMotion) -> bool:
        """Begin in a frame, if enough of its features have a depth."""
        state = first_state(frame, ego, self._rig, self._prior, self._config.min_points)
        if state is not None:
            self.known = np.zeros(0, np.int64)
            self._estimator.start(state, with_rate=True)
        return state is not None

    def _add_earlier(self, frame: FeatureFrame, earlier: Sequence[FeatureFrame]) -> None:
        """Add what past frames saw of the features of a frame that were not given before."""
        window, new = self._estimator.window, frame.ids[~is_in(frame.ids, self.known)]
        if window is None or len(new) == 0:
            return
        kept = {*window.past, window.frame}
        for past in earlier:
            if self._frames.get(past.stamp_ns) in kept:
                seen = past.only(new).usable(len(self._rig.cameras))[0]
                window.tracks.add_past(self._frames[past.stamp_ns], seen)

    def _add_motion(self, now_ns: int, ego: EgoMotion) -> None:
        """Add the motion of the platform since the last frame that was taken."""
        since = self.taken_ns or now_ns - 1
        for stamp in ego.stamps_ns:
            if since < stamp <= now_ns:
                self._estimator.add_motion(ego.samples(stamp, self._offset_ns))
        self.taken_ns = now_ns

    def assume_pixel_noise(self, sigma_px: float) -> None:
        """Take observations for so noisy from now on."""
        self._estimator.assume_pixel_noise(sigma_px)

    def points(self) -> tuple[IntArray, FloatArray]:
        """Ids (N,) and positions (N, 3) of its points, in the frame of the object."""
        return self._estimator.landmarks()

    def step(self, now_ns: int, before_ns: int) -> RelativeStep | None:
        """The motion between two frames, the later one being the last; None if it is not known."""
        if not {now_ns, before_ns} <= self.poses.keys():
            return None
        keys = [X(self._frames[before_ns]), X(self._frames[now_ns])]
        try:
            covariance = self._estimator.covariance_of(keys)
        except EstimationError:  # of an algorithm without past poses: as if independent
            covariance = np.zeros((12, 12))
            covariance[:6, :6] = covariance[6:, 6:] = self.covariance(now_ns)
        return RelativeStep(
            before_ns, now_ns, self.poses[before_ns], self.poses[now_ns], covariance
        )

    def covariance(self, now_ns: int) -> FloatArray:
        """(6, 6) of the tangent of the pose in the last frame."""
        return self._estimator.covariance_of([X(self._frames[now_ns])])


def motion_over(
    members: IntArray,
    window: TrackWindow,
    ego: EgoMotion,
    policies: tuple[AlgorithmConfig, BackendConfig],
    config: ObjectsConfig,
) -> RelativeMotion | None:
    """An estimator that has taken some tracks in the frames of a window.

    Args:
        members: (N,) ids of the tracks, ascending.
        window: the frames.
        ego: the motion of the platform over them.
        policies: algorithm and settings.
        config: of objects.

    Returns:
        None if the equations cannot be solved, or there is no pose in the last frame.
    """
    motion = RelativeMotion(window.rig, *policies, config, config.window_s)
    try:
        for frame in window.frames:
            motion.add(frame.only(members), ego)
    except EstimationError:
        return None
    return motion if ego.stamps_ns[-1] in motion.poses else None


def object_policies(algorithm: AlgorithmConfig) -> AlgorithmConfig:
    """The policies for an object: without features of the state, where those outside do as well.

    Without an IMU features enter the state when two frames have seen them. By then the depth of a
    point is off by a third of the size of an object, and what is linearised there becomes a part of
    the prior: the motion is taken for known far too well. Where features outside of the state are
    linearised anew in every step, nothing is lost without those in it. Where each is used once, at
    the end of its track, an object of which no feature is in the state has no motion at all.
    """
    cost = algorithm.cost
    anew = FEATURE_POLICIES[cost.features].relinearized
    if not anew or cost.past_poses == "evenly_spaced":  # which drops their observations
        return algorithm
    return algorithm.model_copy(update={"cost": cost.model_copy(update={"max_state_features": 0})})


def object_settings(backend: BackendConfig, config: ObjectsConfig) -> BackendConfig:
    """Settings of the estimator of an object."""
    dynamics = {
        "model": "constant_velocity",
        "accel_density": config.accel_density,
        "angular_accel_density": config.angular_accel_density,
        "min_points": config.min_points,
        "start_at_images": False,  # few points on a plane have two poses; prediction is good
    }
    default = BackendConfig()
    # few features, close together, do not show their noise; that of the platform's is given
    noise = {"adaptive_pixels": "never", "adaptive_drift": False}
    # given here, or the default without an IMU, Cauchy, would be taken
    loss = {"robust_loss": backend.gating.loss}
    return backend.model_copy(
        update={
            "noise": backend.noise.model_copy(update=noise),
            "gating": backend.gating.model_copy(update=loss),
            "dynamics": backend.dynamics.model_copy(update=dynamics),
            "calibration": default.calibration,
            "initialization": default.initialization,
        }
    )
