# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost over a recording as a function of all states and features, and its normal equations.

IMU factors and priors are GTSAM's. Reprojection errors are those of the recursive back end
(`cost/reprojection.py`): a recording has hundreds of thousands of them, which are linearised in
one pass, and whose features a compiled kernel eliminates (`kernels/feature_elimination.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy import sparse

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.smoothing.calibrated_fixes import (
    CalibratedFixes,
    EliminatedFixes,
    LinearFixes,
)
from slam_graph.backend.smoothing.state_elimination import (
    ChainEquations,
    EliminatedStates,
    StateColumns,
)
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.kernels.feature_elimination import eliminate_features


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Values of all variables.

    Attributes:
        states: X(k), V(k) and B(k) of the keyframes.
        points: (J, 3) features in the world.
        fixes: (n,) clock (s) and lever arm (m) of position fixes, as far as they are variables.
    """

    states: gtsam.Values
    points: FloatArray
    fixes: FloatArray = field(default_factory=lambda: np.zeros(0))

    def moved(self, step: Step) -> Estimates:
        """The estimates after a step."""
        states = moved_states(self.states, step.states)
        return Estimates(states, self.points + step.points, self.fixes + step.fixes)


def moved_states(states: gtsam.Values, increments: FloatArray) -> gtsam.Values:
    """X(k), V(k) and B(k) of K keyframes after increments (K, 15)."""
    delta = gtsam.VectorValues()
    for k, increment in enumerate(increments):
        delta.insert(X(k), increment[:6])
        delta.insert(V(k), increment[6:9])
        delta.insert(B(k), increment[9:])
    return states.retract(delta)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step of Gauss-Newton.

    Attributes:
        states: (K, 15) increments of the keyframe states.
        points: (J, 3) of the features.
        predicted: by how much the cost decreases by the model whose factor was used, with its
            damping, and with the curvature of where it was made.
        fixes: (n,) of clock (s) and lever arm (m).
    """

    states: FloatArray
    points: FloatArray
    predicted: float
    fixes: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class ReprojectionCost:
    """The robust reprojection errors of features in keyframes.

    Attributes:
        obs: of the keyframes; frame indices are those of keyframes.
        sigmas_px: (N,) standard deviations of the observations.
        projection: of the rig, with the motions of the keyframes for rolling shutters.
        loss: of the length of a whitened residual.
        inefficiency: (N,) or one for all, the information of the observations is divided by it
            (`track_correlation.py`).
    """

    obs: Observations
    sigmas_px: FloatArray
    projection: RigProjection
    loss: RobustLoss
    inefficiency: FloatArray | float = 1.0

    def at(self, estimates: Estimates) -> Geometry:
        """Poses and features."""
        return Geometry(*stacked_poses(estimates.states, self.obs.frames), estimates.points)

    def value(self, estimates: Estimates) -> float:
        """The cost. That of a point behind the camera is constant, and large."""
        residuals, depths = self.projection.residuals(self.obs, self.at(estimates))
        lengths = np.hypot(residuals[:, 0], residuals[:, 1])
        behind = np.flatnonzero(depths <= 0.0)
        focal = np.array([camera.fx for camera in self.projection.cameras])
        lengths[behind] = np.sqrt(8.0) * focal[self.obs.camera[behind]]
        return float(np.sum(self.loss.value(lengths / self.sigmas_px) / self.inefficiency))

    def linearized(self, estimates: Estimates) -> LinearReprojection:
        """Whitened residuals and Jacobians, weighted by the loss."""
        obs, at, projection = self.obs, self.at(estimates), self.projection
        views = projection.views(obs, at)
        by_pose, by_point, _ = projection.derivatives(obs, at, views)
        residuals = obs.pixels - views.pixels
        lengths = np.hypot(residuals[:, 0], residuals[:, 1]) / self.sigmas_px
        weights = np.sqrt(self.loss.weights(lengths) / self.inefficiency) / self.sigmas_px
        weights[views.in_camera[:, 2] <= 0.0] = 0.0
        residuals *= weights[:, None]
        by_pose *= weights[:, None, None]
        by_point *= weights[:, None, None]
        return LinearReprojection(obs, residuals, by_pose, by_point, weights, views.normalized)


@dataclass(frozen=True, slots=True, eq=False)
class LinearReprojection:
    """Linearised reprojection errors r - Jₓ δₓ - Jₚ δₚ, whitened.

    Attributes:
        obs: the observations.
        r: (N, 2).
        by_pose: (N, 2, 6) Jₓ, by the observing pose.
        by_point: (N, 2, 3) Jₚ, by the feature.
        weights: (N,) what whitens and weights residuals in pixels.
        normalized: (N, 2) where the features are predicted on the plane z = 1.
    """

    obs: Observations
    r: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    weights: FloatArray
    normalized: FloatArray

    def rows(self, keep: BoolArray | IntArray) -> LinearReprojection:
        """Some of the observations, by mask or number, of the same features."""
        parts = self.r, self.by_pose, self.by_point, self.weights, self.normalized
        return LinearReprojection(self.obs.rows(keep), *(part[keep] for part in parts))

    def gradient(self, keyframes: int) -> tuple[FloatArray, FloatArray]:
        """Jᵀ r by the poses (K, 6) and the features (J, 3)."""
        by_pose, by_point = self.products(self.r[:, :, None], keyframes)
        return by_pose[:, :, 0], by_point[:, :, 0]

    def products(self, right: FloatArray, keyframes: int) -> tuple[FloatArray, FloatArray]:
        """Jᵀ times a matrix (N, 2, m): by the poses (K, 6, m) and the features (J, 3, m)."""
        found, stacked = [], right.reshape(-1, right.shape[2])
        for blocks, column, count in (
            (self.by_pose, self.obs.frame, keyframes),
            (self.by_point, self.obs.feature, len(self.obs.ids)),
        ):
            width = blocks.shape[2]
            J = _block_rows(blocks, column, count)
            found.append((J.T @ stacked).reshape(count, width, stacked.shape[1]))
        return found[0], found[1]


def _block_rows(blocks: FloatArray, column: IntArray, count: int) -> sparse.csr_matrix:
    """The matrix (n i, count k) of N blocks (n, i, k), one for each i rows, in block columns (n,).

    With 32 bits for its numbers products take half the time.
    """
    n, height, width = blocks.shape
    first = np.repeat(width * column.astype(np.int32), height)
    columns = first[:, None] + np.arange(width, dtype=np.int32)
    ends = np.arange(0, blocks.size + 1, width, dtype=np.int32)
    parts = blocks.ravel(), columns.ravel(), ends
    return sparse.csr_matrix(parts, shape=(n * height, count * width))


class EliminatedFeatures:
    """The factor of the features in the normal equations, and what it leaves of the poses.

    Args:
        linear: the linearised reprojection errors.
        keyframes: number of keyframes K.
        damping: is added to the diagonal.
        fixes: linearised position fixes with variables of their own; None for none.
        reduce: whether `poses` is wanted; otherwise it is empty.

    Attributes:
        fixes: the factor of these variables, whose remains are in `poses` too.
        poses: (n, n) lower triangle of the information on the poses, in `StateColumns`; until
            `EliminatedStates` overwrites it.
    """

    def __init__(
        self,
        linear: LinearReprojection,
        keyframes: int,
        damping: float = 0.0,
        fixes: LinearFixes | None = None,
        reduce: bool = True,
    ) -> None:
        obs = linear.obs
        new = np.ones(len(obs), np.bool_)
        new[1:] = (np.diff(obs.feature) != 0) | (np.diff(obs.frame) != 0)
        first = np.flatnonzero(new)
        features, frame = len(obs.ids), obs.frame[first]
        self._inverse_roots = np.empty((features, 3, 3))
        T = np.empty((len(first), 3, 6))
        self.poses = np.zeros((StateColumns.of(keyframes).size if reduce else 0,) * 2)
        eliminate_features(
            linear.by_pose,
            linear.by_point,
            frame,
            np.append(first, len(obs)),
            np.searchsorted(obs.feature[first], np.arange(features + 1)),
            damping,
            self.poses,
            self._inverse_roots,
            T,
        )
        self._feature = obs.feature[first]
        self._T = _block_rows(T, frame, keyframes)
        self.fixes: EliminatedFixes | None = None
        if fixes is not None:
            self.fixes = EliminatedFixes(fixes, keyframes, damping)
            if reduce:
                self.fixes.add_to(self.poses)

    def reduced(self, by_pose: FloatArray, by_point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The gradient (K, 6) by the poses without features, and L⁻¹ times that (J, 3) by these.

        They may have any more dimensions behind these, the same in both.
        """
        width = by_pose[0, 0].size
        t = self._inverse_roots @ by_point.reshape(len(by_point), 3, width)
        held = self._T.T @ t[self._feature].reshape(-1, width)
        return by_pose - held.reshape(by_pose.shape), t.reshape(by_point.shape)

    def points(self, t: FloatArray, poses: FloatArray) -> FloatArray:
        """Increments (J, 3) of the features, given those (K, 6) of the poses.

        Args:
            t: (J, 3) see `reduced`.
            poses: (K, 6).
        """
        moved = (self._T @ poses.ravel()).reshape(-1, 3).T
        sums = [np.bincount(self._feature, column, len(t)) for column in moved]
        rest = t - np.stack(sums, axis=1)
        return np.asarray(np.einsum("jba,jb->ja", self._inverse_roots, rest))


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """The factor of the normal equations.

    Attributes:
        features: what was eliminated first.
        states: the rest.
    """

    features: EliminatedFeatures
    states: EliminatedStates

    def renewed(self, linear: LinearCost, damping: float) -> Factor:
        """The factor with features eliminated anew, which is cheap, and the states as they were."""
        return Factor(linear.eliminated(damping, reduce=False), self.states)

    def step(self, linear: LinearCost) -> Step:
        """The Gauss-Newton step from where a cost is linearised, by the factor at any estimates."""
        by_state, gradient = linear.chain.gradient.copy(), linear.chain.gradient.copy()
        by_pose, by_point = linear.images.gradient(len(by_state))
        reduced, t = self.features.reduced(by_pose, by_point)
        by_state[:, :6] += reduced
        gradient[:, :6] += by_pose
        eliminated = self.features.fixes
        by_fixes, shared = np.zeros(0), np.zeros(0)
        if linear.fixes is not None and eliminated is not None:
            by_pose, by_fixes = linear.fixes.gradient(len(by_state))
            by_state[:, :6] += eliminated.reduced(by_pose, by_fixes)
            gradient[:, :6] += by_pose
        states = self.states.times_covariance(by_state[:, :, None])[:, :, 0]
        if eliminated is not None:
            shared = eliminated.step(by_fixes, states[:, :6])
        points = self.features.points(t, states[:, :6])
        # with H of the factor, damped, H δ = g, so that the model gᵀ δ - ½ δᵀ H δ is ½ gᵀ δ
        predicted = 0.5 * float(np.sum(gradient * states) + np.sum(by_point * points))
        return Step(states, points, predicted + 0.5 * float(by_fixes @ shared), shared)


@dataclass(frozen=True, slots=True, eq=False)
class LinearCost:
    """A linearised cost.

    Attributes:
        chain: priors, IMU and zero-velocity factors.
        images: the reprojection errors.
        fixes: position fixes with variables of their own; None for none.
    """

    chain: ChainEquations
    images: LinearReprojection
    fixes: LinearFixes | None = None

    def eliminated(self, damping: float = 0.0, reduce: bool = True) -> EliminatedFeatures:
        """The factor of all but the states; see `EliminatedFeatures` for `reduce`."""
        keyframes = len(self.chain.gradient)
        return EliminatedFeatures(self.images, keyframes, damping, self.fixes, reduce)

    def factor(self, damping: float) -> Factor:
        """The factor of the normal equations, damped.

        Raises:
            LinAlgError: if they are not positive definite.
        """
        features = self.eliminated(damping)
        return Factor(features, EliminatedStates(features.poses, self.chain, damping))


@dataclass(frozen=True, slots=True, eq=False)
class RecordingCost:
    """All of the cost.

    Attributes:
        inertial: priors, IMU and zero-velocity factors.
        images: the reprojection errors.
        keyframes: number of keyframes.
        fixes: position fixes with variables of their own; None for none.
    """

    inertial: gtsam.NonlinearFactorGraph
    images: ReprojectionCost
    keyframes: int
    fixes: CalibratedFixes | None = None

    def value(self, estimates: Estimates) -> float:
        """The cost."""
        value = float(self.inertial.error(estimates.states)) + self.images.value(estimates)
        if self.fixes is None:
            return value
        return value + self.fixes.value(estimates.states, estimates.fixes)

    def linearized(self, estimates: Estimates) -> LinearCost:
        """All parts linearised."""
        chain = ChainEquations.of(self.inertial.linearize(estimates.states), self.keyframes)
        fixes = None
        if self.fixes is not None:
            fixes = self.fixes.linearized(estimates.states, estimates.fixes)
        return LinearCost(chain, self.images.linearized(estimates), fixes)

    def with_inertial(self, inertial: gtsam.NonlinearFactorGraph) -> RecordingCost:
        """The cost with other priors, IMU and zero-velocity factors."""
        return replace(self, inertial=inertial)
