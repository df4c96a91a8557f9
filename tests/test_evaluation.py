# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of alignment, association, errors and trajectory files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.errors import DataError
from slam_graph.evaluation.ape import ape
from slam_graph.evaluation.association import associate, nearest
from slam_graph.evaluation.rpe import rpe
from slam_graph.geometry.alignment import Similarity, align, align_first_pose, umeyama
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.geometry.trajectory_files import (
    nanoseconds,
    read_trajectory,
    seconds_text,
    tum_lines,
)

MODES = ("yaw", "se3", "sim3")


def random_trajectory(seed: int, count: int = 60) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        1_403_636_580_838_555_648 + 50_000_000 * np.arange(count, dtype=np.int64),
        np.cumsum(rng.normal(size=(count, 3)), axis=0),
        Rotation.random(count, rng=rng).as_quat(),
        velocities=rng.normal(size=(count, 3)),
    )


def random_similarity(seed: int, mode: str) -> Similarity:
    rng = np.random.default_rng(seed)
    turn = (
        Rotation.from_euler("z", rng.uniform(-3, 3)) if mode == "yaw" else Rotation.random(rng=rng)
    )
    scale = float(rng.uniform(0.2, 5.0)) if mode == "sim3" else 1.0
    return Similarity(turn.as_matrix(), rng.normal(size=3) * 10, scale)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(3))
def test_alignment_recovers_the_transformation(mode: str, seed: int) -> None:
    estimate = random_trajectory(seed)
    truth = random_similarity(seed, mode)
    found = align(truth.apply(estimate).positions, estimate.positions, mode)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-10)
    assert found.scale == pytest.approx(truth.scale, rel=1e-12)
    error = ape(truth.apply(estimate), estimate, "full", mode)
    assert error.statistics.max < 1e-9


@pytest.mark.parametrize("mode", MODES)
def test_alignment_is_a_minimum(mode: str) -> None:
    rng = np.random.default_rng(5)
    estimate = random_trajectory(1).positions
    reference = estimate + rng.normal(size=estimate.shape)
    best = align(reference, estimate, mode)

    def cost(rotation: np.ndarray, translation: np.ndarray, scale: float) -> float:
        return float(np.sum((reference - scale * estimate @ rotation.T - translation) ** 2))

    least = cost(best.rotation, best.translation, best.scale)
    for _ in range(50):
        step = rng.normal(size=7) * 1e-4
        turn = step[:3] * ((0, 0, 1) if mode == "yaw" else 1)
        scale = best.scale + (step[6] if mode == "sim3" else 0.0)
        rotation = Rotation.from_rotvec(turn).as_matrix() @ best.rotation
        assert cost(rotation, best.translation + step[3:6], scale) > least


def test_a_reflection_is_never_returned() -> None:
    points = np.random.default_rng(2).normal(size=(20, 3))
    assert np.linalg.det(umeyama(points * (1, 1, -1), points).rotation) == pytest.approx(1.0)


def test_first_poses_coincide_after_their_alignment() -> None:
    truth = random_trajectory(3)
    moved = random_similarity(4, "yaw").apply(truth)
    back = align_first_pose(truth, moved).apply(moved)
    np.testing.assert_allclose(back.positions, truth.positions, atol=1e-10)


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_positions_without_extent_cannot_be_aligned(mode: str) -> None:
    still = np.ones((10, 3))
    with pytest.raises(DataError, match="cannot align"):
        align(still, still, mode)


def test_nearest_agrees_with_brute_force() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 50):
        stamps = np.sort(rng.choice(10_000, count, replace=False)).astype(np.int64)
        queries = rng.integers(-500, 10_500, 300)
        expected = np.argmin(np.abs(stamps[None, :] - queries[:, None]), axis=1)
        np.testing.assert_array_equal(nearest(stamps, queries), expected)


def test_association_keeps_to_the_tolerance_and_does_not_depend_on_the_order() -> None:
    reference = np.arange(0, 10**9, 5_000_000, dtype=np.int64)
    estimate = np.array([1_000_000, 52_400_000, 3 * 10**9], dtype=np.int64)
    first = associate(reference, estimate, 0.002)
    assert [i.tolist() for i in first] == [[0], [0]]
    second = associate(reference, estimate, 0.0025)
    assert [i.tolist() for i in second] == [[0, 10], [0, 1]]
    swapped = associate(estimate, reference, 0.0025)
    assert [i.tolist() for i in swapped] == [[0, 1], [0, 10]]


def test_errors_vanish_for_the_truth_and_rpe_ignores_a_common_motion() -> None:
    truth = random_trajectory(8)
    moved = random_similarity(9, "se3").apply(truth)
    assert ape(truth, truth, "full").statistics.max < 1e-12
    assert rpe(truth, moved, "full", delta=3).statistics.max < 1e-9


def test_trajectories_of_different_times_are_refused() -> None:
    truth = random_trajectory(1)
    late = Trajectory(truth.stamps_ns + 10**12, truth.positions, truth.quaternions)
    with pytest.raises(DataError, match="no pose of the estimate"):
        ape(truth, late)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1403636580.838555648", 1403636580838555648),
        ("1403636580.8", 1403636580800000000),
        ("12", 12_000_000_000),
        ("1.403636580838555648e+09", 1403636580838555648),
        ("-0.5", -500_000_000),
        ("0.0000000004", 0),
    ],
)
def test_seconds_are_read_exactly(text: str, expected: int) -> None:
    assert nanoseconds(text) == expected
    assert nanoseconds(seconds_text(expected)) == expected


@pytest.mark.parametrize("text", ["", "nan", "inf", "abc", "1.2.3"])
def test_what_is_not_a_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not a time"):
        nanoseconds(text)


def test_tum_file_keeps_stamps_and_nine_decimals(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    trajectory = random_trajectory(4)
    path.write_text("# comment\n" + "".join(tum_lines(trajectory)))
    back = read_trajectory(path)
    np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(back.positions, trajectory.positions, atol=5.1e-10)
    np.testing.assert_allclose(back.quaternions, trajectory.quaternions, atol=2e-9)


GOOD = "1.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no poses"),
        ("# only a comment\n", "no poses"),
        (GOOD + "2.0 0 0 0 0 0 1\n", ":2: 7 columns, expected 8"),
        (GOOD + "2.0 0 x 0 0 0 0 1\n", ":2: not a row of numbers"),
        (GOOD + "2.0 0 nan 0 0 0 0 1\n", ":2: a value is not finite"),
        (GOOD + "2.0 0 0 0 0 0 0 0\n", ":2: the quaternion is not of unit length"),
        ("\n" + GOOD + GOOD, ":3: the time does not increase"),
        ("1,2,3\n", ":1: 3 columns, expected 8 or 11 or 17"),
    ],
)
def test_malformed_files_are_refused_with_their_line(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_trajectory(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
