# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Error or motion? A test of every track over the last frames.

Under H0 the point of a track is static, under H1 it has a constant velocity u. With the poses as
they are estimated, both are least squares over the observations, and twice the logarithm of the
ratio of their likelihoods is uᵀ Σ⁻¹ u, which under H0 has a χ² distribution of three degrees of
freedom (Neyman and Pearson 1933; Wald 1943). Errors of the poses over the window are those of a
velocity and an angular rate of the cameras. A point at r from the cameras seems to move with the
velocity error, and with the rate's times r; so their covariances add to Σ.

What the cameras do not see does not count: along the ray a stereo pair hardly sees a motion, Σ is
large there, and the test cannot tell. A track is called static only if Σ is small in all
directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.gating import threshold
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.objects.ego_motion import EgoMotion
from slam_graph.backend.objects.objects_config import ObjectsConfig
from slam_graph.kernels.track_motion import motion_steps

_STEPS = 4
"""Gauss-Newton steps for position and velocity."""
_MAX_STEP = 0.5
"""A step moves a point by no more than this part of its depth: it stays before the cameras."""
_MAX_SPEED = 20.0
"""Standard deviation of the velocity before any observation, m/s: it keeps the equations regular
where a camera sees nothing of it."""
_MAX_SHIFT = 100.0
"""The same for the position, m."""
_OFFSET_PX, _DRIFT_PX_S = 0.5, 1.0
"""Standard deviations of slow errors: of a match in another camera, pixels, and of the rate at
which a patch slides off its point, pixels/s. Without them such tracks seem to move slowly."""
_CREEP = 0.05
"""Standard deviation, m/s, of the speed with which a static track may seem to move beside that."""
_NUISANCES = 6
_PRIOR_SIGMAS = np.repeat([_MAX_SHIFT, _MAX_SPEED, _OFFSET_PX, _DRIFT_PX_S], [3, 3, 2, 4])
_OBJECT_SPEED = 1.0
"""Standard deviation of each component of the velocity of what moves, m/s, for its probability."""
_PRIOR_ODDS = 0.05
"""Tracks that move to tracks that are static, before they are tested."""
_MISFIT = 1e-6
"""Probability of a track's errors under the better of the two below which it is a wrong match."""


class Verdict(IntEnum):
    """What the test says of a track."""

    UNKNOWN = 0
    STATIC = 1
    MOVING = 2
    WRONG = 3
    """It fits neither: a wrong match, or it does not move evenly."""


@dataclass(frozen=True, eq=False)
class MotionTest:
    """The result for J tracks.

    Attributes:
        ids: (J,) ascending.
        points: (J, 3) where they are now in the world.
        velocities: (J, 3) m/s.
        covariances: (J, 3, 3) of the velocities, with the errors of the poses.
        statistics: (J,) uᵀ Σ⁻¹ u.
        verdicts: (J,) each a `Verdict`.
        misfits: (J,) squared errors under a constant velocity, over what is expected.
    """

    ids: IntArray
    points: FloatArray
    velocities: FloatArray
    covariances: FloatArray
    statistics: FloatArray
    verdicts: IntArray
    misfits: FloatArray

    @staticmethod
    def empty() -> MotionTest:
        """Of no tracks."""
        none, vectors = np.zeros(0), np.zeros((0, 3))
        ids = np.zeros(0, np.int64)
        return MotionTest(ids, vectors, vectors, np.zeros((0, 3, 3)), none, ids, none)

    @cached_property
    def probabilities(self) -> FloatArray:
        """(J,) that each moves; not every test is asked for them."""
        return _probabilities(self.velocities, self.covariances, self.statistics)

    @cached_property
    def moves(self) -> BoolArray:
        """(J,) whose verdict is MOVING or WRONG."""
        return np.asarray((self.verdicts == Verdict.MOVING) | (self.verdicts == Verdict.WRONG))

    def of(self, verdict: Verdict) -> IntArray:
        """Ids (N,) of the tracks with a verdict, ascending."""
        return np.asarray(self.ids[self.verdicts == verdict])


def judge_tracks(
    obs: Observations,
    rig: RigProjection,
    ego: EgoMotion,
    sigma_px: float,
    backend: BackendConfig,
    config: ObjectsConfig,
) -> MotionTest:
    """Test tracks.

    Args:
        obs: of frames of `ego`, by their numbers there; each feature at least twice.
        rig: the cameras.
        ego: the poses.
        sigma_px: standard deviation of the observations.
        backend: thresholds of triangulation.
        config: error rate and speed.
    """
    if len(obs) == 0:
        return MotionTest.empty()
    frames = np.array(obs.frames)
    rotations, positions = (a[frames] for a in ego.arrays())
    seconds = ego.seconds[frames]
    count = len(obs.ids)
    points = _first_points(obs, rig, rotations, positions, backend)
    points, velocities, Sigma, squares = _fit(
        obs, rig, rotations, positions, seconds, points, sigma_px
    )
    offset = points - ego.state.world_T_body.translation()
    arm = _cross_matrices(offset)
    Sigma = (
        Sigma
        + _CREEP**2 * np.eye(3)
        + ego.velocity_covariance
        + arm @ ego.rate_covariance @ arm.transpose(0, 2, 1)
    )
    statistics = _statistics(velocities, Sigma)
    dof = np.maximum(2 * obs.counts - 6, 1)
    verdicts = np.full(count, int(Verdict.UNKNOWN))
    largest = np.sqrt(np.linalg.eigvalsh(Sigma)[:, -1])
    moving = statistics > chdtri(3, config.false_alarm)
    speed = np.linalg.norm(velocities, axis=1)
    verdicts[~moving & (speed + 2.0 * largest < config.min_speed)] = Verdict.STATIC
    verdicts[moving] = Verdict.MOVING
    verdicts[squares > threshold(dof, 1.0 - _MISFIT)] = Verdict.WRONG
    return MotionTest(
        obs.ids,
        points,
        velocities,
        Sigma,
        statistics,
        verdicts,
        squares / dof,
    )


