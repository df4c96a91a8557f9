# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features of GTSAM's smoothers: which are variables, and which observations become factors.

A feature enters with all its observations in the lag once these determine its position. Every later
state that sees it adds one observation. It leaves when no state in the lag has seen it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations, Outcome, is_in
from slam_graph.backend.cost.gating import Innovations, squared_mahalanobis, threshold
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.policies import SmootherPolicy
from slam_graph.backend.solve.square_root import SquareRootInformation
from slam_graph.backend.solve.stacked_values import stacked_points, stacked_poses
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import ConfigError
from slam_graph.sensors import Camera, Rig


def calibration(camera: Camera) -> tuple[Any, Any]:
    """GTSAM's calibration of a camera, and the type of its projection factor.

    Raises:
        ConfigError: if GTSAM has no such camera model.
    """
    model = camera.gtsam_calibration()
    if model is None:
        raise ConfigError(
            f"GTSAM's smoothers have no camera with distortion '{camera.distortion}'; "
            "choose another algorithm"
        )
    return model, getattr(gtsam, f"GenericProjectionFactor{type(model).__name__}")


def pixel_noise(sigma_px: float, loss: RobustLoss) -> gtsam.noiseModel.Base:
    """Noise model of an observation under a robust loss."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_px)
    estimators = gtsam.noiseModel.mEstimator
    if loss.name == "huber":
        return gtsam.noiseModel.Robust.Create(estimators.Huber.Create(loss.width), noise)
    if loss.name == "cauchy":
        return gtsam.noiseModel.Robust.Create(estimators.Cauchy.Create(loss.width), noise)
    return noise


class ProjectionFactors:
    """Makes the projection factors of the cameras of a rig."""

    def __init__(self, rig: Rig, noise: gtsam.noiseModel.Base) -> None:
        self._noise = noise
        self._cameras = [(*calibration(c.camera), c.body_T_camera) for c in rig.cameras]

    def of(
        self, obs: Observations, rolling: RigProjection | None = None
    ) -> list[gtsam.NonlinearFactor]:
        """One factor between `X(frame)` and `L(feature)` for each observation.

        For a point behind the camera the cost is constant; no exception is raised.

        Args:
            obs: the observations.
            rolling: says where the cameras were at the observed rows, if it has rolling shutters.
        """
        factors = []
        mounts = [self._cameras[c][2] for c in obs.camera.tolist()]
        if rolling is not None and rolling.rolling:
            mounts = rolling.mount_poses(obs)
        poses, points = [X(i) for i in obs.frames], [L(j) for j in obs.ids.tolist()]
        rows = zip(
            obs.pixels,
            obs.camera.tolist(),
            obs.frame.tolist(),
            obs.feature.tolist(),
            mounts,
            strict=True,
        )
        for pixel, c, i, j, body_T_camera in rows:
            model, factor, _ = self._cameras[c]
            keys = (poses[i], points[j])
            factors.append(factor(pixel, self._noise, *keys, model, False, False, body_T_camera))
        return factors


def joint_prior(prior: SquareRootInformation, at: gtsam.Values) -> gtsam.NonlinearFactor:
    """A Gaussian on pose, velocity and bias of one frame as one factor, with all correlations.

    Args:
        prior: ‖R δ - d‖² on exactly these three variables.
        at: the linearisation point, at which δ is zero.
    """
    (x, A_x), (v, A_v), (b, A_b) = (
        (key, prior.R[:, columns]) for key, columns in prior.layout.columns.items()
    )
    noise = gtsam.noiseModel.Unit.Create(prior.layout.size)
    gaussian = gtsam.JacobianFactor(x, A_x, v, A_v, b, A_b, prior.d, noise)
    return gtsam.LinearContainerFactor(gaussian, at)


def features_given_pose(
    prior: SquareRootInformation, at: gtsam.Values, ids: IntArray, pose: int
) -> list[gtsam.NonlinearFactor]:
    """What is known of features given a pose, as a factor for each; what they share is left out.

    Args:
        prior: ‖R δ - d‖² on the features, the pose and others.
        at: the linearisation point, at which δ is zero.
        ids: (N,) of the features.
        pose: key of the pose.
    """
    factors: list[gtsam.NonlinearFactor] = []
    for j in ids.tolist():
        known = prior.marginal([L(j), pose])
        of_point, of_pose = (known.layout.columns[key] for key in (L(j), pose))
        R, noise = known.R[:3], gtsam.noiseModel.Unit.Create(3)
        rows = gtsam.JacobianFactor(L(j), R[:, of_point], pose, R[:, of_pose], known.d[:3], noise)
        factors.append(gtsam.LinearContainerFactor(rows, at))
    return factors


_GATE_SCALE = 4.0
"""The gate knows the covariance of the pose only, not of the feature: it is this much wider."""
OUTLIER_SIGMAS = 3.0
"""Features with a larger root mean square reprojection error do not enter, in units of σ."""


@dataclass(eq=False)
class NewObservations:
    """What the images add to the graph at one state.

    Attributes:
        factors: one for each observation.
        points: the features that enter.
        seen: keys of all features with a new observation.
    """

    factors: list[gtsam.NonlinearFactor] = field(default_factory=list)
    points: gtsam.Values = field(default_factory=gtsam.Values)
    seen: list[int] = field(default_factory=list)


class SmootherFeatures:
    """Chooses features and makes their factors.

    Attributes:
        active: ids (N,) of the features that are variables, ascending.
        rejected: ids (N,) of those of which the gate rejected an observation of the newest state.
        innovations: of the observations of the newest state, under a predicted covariance without
            that of the features.
    """

    def __init__(
        self, rig: Rig, policy: SmootherPolicy, config: BackendConfig, diagnostics: Diagnostics
    ) -> None:
        self.active = np.zeros(0, np.int64)
        self.rejected = np.zeros(0, np.int64)
        self.innovations = Innovations()
        self._policy = policy
        self._config = config
        self._diagnostics = diagnostics
        self._rig = RigProjection(rig)
        self._factors = ProjectionFactors(
            rig, pixel_noise(config.noise.pixel_sigma, RobustLoss(policy.robust_loss))
        )

    def retain(self, estimate: gtsam.Values) -> None:
        """Forget the features that are not variables any more."""
        kept = [j for j in self.active.tolist() if estimate.exists(L(j))]
        self.active = np.array(kept, np.int64)

    def move(self, motions: Mapping[int, FrameMotion]) -> None:
        """Take the motions of all frames in the lag, by which rows of rolling shutters moved."""
        self._rig = self._rig.moving(motions)

    def observe(
        self, tracks: FeatureTracks, frame: int, estimate: gtsam.Values, covariance: FloatArray
    ) -> NewObservations:
        """The observations of the graph's newest state.

        Args:
            tracks: observations that are not in the graph.
            frame: index of the newest state.
            estimate: of the poses in `tracks`, the newest one predicted, and of the features.
            covariance: (6, 6) of the predicted pose.
        """
        new = NewObservations()
        seen = np.intersect1d(self.active, tracks.ids_in(frame), True)
        again = tracks.observations(seen, [frame])
        tracks.remove(Outcome.ABSORBED, self.active)
        again = again.rows(self._gate(again, estimate, covariance))
        ids = np.unique(again.ids[again.feature])
        self._add(new, again, ids)
        room = self._policy.max_features - len(ids)
        entering, points = self._entering(tracks, frame, estimate, room)
        for j, point in zip(entering.ids.tolist(), points, strict=True):
            new.points.insert(L(j), point)
        self._add(new, entering, entering.ids)
        tracks.remove(Outcome.ABSORBED, entering.ids)
        self.active = np.union1d(self.active, entering.ids)
        return new

    def _add(self, new: NewObservations, obs: Observations, ids: IntArray) -> None:
        new.factors += self._factors.of(obs, self._rig)
        new.seen += [L(j) for j in ids.tolist()]

    def _gate(self, obs: Observations, estimate: gtsam.Values, covariance: FloatArray) -> BoolArray:
        """Which observations (N,) agree with the predicted pose."""
        self.rejected = np.zeros(0, np.int64)
        self.innovations = Innovations()
        if len(obs) == 0:
            return np.zeros(0, np.bool_)
        at = Geometry(*stacked_poses(estimate, obs.frames), stacked_points(estimate, obs.ids))
        residuals, depths = self._rig.residuals(obs, at)
        by_pose, _ = self._rig.jacobians(obs, at)
        sigma = self._config.noise.pixel_sigma
        distances = squared_mahalanobis(residuals / sigma, by_pose / sigma, covariance)
        dof = np.full(len(obs), 2)
        largest = _GATE_SCALE * threshold(dof, self._config.gating.confidence)
        good = (distances < largest) & (depths > 0.0)
        self.rejected = np.unique(obs.ids[obs.feature[~good]])
        self.innovations = Innovations.of(distances, dof, largest, good)
        self._diagnostics.counts["feature_rejected_by_gate"] += self.innovations.rejected
        return np.asarray(good)

    def _entering(
        self, tracks: FeatureTracks, frame: int, estimate: gtsam.Values, room: int
    ) -> tuple[Observations, FloatArray]:
        """New variables: the longest current tracks that determine a point."""
        ids, lengths = tracks.lengths()
        ready = (lengths >= self._policy.feature_frames) & is_in(ids, tracks.ids_in(frame))
        ids, lengths = ids[ready], lengths[ready]
        obs = tracks.observations(ids)
        if len(ids) == 0 or room <= 0:
            return obs.subset(np.zeros(len(ids), np.bool_)), np.zeros((0, 3))
        poses = stacked_poses(estimate, obs.frames)
        result = triangulate(
            obs, self._rig, *poses, self._config.triangulation, self._policy.feature_parallax_rad
        )
        fits = result.reprojection_px < OUTLIER_SIGMAS * self._config.noise.pixel_sigma
        good = result.good & fits
        longest = np.argsort(-np.where(good, lengths, 0), kind="stable")[:room]
        chosen = np.zeros(len(ids), np.bool_)
        chosen[longest] = True
        chosen &= good
        return obs.subset(chosen), result.points[chosen]
