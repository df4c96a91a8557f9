# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Every compiled kernel does what its NumPy form does."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.kernels.ascending import are_among, are_among_numpy
from slam_graph.kernels.chained_turns import chain_turns, chain_turns_numpy
from slam_graph.kernels.elimination import (
    eliminate_columns,
    eliminate_columns_numpy,
    zeros_to_the_left,
    zeros_to_the_left_numpy,
)
from slam_graph.kernels.epipolar import (
    constraint_moments,
    constraint_moments_numpy,
    sampson_distances,
    sampson_distances_numpy,
)
from slam_graph.kernels.epipolar_equations import CAUCHY_WIDTH, pair_equations, pair_equations_numpy
from slam_graph.kernels.epipolar_pairs import (
    epipolar_distances,
    epipolar_distances_numpy,
    epipolar_moments,
    epipolar_moments_numpy,
)
from slam_graph.kernels.epipolar_rotation import _median, find_directions, refine_rotation
from slam_graph.kernels.epipolar_rotation_numpy import find_directions_numpy, refine_rotation_numpy
from slam_graph.kernels.feature_elimination import (
    eliminate_features,
    eliminate_features_numpy,
)
from slam_graph.kernels.feature_sums import (
    block_sums,
    block_sums_numpy,
    extents,
    extents_numpy,
    sum_of_features,
    sum_of_features_numpy,
)
from slam_graph.kernels.gate import (
    observation_distances,
    observation_distances_numpy,
    observation_rows,
    observation_rows_numpy,
    track_distances,
    track_distances_numpy,
)
from slam_graph.kernels.gyroscope_turns import (
    orientations_at,
    orientations_at_numpy,
    turn_matrices,
    turn_matrices_numpy,
)
from slam_graph.kernels.null_space import triangularize_features, triangularize_features_numpy
from slam_graph.kernels.patch_search import (
    along_rays,
    along_rays_numpy,
    most_similar,
    most_similar_numpy,
)
from slam_graph.kernels.pose_steps import pose_steps, pose_steps_numpy
from slam_graph.kernels.projection import (
    chain_rule,
    chain_rule_numpy,
    distort_equidistant,
    distort_radtan,
    to_cameras,
    to_cameras_numpy,
)
from slam_graph.kernels.ray_triangulation import triangulate_rays, triangulate_rays_numpy
from slam_graph.kernels.secular import (
    constrained_solutions,
    constrained_solutions_numpy,
    secular_roots,
    secular_roots_numpy,
)
from slam_graph.kernels.state_rows import fill_state_rows, fill_state_rows_numpy
from slam_graph.kernels.track_motion import motion_steps, motion_steps_numpy
from slam_graph.sensors import Camera
from slam_graph.sensors.camera_model import CameraModel
from slam_graph.sensors.lens_models import RadialTangential

EQUAL = 1e-12
"""Largest difference, relative to the largest value."""


def same(a: np.ndarray, b: np.ndarray, equal: float = EQUAL) -> bool:
    return bool(np.abs(a - b).max(initial=0.0) <= equal * max(1.0, np.abs(b).max(initial=0.0)))


def test_triangularize_features() -> None:
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(12, 10, 3)), rng.normal(size=(12, 10, 17))
    A[3, 4:] = B[3, 4:] = 0.0  # a feature with fewer observations
    A[5] = 0.0  # one that does not depend on its position
    expected = A.copy(), B.copy()
    triangularize_features_numpy(*expected)
    triangularize_features(A, B)
    assert same(A, expected[0])
    assert same(B, expected[1])


def test_projection() -> None:
    rng = np.random.default_rng(2)
    rotations, mount_R = (Rotation.random(k, random_state=k).as_matrix() for k in (4, 2))
    positions, mount_p, points = (rng.normal(size=(k, 3)) for k in (4, 2, 9))
    frame, feature, mount = (rng.integers(0, k, 40) for k in (4, 9, 2))
    scene = rotations, positions, points, mount_R, mount_p, frame, feature, mount, 1e-3

    def filled(
        kernel: Callable[..., None], shapes: list[tuple[int, ...]], *given: object
    ) -> list[np.ndarray]:
        results = [np.empty((40, *shape)) for shape in shapes]
        kernel(*given, *results)
        return results

    seen, expected = (filled(f, [(3,), (3,), (2,)], *scene) for f in (to_cameras, to_cameras_numpy))
    assert all(same(a, b) for a, b in zip(seen, expected, strict=True))
    assert np.any(seen[1][:, 2] < 0.0)  # behind the camera, too
    given = *expected[:2], rng.normal(size=(40, 2, 2)), rotations, mount_R, frame, mount, 1e-3
    shapes = [(2, 3), (2, 6), (2, 3)]
    derivatives = (filled(f, shapes, *given) for f in (chain_rule, chain_rule_numpy))
    assert all(same(a, b) for a, b in zip(*derivatives, strict=True))


