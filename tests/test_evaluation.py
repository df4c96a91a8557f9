# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of alignment, association, errors and trajectory files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.errors import ConfigError, DataError
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.evaluation.choices import PAIRINGS, DeltaUnit
from slam_graph.evaluation.relative_pose_error import rpe
from slam_graph.evaluation.truth_pairing import associate, nearest, synchronize
from slam_graph.geometry.trajectory import Trajectory, interpolate, seconds_text
from slam_graph.geometry.trajectory_alignment import AlignmentMode, Similarity

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
    found = Similarity.of_positions(truth.apply(estimate).positions, estimate.positions, mode)
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
    best = Similarity.of_positions(reference, estimate, mode)

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
    assert np.linalg.det(
        Similarity.of_positions(points * (1, 1, -1), points, "se3").rotation
    ) == pytest.approx(1.0)


def test_first_poses_coincide_after_their_alignment() -> None:
    truth = random_trajectory(3)
    moved = random_similarity(4, "yaw").apply(truth)
    back = Similarity.of_first_pose(truth, moved).apply(moved)
    np.testing.assert_allclose(back.positions, truth.positions, atol=1e-10)


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_positions_without_extent_cannot_be_aligned(mode: str) -> None:
    still = np.ones((10, 3))
    with pytest.raises(DataError, match="cannot align"):
        Similarity.of_positions(still, still, mode)


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
@pytest.mark.parametrize("seed", range(4))
def test_what_stands_is_not_aligned_by_noise(mode: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, still = rng.normal(size=(200, 3)) * 1e-4, rng.normal(size=(200, 3)) * 1e-3
    with pytest.raises(DataError, match="cannot align"):
        Similarity.of_positions(truth, still, mode)
    Similarity.of_positions(truth, still, mode, doubtful=True)


CIRCLES_M, DRIFT_M = 3.0, 30.0


def circles_and_what_drifts_away(drift_m: float = DRIFT_M) -> tuple[Trajectory, Trajectory]:
    """A path over circles, and an estimate of it that drifts along a line on the way."""
    turns = np.linspace(0.0, 8.0 * np.pi, 400)
    circles = np.column_stack([np.cos(turns), np.sin(turns), 0.3 * np.sin(2.0 * turns)])
    stamps_ns = np.arange(400, dtype=np.int64) * 50_000_000
    truth = Trajectory(stamps_ns, CIRCLES_M * circles, np.tile([0.0, 0.0, 0.0, 1.0], (400, 1)))
    away = np.linspace(0.0, drift_m, 400)[:, None] * np.array([0.6, -0.8, 0.0])
    return truth, Trajectory(stamps_ns, truth.positions + away, truth.quaternions)


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_an_estimate_that_drifts_away_has_an_error(mode: AlignmentMode) -> None:
    truth, estimate = circles_and_what_drifts_away()
    error_m = ape(truth, estimate, alignment=mode).statistics.rmse
    # a scale may shrink all to one place, from where the circles are as far away as they are wide
    assert error_m > 0.8 * CIRCLES_M
    if mode != "sim3":
        assert error_m > 0.2 * DRIFT_M  # that of a line, σ = 1/√12 of it, less what a turn gains
        further = ape(*circles_and_what_drifts_away(10 * DRIFT_M), alignment=mode)
        assert further.statistics.rmse > 5.0 * error_m


@pytest.mark.parametrize("mode", ["se3", "yaw"])
def test_an_estimate_that_goes_nowhere_near_the_truth_is_refused_only_if_that_stands(
    mode: AlignmentMode,
) -> None:
    truth, _ = circles_and_what_drifts_away()
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(400, 3))
    stands, apart = (replace(truth, positions=size * noise) for size in (0.01, 1.0))
    with pytest.raises(DataError, match=r"cannot align .* stand"):
        ape(stands, truth, alignment=mode)
    for wrong in (stands, apart):
        assert ape(truth, wrong, alignment=mode).statistics.rmse > 0.8 * CIRCLES_M


def test_a_world_that_drifts_away_counts_among_others() -> None:
    truth, drifted = circles_and_what_drifts_away()
    middle = int(truth.stamps_ns[200])
    estimate = Trajectory.concatenate([truth[:200], drifted[200:]])
    found = ape(truth, estimate, alignment="yaw", breaks_ns=[middle])
    assert found.poses == len(truth)
    assert found.statistics.max > 0.2 * DRIFT_M
    assert found.values[:200].max() < 1e-9


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_a_short_way_is_aligned_in_spite_of_noise(mode: str) -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(0.0, 2.0, 10)
    truth = 3e-3 * np.column_stack([np.cos(angles), np.sin(angles), angles])
    turned = truth @ Rotation.from_euler("z", 0.5).as_matrix()
    found = Similarity.of_positions(truth, turned + rng.normal(size=(10, 3)) * 3e-4, mode)
    assert Rotation.from_matrix(found.rotation).as_rotvec() == pytest.approx([0, 0, 0.5], abs=0.3)


