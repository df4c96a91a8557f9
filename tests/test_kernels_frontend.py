# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of the front end do what their NumPy forms, SciPy and OpenCV do."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.kernels.corners import smallest_eigenvalues, strongest_in_cells, strongest_maxima
from slam_graph.kernels.corners_numpy import (
    smallest_eigenvalues_numpy,
    strongest_in_cells_numpy,
    strongest_maxima_numpy,
)
from slam_graph.kernels.epipolar import (
    ray_depths,
    ray_depths_numpy,
)
from slam_graph.kernels.halvings import halved, halvings_room
from slam_graph.kernels.image_turn import turn_steps, turn_steps_numpy
from slam_graph.kernels.near_pairs import (
    median_motions,
    median_motions_numpy,
    near_pairs,
    near_pairs_numpy,
    nearest,
    nearest_numpy,
)
from slam_graph.kernels.patch_alignment import (
    align_patches,
    align_patches_numpy,
    judge_patches,
    judge_patches_numpy,
)
from slam_graph.kernels.patch_templates import fill_templates, fill_templates_numpy
from slam_graph.kernels.spacing import (
    apart,
    apart_numpy,
    claim,
    claim_numpy,
    clear_disks,
    clear_disks_numpy,
    in_mask,
    in_mask_numpy,
)
from slam_graph.kernels.undistortion import approach_radtan, invert_radtan, undistort_radtan
from slam_graph.kernels.window_tracking import WINDOW_PX, track_windows
from slam_graph.kernels.window_tracking_numpy import track_windows_numpy

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
    moved = there + rng.normal(0.0, 3.0, there.shape).astype(np.float32)
    np.testing.assert_array_equal(
        median_motions(there, moved, places, count),
        median_motions_numpy(there, moved, places, count),
    )


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


@pytest.mark.parametrize("coefficients", [EUROC, (-3.0, 0.0, 0.01, -0.02)])
def test_inversion_in_one_call(coefficients: tuple[float, ...]) -> None:
    q, own = np.random.default_rng(6).uniform(-0.8, 0.8, (300, 2)), np.array(coefficients)
    start = approach_radtan(q, own, 20, 1e-9)
    found, given_up = invert_radtan(q, own, 20, 1e-9, 3, 1e-10)
    np.testing.assert_array_equal(found, undistort_radtan(q, start, own, 3, 1e-10))
    assert given_up == np.count_nonzero(np.isnan(start[:, 0]))
    assert (given_up == 0) == (coefficients == EUROC)


def test_in_mask() -> None:
    rng = np.random.default_rng(9)
    mask = np.where(rng.random((100, 120)) < 0.7, np.uint8(255), np.uint8(0))
    points = rng.uniform(-10.0, 130.0, (400, 2)).astype(np.float32)
    points[:2] = [119.5, 50.0], [119.4, 99.5]  # beyond the last column and row, and not quite
    found = in_mask(mask, points)
    assert np.array_equal(found, in_mask_numpy(mask, points))
    assert 0 < np.count_nonzero(found) < 300


def test_judge_patches() -> None:
    rng = np.random.default_rng(10)
    rows = rng.permutation(90)[:80]
    former = np.eye(2) + rng.normal(0.0, 0.1, (80, 2, 2))
    warps = np.eye(2) + rng.normal(0.0, 0.3, (90, 2, 2))
    found, correlations = rng.random(80) < 0.8, rng.uniform(0.5, 1.0, 80)
    found[0], correlations[0] = True, np.nan  # of a patch without contrast
    results = []
    for judge in (judge_patches, judge_patches_numpy):
        own, after, refusals = found.copy(), warps.copy(), np.arange(90) % 4
        limits = 0.7, 0.6, 1.5, 1.6, 3
        given_up = judge(own, correlations, rows, former, after, refusals, *limits)
        assert 0 < np.count_nonzero(given_up) < np.count_nonzero(~own) < 80
        results.append((given_up, own, after, refusals))
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)


def disk(radius: int) -> np.ndarray:
    image = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    cv2.circle(image, (radius, radius), radius, 1, cv2.FILLED)
    return image.sum(axis=1, dtype=np.int64) // 2


