# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Triangulation: exact without noise, unbiased with it, and honest about what it cannot see."""

import numpy as np
import pytest
from flight import FISHEYE, FORWARD, RADTAN, Flight, rig, room, scene

from slam_graph.arrays import FloatArray
from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.triangulation import (
    Triangulation,
    moved_in_inverse_depth,
    triangulate,
)
from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import Rig

CONFIG = TriangulationConfig()


def seen_from(
    cameras: Rig, points: FloatArray, positions: FloatArray, noise_px: FloatArray | None = None
) -> Observations:
    """Points seen by the first camera from level poses that look along world x."""
    mounted = cameras.cameras[0]
    J, F = len(points), len(positions)
    matrix = mounted.body_T_camera.matrix()
    in_body = points[:, None] - positions[None]
    in_camera = ((in_body - matrix[:3, 3]) @ matrix[:3, :3]).reshape(-1, 3)
    pixels = mounted.camera.distort(in_camera[:, :2] / in_camera[:, 2:])[0]
    if noise_px is not None:
        pixels = pixels + noise_px
    return Observations(
        np.arange(J),
        tuple(range(F)),
        np.repeat(np.arange(J), F),
        np.tile(np.arange(F), J),
        np.zeros(J * F, np.int64),
        pixels,
        mounted.camera.undistort(pixels),
    )


def level(positions: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(3), (len(positions), 3, 3)).copy()


def solve(
    cameras: Rig, obs: Observations, positions: FloatArray, config: TriangulationConfig = CONFIG
) -> Triangulation:
    return triangulate(obs, RigProjection(cameras), level(positions), positions, config)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "equidistant"])
def test_exact_without_noise(count: int, camera: Camera) -> None:
    cameras = rig(count, camera)
    points = room(300, np.random.default_rng(0))
    obs, truth = scene(Flight(), cameras, points, np.linspace(0.0, 2.0, 9))
    result = triangulate(obs, RigProjection(cameras), truth.rotations, truth.positions, CONFIG)
    assert result.good.sum() > 50
    np.testing.assert_allclose(result.points[result.good], truth.points[result.good], atol=1e-6)
    assert result.reprojection_px[result.good].max() < 1e-5


def test_two_rays_are_enough() -> None:
    cameras = rig(1)
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    points = np.array([[3.0, 0.2, 0.1], [8.0, -1.0, 0.5]])
    result = solve(cameras, seen_from(cameras, points, positions), positions)
    assert result.good.all()
    np.testing.assert_allclose(result.points, points, atol=1e-7)


def test_unbiased_within_the_noise() -> None:
    """The mean error over many draws is small beside its own standard error."""
    cameras, rng = rig(1), np.random.default_rng(1)
    positions = np.stack([np.zeros(8), np.linspace(-0.7, 0.7, 8), np.zeros(8)], axis=1)
    points = np.tile([[4.0, 0.3, -0.2]], (3000, 1))
    noise = rng.normal(0.0, 1.0, (len(points) * len(positions), 2))
    result = solve(cameras, seen_from(cameras, points, positions, noise), positions)
    assert result.good.all()
    error = result.points - points
    standard_error = error.std(axis=0) / np.sqrt(len(points))
    # depth is a nonlinear function of the pixels: its bias is of second order, var / depth
    second_order = error.var(axis=0).max() / 4.0
    assert np.all(np.abs(error.mean(axis=0)) < 4 * standard_error + 2 * second_order)
    assert np.all(np.abs(error.mean(axis=0)) < 0.1 * error.std(axis=0))
    # 16 residuals with 3 unknowns leave 13 squared units of variance
    np.testing.assert_allclose(np.mean(result.reprojection_px**2), 13 / 8, rtol=0.03)


def test_the_noise_is_the_best_possible() -> None:
    """The covariance of the result is that of the Gauss-Newton solution (Cramér-Rao)."""
    cameras, rng = rig(1), np.random.default_rng(2)
    positions = np.stack([np.zeros(6), np.linspace(-0.6, 0.6, 6), np.zeros(6)], axis=1)
    truth = np.array([[3.0, 0.2, 0.3]])
    points = np.tile(truth, (3000, 1))
    noise = rng.normal(0.0, 0.5, (len(points) * len(positions), 2))
    error = solve(cameras, seen_from(cameras, points, positions, noise), positions).points - points
    at = seen_from(cameras, truth, positions)
    _, by_point = RigProjection(cameras).jacobians(at, Geometry(level(positions), positions, truth))
    H = by_point.reshape(-1, 3) / 0.5
    bound = np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
    np.testing.assert_allclose(error.std(axis=0), bound, rtol=0.08)


def test_the_depth_is_known_as_well_as_it_says() -> None:
    cameras, rng = rig(1), np.random.default_rng(3)
    positions = np.stack([np.zeros(6), np.linspace(-0.6, 0.6, 6), np.zeros(6)], axis=1)
    points = np.tile([[3.0, 0.2, 0.3]], (3000, 1))
    noise = rng.normal(0.0, 0.5, (len(points) * len(positions), 2))
    result = solve(cameras, seen_from(cameras, points, positions, noise), positions)
    inverse_depth = 1.0 / (result.points[:, 0] - cameras.cameras[0].body_T_camera.x())
    error = inverse_depth.std() / inverse_depth.mean()
    said = 0.5 / cameras.cameras[0].camera.fx * result.depth_error.mean()
    np.testing.assert_allclose(error, said, rtol=0.08)