@pytest.mark.parametrize("mode", ["se3", "sim3", "yaw"])
def test_a_line_with_noise_is_aligned_along_it(mode: str) -> None:
    rng = np.random.default_rng(1)
    way = np.column_stack([np.linspace(0.0, 5.0, 300), np.zeros((300, 2))])
    truth, estimate = (way + rng.normal(size=(300, 3)) * 1e-3 for _ in range(2))
    turned = estimate @ Rotation.from_euler("z", 0.5).as_matrix()
    found = Similarity.of_positions(truth, turned, mode)
    left = truth - (found.scale * turned @ found.rotation.T + found.translation)
    assert np.abs(left).max() < 0.01
    assert found.scale == pytest.approx(1.0, abs=1e-3)


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


def steady_motion(stamps_ns: np.ndarray) -> Trajectory:
    """Constant speed and constant rate of turn, which interpolation follows exactly."""
    seconds = stamps_ns * 1e-9
    turn = Rotation.from_euler("x", 0.3) * Rotation.from_rotvec(np.outer(seconds, (0, 0.5, 1.0)))
    return Trajectory(stamps_ns, np.outer(seconds, (1.0, 2.0, 3.0)), turn.as_quat())


@pytest.mark.parametrize("offset_ms", [0.0, 1.0, 2.5])
def test_an_exact_estimate_has_no_error_wherever_the_stamps_of_the_truth_are(
    offset_ms: float,
) -> None:
    truth = steady_motion(np.arange(0, 10**9, 5_000_000, dtype=np.int64))
    stamps = np.arange(50_000_000, 9 * 10**8, 50_000_000, dtype=np.int64)
    exact = steady_motion(stamps + round(offset_ms * 1e6))
    for error in (ape(truth, exact, "full"), rpe(truth, exact, "full", delta=3)):
        assert error.poses == len(exact)
        assert error.statistics.max < 1e-12
    speed_m_s = float(np.linalg.norm((1.0, 2.0, 3.0)))
    floor_m = ape(truth, exact, pairing="nearest").statistics.mean
    assert floor_m == pytest.approx(speed_m_s * offset_ms * 1e-3, abs=1e-9)


def test_the_truth_is_not_made_up_in_a_gap_or_beyond_its_ends() -> None:
    stamps = np.arange(0, 10**9, 10**7, dtype=np.int64)
    outside_gap = (stamps < 3 * 10**8) | (stamps > 6 * 10**8)
    truth = steady_motion(stamps[outside_gap])
    estimate = steady_motion(np.arange(-(10**8), 12 * 10**8, 4 * 10**7 + 1, dtype=np.int64))
    own = synchronize(truth, estimate)[1].stamps_ns
    ends = truth.stamps_ns[[0, -1]]
    assert own.min() >= ends[0]
    assert own.max() <= ends[1]
    assert not np.any((own > 3 * 10**8) & (own < 6 * 10**8))
    bridged = synchronize(truth, estimate, limit_s=0.4)[1].stamps_ns
    assert np.any((bridged > 3 * 10**8) & (bridged < 6 * 10**8))


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ({"alignment": "SE3"}, "unknown alignment 'SE3'; did you mean 'se3'"),
        ({"relation": "bogus"}, "unknown relation 'bogus'; known: full, trans_part"),
        ({"relation": "angle_degrees"}, "did you mean 'angle_deg'"),
        ({"pairing": "nearst"}, "unknown pairing 'nearst'; did you mean 'nearest'"),
    ],
)
def test_unknown_words_are_errors(arguments: dict[str, str], hint: str) -> None:
    truth = random_trajectory(1)
    for function in (ape, rpe):
        with pytest.raises(ConfigError, match=hint):
            function(truth, truth, **arguments)
    with pytest.raises(ConfigError, match="unknown unit of a step 'metres'"):
        rpe(truth, truth, unit="metres")


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (1403636580838555648, "1403636580.838555648"),
        (5, "0.000000005"),
        (-500_000_000, "-0.500000000"),
    ],
)
def test_seconds_keep_every_nanosecond(stamp_ns: int, text: str) -> None:
    assert seconds_text(stamp_ns) == text


