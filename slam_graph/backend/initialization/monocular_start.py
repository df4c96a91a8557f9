# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The start of one camera without an IMU: two views, and all frames in between.

The present frame and an earlier one give the motion between them up to its length, and points
(`two_views.py`); PnP gives the frames in between. Then all poses, velocities and points are
estimated together, as in a start with an IMU (`dynamic_refinement.py`).

Nothing measures the length of anything: a motion, and all points with it, can be scaled. So a
convention sets the unit: the median depth of the points of the two views is
`backend.dynamics.median_depth`. The gauge has seven degrees of freedom, pose and scale. The pose of
the last frame is that of the world, and the scale is that in which the points which live on have
the depths that were estimated, in the mean of their inverses. What the covariances say is relative
to these: depths and velocity are as uncertain as their ratios.

Odometry of wheels or legs measures lengths: the unit is the metre then, motions of the odometry are
part of the batch, and the gauge is the pose alone.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, V, X

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.aiding.odometry_factors import odometry_factor
from slam_graph.backend.aiding.regauging import gauge_directions
from slam_graph.backend.cost.cost import Linearization
from slam_graph.backend.cost.imu_factor import imu_factor
from slam_graph.backend.cost.unit_of_length import scale_direction
from slam_graph.backend.dynamics import bias_covariance
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.batch_cost import BatchCost
from slam_graph.backend.initialization.dynamic_refinement import (
    MAX_NORMALIZED_COST,
    MAX_SCALE_SIGMA,
    MAX_STEP_LEFT,
    DynamicRefinement,
    prior_factors,
)
from slam_graph.backend.initialization.dynamic_start import StartFrames, StartGuess
from slam_graph.backend.initialization.odometry_scale import in_metres, motions_by_odometry
from slam_graph.backend.initialization.segment_joint import moved
from slam_graph.backend.initialization.start_diagnosis import Refusal
from slam_graph.backend.initialization.two_views import MIN_POINTS, TwoViews, two_view_motion
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation, triangularize
from slam_graph.backend.solve.state import State, imu_state_keys
from slam_graph.backend.visual_motion import ERROR_PX
from slam_graph.backend.window import Window
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame

_LONGEST_NS = 5_000_000_000
"""Frames that are older are not a view to start from."""
_SHARED = 0.5
"""Smallest part of the present features that the other view must have seen."""
_MAX_FRAMES = 12
"""Frames of the batch problem, evenly spaced in time."""
_POSE_SIGMA, _VELOCITY_SIGMA, _RATE_SIGMA = 1e-3, 10.0, 3.0
"""Standard deviations of the first state: its pose is the gauge, the rest is not known."""
_SCALE_SIGMA = 1e-3
"""Relative standard deviation of the scale at the start: it is a convention."""
_MAX_DEPTH_SIGMA = 0.03
"""Largest accepted relative standard deviation of the depths that are known best."""


