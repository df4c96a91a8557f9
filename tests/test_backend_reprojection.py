# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Reprojection of many observations at once against GTSAM's factors and numerical derivatives."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from flight import FISHEYE, RADTAN, Flight, rig, room, scene
from gtsam.symbol_shorthand import L, X
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import Rig

PLAIN = replace(RADTAN, distortion="none", coefficients=())
CAMERAS = {"radtan": RADTAN, "equidistant": FISHEYE, "none": PLAIN}
STEP = 1e-6


def native_factor(camera: Camera) -> tuple[Any, Any]:
    """GTSAM's calibration and its projection factor for a camera."""
    intrinsics = (camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    if camera.distortion == "equidistant":
        calibration = gtsam.Cal3Fisheye(*intrinsics, *camera.coefficients)
        return calibration, gtsam.GenericProjectionFactorCal3Fisheye
    coefficients = camera.coefficients or (0.0,) * 4
    return gtsam.Cal3DS2(*intrinsics, *coefficients), gtsam.GenericProjectionFactorCal3DS2


@pytest.fixture(params=CAMERAS)
def case(request: pytest.FixtureRequest) -> tuple[Rig, Observations, Geometry]:
    """Noisy observations by two cameras, and values that do not fit them exactly."""
    rng = np.random.default_rng(7)
    two = rig(2, CAMERAS[request.param])
    times = rng.uniform(0.0, 20.0, 12)
    obs, truth = scene(Flight(), two, room(150, rng), np.sort(times), rng)
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.02, (12, 3))).as_matrix()
    return (
        two,
        obs,
        Geometry(
            truth.rotations @ turns,
            truth.positions + rng.normal(0.0, 0.05, (12, 3)),
            truth.points + rng.normal(0.0, 0.05, truth.points.shape),
        ),
    )


def test_agrees_with_the_native_factors(case: tuple[Rig, Observations, Geometry]) -> None:
    two, obs, at = case
    projection = RigProjection(two)
    residuals, depths = projection.residuals(obs, at)
    by_pose, by_point = projection.jacobians(obs, at)
    assert len(obs) > 500
    assert set(obs.camera.tolist()) == {0, 1}
    unit = gtsam.noiseModel.Unit.Create(2)
    for row in range(len(obs)):
        i, j = int(obs.frame[row]), int(obs.feature[row])
        mounted = two.cameras[int(obs.camera[row])]
        calibration, factor_type = native_factor(mounted.camera)
        factor = factor_type(
            obs.pixels[row], unit, X(i), L(j), calibration, True, False, mounted.body_T_camera
        )
        values = gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(at.rotations[i]), at.positions[i])
        values.insert(X(i), pose)
        values.insert(L(j), at.points[j])
        # whitened GTSAM factors are A δ - b with b = z - h: our residual
        A, b = gtsam.JacobianFactor(factor.linearize(values)).jacobian()
        np.testing.assert_allclose(residuals[row], b, rtol=1e-9, atol=1e-9)
        expected = np.hstack([by_pose[row], by_point[row]])
        np.testing.assert_allclose(expected, A, rtol=1e-9, atol=1e-9)
        camera_T_point = (pose * mounted.body_T_camera).transformTo(at.points[j])
        wide = mounted.camera.model.sees_sideways
        depth = np.linalg.norm(camera_T_point) if wide else camera_T_point[2]
        np.testing.assert_allclose(depths[row], depth, atol=1e-9)


def test_jacobians_are_the_numerical_ones(case: tuple[Rig, Observations, Geometry]) -> None:
    two, obs, at = case
    projection = RigProjection(two)
    by_pose, by_point = projection.jacobians(obs, at)

    def pixels(turn: FloatArray, move: FloatArray, shift: FloatArray) -> FloatArray:
        """Pixels after every pose has been moved by (turn, move) in its body, points by shift."""
        moved = Geometry(
            at.rotations @ Rotation.from_rotvec(turn).as_matrix(),
            at.positions + at.rotations @ move,
            at.points + shift,
        )
        return obs.pixels - projection.residuals(obs, moved)[0]

    for column in range(9):
        step = np.zeros(9)
        step[column] = STEP
        forward = pixels(step[:3], step[3:6], step[6:])
        backward = pixels(-step[:3], -step[3:6], -step[6:])
        numerical = (forward - backward) / (2 * STEP)
        ours = by_pose[:, :, column] if column < 6 else by_point[:, :, column - 6]
        np.testing.assert_allclose(ours, numerical, rtol=1e-6, atol=2e-5)


def test_a_perfect_observation_has_no_residual() -> None:
    two = rig(2)
    times = np.linspace(0.0, 3.0, 7)
    obs, truth = scene(Flight(), two, room(80, np.random.default_rng(0)), times)
    residuals, depths = RigProjection(two).residuals(obs, truth)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-9)
    assert depths.min() > 0.3


def test_moving_the_whole_world_changes_no_residual() -> None:
    """Shifts and rotations of poses and points together are not seen by a camera."""
    rng = np.random.default_rng(1)
    one = rig(1)
    obs, at = scene(Flight(), one, room(80, rng), np.linspace(0.0, 3.0, 7), rng)
    by_pose, by_point = RigProjection(one).jacobians(obs, at)
    R, p, f = at.rotations[obs.frame], at.positions[obs.frame], at.points[obs.feature]
    for axis in np.eye(3):
        shift = np.einsum("nji,j->ni", R, axis)
        change = np.einsum("nij,nj->ni", by_pose[:, :, 3:], shift) + by_point @ axis
        np.testing.assert_allclose(change, 0.0, atol=1e-8)
        turn = np.concatenate([shift, np.einsum("nji,nj->ni", R, np.cross(axis, p))], axis=1)
        change = np.einsum("nij,nj->ni", by_pose, turn)
        change += np.einsum("nij,nj->ni", by_point, np.cross(axis, f))
        np.testing.assert_allclose(change, 0.0, atol=1e-8)


def test_points_behind_the_camera_give_finite_numbers() -> None:
    one = rig(1)
    obs, at = scene(Flight(), one, room(40, np.random.default_rng(2)), np.linspace(0.0, 1.0, 3))
    mirrored = Geometry(at.rotations, at.positions, -at.points)
    residuals, depths = RigProjection(one).residuals(obs, mirrored)
    by_pose, by_point = RigProjection(one).jacobians(obs, mirrored)
    assert (depths < 0).any()
    for values in (residuals, by_pose, by_point):
        assert np.isfinite(values).all()