def test_tum_file_keeps_stamps_and_nine_decimals(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    trajectory = random_trajectory(4)
    path.write_text("# comment\n" + "".join(trajectory.tum_lines()))
    back = read_groundtruth(path)
    np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(back.positions, trajectory.positions, atol=5.1e-10)
    np.testing.assert_allclose(back.quaternions, trajectory.quaternions, atol=2e-9)


def test_interpolation_keeps_the_poses_and_follows_a_steady_motion() -> None:
    stamps = np.arange(0, 10**9, 10**8, dtype=np.int64)
    steady = steady_motion(stamps)
    fine = np.arange(-(10**8), 11 * 10**8, 25 * 10**6, dtype=np.int64)
    found, valid = interpolate(steady, fine)
    np.testing.assert_array_equal(valid, (fine >= 0) & (fine <= stamps[-1]))
    expected = steady_motion(fine[valid])
    np.testing.assert_allclose(found.positions, expected.positions)
    turns = Rotation.from_quat(expected.quaternions).inv() * Rotation.from_quat(found.quaternions)
    assert turns.magnitude().max() < 1e-12


def test_parts_make_the_whole_again_with_the_columns_that_all_have() -> None:
    whole = random_trajectory(6)
    parts = [whole[:20], whole[20:20], whole[20:]]
    joined = Trajectory.concatenate(parts)
    for name in ("stamps_ns", "positions", "quaternions", "velocities"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
    assert joined.gyro_biases is None
    without = replace(whole[20:], velocities=None)
    assert Trajectory.concatenate([whole[:20], without]).velocities is None


def test_nothing_is_made_up_inside_a_gap() -> None:
    stamps = np.array([0, 10**8, 10**9], dtype=np.int64)
    gappy = Trajectory(stamps, np.zeros((3, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
    _, valid = interpolate(gappy, np.array([0, 5 * 10**7, 5 * 10**8, 10**9]), max_gap_s=0.2)
    assert valid.tolist() == [True, True, False, True]


def test_worlds_are_aligned_apart_and_no_step_leads_from_one_to_another() -> None:
    truth = random_trajectory(4)
    parts = [truth[:25], truth[25:26], truth[26:]]
    moved = [random_similarity(k, "sim3").apply(part) for k, part in enumerate(parts)]
    estimate = Trajectory.concatenate(moved)
    breaks = [int(truth.stamps_ns[row]) for row in (25, 26)]
    assert ape(truth, estimate, alignment="sim3").statistics.rmse > 0.1
    found = ape(truth, estimate, alignment="sim3", breaks_ns=breaks)
    assert found.statistics.max < 1e-9
    assert found.poses == len(truth) - 1  # a world of one pose cannot be aligned
    assert np.isnan(found.alignment.scale)
    steps = rpe(truth, estimate, alignment="sim3", breaks_ns=breaks)
    assert len(steps) == 24 + 33
    assert steps.statistics.max < 1e-9
    for path, part in zip(found.alignment.to_estimate(truth), (moved[0], moved[2]), strict=True):
        np.testing.assert_allclose(path, part.positions, atol=1e-9)
    with pytest.raises(DataError, match="cannot align"):
        ape(truth[:2], estimate[:2], alignment="se3", breaks_ns=breaks[:1])


def test_samples_too_far_apart_are_named_with_what_is_bridged() -> None:
    truth = random_trajectory(1)
    with pytest.raises(DataError, match=r"samples are 0\.30 s apart, and at most 0\.2 s"):
        ape(truth[::6], truth[1::6])
    later = Trajectory(truth.stamps_ns + 10**12, truth.positions, truth.quaternions)
    with pytest.raises(DataError, match="check their clocks"):
        ape(truth, later)


def test_limits_of_any_length_bridge_all() -> None:
    truth = random_trajectory(2)
    for pairing in PAIRINGS:
        found = ape(truth[::10], truth, pairing=pairing, limit_s=np.inf)
        assert len(found) >= 6


@pytest.mark.parametrize(
    ("delta", "unit", "message"),
    [
        (2.4, "f", "whole number of frames"),
        (0.0, "f", "too short"),
        (np.inf, "f", "finite"),
        (np.inf, "m", "finite"),
        (np.nan, "d", "finite"),
        (1e300, "f", "no step of"),
        (1e300, "m", "no step of"),
    ],
)
def test_lengths_of_steps_without_a_meaning_are_refused(
    delta: float, unit: DeltaUnit, message: str
) -> None:
    path = random_trajectory(3)
    for all_pairs in (False, True):
        with pytest.raises(DataError, match=message):
            rpe(path, path, delta=delta, unit=unit, all_pairs=all_pairs)


@pytest.mark.parametrize("unit", ["f", "m", "d", "r"])
def test_one_pose_has_no_step(unit: DeltaUnit) -> None:
    path = random_trajectory(3)
    for all_pairs in (False, True):
        with pytest.raises(DataError, match="no step of"):
            rpe(path, path[:1], unit=unit, all_pairs=all_pairs)