class MonocularStart:
    """Collects frames until two of them show motion and depths.

    Attributes:
        leaves_frame: whether the start has not used the features of its last frame.
    """

    leaves_frame = False

    def __init__(self, context: EngineContext) -> None:
        self._context = context
        self._stamps_ns: list[int] = []
        self._frames: list[FeatureFrame] = []
        self._refusal = Refusal("frames", "two frames")
        self._refinement = ScaleFreeRefinement(context)

    @property
    def outliers(self) -> IntArray:
        """Ids (N,) of the features that did not fit the last attempt, ascending."""
        return self._refinement.outliers

    def waiting_for(self) -> str:
        """What a start still needs."""
        return self._refusal.needs

    def try_to_start(self, stamp_ns: int, frame: FeatureFrame) -> Window | None:
        """Take the next frame and start if it is possible.

        Args:
            stamp_ns: time of the frame on the clock of the dynamics.
            frame: its features.
        """
        self._stamps_ns.append(stamp_ns)
        self._frames.append(frame)
        self._forget()
        outcome = self._attempt()
        if isinstance(outcome, Refusal):
            self._refusal = outcome
            return None
        world_T_body = self._context.rig.cameras[0].body_T_camera.inverse()
        there = outcome.state.frames.atPose3(X(outcome.frame))
        return moved(outcome, world_T_body.compose(there.inverse()))

    def _forget(self) -> None:
        """Forget frames that are too old, or share too few features with the present one.

        Where odometry tells the unit of length, also those that it does not connect with that.
        """
        latest = self._frames[-1].cameras[0].ids
        enough = max(MIN_POINTS, _SHARED * len(latest))
        while len(self._frames) > 1:
            shared = np.count_nonzero(np.isin(self._frames[0].cameras[0].ids, latest))
            recent = self._stamps_ns[-1] - self._stamps_ns[0] <= _LONGEST_NS
            if shared >= enough and recent and self._is_measured():
                return
            del self._stamps_ns[0], self._frames[0]

    def _is_measured(self) -> bool:
        """Whether odometry, if it tells the unit of length, leads from the first frame on."""
        if not self._context.rig.has_odometry:
            return True
        ends = self._stamps_ns[0], self._stamps_ns[-1]
        return motions_by_odometry(self._context, ends) is not None

    def _attempt(self) -> Window | Refusal:
        """A start from the frames so far, or what is missing for it."""
        if len(self._frames) < 3:
            led = " and odometry" if self._context.rig.has_odometry else ""
            needs = f"frames that share {MIN_POINTS} features{led}, and half of the present ones"
            return Refusal("tracks", needs)
        first, last = self._frames[0].cameras[0], self._frames[-1].cameras[0]
        ids, rows, others = np.intersect1d(first.ids, last.ids, return_indices=True)
        camera = self._context.rig.cameras[0].camera
        sigma = self._context.config.noise.pixel_sigma / float(np.sqrt(camera.fx * camera.fy))
        views = two_view_motion(first.normalized[rows], last.normalized[others], sigma)
        if isinstance(views, Refusal):
            return views
        chosen = np.linspace(0, len(self._frames) - 1, min(_MAX_FRAMES, len(self._frames)))
        frames = StartFrames(
            [self._stamps_ns[k] for k in chosen.astype(int)],
            [self._frames[k] for k in chosen.astype(int)],
        )
        guess = self._guess(frames, ids, views)
        return guess if isinstance(guess, Refusal) else self._refinement.refine(frames, guess)

    def _guess(self, frames: StartFrames, ids: IntArray, views: TwoViews) -> StartGuess | Refusal:
        """States of all frames, in the world of the first camera.

        Args:
            frames: what they observed.
            ids: (N,) of the features of the two views.
            views: the first and the last of the frames.
        """
        mounted = self._context.rig.cameras[0]
        median = float(np.median(views.points[views.good, 2]))
        scale = self._context.config.dynamics.median_depth / median
        known, points = ids[views.good], scale * views.points[views.good]
        last = views.first_T_second
        last = gtsam.Pose3(last.rotation(), scale * last.translation())
        camera_T_body = mounted.body_T_camera.inverse()
        poses = [camera_T_body]
        for frame in frames.frames[1:-1]:
            seen = frame.cameras[0]
            _, rows, others = np.intersect1d(known, seen.ids, return_indices=True)
            found = mounted.body_pose(points[rows], seen.normalized[others], ERROR_PX)
            if found is None or 2 * np.count_nonzero(found[1]) < len(rows):
                return Refusal("fit", "frames between two views that fit their points")
            poses.append(found[0])
        poses.append(last.compose(camera_T_body))
        measured = self._in_metres(poses, frames) if self._context.rig.has_odometry else poses
        if isinstance(measured, Refusal):
            return measured
        return StartGuess(_states(frames.stamps_ns, measured), known)

    def _in_metres(
        self, poses: list[gtsam.Pose3], frames: StartFrames
    ) -> list[gtsam.Pose3] | Refusal:
        """Poses in metres by the odometry, or what is missing for that."""
        motions = motions_by_odometry(self._context, frames.stamps_ns)
        if motions is None:
            return Refusal("frames", "odometry of the time between two views")
        return in_metres(poses, motions, self._context)


