# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of wide lenses: errors count in pixels, up to the edge of the image."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from flight import GRAVITY, Flight, rig, room
from numpy.typing import NDArray

from slam_graph.backend.backend_config import TriangulationConfig
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import Geometry, RigProjection
from slam_graph.backend.cost.triangulation import triangulate
from slam_graph.backend.initialization.visual_inertial_alignment import Motion, align
from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.frontend.epipolar_test import EpipolarTest, distances_px, fitted_motion
from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.outliers import essential_matrix
from slam_graph.pipeline import run
from slam_graph.sensors import Camera, FeatureFrame, ImuNoise, Rig
from slam_graph.simulation.simulator import euroc_rig, simulate

Array = NDArray[np.float64]

FISHEYE = Camera(154.0, 154.0, 255.5, 255.5, "equidistant", (0.0, 0.0, 0.0, 0.0), 512, 512)
SPHERES = Camera(155.0, 155.0, 255.5, 255.5, "double_sphere", (-0.2, 0.58), 512, 512)
MEI = Camera(420.0, 420.0, 255.5, 255.5, "mei", (1.6, 0.0, 0.0, 0.0, 0.0), 512, 512)
WIDE = [FISHEYE, SPHERES, MEI]
B_T_A = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.02, -0.03, 0.01])), [0.2, -0.05, 0.1])
each_lens = pytest.mark.parametrize("camera", WIDE, ids=lambda c: c.distortion)


def matches(camera: Camera, count: int, noise_px: float, seed: int) -> tuple[Array, Array]:
    """Normalised points (N, 2) of one scene in two images, up to 83° off the axis."""
    rng = np.random.default_rng(seed)
    angle = np.deg2rad(82.0) * np.sqrt(rng.random(4 * count))
    around = rng.uniform(0.0, 2 * np.pi, 4 * count)
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around)], axis=1)
    in_a = np.column_stack([rays, np.cos(angle)]) * rng.uniform(1.5, 8.0, (4 * count, 1))
    in_b = np.asarray(B_T_A.transformFrom(in_a.T)).T
    seen = in_b[:, 2] > 0.12 * np.linalg.norm(in_b, axis=1)
    pixels = [camera.project(p[seen][:count]) for p in (in_a, in_b)]
    m = [camera.undistort(p + rng.normal(0.0, noise_px, p.shape)) for p in pixels]
    return m[0], m[1]


@each_lens
def test_the_epipolar_distance_is_the_smallest_correction_in_pixels(camera: Camera) -> None:
    """At a match that fits, its gradient by the four pixel coordinates has length one."""
    m_a, m_b = matches(camera, 60, 0.0, 0)
    E, step = essential_matrix(B_T_A), 1e-3
    assert np.max(distances_px(camera, E, m_a, m_b)) < 1e-6
    squares = np.zeros(len(m_a))
    for side in (0, 1):
        for axis in np.eye(2):
            moved = [m_a, m_b]
            moved[side] = camera.undistort(camera.distort(moved[side])[0] + step * axis)
            squares += (distances_px(camera, E, moved[0], moved[1]) / step) ** 2
    np.testing.assert_allclose(squares, 1.0, rtol=2e-2)


@each_lens
@pytest.mark.parametrize("method", ["fundamental", "gyroscope"])
def test_matches_at_the_edge_are_told_from_wrong_ones(camera: Camera, method: str) -> None:
    m_a, m_b = matches(camera, 200, 0.15, 1)
    wrong = np.arange(len(m_b)) % 4 == 0
    rng = np.random.default_rng(2)
    pixels = camera.distort(m_b)[0]
    pixels[wrong] += 25.0 * np.sign(255.5 - pixels[wrong]) * rng.uniform(0.3, 1.0, (wrong.sum(), 2))
    test = EpipolarTest(camera, FrontendConfig(outliers=method), rng)  # type: ignore[arg-type]
    inlier = test.inliers(m_a, camera.undistort(pixels), B_T_A.rotation().matrix())
    edge = np.linalg.norm(m_a, axis=1) > np.tan(np.deg2rad(70))
    assert edge.sum() > 30
    assert np.mean(inlier[~wrong & edge]) > 0.97
    assert np.mean(inlier[~wrong]) > 0.97
    assert np.mean(inlier[wrong]) < 0.25  # some are off along their epipolar lines


@each_lens
def test_a_motion_fits_all_of_the_image(camera: Camera) -> None:
    m_a, m_b = matches(camera, 150, 0.0, 3)
    F, E = fitted_motion(camera, m_a, m_b), essential_matrix(B_T_A)
    F, E = F / np.linalg.norm(F), E / np.linalg.norm(E)
    assert min(np.linalg.norm(F - E), np.linalg.norm(F + E)) < 1e-6