def _first_points(
    obs: Observations,
    rig: RigProjection,
    rotations: FloatArray,
    positions: FloatArray,
    backend: BackendConfig,
) -> FloatArray:
    """Positions (J, 3) from which the fit begins: those in the last frame, if two cameras saw it.

    What moves is not where its rays of different times meet. Far points are put at the largest
    depth that counts, where no motion is seen of them.
    """
    config = backend.triangulation
    points = np.empty((len(obs.ids), 3))
    last = obs.rows(obs.frame == len(obs.frames) - 1)
    paired = last.counts >= 2
    for rows, part in ((~paired, obs.subset(~paired)), (paired, last.subset(paired))):
        if len(part):
            points[rows] = triangulate(part, rig, rotations, positions, config).points
    now = obs.starts[1:] - 1
    camera_p = positions[obs.frame[now]]
    rays = np.column_stack([obs.normalized[now], np.ones(len(now))])
    world_R = rotations[obs.frame[now]] @ rig.body_R_camera[obs.camera[now]]
    ahead = np.einsum("nij,nj->ni", world_R, rays)
    depth = np.einsum("ni,ni->n", points - camera_p, world_R[:, :, 2])
    bad = ~np.isfinite(depth) | (depth < config.min_depth_m) | (depth > config.max_depth_m)
    points[bad] = (camera_p + config.max_depth_m * ahead)[bad]
    return points


def _fit(
    obs: Observations,
    rig: RigProjection,
    rotations: FloatArray,
    positions: FloatArray,
    seconds: FloatArray,
    points: FloatArray,
    sigma_px: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Position now and velocity (J, 3), its covariance (J, 3, 3), squared errors (J,) over σ²."""
    J, N = len(obs.ids), len(obs)
    alone = replace(obs, feature=np.arange(N))  # every observation has a point of its own
    since, reach = seconds[obs.frame] + rig.row_times_s(obs), float(-seconds.min())
    x = np.hstack([points, np.zeros((J, 3 + _NUISANCES))])
    prior = obs.starts, x.copy(), _PRIOR_SIGMAS**-2.0
    shares = _shares(obs, since) / sigma_px
    seen, squares, covariances = points[obs.feature], np.empty(J), np.empty((J, 3, 3))
    for step in range(_STEPS + 1):
        last = step == _STEPS  # tells how well the tracks are known
        at = Geometry(rotations, positions, seen)
        views = rig.views(alone, at)
        by_point = rig.derivatives(alone, at, views)[1]
        system = by_point, obs.pixels - views.pixels, views.in_camera, shares, since, *prior
        limits = sigma_px, reach, 0.0 if last else _MAX_STEP
        motion_steps(*system, *limits, x, seen, squares, covariances if last else covariances[:0])
    return x[:, :3], x[:, 3:6], covariances, squares


def _shares(obs: Observations, since: FloatArray) -> FloatArray:
    """Derivatives (N, 3) of each pixel coordinate by offset and two drifts; see `_OFFSET_PX`."""
    second = (obs.camera > 0).astype(np.float64)
    return np.stack([second, (1.0 - second) * since, second * since], axis=1)


def _probabilities(velocities: FloatArray, Sigma: FloatArray, statistics: FloatArray) -> FloatArray:
    """(J,) that a track moves, by the Bayes factor of the two hypotheses."""
    wide = Sigma + _OBJECT_SPEED**2 * np.eye(3)
    moving = _log_density(wide, _statistics(velocities, wide))
    log_odds = np.log(_PRIOR_ODDS) + moving - _log_density(Sigma, statistics)
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0))))


def _statistics(velocities: FloatArray, P: FloatArray) -> FloatArray:
    """(J,) uᵀ P⁻¹ u."""
    solved = np.linalg.solve(P, velocities[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("ji,ji->j", velocities, solved))


def _log_density(P: FloatArray, squares: FloatArray) -> FloatArray:
    """Logarithms (J,) of the densities of normal distributions but for a constant."""
    return np.asarray(-0.5 * (squares + np.linalg.slogdet(P)[1]))


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    """Matrices (N, 3, 3) of the cross products with vectors (N, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -z, y, -x
    result[:, 1, 0], result[:, 2, 0], result[:, 2, 1] = z, -y, x
    return result