class ScaleFreeRefinement(DynamicRefinement):
    """The batch problem of a start without an IMU, whose scale is a convention or by odometry."""

    def __init__(self, context: EngineContext) -> None:
        super().__init__(context, MAX_SCALE_SIGMA)

    def _hope(self, cost: BatchCost) -> None:
        """All steps are taken: without an IMU attempts that fail are rare."""

    def _factors(self, frames: StartFrames, guess: StartGuess) -> list[gtsam.NonlinearFactor]:
        """The dynamics from frame to frame, the first pose, and what holds the scale."""
        params = self._context.propagation.noise.params()
        factors: list[gtsam.NonlinearFactor] = []
        for k, samples in enumerate(frames.imu_between(self._context.imu)):
            bias = gtsam.imuBias.ConstantBias(np.zeros(3), guess.states[k].gyro_bias)
            factors.append(imu_factor(k, k + 1, samples.preintegrated(bias, params)))
        first, last = guess.states[0], guess.states[-1]
        covariance = np.zeros((15, 15))
        sigmas = np.repeat([_POSE_SIGMA, _POSE_SIGMA, _VELOCITY_SIGMA], 3)
        covariance[:9, :9] = np.diag(sigmas**2)
        covariance[9:, 9:] = bias_covariance(_RATE_SIGMA)
        factors += prior_factors(replace(first, covariance=covariance))
        if self._context.rig.has_odometry:
            motions = motions_by_odometry(self._context, frames.stamps_ns)
            assert motions is not None, "the guess is made of them"
            poses = [nav.world_T_body for nav in guess.states]
            return factors + [
                odometry_factor((k, k + 1), motion, a.range(b), self._context.config.odometry)
                for k, (motion, (a, b)) in enumerate(zip(motions, pairwise(poses), strict=True))
            ]
        distance = first.world_T_body.range(last.world_T_body)
        noise = gtsam.noiseModel.Isotropic.Sigma(1, _SCALE_SIGMA * distance)
        end = len(guess.states) - 1
        return [*factors, gtsam.RangeFactorPose3(X(0), X(end), distance, noise)]

    def _hopeless(self, cost: BatchCost, linear: Linearization, static: int) -> Refusal | None:
        """What is missing if the guess already shows that no start will come of it."""
        if linear.tracks is None:
            return Refusal("fit", f"features that fit the motion (0 of {static} do)")
        return None

    def _in_gauge(
        self, prior: SquareRootInformation, state: State, last: int, features: IntArray
    ) -> SquareRootInformation:
        """The prior with the last pose for known, and the scale where nothing measures it.

        This is an S-transformation (Baarda 1973).
        """
        layout, values = prior.layout, state.first
        arm = self._context.rig.cameras[0].body_T_camera.translation()
        centre = values.atPose3(X(last)).transformFrom(arm)
        unmeasured = gauge_directions(values, layout, centre, level=False)
        fixed = np.zeros((6, layout.size + 1))
        fixed[:, layout.indices([X(last)])] = np.eye(6) / _POSE_SIGMA
        if not self._context.rig.has_scale:
            scale = scale_direction(values, layout, centre, arm)
            unmeasured = np.column_stack([unmeasured, scale])
            away = {L(j): values.atPoint3(L(j)) - centre for j in features.tolist()}
            fixed = np.vstack([fixed, _held_scale(layout, scale, away, V(last))])
        count = len(fixed)
        free = np.zeros((layout.size + 1, count))
        free[:-1] = prior.R @ unmeasured
        rest = triangularize(np.hstack([free, prior.Rd]))[count:, count:]
        fixed[:, -1] = fixed[:, :-1] @ state.offset(layout)
        return SquareRootInformation(layout, triangularize(np.vstack([rest, fixed])))

    def _doubt(self, normalized_cost: float, start: Window) -> Refusal | None:
        """What is missing if a solution cannot be trusted; None if it can."""
        last = start.prior.marginal(imu_state_keys(start.frame))
        if not np.linalg.norm(last.d) < MAX_STEP_LEFT:
            return Refusal("fit", "steps that converge")
        if normalized_cost > MAX_NORMALIZED_COST:
            needs = f"frames that fit one another (normalised cost {normalized_cost:.1f})"
            return Refusal("fit", needs)
        measured = self._context.rig.has_scale
        if self.scale_sigma > (MAX_SCALE_SIGMA if measured else _MAX_DEPTH_SIGMA):
            needs = f"more parallax (depths are known to {self.scale_sigma:.0%} only)"
            return Refusal("motion", needs)
        return None


def _held_scale(
    layout: Layout, scale: FloatArray, away: dict[int, FloatArray], velocity: int
) -> FloatArray:
    """Row (1, n + 1) that holds the mean of the features' inverse distances.

    Args:
        layout: of the variables.
        scale: (n,) their tangents when the world is scaled.
        away: (3,) by key of a feature: where it is from the camera.
        velocity: key of the velocity, which is held where there is no feature.
    """
    held = np.zeros(layout.size + 1)
    for key, vector in away.items():
        held[layout.indices([key])] = vector / np.linalg.norm(vector) ** 3
    if not away:
        held[layout.indices([velocity])] = scale[layout.indices([velocity])]
    return np.asarray(held / (held[:-1] @ scale) / _SCALE_SIGMA)[None]


def _states(stamps_ns: list[int], poses: list[gtsam.Pose3]) -> list[NavState]:
    """States at some poses, with the mean velocities and rates around each."""
    states = []
    for k, pose in enumerate(poses):
        a, b = max(k - 1, 0), min(k + 1, len(poses) - 1)
        seconds = (stamps_ns[b] - stamps_ns[a]) * 1e-9
        turn = gtsam.Rot3.Logmap(poses[a].rotation().between(poses[b].rotation()))
        states.append(
            NavState(
                stamps_ns[k],
                pose,
                (poses[b].translation() - poses[a].translation()) / seconds,
                accel_bias=np.zeros(3),
                gyro_bias=-turn / seconds,
            )
        )
    return states
