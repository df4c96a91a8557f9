# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost: residuals as a function of the variables, their linearisation and their gate.

The cost is the sum of the marginal prior, factors of GTSAM (IMU, zero velocity), single
observations of features that are in the state, and whole tracks of others. One of these either
becomes a variable of the state or is marginalised as soon as it is linearised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_factors import (
    SummedFeatures,
    WhitenedObservations,
    sum_features,
    whiten,
)
from slam_graph.backend.cost.feature_tracks import Observations, is_in
from slam_graph.backend.cost.gating import (
    Gate,
    Innovations,
    distances_of_tracks,
    passing,
)
from slam_graph.backend.cost.measurement_rows import (
    gated_columns,
    pose_rows,
    starts_of_points,
    state_feature_rows,
)
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.triangulation import first_centres, moved_in_inverse_depth
from slam_graph.backend.cost.unit_of_length import without_scale
from slam_graph.backend.cost.whitened_update import GateRoot, gate_root
from slam_graph.backend.solve.square_root import Layout, SquareRootInformation
from slam_graph.backend.solve.state import POINT_DIM, State, dims_of, landmark_keys


@dataclass(frozen=True, slots=True, eq=False)
class TrackFeatures:
    """Features that enter the cost in this step with all of their observations.

    Attributes:
        obs: their tracks.
        points: (J, 3) triangulated positions; moved by every Gauss-Newton step.
        in_state: (J,) whether the feature stays as a variable or is used once.
    """

    obs: Observations
    points: FloatArray
    in_state: BoolArray

    def subset(self, keep: BoolArray) -> TrackFeatures:
        """The features where `keep` (J,) holds."""
        if keep.all():
            return self
        return TrackFeatures(self.obs.subset(keep), self.points[keep], self.in_state[keep])


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """The cost, linear in an increment of the tangents.

    Attributes:
        landmarks: observations of the features of the state.
        tracks: features outside the state: each observation, as the gate needs them, or summed up.
        errors: (N,) lengths of all residuals of observations, in standard deviations.
    """

    landmarks: WhitenedObservations | None
    tracks: WhitenedObservations | SummedFeatures | None
    errors: FloatArray

    @staticmethod
    def of(
        landmarks: WhitenedObservations | None,
        tracks: WhitenedObservations | None,
        summed: Observations | None,
    ) -> Linearization:
        """That of some observations; the tracks are summed up if they are given as `summed`."""
        errors = [part.errors for part in (landmarks, tracks) if part is not None]
        stacked = np.concatenate(errors) if errors else np.zeros(0)
        if tracks is None or summed is None:
            return Linearization(landmarks, tracks, stacked)
        total = sum_features(summed, tracks) if len(summed) else None
        return Linearization(landmarks, total, stacked)

    def unweighted(self, loss: RobustLoss) -> Linearization:
        """The same without the weights of a loss; features must not be summed up."""
        assert not isinstance(self.tracks, SummedFeatures), "these have been weighted"
        parts = [None if p is None else p.unweighted(loss) for p in (self.landmarks, self.tracks)]
        return Linearization(parts[0], parts[1], self.errors)