def test_brown_distortion() -> None:
    rng = np.random.default_rng(3)
    m, camera = rng.uniform(-0.8, 0.8, (30, 2)), np.repeat([0, 1], 15)
    lenses = np.array([[458, 457, 367, 248, -0.28, 0.07, 2e-4, 2e-5], [1, 2, 3, 4, 0, 0, 0, 0]])
    pixels, slopes = np.empty((30, 2)), np.empty((30, 2, 2))
    distort_radtan(m, camera, lenses, pixels, slopes)
    for rows, lens, model in (camera == 0, lenses[0], "radtan"), (camera == 1, lenses[1], "none"):
        coefficients = tuple(lens[4:]) if model == "radtan" else ()
        expected = Camera(*lens[:4], model, coefficients, 752, 480).distort(m[rows])
        assert same(pixels[rows], expected[0])
        assert same(slopes[rows], expected[1])


def test_distort_equidistant() -> None:
    """Up to 84° off the axis, and on it, where its scale is a limit."""
    rng = np.random.default_rng(3)
    m = np.concatenate([rng.uniform(-7.0, 7.0, (40, 2)), [[0, 0], [1e-10, 0], [5e-8, 1e-8]]])
    camera = rng.integers(0, 2, len(m))
    lenses = np.array([[190, 191, 254, 256, 3e-3, 7e-4, -2e-3, 2e-4], [1, 2, 3, 4, 0, 0, 0, 0]])
    pixels, slopes = np.empty((len(m), 2)), np.empty((len(m), 2, 2))
    distort_equidistant(m, camera, lenses, pixels, slopes)
    for number, lens in enumerate(lenses):
        rows = camera == number
        model = Camera(*lens[:4], "equidistant", tuple(lens[4:]), 512, 512)
        expected = model.distort(m[rows])
        assert same(pixels[rows], expected[0])
        assert same(slopes[rows], expected[1])


@pytest.mark.parametrize(("noise", "bound"), [(1e-6, 1e-12), (2e-3, 1e-8)])
@pytest.mark.parametrize("weighted", [False, True])
def test_triangulation(weighted: bool, noise: float, bound: float) -> None:
    rng = np.random.default_rng(4)
    counts = np.array([2, 5, 9, 4, 6])
    starts = np.append(0, np.cumsum(counts))
    truth = np.repeat(rng.uniform([-2, -2, 4], [2, 2, 9], (5, 3)), counts, axis=0)
    positions = rng.normal(0.0, 0.5, truth.shape)
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.2, truth.shape))
    seen = turns.inv().apply(truth - positions)
    normalized = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, noise, (len(seen), 2))
    normalized[starts[4] :] *= -1.0  # rays that meet behind the cameras
    weights = (
        np.eye(2) + rng.normal(0.0, 0.1, (len(seen), 2, 2)) if weighted else np.ones((0, 2, 2))
    )
    found = []
    for kernel in triangulate_rays, triangulate_rays_numpy:
        points, depth_error, parallax = np.empty((5, 3)), np.empty(5), np.empty(5)
        kernel(
            turns.as_matrix(), positions, normalized, weights, starts, points, depth_error, parallax
        )
        found.append((points, depth_error, np.cos(parallax)))
    errors = []
    for points, _, _ in found:
        seen = turns.inv().apply(np.repeat(points, counts, axis=0) - positions)
        r = (seen[:, :2] / seen[:, 2:] - normalized)[: starts[4]]
        r = np.einsum("nij,nj->ni", weights[: starts[4]], r) if weighted else r
        errors.append(np.add.reduceat(np.sum(r**2, axis=1), starts[:4]))
    assert same(*errors)
    # whether the last of the steps, which have converged, lowers the error is decided by rounding;
    # with large residuals it moves the point by more
    assert all(same(a, b, bound) for a, b in zip(*found, strict=True))
    np.testing.assert_allclose(found[0][0][:4], truth[starts[:4]], atol=0.5)