def observed(
    camera: Camera, at: Geometry, noise_px: float, rng: np.random.Generator
) -> tuple[RigProjection, Observations]:
    """All features of a scene in all frames that see them less than 82° off the axis."""
    frames, count = len(at.positions), len(at.points)
    projection, n = RigProjection(rig(1, camera)), frames * len(at.points)
    feature, frame = np.repeat(np.arange(count), frames), np.tile(np.arange(frames), count)
    zeros, nothing = np.zeros(n, np.int64), np.zeros((n, 2))
    ids, numbers = np.arange(count), tuple(range(frames))
    obs = Observations(ids, numbers, feature, frame, zeros, nothing, nothing)
    in_camera = projection.in_camera(obs, projection.in_body(obs, at))
    seen = in_camera[:, 2] > np.cos(np.deg2rad(82)) * np.linalg.norm(in_camera, axis=1)
    pixels = rng.normal(0.0, noise_px, (n, 2))
    pixels[seen] += projection.pixels(obs.rows(seen), in_camera[seen])[0]
    normalized = np.zeros((n, 2))
    normalized[seen] = camera.undistort(pixels[seen])
    return projection, replace(obs, pixels=pixels, normalized=normalized).rows(seen)


def passing(
    camera: Camera, copies: int, noise_px: float
) -> tuple[RigProjection, Observations, Geometry]:
    """A point 47 to 80° off the axis, seen from eight places, `copies` times."""
    positions = np.column_stack([np.linspace(0.0, 1.6, 8), np.zeros(8), np.zeros(8)])
    points = np.tile([[2.0, 2.2, 0.3]], (copies, 1))
    at = Geometry(np.tile(np.eye(3), (8, 1, 1)), positions, points)
    return *observed(camera, at, noise_px, np.random.default_rng(4)), at


@each_lens
def test_a_point_at_the_edge_is_triangulated_as_well_as_can_be(camera: Camera) -> None:
    """Its covariance is that of the solution in pixels (Cramér-Rao), and so is the depth's σ."""
    sigma_px = 0.5
    projection, obs, at = passing(camera, 2000, sigma_px)
    found = triangulate(obs, projection, at.rotations, at.positions, TriangulationConfig())
    assert found.good.all()
    one = obs.subset(np.arange(len(obs.ids)) == 0)
    _, by_point = projection.jacobians(one, at)
    H = by_point.reshape(-1, 3) / sigma_px
    bound = np.sqrt(np.diag(np.linalg.inv(H.T @ H)))
    np.testing.assert_allclose((found.points - at.points).std(axis=0), bound, rtol=0.08)
    forward = projection.body_R_camera[0][:, 2]
    spread = np.std((found.points - at.points) @ forward)
    depth = float((at.points[0] - projection.body_p_camera[0]) @ forward)
    stated = np.median(found.depth_error) * sigma_px / camera.fx
    np.testing.assert_allclose(stated, spread / depth, rtol=0.1)


@each_lens
def test_weights_make_the_start_better(camera: Camera) -> None:
    """Velocity by the closed-form alignment, with noisy points up to the edge of the image."""
    flight, times = Flight(), np.linspace(0.0, 1.2, 9)
    rng = np.random.default_rng(5)
    first = flight.rotation(times[:1]).as_matrix()[0]
    v, g = flight.velocities(times[:1])[0], GRAVITY
    t = times[:, None]
    moved = flight.positions(times) - flight.positions(times[:1]) - v * t - 0.5 * g * t**2
    speeds = flight.velocities(times) - v - g * t
    rotations = first.T @ flight.rotation(times).as_matrix()
    motion = Motion(times, rotations, moved @ first, speeds @ first)
    errors = []
    for _ in range(6):
        points = room(150, rng)
        at = Geometry(flight.rotation(times).as_matrix(), flight.positions(times), points)
        projection, obs = observed(camera, at, 0.5, rng)
        obs = obs.subset(obs.counts >= 3)
        for weighted in (True, False):
            projection.wide = weighted
            found = align(obs, motion, projection, 9.81)
            assert found is not None
            errors.append(np.linalg.norm(found.velocity - v @ first))
    weighted, plain = np.mean(errors[::2]), np.mean(errors[1::2])
    assert weighted < 0.08
    assert weighted < 0.5 * plain


def test_a_run_uses_the_edge_of_a_fisheye(tmp_path: Path) -> None:
    """Simulated tracks of half a pixel up to 84° off the axis, one camera, 6 s."""
    mounted = euroc_rig().cameras[0]
    write_kalibr(Rig((replace(mounted, camera=FISHEYE),), ImuNoise()), tmp_path / "lens.yaml")
    sequence = simulate(
        calibration=tmp_path / "lens.yaml",
        duration_s=6.0,
        seed=2,
        tracks={"features": 150, "pixel_sigma": 0.5},
    )
    frame = next(iter(sequence.packets())).frame
    assert isinstance(frame, FeatureFrame)
    length = np.linalg.norm(frame.cameras[0].normalized, axis=1)
    assert np.mean(length > np.tan(np.deg2rad(70))) > 0.2
    result = run(sequence, algorithm="msckf", overrides=["final_ba.enabled=false"])
    result.check()
    assert result.metrics["accuracy"]["yaw"]["ate"]["translation_m"]["rmse"] < 0.0125