@dataclass(eq=False)
class Cost:
    """All residuals of one step, as a function of the variables in `state`.

    Attributes:
        state: estimates and linearisation points.
        rig: projection into the cameras.
        config: noise and gating.
        prior: what was marginalised before, over the offsets from the linearisation points; its
            variables must be frozen.
        factors: GTSAM's factors between the variables.
        landmarks: observations of features that are variables of the state.
        tracks: features outside the state, with whole tracks.
        loss: on reprojection residuals; None for that of the settings.
        sigma_px: (C,) standard deviation of the observations of each camera; None for that of the
            settings.
    """

    state: State
    rig: RigProjection
    config: BackendConfig
    prior: SquareRootInformation
    factors: Sequence[gtsam.NonlinearFactor] = field(default_factory=list)
    landmarks: Observations | None = None
    tracks: TrackFeatures | None = None
    loss: RobustLoss | None = None
    sigma_px: FloatArray | None = None
    defines_unit: ClassVar[bool] = False  # whether its factors say what the unit of length is
    _layout: tuple[tuple[object, ...], Layout] | None = field(default=None, init=False)  # the last
    _jacobians: dict[int, gtsam.JacobianFactor] = field(default_factory=dict, init=False)  # by id
    _squares: tuple[tuple[object, ...], FloatArray] = field(default=((), np.zeros(0)), init=False)

    @property
    def robust(self) -> RobustLoss:
        """The loss on reprojection residuals."""
        return self.loss or RobustLoss(self.config.gating.loss)

    def sigmas(self, obs: Observations) -> FloatArray:
        """Standard deviations (N,) of observations, in pixels."""
        if self.sigma_px is None:
            return np.full(len(obs), self.config.noise.pixel_sigma)
        return self.sigma_px[obs.camera]

    def layout(self) -> Layout:
        """Columns of the variables: those of the prior, then the new ones."""
        tracks = self.tracks
        depends_on: tuple[object, ...] = self.prior, self.landmarks
        if tracks is not None:
            depends_on += tracks.obs, tracks.in_state
        if self._layout is not None and _are_same(self._layout[0], depends_on):
            return self._layout[1]
        keys = [key for factor in self.factors for key in factor.keys()]  # noqa: SIM118
        if self.landmarks is not None:
            keys += self.rig.keys_of(self.landmarks)
            keys += landmark_keys(self.landmarks.ids[self.landmarks.counts > 0])
        if tracks is not None:
            keys += self.rig.keys_of(tracks.obs)
            keys += landmark_keys(tracks.obs.ids[tracks.in_state])
        known = self.prior.layout
        new = dims_of(k for k in dict.fromkeys(keys) if k not in known.dims)
        layout = self._layout[1] if self._layout is not None else known
        if list(layout.dims) != [*known.dims, *new]:
            layout = known.extended(new)
        self._layout = depends_on, layout
        return layout

    def prior_at_estimate(self) -> SquareRootInformation:
        """The prior as a function of an increment of the current estimates."""
        prior = self.prior
        there = prior.over(self.layout(), copy=True)
        there.Rd[: prior.layout.size, -1] -= prior.R @ self.state.offset(prior.layout)
        return there

    def part(self, factors: Sequence[gtsam.NonlinearFactor], tracks: BoolArray) -> Cost:
        """The prior and the features of the state, with some of the factors and new features (J,).

        Observations of features of the state are never linearised again, so no part is without
        them. New features that fewer than two observations are left of are left out.
        """
        features = None
        if self.tracks is not None:
            features = self.tracks.subset(tracks & (self.tracks.obs.counts > 1))
            features = replace(features, obs=features.obs.without_idle_frames())
        return replace(self, factors=factors, tracks=features)

    def ids_of(self, tracks: BoolArray) -> IntArray:
        """Ids, ascending, of some of the new features (J,)."""
        return self.tracks.obs.ids[tracks] if self.tracks is not None else np.zeros(0, np.int64)

    def value(
        self, linear: Linearization | None = None, predicted: SquareRootInformation | None = None
    ) -> float:
        """The cost at the current estimates: half the squared residuals, under the robust loss.

        Args:
            linear: the linearisation there, if it is known; it has the residuals of observations.
            predicted: prior and factors of GTSAM there, if they are known.
        """
        if predicted is not None:
            total = 0.5 * (float(predicted.d @ predicted.d) + predicted.residual)
        else:
            d = self.prior.d - self.prior.R @ self.state.offset(self.prior.layout)
            total = 0.5 * (float(d @ d) + self.prior.residual)
            total += sum(factor.error(self.state.frames) for factor in self.factors)
        if linear is not None:
            return total + float(np.sum(self.robust.value(linear.errors)))
        if self.landmarks is not None and len(self.landmarks):
            total += self._loss(self.landmarks, None)
        if self.tracks is not None and len(self.tracks.obs):
            total += self._loss(self.tracks.obs, self.tracks.points)
        return total

    def _loss(self, obs: Observations, points: FloatArray | None) -> float:
        errors = np.sqrt(self.squared_errors(obs, points))
        return float(np.sum(self.robust.value(errors)))

    def squared_errors(self, obs: Observations, points: FloatArray | None) -> FloatArray:
        """Squared residuals (N,) of observations at the current estimates, in units of σ².

        Args:
            obs: of features at `points` (J, 3), or of features of the state where these are None.
            points: in the world.
        """
        depends_on = obs, points, self.state.frames, self.state.points
        if _are_same(self._squares[0], depends_on):  # the gate after the steps asks again
            return self._squares[1]
        rig = self.rig.at(self.state)
        points = self.state.positions_of(obs.ids) if points is None else points
        residuals, _ = rig.residuals(obs, self._geometry(rig, obs, points))
        squares = np.einsum("ni,ni->n", residuals, residuals)
        self._squares = depends_on, np.asarray(squares / self.sigmas(obs) ** 2, dtype=np.float64)
        return self._squares[1]

    # --- linearisation -------------------------------------------------------------------------

    def linearize(self, summed: bool = False) -> Linearization:
        """Linearise all observations.

        Args:
            summed: whether new features are summed up; else their observations stay apart, as the
                gate needs them.
        """
        self.state.relinearize()
        landmarks = tracks = None
        if self.landmarks is not None and len(self.landmarks):
            landmarks = self._whitened(self.landmarks, None)
        if self.tracks is not None and len(self.tracks.obs):
            tracks = self._whitened(self.tracks.obs, self.tracks.points)
        return Linearization.of(
            landmarks, tracks, self.tracks.obs if summed and self.tracks else None
        )

    def _whitened(self, obs: Observations, points: FloatArray | None) -> WhitenedObservations:
        rig = self.rig.at(self.state)
        now, then = (
            (points, points) if points is not None else self.state.both_positions_of(obs.ids)
        )
        first = self._geometry(rig, obs, then, first=True)
        estimate = self._geometry(rig, obs, now)
        return whiten(obs, rig, first, estimate, self.sigmas(obs), self.robust)

    def _geometry(
        self, rig: RigProjection, obs: Observations, points: FloatArray, first: bool = False
    ) -> Geometry:
        """Poses, or their first estimates, and points of observations."""
        poses = self.state.poses(obs.frames, first)
        return Geometry(*rig.when_taken(obs.frames, *poses), points)

    def factor_rows(self, layout: Layout) -> FloatArray:
        """Rows [A b] (m, n + 1) of GTSAM's factors: A at first estimates, b at current ones."""
        end, first, now = 0, self.state.first_frames, self.state.frames
        of_dynamics: list[int] = []
        Ab = np.zeros((sum(factor.dim() for factor in self.factors), layout.size + 1), order="F")
        for factor in self.factors:
            assert isinstance(factor, gtsam.NoiseModelFactor)
            jacobian = self._jacobians.get(id(factor)) or factor.linearize(first)
            if not isinstance(jacobian, gtsam.JacobianFactor):
                jacobian = gtsam.JacobianFactor(jacobian)
            keys, (A, _) = jacobian.keys(), jacobian.jacobian()
            if self.prior.layout.dims.keys() >= set(keys):  # first estimates of these do not move
                self._jacobians[id(factor)] = jacobian
            rows = slice(end, end + len(A))
            Ab[rows, layout.indices(keys)] = A
            Ab[rows, -1] = -factor.whitenedError(now)
            end = rows.stop
            if isinstance(factor, gtsam.CombinedImuFactor):
                of_dynamics += range(rows.start, end)
        if self.rig.needs_two_views and not self.defines_unit:
            arm, alone = self.rig.body_p_camera[0], len(of_dynamics) == end
            chosen = slice(None) if alone else of_dynamics  # without a copy where all are
            Ab[chosen] = without_scale(Ab[chosen], self.state, layout, arm)
        return Ab

    def rows(self, linear: Linearization, layout: Layout) -> list[FloatArray]:
        """Rows [A b] (m, n + 1) of all observations, to be folded in one after the other."""
        none, size = np.zeros(0, np.intp), layout.size
        leading, rest, of_state = np.zeros((0, size + 1)), np.zeros((0, 1)), none
        if linear.landmarks is not None and self.landmarks is not None:
            obs = self.landmarks
            of_state = layout.indices(self.rig.keys_of(obs))
            own = starts_of_points(obs, layout)
            leading, rest = state_feature_rows(obs, linear.landmarks, own, of_state, size)
        if linear.tracks is None or self.tracks is None:
            return [leading, pose_rows(rest, None, none, none, (of_state, none), size)]
        assert isinstance(linear.tracks, SummedFeatures)
        columns = of_state, layout.indices(self.rig.keys_of(self.tracks.obs))
        new = self.tracks.in_state.nonzero()[0]
        own = layout.indices(landmark_keys(self.tracks.obs.ids[new]))
        return [leading, pose_rows(rest, linear.tracks, new, own, columns, size)]

    def apply(self, delta: FloatArray, linear: Linearization, layout: Layout) -> None:
        """Move the estimates by an increment (n,), and new features with them, in inverse depth.

        In metres one with little parallax would jump, and stop a step that is good for all others.
        One that becomes a variable goes where the increment says: there its rows are linearised.
        """
        tracks, state, was = self.tracks, self.state, self.state.frames
        if tracks is None or linear.tracks is None:
            state.update(layout, delta)
            self.rig.follow(state, was)
            return
        assert isinstance(linear.tracks, SummedFeatures)
        columns, own = layout.indices(self.rig.keys_of(tracks.obs)), tracks.in_state
        increments = linear.tracks.point_increments(delta[columns])
        before = first_centres(tracks.obs, self.rig.at(state), state)
        state.update(layout, delta)
        self.rig.follow(state, was)
        after = first_centres(tracks.obs, self.rig.at(state), state)
        points = moved_in_inverse_depth(tracks.points, increments, before, after)
        points[own] = state.positions_of(tracks.obs.ids[own])
        self.tracks = TrackFeatures(tracks.obs, points, own)

    def snapshot(self) -> tuple[State, TrackFeatures | None]:
        """What `apply` changes, to be given back to `restore`."""
        return self.state.copy(), self.tracks

    def restore(self, before: tuple[State, TrackFeatures | None]) -> None:
        """Undo what was applied since a snapshot."""
        self.state.assign(before[0])
        self.tracks = before[1]

    def gate(
        self,
        linear: Linearization,
        predicted: SquareRootInformation,
        tested: BoolArray | None = None,
        admitted: tuple[BoolArray | bool, BoolArray | bool] = (True, True),
        known: GateRoot | None = None,
    ) -> Gate:
        """Which tracked observations and new features pass the χ² test.

        Args:
            linear: of this cost, not summed up. Under the weights of a loss that vanish for large
                residuals any would pass (`Linearization.unweighted`).
            predicted: what is known of the variables before these measurements.
            tested: (J,) which of the new features are tested; all of them if it is not given.
            admitted: which observations (N,) and which of the tested features may pass; else all.
            known: the root for these observations, where it was found already.
        """
        obs = None if self.tracks is None or linear.tracks is None else self.tracks.obs
        if obs is not None and tested is not None:  # they are new: few poses have seen them
            obs = obs.subset(tested).without_idle_frames()
        landmarks = np.zeros(0, np.bool_)
        tracks = np.zeros(0 if tested is None else len(tested), np.bool_)
        innovations, confidence = Innovations(), self.config.gating.confidence
        if known is None:
            of_state = None if linear.landmarks is None else self.landmarks
            columns, poses = gated_columns(of_state, obs, self.rig, predicted.layout)
            if not len(columns) and not len(poses):
                return Gate(landmarks, tracks, innovations)
            known = gate_root(predicted, columns, poses)
        if linear.landmarks is not None:
            # nearer or behind, the slope of the projection is so large that any residual would pass
            near = linear.landmarks.depths < self.config.triangulation.min_depth_m
            distances = known.distances(linear.landmarks)
            dof = np.full(len(distances), 2)
            landmarks, innovations = passing(distances, dof, confidence, ~near & admitted[0])
        if obs is not None and len(obs) and self.tracks is not None:
            observed = linear.tracks
            assert isinstance(observed, WhitenedObservations), "these are not told apart"
            if tested is not None:
                observed = observed.subset(tested[self.tracks.obs.feature])
            covariance = known.pose_root.T @ known.pose_root
            distances = distances_of_tracks(obs, observed, covariance)
            dof = 2 * obs.counts - POINT_DIM
            passed, of_tracks = passing(distances, dof, confidence, admitted[1])
            tracks = is_in(self.tracks.obs.ids, obs.ids[passed])
            innovations += of_tracks
        return Gate(landmarks, tracks, innovations)


def _are_same(some: tuple[object, ...], others: tuple[object, ...]) -> bool:
    """Whether two tuples hold the very same objects."""
    return len(some) == len(others) and all(a is b for a, b in zip(some, others, strict=True))