def test_refuses_what_was_seen_without_parallax() -> None:
    cameras = rig(1)
    still = np.zeros((5, 3))
    points = np.array([[4.0, 0.5, 0.2]])
    assert not solve(cameras, seen_from(cameras, points, still), still).good.any()
    nearly = np.stack([np.zeros(5), np.linspace(0.0, 0.03, 5), np.zeros(5)], axis=1)
    assert not solve(cameras, seen_from(cameras, points, nearly), nearly).good.any()
    ahead = np.stack([np.linspace(0.0, 0.5, 5), np.zeros(5), np.zeros(5)], axis=1)
    on_axis = np.array([[6.0, 0.05, 0.02]])
    assert not solve(cameras, seen_from(cameras, on_axis, ahead), ahead).good.any()


@pytest.mark.parametrize("angle", [0.002, 0.02, 0.1])
def test_parallax_is_the_angle_between_the_rays(angle: float) -> None:
    cameras = rig(1)
    depth = 4.0
    centre = cameras.cameras[0].body_T_camera.matrix()[:3, 3]
    positions = np.array([[0.0, 0.0, 0.0], [0.0, depth * np.tan(angle), 0.0]])
    points = centre + np.array([[depth, 0.0, 0.0]])
    obs = seen_from(cameras, points, positions)
    for threshold, good in ((0.98 * angle, True), (1.02 * angle, False)):
        config = TriangulationConfig(min_parallax_rad=threshold)
        assert bool(solve(cameras, obs, positions, config).good[0]) is good


def test_refuses_what_is_behind_a_camera() -> None:
    """Rays that diverge meet behind the cameras."""
    cameras = rig(1)
    positions = np.array([[0.0, -0.3, 0.0], [0.0, 0.3, 0.0]])
    points = np.array([[4.0, 0.0, 0.0]])
    obs = seen_from(cameras, points, positions)
    swapped = obs.normalized[::-1].copy()
    crossed = Observations(
        obs.ids, obs.frames, obs.feature, obs.frame, obs.camera, obs.pixels[::-1].copy(), swapped
    )
    assert solve(cameras, obs, positions).good.all()
    assert not solve(cameras, crossed, positions).good.any()


def test_refuses_what_one_later_camera_has_behind_it() -> None:
    cameras = rig(1)
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 0.4, 0.0], [5.0, 0.2, 0.0]])
    points = np.array([[4.0, 0.3, 0.1]])  # the third pose has flown past it
    obs = seen_from(cameras, points, positions)
    assert not solve(cameras, obs, positions).good.any()


def test_refuses_what_is_too_near_or_too_far() -> None:
    cameras = rig(1)
    positions = np.stack([np.zeros(4), np.linspace(0.0, 1.5, 4), np.zeros(4)], axis=1)
    points = np.array([[20.0, 0.5, 0.0], [40.0, 0.5, 0.0]])
    obs = seen_from(cameras, points, positions)
    for limit, good in ((15.0, [False, False]), (30.0, [True, False]), (60.0, [True, True])):
        config = TriangulationConfig(max_depth_m=limit)
        assert solve(cameras, obs, positions, config).good.tolist() == good
    for limit, good in ((10.0, [True, True]), (30.0, [False, True])):
        config = TriangulationConfig(min_depth_m=limit)
        assert solve(cameras, obs, positions, config).good.tolist() == good


def test_every_feature_is_solved_as_if_it_were_alone() -> None:
    cameras, rng = rig(2), np.random.default_rng(3)
    obs, truth = scene(Flight(), cameras, room(80, rng), np.linspace(0.0, 2.0, 7), rng)
    projection = RigProjection(cameras)
    together = triangulate(obs, projection, truth.rotations, truth.positions, CONFIG)
    for j in range(len(obs.ids)):
        alone = triangulate(
            obs.subset(np.arange(len(obs.ids)) == j),
            projection,
            truth.rotations,
            truth.positions,
            CONFIG,
        )
        np.testing.assert_allclose(alone.points[0], together.points[j], rtol=1e-4, atol=1e-4)
        assert alone.good[0] == together.good[j]


def test_a_flight_straight_at_the_wall_gives_finite_numbers() -> None:
    cameras, rng = rig(1), np.random.default_rng(4)
    ahead = np.stack([np.linspace(0.0, 2.0, 6), np.zeros(6), np.zeros(6)], axis=1)
    points = np.column_stack([np.full(50, 5.0), rng.uniform(-1.5, 1.5, (50, 2))])
    noise = rng.normal(0.0, 1.0, (300, 2))
    result = solve(cameras, seen_from(cameras, points, ahead, noise), ahead)
    assert np.isfinite(result.points).all()
    assert np.isfinite(result.reprojection_px).all()
    assert FORWARD[0, 2] == 1.0  # the camera looks along the flight


def test_an_increment_in_inverse_depth_is_that_in_metres_to_first_order() -> None:
    rng = np.random.default_rng(4)
    points, centres, increments = rng.normal(size=(3, 50, 3))
    step = 1e-4
    moved = moved_in_inverse_depth(points, step * increments, centres, centres)
    size = np.linalg.norm(points - centres, axis=1, keepdims=True)
    assert np.all(np.abs(moved - points - step * increments) < 100 * step**2 / size)


def test_an_increment_along_a_ray_changes_the_inverse_depth_by_what_it_says() -> None:
    """And never leads through the camera."""
    centres, ray = np.zeros((4, 3)), np.array([0.6, 0.0, 0.8])
    depths, increments = np.array([2.0, 2.0, 2.0, 20.0]), np.array([0.5, -0.5, -100.0, 19.0])
    moved = moved_in_inverse_depth(
        depths[:, None] * ray, increments[:, None] * ray, centres, centres
    )
    found = moved @ ray
    np.testing.assert_allclose(1.0 / found, 1.0 / depths - increments / depths**2, rtol=1e-12)
    np.testing.assert_allclose(moved, found[:, None] * ray, atol=1e-12)
    assert np.all(found > 0.0)