@pytest.mark.parametrize("radius", [0, 1, 4, 12, 30])
def test_clear_disks(radius: int) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-20.0, 140.0, (40, 2)).astype(np.float32)
    masks = [np.full((100, 120), 255, np.uint8) for _ in range(3)]
    clear_disks(masks[0], points, disk(radius))
    clear_disks_numpy(masks[1], points, disk(radius))
    for u, v in np.rint(points).astype(int).tolist():
        cv2.circle(masks[2], (u, v), radius, 0, cv2.FILLED)
    assert np.array_equal(masks[0], masks[1])
    assert np.array_equal(masks[0], masks[2])


@pytest.mark.parametrize("count", [0, 5, 1000])
def test_claim(count: int) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(0.0, 119.0, (300, 2)).astype(np.float32)
    mask = np.where(rng.random((100, 120)) < 0.7, np.uint8(255), np.uint8(0))
    masks = mask.copy(), mask.copy()
    chosen = claim(masks[0], points, count, 8.5, disk(8))
    assert np.array_equal(chosen, claim_numpy(masks[1], points, count, 8.5, disk(8)))
    assert np.array_equal(*masks)
    assert len(chosen) == 0 if count == 0 else 0 < len(chosen) <= count
    apart_px = np.linalg.norm(points[chosen][:, None] - points[chosen], axis=2)
    assert np.all(apart_px[~np.eye(len(chosen), dtype=bool)] >= 8.5)


def test_apart() -> None:
    points = np.random.default_rng(3).uniform(0.0, 60.0, (200, 2)).astype(np.float32)
    alone = apart(points, 3.0)
    assert np.array_equal(alone, apart_numpy(points, 3.0))
    assert 0 < np.count_nonzero(alone) < len(points)


@pytest.mark.parametrize("count", [0, 40])
def test_near_pairs(count: int) -> None:
    rng = np.random.default_rng(8)
    one, other = rng.uniform(0.0, 100.0, (count, 2)), rng.uniform(0.0, 100.0, (300, 2))
    found = near_pairs(one, other, 8.0)
    assert np.array_equal(found, near_pairs_numpy(one, other, 8.0))
    assert found.shape[1] == 2
    assert len(found) > count or count == 0


def two_images() -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(7).integers(0, 256, (120, 150)).astype(np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2.0)
    image[70:, 100:] = 90  # no texture
    image[:20, :20] = np.where(np.arange(20) % 4 < 2, 0, 255)  # the largest sums
    shift = np.array([[1.0, 0.02, 2.6], [-0.02, 1.0, -1.7]])
    return image, cv2.warpAffine(image, shift, (150, 120), borderMode=cv2.BORDER_REFLECT)


def with_halvings(image: np.ndarray, levels: int) -> tuple[np.ndarray, np.ndarray]:
    halvings = np.empty(halvings_room(image.shape, levels), np.uint8)
    for level in range(levels):
        halved(image, halvings, level + 1)[:] = cv2.pyrDown(halved(image, halvings, level))
    return image, halvings


@pytest.mark.parametrize("levels", [0, 1, 2])
def test_track_windows(levels: int) -> None:
    rng = np.random.default_rng(8)
    image, other = two_images()
    points = rng.uniform(-9.0, 160.0, (150, 2)).astype(np.float32)  # some outside
    start = points + rng.normal(0.0, 2.0, points.shape).astype(np.float32)
    images = *with_halvings(image, levels), *with_halvings(other, levels)
    results = [
        form(*images, points, start, levels, 5, 15, 0.02, 1e-3)
        for form in (track_windows, track_windows_numpy)
    ]
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert 20 < np.count_nonzero(results[0][1]) < 140