def tracks(rng: np.random.Generator, calibration: int) -> tuple[np.ndarray, ...]:
    """Linearised observations of four features by five poses, as the kernels take them."""
    counts = np.array([2, 5, 9, 3])
    starts, total = np.append(0, np.cumsum(counts)), counts.sum()
    shapes = [(total, 2), (total, 2, 6), (total, 2, 3), (total, 2, calibration)]
    return *(rng.normal(size=shape) for shape in shapes), rng.integers(0, 5, total), starts


@pytest.mark.parametrize("calibration", [0, 4])
def test_gate(calibration: int) -> None:
    rng = np.random.default_rng(5)
    given, size = tracks(rng, calibration), 30 + calibration
    root = np.asfortranarray(rng.normal(size=(size, size)))
    found = np.empty((2, 4))
    track_distances(*given, root.T @ root, found[0])
    track_distances_numpy(*given, root.T @ root, found[1])
    assert same(*found)
    r, H, columns = given[0], given[1], rng.integers(0, size, (len(given[0]), 6))
    found = np.empty((2, len(r)))
    observation_distances(r, H, root, columns, found[0])
    observation_distances_numpy(r, H, root, columns, found[1])
    assert same(*found)


def test_observation_rows() -> None:
    rng = np.random.default_rng(11)
    H, root = rng.normal(size=(20, 2, 9)), np.asfortranarray(np.tril(rng.normal(size=(40, 40))))
    columns, found = rng.integers(0, 40, (20, 9)), np.empty((2, 40, 40))
    observation_rows(H, root, columns, found[0])
    observation_rows_numpy(H, root, columns, found[1])
    assert same(*found)


def test_pose_steps() -> None:
    rng = np.random.default_rng(12)
    points = rng.uniform([-3, -3, -1], [3, 3, 8], (60, 3))
    rays, chosen = rng.uniform(-0.5, 0.5, (60, 2)), rng.uniform(size=60) < 0.8
    ahead = points[:, 2] > 1.0
    rays[ahead] = points[ahead, :2] / points[ahead, 2:] + rng.normal(0.0, 0.01, (ahead.sum(), 2))
    found = []
    for kernel in pose_steps, pose_steps_numpy:
        pose, errors = np.eye(3, 4), np.empty(60)
        pose[:, 3] = 0.05
        kernel(points, rays, chosen, np.array([0.2, 0.1, np.inf]), pose, errors)
        found.append((pose, errors))
    (pose, errors), (expected, others) = found
    assert same(pose, expected)
    assert np.isinf(errors).any()
    assert same(errors[np.isfinite(errors)], others[np.isfinite(others)])


