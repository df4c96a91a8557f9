# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run that was lost, and whose parts nothing joins: errors are those of each world."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun_rows import rows_of
from scipy.spatial.transform import Rotation

import slam_graph as sg
from slam_graph.cli.run import echo_summary
from slam_graph.datasets.faults.injection import inject
from slam_graph.errors import DataError
from slam_graph.evaluation import nees_of_run, synchronize
from slam_graph.geometry import Similarity, Trajectory
from slam_graph.loop_closure import LoopClosures
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.loop_closure.loop_verification import Loop
from slam_graph.pose_graph import Poses
from slam_graph.results import RunResult
from slam_graph.results.run_picture import (
    CAUSAL,
    LOOPS_CLOSED,
    SMOOTHED,
    PoseEstimate,
    RunView,
    _title,
)
from slam_graph.results.segments import Segments
from slam_graph.visualization import RerunRecording
from slam_graph.visualization.rerun_truth import JudgedRun


@pytest.fixture(scope="module")
def lost() -> RunResult:
    """A run of two cameras without an IMU in two worlds."""
    flight = sg.simulate(
        trajectory="figure8", duration_s=7.0, rate_hz=10.0, seed=1, cameras=2, with_imu=False
    )
    cut = inject(flight, ["all_missing:at_s=3,duration_s=1.2"])
    result = sg.run(cut, overrides=["backend.initialization.mode=motion"])
    assert [segment.joined_by for segment in result.segments] == ["start", "none"]
    return result


def rmse_m(accuracy: dict[str, dict[str, dict[str, dict[str, float]]]]) -> float:
    return accuracy["se3"]["ate"]["translation_m"]["rmse"]


def test_errors_are_those_of_each_world(lost: RunResult) -> None:
    metrics = lost.metrics
    (boundary,) = metrics["extent"]["world_breaks_ns"]
    assert lost.segments[0].end_ns < boundary < lost.segments[1].begin_ns
    for whole, name in (
        (metrics["accuracy"], "accuracy"),
        (metrics["final_ba"]["accuracy"], "smoothed"),
    ):
        parts = [rmse_m(segment[name]) for segment in metrics["segments"]]
        assert max(parts) < 0.05
        assert min(parts) <= rmse_m(whole) <= max(parts)
    assert metrics["accuracy"]["sim3"]["scale"] is None


def test_the_smoothed_nees_is_that_of_all_worlds_and_the_causal_one_says_what_it_lacks(
    lost: RunResult,
) -> None:
    causal, smoothed = lost.metrics["nees"], lost.metrics["final_ba"]["nees"]
    second = lost.segments[1].part_of(lost.trajectory)
    assert causal["left_out"] == len(second)  # the place of the second world is not known
    assert causal["states"] + causal["left_out"] == len(lost.trajectory)
    assert lost.smoothed is not None
    assert lost.final_ba is not None
    assert lost.groundtruth is not None
    assert (smoothed["states"], smoothed["left_out"]) == (len(lost.smoothed), 0)
    breaks_ns = lost.segments.breaks_ns()
    history = lost.final_ba.history
    found, _ = nees_of_run(lost.groundtruth, history, False, lost.final_ba, breaks_ns)
    for part in (found.stamps_ns < breaks_ns[0], found.stamps_ns > breaks_ns[0]):
        assert 0.5 < found.position[part].mean() < 10.0
        assert 0.5 < found.orientation[part].mean() < 10.0


def test_a_summary_says_that_there_are_two_worlds(
    lost: RunResult, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    echo_summary(lost, tmp_path, [])
    printed = capsys.readouterr().out
    assert "2, of which nothing joins one with another" in printed
    rows = [line.split() for line in printed.splitlines() if line[:2] in ("0 ", "1 ")]
    assert [row[3] for row in rows] == ["start", "none"]
    assert "each of 2 worlds by itself" in _title(lost.metrics)
    assert lost._facts()["worlds"] == "each of 2 worlds by itself"


def test_a_picture_has_each_world_where_it_is(lost: RunResult, tmp_path: Path) -> None:
    lost.save(tmp_path)
    for view in (lost._view(), sg.load_result(tmp_path)._view()):
        assert view.truth is not None
        for name in (CAUSAL, SMOOTHED):
            path = view.estimates[name].trajectory
            assert sg.ape(view.truth, path).statistics.rmse < 0.05
            sigmas = view.estimates[name].world_sigmas()
            assert np.nanmax(sigmas[:, :3]) < 1.0


def test_rerun_has_the_truth_in_each_world(lost: RunResult, tmp_path: Path) -> None:
    lost.save(tmp_path)
    saved, path = sg.load_result(tmp_path), tmp_path / "a.rrd"
    with RerunRecording("save", "a", path) as recording:
        recording.show_run(saved, saved.points, saved.timing, saved.by_frame, saved.rig)
    values = np.array([row["scalars"] for row in rows_of(path)["/error/position"]])
    rms_m = float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
    assert rms_m == pytest.approx(rmse_m(lost.metrics["accuracy"]), rel=1e-3)


@pytest.mark.parametrize("accepted", [True, False])
def test_what_loops_have_joined_is_one_world_in_all_that_is_said_of_their_path(
    lost: RunResult, accepted: bool, tmp_path: Path
) -> None:
    """A loop between the two worlds, and poses of its graph that are right or as they were."""
    best = lost.best_trajectory
    assert lost.groundtruth is not None
    true, own = synchronize(lost.groundtruth, best[::3])
    nothing = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 32), np.uint8), np.zeros((0, 3))
    keyframes = [
        Keyframe(stamp_ns, pose, *nothing)
        for stamp_ns, pose in zip(own.stamps_ns.tolist(), own, strict=True)
    ]
    relative = true.pose(0).between(true.pose(len(true) - 1))
    pairs = np.zeros((0, 2), np.int64)
    loop = Loop(0, len(true) - 1, relative, np.eye(6), inliers=9, matches=9, pairs=pairs)
    mask, poses = np.array([accepted]), Poses.from_gtsam(list(true if accepted else own))
    loops = LoopClosures(keyframes, [loop], mask, poses, lost.segments.later)
    assert loops.accepted_ns().tolist() == [[own.stamps_ns[0], own.stamps_ns[-1]]][: int(accepted)]

    joined = replace(lost, loops=loops)
    joined.save(tmp_path)
    saved = sg.load_result(tmp_path)
    breaks_ns = joined.metrics["extent"]["world_breaks_ns"]
    assert len(breaks_ns) == 1
    for result in (joined, saved):
        table = result.metrics["loop_closure"]
        assert table["world_breaks_ns"] == ([] if accepted else breaks_ns)
        assert rmse_m(table["accuracy"]) < 0.05
        paths, truth = result._view().paths, result._view().truth
        assert list(paths) == [LOOPS_CLOSED][: int(accepted)]
        assert truth is not None
        for path in paths.values():
            assert sg.ape(truth, path).statistics.rmse < 0.05
        worlds = JudgedRun.of(result, truth).true_paths(truth)
        assert len(worlds) == (3 if accepted else 2)
    (tmp_path / "metrics.json").write_text(
        (tmp_path / "metrics.json").read_text().replace('"accepted"', '"world_breaks_ns": 1, "x"')
    )
    with pytest.raises(DataError, match="loop_closure"):
        _ = sg.load_result(tmp_path).metrics


