# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the epipolar checks, on random scenes."""

from typing import Literal

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from slam_graph.frontend.frontend_config import FrontendConfig
from slam_graph.frontend.outliers import (
    coherent_groups,
    direction_inliers,
    eight_point,
    epipolar_distance,
    essential_matrix,
    fundamental_inliers,
    map_inliers,
)
from slam_graph.kernels.epipolar import ray_depths

FOCAL_PX = 450.0
Method = Literal["fundamental", "essential", "magsac", "gyroscope"]
B_T_A = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.05, -0.1, 0.02])), [0.2, -0.05, 0.1])


def scene(
    rng: np.random.Generator, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Normalised coordinates (N, 2) in a and b, and depths (N, 2) there."""
    depth_m = rng.uniform(1, 8, count)
    in_a = np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)), np.ones(count)]) * depth_m[:, None]
    in_b = np.asarray(B_T_A.transformFrom(in_a.T)).T
    depths_m = np.column_stack([in_a[:, 2], in_b[:, 2]])
    return in_a[:, :2] / in_a[:, 2:], in_b[:, :2] / in_b[:, 2:], depths_m


def depths_of(
    b_T_a: gtsam.Pose3, m_a: NDArray[np.float64], m_b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Depths (N, 2) of matches in a and b."""
    R = np.ascontiguousarray(b_T_a.rotation().matrix())
    return ray_depths(R, np.array(b_T_a.translation()), m_a, m_b)


def test_true_matches_fit_the_essential_matrix_and_triangulate() -> None:
    m_a, m_b, depths_m = scene(np.random.default_rng(0), 50)
    assert np.max(epipolar_distance(essential_matrix(B_T_A), m_a, m_b)) < 1e-12
    np.testing.assert_allclose(depths_of(B_T_A, m_a, m_b), depths_m, rtol=1e-9)


def test_epipolar_distance_is_the_smallest_correction() -> None:
    m_a, m_b, _ = scene(np.random.default_rng(1), 200)
    E = essential_matrix(B_T_A)
    line = np.column_stack([m_a, np.ones(len(m_a))]) @ E.T
    normal = line[:, :2] / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    # An error e across the line in one image only is shared between both by Sampson's distance
    distance = epipolar_distance(E, m_a, m_b + 1e-5 * normal)
    assert np.all(distance < 1e-5)
    assert np.all(distance > 0.5e-5)


def test_parallel_rays_are_infinitely_far_away() -> None:
    sideways = gtsam.Pose3(gtsam.Rot3(), [-0.1, 0, 0])
    m = np.array([[0.1, 0.2]])
    assert np.all(np.isinf(depths_of(sideways, m, m)))
    behind = depths_of(sideways, m, m + np.array([0.01, 0.0]))
    assert np.all(behind < 0)


def test_without_a_baseline_nothing_is_rejected() -> None:
    still = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.1, 0, 0])), [0.0, 0, 0])
    m = np.random.default_rng(2).normal(size=(10, 2))
    np.testing.assert_array_equal(epipolar_distance(essential_matrix(still), m, m), 0.0)


def test_eight_points_give_the_essential_matrix_up_to_scale() -> None:
    m_a, m_b, _ = scene(np.random.default_rng(3), 40)
    F, E = eight_point(m_a, m_b), essential_matrix(B_T_A)
    F, E = F / np.linalg.norm(F), E / np.linalg.norm(E)
    assert min(np.linalg.norm(F - E), np.linalg.norm(F + E)) < 1e-6