@pytest.mark.parametrize("calibration", [0, 4])
def test_sum_of_features(calibration: int) -> None:
    given, width = tracks(np.random.default_rng(6), calibration), 31 + calibration
    found = []
    for kernel in sum_of_features, sum_of_features_numpy:
        shapes = (4, 3, 3), (4, 3, width), (width, width)
        found.append([np.empty(shape) for shape in shapes])
        kernel(*given, *found[-1])
    assert all(same(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("calibration", [0, 2])
def test_fill_state_rows(calibration: int) -> None:
    """Features with no, one, two and five observations, from two poses."""
    rng = np.random.default_rng(3)
    counts = np.array([2, 0, 1, 5, 2])
    N, size, k = int(counts.sum()), 40, 12 + calibration
    parts = (rng.normal(size=(N, 2, width)) for width in (6, 3, calibration))
    given = rng.normal(size=(N, 2)), *parts, rng.integers(0, 2, N)
    starts, order = np.append(0, np.cumsum(counts)), np.array([3, 0, 4, 1, 2])
    of_points, columns = np.array([3, 9, 12, 0, 6]), np.append(np.arange(15, 26), 30)
    columns = np.append(columns, np.arange(33, 33 + calibration))
    with_feature = int(np.minimum(2 * counts, 3).sum())
    results = []
    for kernel in (fill_state_rows, fill_state_rows_numpy):
        Ab = np.zeros((with_feature, size + 1), order="F")
        rest = np.empty((2 * N - with_feature, k + 1))
        kernel(*given, starts, order, of_points, columns, Ab, rest)
        results.append((Ab, rest))
    assert all(same(a, b) for a, b in zip(*results, strict=True))
    assert zeros_to_the_left(results[0][0]) == (0, True)


@pytest.mark.parametrize("first", [0, 3, 7])
@pytest.mark.parametrize("below", [0.0, 1.0])
def test_zeros_to_the_left(first: int, below: float) -> None:
    rows = np.zeros((4, 7), order="F")
    rows[:, first:] = np.triu(np.ones((4, 7 - first)))
    rows[2, first : first + 1] = below
    found = zeros_to_the_left(rows)
    assert found == zeros_to_the_left_numpy(rows)
    assert found[0] == first
    assert found[1] == (below == 0.0 and first <= 3)


@pytest.mark.parametrize("gone", [[], [0, 1], [4, 5, 9], [3, 11, 12], [11, 12]])
def test_eliminate_columns(gone: list[int]) -> None:
    """Up to the signs of rows: those that stay, and those that determine the eliminated columns."""
    n, columns, w = 10, 14, len(gone)
    triangle = np.triu(np.random.default_rng(3).normal(size=(columns, columns)))
    order = np.array([*gone, *(k for k in range(columns) if k not in gone)], np.int64)
    given, behind = np.zeros((w, columns)), sum(k >= n for k in gone)
    tail = np.linalg.qr(triangle[n:, order[w - behind :]])[1][:behind]
    given[w - behind :, w - behind :] = tail
    found = []
    for kernel in eliminate_columns, eliminate_columns_numpy:
        carried, kept = given.copy(), np.zeros((n - w + behind, columns - w), order="F")
        kernel(np.asfortranarray(triangle)[:n], order, carried, kept)
        found.append((np.abs(carried), np.abs(kept)))
    assert all(same(a, b) for a, b in zip(*found, strict=True))


def test_block_sums() -> None:
    rng = np.random.default_rng(7)
    r, _, by_point, _, camera, starts = tracks(rng, 0)
    frame = np.cumsum(rng.integers(0, 3, len(r)))  # two cameras see a frame, and some are left out
    found = np.empty((2, 4, len(starts) - 1, 2))
    block_sums(r, by_point, camera % 2, frame, starts, 3, found[0])
    block_sums_numpy(r, by_point, camera % 2, frame, starts, 3, found[1])
    assert same(*found)
    assert np.any(found[0] == 0.0)


@pytest.mark.parametrize(("covariances", "largest"), [(0, 0.5), (4, 0.0), (4, 1e3)])
def test_motion_steps(covariances: int, largest: float) -> None:
    rng = np.random.default_rng(9)
    r, _, by_point, _, _, starts = tracks(rng, 0)
    shares, since = rng.normal(size=(len(r), 3)), rng.uniform(-0.5, 0.0, len(r))
    in_camera, (x, before) = rng.normal(size=(len(r), 3)), rng.normal(size=(2, 4, 12))
    prior = starts, before, rng.uniform(0.1, 1.0, 12)
    given = by_point, r, in_camera, shares, since, *prior, 0.7, 0.5, largest
    found = []
    for kernel in motion_steps, motion_steps_numpy:
        covariance = np.empty((covariances, 3, 3))
        found.append([x.copy(), np.empty((len(r), 3)), np.empty(4), covariance])
        kernel(*given, *found[-1])
    assert all(same(a, b) for a, b in zip(*found, strict=True))
    assert np.array_equal(found[0][0], x) == (largest == 0.0)


def test_motion_steps_where_rounding_makes_the_equations_indefinite() -> None:
    """A point all but in a camera: 1e20 in some directions and 1e-4 in others."""
    rng = np.random.default_rng(10)
    r, _, by_point, _, _, starts = tracks(rng, 0)
    by_point, in_camera = 1e10 * np.ones_like(by_point), np.ones((len(r), 3))
    shares, since, x = np.ones((len(r), 3)), np.full(len(r), -0.1), np.zeros((4, 12))
    found = x, np.empty((len(r), 3)), np.empty(4), np.empty((4, 3, 3))
    prior = starts, x.copy(), np.full(12, 1e-4)
    motion_steps(by_point, r, in_camera, shares, since, *prior, 1.0, 0.1, 0.5, *found)
    assert all(np.isfinite(values).all() for values in found)


def test_extents() -> None:
    rng = np.random.default_rng(8)
    *_, camera, starts = tracks(rng, 0)
    pixels, found = rng.uniform(0.0, 700.0, (len(camera), 2)), np.empty((2, len(starts) - 1, 5))
    extents(pixels, camera % 4, starts, found[0])
    extents_numpy(pixels, camera % 4, starts, found[1])
    assert same(*found)
    assert np.all(found[0, :, 4] == 0.0)


@pytest.mark.parametrize("count", [0, 1, 30])
def test_are_among(count: int) -> None:
    rng = np.random.default_rng(9)
    values, ascending = rng.integers(0, 60, 100), np.sort(rng.choice(50, count, replace=False))
    found = are_among(values, ascending)
    assert np.array_equal(found, are_among_numpy(values, ascending))
    assert found.any() == (count > 0)


@pytest.mark.parametrize("count", [0, 1, 200])
def test_chain_turns(count: int) -> None:
    turns = Rotation.from_rotvec(np.random.default_rng(10).normal(size=(count, 3))).as_matrix()
    found = np.empty((2, count + 1, 3, 3))
    chain_turns(turns, found[0])
    chain_turns_numpy(turns, found[1])
    assert same(*found)


@pytest.mark.parametrize("features", [0, 7])
def test_epipolar_distances_and_moments(features: int) -> None:
    rng = np.random.default_rng(11)
    pairs = 4
    bearings = rng.normal(size=(2, pairs, features, 3))
    by_pixels = rng.normal(size=(2, pairs, features, 2, 3))
    R = Rotation.random(pairs, rng=rng).as_matrix()
    seen = *bearings, *by_pixels, R
    t, least = rng.normal(size=(pairs, 3)), rng.uniform(0.0, 3.0, (pairs, features))
    distances = []
    for kernel, slopes in (
        (epipolar_distances, np.empty(bearings[0].shape)),
        (epipolar_distances_numpy, np.empty(bearings[0].shape)),
        (epipolar_distances, np.empty((0, 0, 0))),
    ):
        distances.append([np.empty(least.shape), np.empty(least.shape), slopes])
        kernel(*seen, t, least, *distances[-1])
    assert all(same(a, b) for a, b in zip(*distances[:2], strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(distances[0][:2], distances[2], strict=False))
    weights, by_noise = rng.uniform(size=(2, pairs, features)) * (rng.uniform(size=features) > 0.2)
    for normalize in False, True:
        moments = np.empty((2, pairs, 3, 3))
        epipolar_moments(*seen, weights, by_noise, normalize, moments[0])
        epipolar_moments_numpy(*seen, weights, by_noise, normalize, moments[1])
        assert same(*moments)


def test_epipolar_distances_have_their_derivatives() -> None:
    rng = np.random.default_rng(12)
    seen = *rng.normal(size=(2, 1, 5, 3)), *rng.normal(size=(2, 1, 5, 2, 3)), np.eye(3)[None]
    t, slopes, step = rng.normal(size=(1, 3)), np.empty((1, 5, 3)), 1e-6
    e, sigmas = np.empty((2, 3, 1, 5)), np.empty((1, 5))
    for side, sign in enumerate((-1.0, 1.0)):
        for c, change in enumerate(step * np.eye(3)):
            moved = t + sign * change
            epipolar_distances(*seen, moved, np.zeros((1, 5)), e[side, c], sigmas, slopes)
    epipolar_distances(*seen, t, np.zeros((1, 5)), np.empty((1, 5)), sigmas, slopes)
    np.testing.assert_allclose(slopes[0], (e[1] - e[0])[:, 0].T / (2.0 * step), atol=1e-7)


def test_epipolar_constraint() -> None:
    rng = np.random.default_rng(4)
    F, a, b = rng.normal(size=(3, 3)), rng.normal(size=(90, 2)), rng.normal(size=(90, 2))
    assert same(sampson_distances(F, a, b), sampson_distances_numpy(F, a, b))
    assert same(constraint_moments(a, b), constraint_moments_numpy(a, b))
    assert np.all(sampson_distances(np.zeros((3, 3)), a, b) == 0.0)


@pytest.mark.parametrize("parallax", [0.3, 0.05, 0.0])
@pytest.mark.parametrize("wrong", [0, 6])
@pytest.mark.parametrize("count", [15, 16, 90])
def test_refine_rotation(count: int, wrong: int, parallax: float) -> None:
    rng = np.random.default_rng(11)
    turn, away = (Rotation.from_rotvec(rng.normal(0.0, s, 3)).as_matrix() for s in (0.2, 0.05))
    points = rng.uniform([-2.0, -2.0, 2.0], [2.0, 2.0, 8.0], (count, 3))
    first, second = points, (points - [parallax, 0.0, 0.0]) @ turn
    second[:wrong] = second[:wrong][::-1]
    bearings = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in (first, second))
    first, second = (f + rng.normal(0.0, 1e-3, f.shape) for f in bearings)
    variances, results = (1e-3 * rng.uniform(0.5, 1.5, (count, 2))) ** 2, []
    for form in refine_rotation, refine_rotation_numpy:
        R, information = turn @ away, np.empty((3, 3))
        cost = form(first, second, variances, R, information)
        results.append((R, information, np.array(cost)))
    (R, *others), (expected, *other_form) = results
    assert same(R, expected)
    # the direction is an eigenvector: rounding over the distance of its eigenvalue to the next
    assert all(same(a, b, 1e-9) for a, b in zip(others, other_form, strict=True))
    error = Rotation.from_matrix(turn.T @ R).as_rotvec()
    assert wrong > 0 or error @ others[0] @ error < 16.3  # χ² of three, p = 0.001


def test_pair_equations() -> None:
    """The gradient is that of the cost with the best directions, as far as weights are constant."""
    rng = np.random.default_rng(11)
    pairs, R = [], np.empty((3, 3, 3))
    for p, count in enumerate((15, 60, 33)):
        turn, away = (Rotation.from_rotvec(rng.normal(0.0, s, 3)) for s in (0.2, 1e-3))
        points = rng.uniform([-2.0, -2.0, 2.0], [2.0, 2.0, 8.0], (count, 3))
        both = points, (points - [0.3, 0.0, 0.0]) @ turn.as_matrix()
        rays = [f / np.linalg.norm(f, axis=1, keepdims=True) for f in both]
        pairs.append([f + rng.normal(0.0, 1e-3, f.shape) for f in rays])
        R[p] = (turn * away).as_matrix()
    first, second = (np.concatenate(seen) for seen in zip(*pairs, strict=True))
    variances = (1e-3 * rng.uniform(0.5, 1.5, (len(first), 2))) ** 2
    begins = np.array([0, 15, 75, 108])

    def filled(form: Callable[..., None], R: FloatArray) -> tuple[FloatArray, ...]:
        t, found = np.tile([0.96, 0.28, 0.0], (3, 1)), np.empty((3, 3, 4))
        squares = np.empty(len(first))
        for _ in range(4):  # a direction that is far off takes some steps more
            form(first, second, variances, begins, np.ascontiguousarray(R), t, found, squares)
        return found, t, squares

    def costs(R: FloatArray) -> FloatArray:
        squares = filled(pair_equations, R)[2]
        return np.add.reduceat(0.5 * CAUCHY_WIDTH**2 * np.log1p(squares), begins[:-1])

    both_forms = zip(filled(pair_equations, R), filled(pair_equations_numpy, R), strict=True)
    assert all(same(ours, other) for ours, other in both_forms)
    gradients = filled(pair_equations, R)[0][:, :, 3]
    for k in range(3):
        step = Rotation.from_rotvec(1e-6 * np.eye(3)[k]).as_matrix()
        numerical = (costs(R @ step) - costs(R @ step.T)) / 2e-6
        np.testing.assert_allclose(gradients[:, k], numerical, atol=0.05 * np.abs(gradients).max())


def test_find_directions() -> None:
    """Of bearings with noise and wrong matches; NaN of a pair without noise in some direction."""
    rng = np.random.default_rng(13)
    turn = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    points = rng.uniform([-2.0, -2.0, 2.0], [2.0, 2.0, 8.0], (40, 3))
    both = points, (points - [0.24, 0.32, 0.0]) @ turn
    first, second = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in both)
    first += rng.normal(0.0, 1e-4, first.shape)
    second[:4] = second[4:8]
    ahead = np.tile([0.0, 0.0, 1.0], (20, 1))
    seen = np.concatenate([first, ahead]), np.concatenate([second, ahead])
    variances = np.concatenate([np.full((40, 2), 1e-8), np.zeros((20, 2))])
    pairs = np.array([0, 40, 60]), np.stack([turn, np.eye(3)])
    found = np.empty((2, 2, 3))
    for form, t in zip((find_directions, find_directions_numpy), found, strict=True):
        form(*seen, variances, *pairs, t)
        assert abs(t[0] @ [0.6, 0.8, 0.0]) > np.cos(5e-3)
        assert np.isnan(t[1]).all()
    np.testing.assert_allclose(abs(found[0, 0] @ found[1, 0]), 1.0, atol=1e-12)


def test_gyroscope_turns() -> None:
    """By a stretch of samples that are not evenly spaced, and beyond both of its ends."""
    rng = np.random.default_rng(14)
    times = np.sort(rng.uniform(0.0, 2.0, 200))
    rates, chained = rng.normal(0.0, 2.0, (200, 3)), Rotation.random(200, rng).as_matrix()
    at = np.concatenate([[-0.1, 2.1], times[:3], rng.uniform(0.0, 2.0, 300)])
    ours, other = np.empty((2, len(at), 3, 3))
    orientations_at(times, rates, chained, at, ours)
    orientations_at_numpy(times, rates, chained, at, other)
    np.testing.assert_allclose(ours, other, atol=1e-13)
    lengths = np.concatenate([[0.0, 1e-9, 1e-5, 1.1e-4, np.pi, 6.0], rng.uniform(0.0, 4.0, 50)])
    vectors = lengths[:, None] * Rotation.random(len(lengths), rng).as_matrix()[:, 0]
    ours, other = np.empty((2, len(vectors), 3, 3))
    turn_matrices(vectors, ours)
    turn_matrices_numpy(vectors, other)
    np.testing.assert_allclose(ours, other, atol=1e-14)


@pytest.mark.parametrize("form", [refine_rotation, refine_rotation_numpy])
def test_refine_rotation_without_noise_in_some_direction(form: Callable[..., float]) -> None:
    ahead = np.tile([0.0, 0.0, 1.0], (20, 1))
    assert form(ahead, ahead, np.full((20, 2), 1e-6), np.eye(3), np.empty((3, 3))) == np.inf


@pytest.mark.parametrize("count", [1, 2, 15, 40])
@pytest.mark.parametrize("different", [2, 1000])
def test_median(count: int, different: int) -> None:
    values = np.random.default_rng(12).integers(0, different, (20, count)).astype(float)
    # compiled it is part of its kernel only
    median = getattr(_median, "py_func", _median)
    assert all(median(row.copy()) == np.median(row) for row in values)


@pytest.mark.parametrize(("height", "width"), [(60, 90), (60, 50), (35, 90)])
def test_most_similar(height: int, width: int) -> None:
    rng = np.random.default_rng(5)
    one, other = rng.integers(0, 256, (2, 60, 90)).astype(np.uint8)
    other[20:40] = one[20:40]
    one[:9] = 7  # no texture
    one = np.ascontiguousarray(one[:height, :width])
    points = rng.uniform(-5.0, 365.0, (50, 2))
    candidates = points[:, None] + rng.uniform(-30.0, 30.0, (50, 25, 2))
    candidates[:, 7], candidates[:5] = points, -1e6
    scores = np.zeros((2, 50))
    best = most_similar(one, other, points, candidates, 4, 3, scores[0])
    assert np.array_equal(best, most_similar_numpy(one, other, points, candidates, 4, 3, scores[1]))
    assert same(*scores)


def test_along_rays() -> None:
    rng = np.random.default_rng(7)
    rays = np.column_stack([rng.uniform(-1.0, 1.0, (30, 2)), rng.uniform(-0.1, 1.0, 30)])
    shifts = np.outer(np.linspace(0.0, 3.0, 12), [0.11, -0.02, -0.3])
    found, expected = along_rays(rays, shifts, 1e-3), along_rays_numpy(rays, shifts, 1e-3)
    assert found.shape == (360, 2)
    assert np.array_equal(found, expected)
    assert len(along_rays(rays[:0], shifts, 1e-3)) == 0


def test_undistort_radtan() -> None:
    coefficients = (-0.283, 0.0739, 1.9e-4, 1.8e-5)
    m = np.random.default_rng(6).uniform(-0.8, 0.8, (200, 2))
    model = RadialTangential()
    q = model.distort(m, coefficients)[0]
    assert same(model.undistort(q, coefficients), m)
    assert same(CameraModel._newton(model, q, coefficients, q, 20), m)


def test_constrained_solutions() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(101, 30, 7)) * [1.0, 1.0, 1.0, 0.5, 0.5, 0.3, 10.0]
    M = rows.transpose(0, 2, 1) @ rows
    found, expected = np.empty((2, len(M), 6))
    constrained_solutions(M.copy(), 9.81, 1e-13, 12, found)
    constrained_solutions_numpy(M, 9.81, 1e-13, 12, expected)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
    M[0], M[1] = 0.0, np.nan
    constrained_solutions(M, 9.81, 1e-13, 12, found)
    assert np.isnan(found[:2]).all()
    assert np.isfinite(found[2:]).all()