A, B, C, D = 5, 25, 45, 65
"""Times within four segments, 10 ns long and 10 ns apart."""


@pytest.mark.parametrize(
    ("loops", "breaks"),
    [
        ([], [15, 35]),
        ([(A, C)], [15, 35]),  # A, B, A: the world in between is still another
        ([(D, A)], [15, 35]),
        ([(B, C)], [15]),
        ([(A, B)], [35]),
        ([(A, C), (D, B)], []),  # the IMU joins C and D, and so A and B
        ([(C, D), (A, A)], [15, 35]),
    ],
)
def test_worlds_in_a_row_are_one_where_loops_connect_them(
    loops: list[tuple[int, int]], breaks: list[int]
) -> None:
    segments = Segments()
    for begin_ns, joined in ((0, False), (20, False), (40, False), (60, True)):
        segments.add(begin_ns, joined=joined)
        segments.add(begin_ns + 10)
        segments.end(begin_ns + 10, "lost")
    assert [segment.joined_by for segment in segments] == ["start", "none", "none", "imu"]
    assert segments.breaks_ns(np.reshape(loops, (-1, 2)).astype(np.int64)) == breaks
    assert segments.breaks_ns() == [15, 35]
    assert Segments().breaks_ns() == []


def three_worlds() -> tuple[Trajectory, Trajectory, Trajectory, list[int]]:
    """A path, an estimate in three worlds, one after loops have joined the last two, its breaks."""
    angles = np.linspace(0.0, 6.0, 60)
    way = np.column_stack([2.0 * np.cos(angles), np.sin(angles), 0.2 * angles])
    turns = Rotation.from_euler("z", angles[:, None]).as_quat()
    truth = Trajectory(np.arange(60, dtype=np.int64) * 100_000_000, way, turns)
    places = [
        Similarity(Rotation.from_euler("z", yaw).as_matrix(), np.array([far, -far, 1.0]))
        for yaw, far in ((0.5, 3.0), (-1.0, 50.0), (2.0, -80.0))
    ]
    parts = [truth[:20], truth[20:40], truth[40:]]
    lost = [place.apply(part) for place, part in zip(places, parts, strict=True)]
    closed = [lost[0], lost[1], places[1].apply(parts[2])]
    breaks_ns = [int(truth.stamps_ns[row]) for row in (20, 40)]
    return truth, Trajectory.concatenate(lost), Trajectory.concatenate(closed), breaks_ns


def test_a_picture_aligns_paths_after_loop_closure_by_the_worlds_that_are_left() -> None:
    truth, causal, closed, breaks_ns = three_worlds()
    estimate = PoseEstimate(causal, np.tile(np.eye(6) * 1e-4, (60, 1, 1)))
    points = np.zeros((0, 3))
    views = [
        RunView({CAUSAL: estimate}, {LOOPS_CLOSED: closed}, truth, points, 0, left_ns)
        for left_ns in (breaks_ns[:1], [])
    ]
    errors_m = [
        sg.ape(truth, view.aligned("yaw", breaks_ns).paths[LOOPS_CLOSED]).statistics.rmse
        for view in views
    ]
    assert errors_m[0] < 1e-6
    assert errors_m[1] > 1.0


def test_rerun_has_the_truth_of_the_path_after_loop_closure() -> None:
    truth, causal, closed, breaks_ns = three_worlds()
    paths = JudgedRun(
        truth, causal, causal, np.zeros((60, 6)), "yaw", breaks_ns, closed, breaks_ns[:1]
    ).true_paths(truth)
    assert [len(path) for path in paths] == [20, 20, 20, 20, 40]
    np.testing.assert_allclose(np.concatenate(paths[:3]), causal.positions, atol=1e-6)
    np.testing.assert_allclose(np.concatenate(paths[3:]), closed.positions, atol=1e-6)