@pytest.mark.parametrize("side", [1, 2, 5])
def test_track_windows_of_black_and_white(side: int) -> None:
    # the largest derivatives; between small fractions the last of the four weights is -1
    rng = np.random.default_rng(10)
    squares = rng.integers(0, 2, (200 // side, 200 // side), np.uint8) * np.uint8(255)
    image = np.ascontiguousarray(np.kron(squares, np.ones((side, side), np.uint8)))
    fractions = rng.choice(np.array([0, 7, 35, 63, 2**15, 65170]) / 2**16, (200, 2))
    points = (rng.integers(5, 195, (200, 2)) + fractions).astype(np.float32)
    start = points + rng.choice([0.0, 0.25, 1.0], points.shape).astype(np.float32)
    images = *with_halvings(image, 1), *with_halvings(image, 1)
    results = [
        form(*images, points, start, 1, 5, 15, 0.02, 1e-3)
        for form in (track_windows, track_windows_numpy)
    ]
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert np.count_nonzero(results[0][1]) > 100


def test_track_windows_is_opencv() -> None:
    rng = np.random.default_rng(9)
    image, other = two_images()
    points = rng.uniform(3.0, 147.0, (400, 2)).astype(np.float32)
    start = points + rng.normal(0.0, 1.5, points.shape).astype(np.float32)
    settings = {
        "winSize": (WINDOW_PX, WINDOW_PX),
        "maxLevel": 1,
        "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": 1e-3,
    }
    theirs, status, _ = cv2.calcOpticalFlowPyrLK(image, other, points, start.copy(), **settings)
    images = *with_halvings(image, 1), *with_halvings(other, 1)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        other, image, theirs, points.copy(), status=None, err=None, **(settings | {"maxLevel": 0})
    )
    ours, found, round_px = track_windows(*images, points, start, 1, -1000, 15, 0.02, 1e-3)
    both = (status[:, 0] == 1) & (returned[:, 0] == 1)
    np.testing.assert_array_equal(found, both)
    # OpenCV's sums are rounded; a point at the limit of the last step may take one more
    for one, two in (
        (ours, theirs),
        (round_px[:, None], np.linalg.norm(back - points, axis=1)[:, None]),
    ):
        error_px = np.abs(one - two).max(axis=1)[found]
        assert np.median(error_px) < 1e-6
        assert error_px.max() < 0.05


@pytest.mark.parametrize("count", [0, 1, 5, 100])
@pytest.mark.parametrize("distance_px", [1.0, 8.0])
@pytest.mark.parametrize("levels", [3, 200])
def test_strongest_maxima_are_those_of_opencv(count: int, distance_px: float, levels: int) -> None:
    rng = np.random.default_rng(7)
    image = cv2.GaussianBlur(rng.integers(0, levels, (60, 73), np.uint8), (0, 0), 1.5)
    image[20:50, 30:60] = 0  # without gradients all scores are alike
    image[35:40, 40:45] = levels
    allowed = np.full(image.shape, 255, np.uint8)
    allowed[:30, 10:20] = 0
    scores = np.asarray(cv2.cornerMinEigenVal(image, 7), np.float32)
    smallest = 0.3 * float(scores.max())
    given = scores, allowed, count, 0.05, smallest, distance_px
    found = strongest_maxima(*given)
    np.testing.assert_array_equal(found, strongest_maxima_numpy(*given))
    if count:  # to OpenCV, 0 means all
        corners, strengths = cv2.goodFeaturesToTrackWithQuality(
            image, count, 0.05, distance_px, allowed, blockSize=7
        )
        opencv = np.column_stack([np.reshape(corners, (-1, 2)), np.ravel(strengths)])
        np.testing.assert_array_equal(found, opencv[opencv[:, 2] >= smallest])
    assert len(strongest_maxima(scores, np.zeros_like(allowed), 9, 0.05, 0.0, 1.0)) == 0


@pytest.mark.parametrize(("missing", "surplus"), [(0, 1), (7, 1), (30, 2), (500, 2)])
def test_strongest_in_cells(missing: int, surplus: int) -> None:
    """Cells at the edge and in the middle of the image, without room, and without gradients."""
    rng = np.random.default_rng(8)
    image = cv2.GaussianBlur(rng.integers(0, 256, (100, 130), np.uint8), (0, 0), 1.5)
    image[:45, 60:] = 90
    image, free = np.ascontiguousarray(image), np.full(image.shape, 255, np.uint8)
    free[50:, :40] = 0
    free[60:70, 60:90] = 0
    cells = np.array(
        [(0, 0, 40, 50), (0, 50, 40, 100), (80, 0, 130, 40), (40, 50, 85, 100), (85, 50, 130, 100)]
    )
    masks, wanted = (free, free.copy()), np.array([3, 5, 2, 8, 400])
    results = []
    for strongest, mask in zip((strongest_in_cells, strongest_in_cells_numpy), masks, strict=True):
        points = np.zeros((surplus * wanted.sum(), 2), np.float32)
        room = np.zeros(60 * 60, np.float32), points, *np.zeros((2, 5), np.int64)
        limits = missing, surplus, 0.05, 1e-4, 6.0, disk(6)
        results.append((strongest(image, mask, cells, 4, wanted, *limits, *room), *room))
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(*masks)
    seen, _, points, counts, quotas = results[0]
    assert np.count_nonzero(points.any(axis=1)) == counts.sum()
    assert seen == {0: 0, 7: 4, 30: 5, 500: 5}[missing]
    if missing > 0:
        assert counts[1] == counts[2] == 0  # nothing is free there, or there is no corner
        assert quotas[0] == 3
        assert np.all(counts <= surplus * quotas)


@pytest.mark.parametrize("iterations", [1, 2, 20])
def test_align_patches(iterations: int) -> None:
    """Patches that are there, beyond an edge, without contrast, and of something else."""
    rng = np.random.default_rng(iterations)
    image = rng.integers(0, 256, (120, 160)).astype(np.uint8)
    image = np.ascontiguousarray(cv2.GaussianBlur(image, (0, 0), 2.0))
    image[:40, :40] = 90
    count = 60
    middles = rng.integers([10, 10], [150, 110], (count, 2)) + rng.uniform(size=(count, 2))
    filled = []
    for fill in (fill_templates, fill_templates_numpy):
        room = (
            np.zeros((count, 3, 240), np.float32),
            np.zeros((count, 8, 6)),
            np.ones((count, 2, 2)),
        )
        rich = fill(image, middles.astype(np.float32), np.arange(count)[::-1].copy(), *room)
        filled.append((rich, *room))
    for one, other in zip(*filled, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    (rich, templates, systems, _), middles = filled[0], middles[::-1]
    assert 0 < np.count_nonzero(rich) < count
    templates[::7] = rng.normal(size=templates[::7].shape)
    warps = np.eye(2) + rng.normal(0.0, 0.03, (count, 2, 2))
    rows = rng.permutation(count)[:50]
    start = middles[rows] + rng.normal(0.0, 0.3, (50, 2))
    results = []
    for kernel in (align_patches, align_patches_numpy):
        points, changed = start.copy(), warps.copy()
        shared = image, templates, systems, changed, rows, points
        found, correlations = kernel(*shared, iterations, 0.01)
        results.append((found, correlations, points, changed))
    (found, *values), (expected, *others) = results
    np.testing.assert_array_equal(found, expected)
    assert 10 < np.count_nonzero(found) < 50
    for one, other in zip(values, others, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("steps", [0, 1, 6])
@pytest.mark.parametrize("stride", [1, 2])
def test_turn_steps(steps: int, stride: int) -> None:
    noise = np.random.default_rng(12).normal(0.0, 100.0, (60, 100)).astype(np.float32)
    scene = cv2.GaussianBlur(noise, (0, 0), 3.0)
    one, other = (np.ascontiguousarray(scene[k : k + 50, 2 * k : 2 * k + 80]) for k in (4, 5))
    slopes = [np.asarray(cv2.Sobel(one, -1, *d, scale=0.125)) for d in ((1, 0), (0, 1))]
    camera = np.array([50.0, 52.0, 40.0, 25.0])
    found = []
    for kernel in turn_steps, turn_steps_numpy:
        R = np.eye(3)
        outcome = kernel(one, other, *slopes, camera, stride, steps, 1e-9, R)
        found.append((R, *outcome))
    for value, expected in zip(*found, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12)
    if steps == 6:  # by two pixels to the left and one upwards
        np.testing.assert_allclose(found[0][0][:2, 2], [-2 / 50, -1 / 52], atol=0.01)