def test_secular_roots() -> None:
    """Of problems of all sizes, and of one without a solution."""
    rng = np.random.default_rng(8)
    values = np.sort(10.0 ** rng.uniform(-6.0, 6.0, (60, 3)), axis=1)
    projected = rng.normal(size=(60, 3)) * 10.0 ** rng.uniform(-6.0, 6.0, (60, 1))
    values[7], projected[8] = np.nan, 0.0
    found, expected = (-values[:, 0] + 1e-12 * values[:, 2] for _ in range(2))
    secular_roots(values, projected, 9.81, 12, found)
    secular_roots_numpy(values, projected, 9.81, 12, expected)
    np.testing.assert_array_equal(found, expected)


def test_eliminate_features() -> None:
    """Features in one or two cameras, some with gaps in their tracks."""
    rng, frames, features = np.random.default_rng(7), 12, 30
    seen = [np.flatnonzero(rng.random(frames) < rng.uniform(0.4, 1.0)) for _ in range(features)]
    frame, starts = np.concatenate(seen), np.append(0, np.cumsum([len(own) for own in seen]))
    views = np.append(0, np.cumsum(rng.integers(1, 3, len(frame))))
    by_pose, by_point = rng.normal(size=(views[-1], 2, 6)), rng.normal(size=(views[-1], 2, 3))
    given = np.tril(rng.normal(size=(6 * frames + 9,) * 2))
    results = []
    for eliminate in (eliminate_features, eliminate_features_numpy):
        information, T = given.copy(), np.empty((len(frame), 3, 6))
        roots = np.empty((features, 3, 3))
        eliminate(by_pose, by_point, frame, views, starts, 0.3, information, roots, T)
        results.append((np.tril(information), roots, T))
        alone, T = np.empty((features, 3, 3)), np.empty(T.shape)
        eliminate(by_pose, by_point, frame, views, starts, 0.3, np.empty((0, 0)), alone, T)
        assert same(alone, roots)
        assert same(T, results[-1][2])
    assert all(same(own, other) for own, other in zip(*results, strict=True))


def test_a_division_by_zero_is_no_exception() -> None:
    """A feature that no observation depends on: its linear system is refused later, as NaN."""
    r, by_pose, none = np.ones((2, 2)), np.ones((2, 2, 6)), np.zeros((2, 2, 0))
    frame, starts = np.array([0, 1]), np.array([0, 2])
    R_f, T, products = np.zeros((1, 3, 3)), np.zeros((1, 3, 13)), np.zeros((13, 13))
    sum_of_features(r, by_pose, np.zeros((2, 2, 3)), none, frame, starts, R_f, T, products)
    assert np.isnan(T).any()
