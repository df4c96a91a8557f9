# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Free poses of a body, and what they tell a review."""

import gtsam
import numpy as np
import pytest

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.objects.ego_motion import pose_arrays
from slam_graph.backend.objects.free_motion import freely_fitted
from slam_graph.simulation.simulator import euroc_rig

FRAMES, POINTS = 5, 12
RIG, DEPTHS = RigProjection(euroc_rig()), TriangulationConfig()


def seen(poses: list[gtsam.Pose3], points: FloatArray, sigma_px: float) -> Observations:
    """Observations of all points by both cameras in all frames."""
    feature, frame, camera = (
        values.ravel()
        for values in np.meshgrid(*map(np.arange, (POINTS, FRAMES, 2)), indexing="ij")
    )
    none, numbers = np.zeros((len(feature), 2)), tuple(range(FRAMES))
    obs = Observations(np.arange(POINTS), numbers, feature, frame, camera, none, none)
    pixels = RIG.views(obs, Geometry(*pose_arrays(tuple(poses)), points)).pixels
    pixels = pixels + np.random.default_rng(3).normal(0.0, sigma_px, pixels.shape)
    rays = none.copy()
    for number, lens in enumerate(RIG.cameras):
        rays[camera == number] = lens.undistort(pixels[camera == number])
    return Observations(obs.ids, numbers, feature, frame, camera, pixels, rays)


def scene() -> tuple[list[gtsam.Pose3], FloatArray]:
    """Poses of the platform relative to a body 3 m ahead that turns, and points of the body."""
    rng = np.random.default_rng(2)
    ahead = euroc_rig().cameras[0].body_T_camera
    box = rng.uniform(-0.5, 0.5, (3, POINTS)) + np.array([[0.0], [0.0], [3.0]])
    points = ahead.transformFrom(box).T
    steps = [np.r_[0.03, -0.02, 0.04, 0.01, 0.02, -0.03] * k for k in range(FRAMES)]
    return [gtsam.Pose3.Expmap(step) for step in steps], np.ascontiguousarray(points)


@pytest.mark.parametrize("turn_rad", [0.0, 0.01, 0.05])
def test_free_poses_are_the_true_ones_without_noise(turn_rad: float) -> None:
    poses, points = scene()
    obs = seen(poses, points, 0.0)
    off = [pose.retract(np.full(6, turn_rad * k)) for k, pose in enumerate(poses)]
    found = freely_fitted(obs, RIG, off, points + turn_rad, 0.5, RobustLoss("none"))
    for one, other in zip(found, poses, strict=True):
        relative = gtsam.Pose3.Logmap(found[0].between(one)) - gtsam.Pose3.Logmap(
            poses[0].between(other)
        )
        assert np.abs(relative).max() < 1e-6


def test_free_poses_fit_better_than_the_true_ones() -> None:
    poses, points = scene()
    obs = seen(poses, points, 0.5)
    found = freely_fitted(obs, RIG, poses, points, 0.5, RobustLoss("none"))
    assert found[0].equals(poses[0], 1e-5)  # it defines the frame
    fitted, true = (
        np.sum(triangulate(obs, RIG, *pose_arrays(tuple(of)), DEPTHS).reprojection_px ** 2)
        for of in (found, poses)
    )
    assert fitted < true


def test_poses_stay_that_nothing_has_seen() -> None:
    poses, points = scene()
    obs = seen(poses, points, 0.0)
    obs = obs.rows(obs.frame != 2).without_idle_frames()
    found = freely_fitted(obs, RIG, poses, points, 0.5, RobustLoss("none"))
    assert found[2].equals(poses[2], 0.0)
