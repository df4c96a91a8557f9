# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of the front end do what their NumPy forms, SciPy and OpenCV do."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.kernels.corner_scores import smallest_eigenvalues, smallest_eigenvalues_numpy
from slam_graph.kernels.epipolar import ray_depths, ray_depths_numpy
from slam_graph.kernels.near_pairs import nearest, nearest_numpy
from slam_graph.kernels.undistortion import approach_radtan

EUROC = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)


@pytest.mark.parametrize("shape", [(120, 102), (2, 3), (5, 64), (33, 2), (1, 9), (4, 1)])
def test_corner_scores(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, shape, dtype=np.uint8)
    found = smallest_eigenvalues(image)
    np.testing.assert_array_equal(found, smallest_eigenvalues_numpy(image))


@pytest.mark.parametrize("flat", [False, True])
def test_corner_scores_are_those_of_opencv(flat: bool) -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (90, 110), dtype=np.uint8)
    if flat:  # black and white squares: the largest gradients, and none
        image = np.kron(rng.integers(0, 2, (9, 11)), np.ones((10, 10))).astype(np.uint8) * 255
    image = np.ascontiguousarray(image)
    expected = cv2.cornerMinEigenVal(image, 7, None, 3)
    tolerance = 1e-5 * float(expected.max())  # OpenCV adds in 32 bits
    np.testing.assert_allclose(smallest_eigenvalues(image), expected, rtol=0, atol=tolerance)


def test_ray_depths() -> None:
    rng = np.random.default_rng(3)
    R, t = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.array([1.0, 0.2, -0.3])
    X = np.column_stack([rng.uniform(-2, 2, (50, 2)), rng.uniform(1, 9, 50)])
    Y = X @ R.T + t
    m_a, m_b = X[:, :2] / X[:, 2:], Y[:, :2] / Y[:, 2:]
    depths = ray_depths(R, t, m_a, m_b)
    np.testing.assert_allclose(depths, np.column_stack([X[:, 2], Y[:, 2]]), rtol=1e-9)
    noisy = m_b + rng.normal(0, 1e-2, m_b.shape)
    expected = ray_depths_numpy(R, t, m_a, noisy)
    error = np.abs(ray_depths(R, t, m_a, noisy) - expected)
    assert np.all(error <= 1e-12 * np.max(np.abs(expected)))
    parallel = ray_depths(np.eye(3), t, m_a, m_a)
    assert np.all(np.isinf(parallel))
    assert np.all(np.isinf(ray_depths_numpy(np.eye(3), t, m_a, m_a)))


@pytest.mark.parametrize(("points", "count"), [(3, 3), (40, 3), (200, 1), (200, 5)])
def test_nearest(points: int, count: int) -> None:
    rng = np.random.default_rng(4)
    there = rng.uniform(0, 700, (points, 2)).astype(np.float32)
    places = rng.uniform(0, 700, (30, 2)).astype(np.float32)
    np.testing.assert_array_equal(
        nearest(there, places, count), nearest_numpy(there, places, count)
    )
    assert nearest(there, places[:0], count).shape == (0, count)


@pytest.mark.parametrize(
    ("coefficients", "reach"),
    [(EUROC, 0.9), ((0.0, 0.0, 0.0, 0.0), 1.0), ((-3.0, 0.0, 0.01, -0.02), 0.8)],
)
def test_approach_is_that_of_opencv(coefficients: tuple[float, ...], reach: float) -> None:
    q = np.random.default_rng(5).uniform(-reach, reach, (300, 2))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
    own, eye = np.array(coefficients), np.eye(3)
    expected = cv2.undistortPointsIter(q[:, None], eye, own, eye, eye, criteria)[:, 0]
    found = approach_radtan(q, own, 20, 1e-9)
    good = np.isfinite(found[:, 0])
    np.testing.assert_allclose(found[good], expected[good], rtol=0, atol=1e-12)
    # it gives up only where the polynomial folds back, or nearly
    assert good.all() == (coefficients[0] > -1.0)
    assert good[np.linalg.norm(q, axis=1) < 0.1].all()