def noisy_scene(
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Matches (200, 2) in a and b, with the indices of the 50 that are wrong."""
    m_a, m_b, _ = scene(rng, 200)
    m_b += rng.normal(scale=0.2 / FOCAL_PX, size=m_b.shape)
    wrong = rng.permutation(200)[:50]
    m_b[wrong] += rng.uniform(-40, 40, (50, 2)) / FOCAL_PX
    return m_a, m_b, wrong


@pytest.mark.parametrize("method", ["fundamental", "essential", "magsac", "gyroscope"])
@pytest.mark.parametrize("seed", range(5))
def test_outliers_are_found_among_noisy_matches(seed: int, method: Method) -> None:
    m_a, m_b, wrong = noisy_scene(np.random.default_rng(seed))
    config = FrontendConfig(outliers=method)

    def found() -> NDArray[np.bool_]:
        if method != "gyroscope":
            return fundamental_inliers(m_a, m_b, FOCAL_PX, config)
        R = B_T_A.rotation().matrix()
        return direction_inliers(m_a, m_b, R, FOCAL_PX, config, np.random.default_rng(seed))

    true_distance_px = epipolar_distance(essential_matrix(B_T_A), m_a, m_b) * FOCAL_PX
    inlier = found()
    right = np.setdiff1d(np.arange(200), wrong)
    assert np.mean(inlier[right]) > 0.97
    assert not np.any(inlier[true_distance_px > 3.0])
    np.testing.assert_array_equal(inlier, found())


def test_with_the_rotation_known_the_majority_may_be_wrong() -> None:
    rng = np.random.default_rng(6)
    m_a, m_b, _ = scene(rng, 200)
    m_b[:120] = m_a[:120] + rng.uniform(-20, 20, (120, 2)) / FOCAL_PX
    R = B_T_A.rotation().matrix()
    inlier = direction_inliers(m_a, m_b, R, FOCAL_PX, FrontendConfig(), rng)
    assert np.mean(inlier[120:]) > 0.97
    distance_px = epipolar_distance(essential_matrix(B_T_A), m_a, m_b) * FOCAL_PX
    assert not np.any(inlier[distance_px > 3.0])


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_an_object_that_moves_is_a_group_of_its_own(share: float) -> None:
    """Neither the object nor the world is lost, whichever has more; errors are."""
    rng = np.random.default_rng(8)
    m_a, m_b, _ = scene(rng, 200)
    count = round(200 * share)
    m_b[:count] = m_a[:count] + np.array([25.0, -12.0]) / FOCAL_PX
    m_b += rng.normal(scale=0.2 / FOCAL_PX, size=m_b.shape)
    m_b[190:] += rng.uniform(20, 40, (10, 2)) / FOCAL_PX

    def inliers(rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        return fundamental_inliers(m_a[rows], m_b[rows], FOCAL_PX, FrontendConfig())

    first = inliers(np.arange(200))
    groups = [np.flatnonzero(first), *coherent_groups(inliers, np.flatnonzero(~first), 200)]
    assert len(groups) == 2
    kept = np.concatenate(groups)
    assert np.mean(np.isin(np.arange(190), kept)) > 0.97
    assert np.mean(np.isin(np.arange(190, 200), kept)) < 0.4


def test_a_few_errors_are_no_group() -> None:
    m_a, m_b, _ = scene(np.random.default_rng(9), 200)
    m_b[:15] += 10.0 / FOCAL_PX  # all alike, but too few

    def inliers(rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        return fundamental_inliers(m_a[rows], m_b[rows], FOCAL_PX, FrontendConfig())

    assert coherent_groups(inliers, np.flatnonzero(~inliers(np.arange(200))), 200) == []


def test_observations_that_do_not_fit_the_map_are_found() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform([-2, -2, 2], [2, 2, 8], (100, 3))
    in_b = np.asarray(B_T_A.transformFrom(points.T)).T
    m = in_b[:, :2] / in_b[:, 2:] + rng.normal(scale=0.3 / FOCAL_PX, size=(100, 2))
    m[:20] += 10.0 / FOCAL_PX
    guess = B_T_A.retract(np.full(6, 0.01))
    config = FrontendConfig(map_check_px=2.0)
    fits = map_inliers(points, m, guess, FOCAL_PX, config)
    np.testing.assert_array_equal(fits, np.arange(100) >= 20)
    assert np.all(map_inliers(points[:5], m[:5], guess, FOCAL_PX, config))


def test_a_still_camera_and_few_points_reject_nothing() -> None:
    rng = np.random.default_rng(4)
    m = rng.uniform(-0.5, 0.5, (100, 2))
    noisy = m + rng.normal(scale=0.1 / FOCAL_PX, size=m.shape)
    assert np.all(fundamental_inliers(m, noisy, FOCAL_PX, FrontendConfig()))
    few = m[:5]
    assert np.all(fundamental_inliers(few, few[::-1], FOCAL_PX, FrontendConfig()))
