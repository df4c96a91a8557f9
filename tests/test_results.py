# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Result files: whole or absent, read back as written, and a `latest` link that always works."""

import csv
import io
import json
import logging
import pickle
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from flight import rig

from slam_graph.arrays import GrowingTable
from slam_graph.backend import Estimator
from slam_graph.backend.cost.gating import Innovations
from slam_graph.backend.engine_protocol import StepReport
from slam_graph.cli.options import write_result
from slam_graph.config import load_config
from slam_graph.datasets.groundtruth import read_groundtruth
from slam_graph.datasets.sequence import SequenceInfo
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.geometry.trajectory import NavState, Trajectory
from slam_graph.pipeline.tracking import Stopwatch
from slam_graph.results.frame_table import FrameTable
from slam_graph.results.map_output import PointMap, write_ply
from slam_graph.results.metrics import SCHEMA_VERSION, finite
from slam_graph.results.result_files import ResultFolder
from slam_graph.results.run_input import RunInput
from slam_graph.results.run_logs import TimingLog
from slam_graph.results.run_result import RunResult
from slam_graph.results.saved_run import load_result
from slam_graph.results.segments import Segment, Segments
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations

NOON = datetime(2026, 3, 4, 12, 0, 0, tzinfo=UTC)


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    Files.write_text(path, ["old\n"])

    def fail() -> None:
        with Files.appearing(path) as partial:
            partial.write_text("half")
            assert path.read_text() == "old\n"
            raise RuntimeError("crash")

    with pytest.raises(RuntimeError, match="crash"):
        fail()
    assert path.read_text() == "old\n"
    Files.write_text(path, ["new\n"])
    assert path.read_text() == "new\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_run_folders_never_collide_and_latest_follows(tmp_path: Path) -> None:
    link, folders = tmp_path / "data" / "latest", []
    for _ in range(2):
        with ResultFolder.of_run(tmp_path, "data", NOON) as made:
            folders.append(made.folder)
            made.text("a.txt", ["a\n"])
        assert link.resolve() == made.folder.resolve()
        assert not link.readlink().is_absolute()
    first, second = folders
    assert first.name == "2026-03-04T12-00-00Z"
    assert first != second
    assert sorted(p.name for p in (tmp_path / "data").iterdir()) == sorted(
        [first.name, second.name, "latest"]
    )


def test_a_run_that_fails_leaves_what_it_has_written_and_no_link(tmp_path: Path) -> None:
    def fail(*names: str) -> None:
        with ResultFolder.of_run(tmp_path, "data", NOON) as made:
            for name in names:
                made.text(name, [])
            raise RuntimeError("crash")

    with pytest.raises(RuntimeError, match="crash"):
        fail()
    assert not (tmp_path / "data").exists()
    with pytest.raises(RuntimeError, match="crash"):
        fail("a.txt")
    (folder,) = (tmp_path / "data").iterdir()
    assert [file.name for file in folder.iterdir()] == ["a.txt"]


def test_a_result_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    class Partial:
        def save(self, folder: Path) -> list[Path]:
            (folder / "config.yaml").write_text("")
            raise DataError("disk full")

    with pytest.raises(DataError, match="disk full"):
        write_result(Partial(), "data", tmp_path, [])  # type: ignore[arg-type, type-var]
    assert not (tmp_path / "data").exists()


def test_a_real_folder_called_latest_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "data" / "latest").mkdir(parents=True)
    with pytest.raises(DataError, match="not a link"), ResultFolder.of_run(tmp_path, "data", NOON):
        pass


def test_a_folder_that_cannot_be_made_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(DataError, match="cannot make a folder"),
        ResultFolder.of_run(tmp_path / "file", "data"),
    ):
        pass


def test_timing_table_keeps_stages_that_come_late() -> None:
    log = TimingLog()
    log.append(1, {"read": 1.0})
    log.append(2, {"read": 3.0, "backend": 5.0})
    lines = list(log.csv_lines())
    assert lines == [
        "stamp_ns,backend_ms,read_ms\n",
        "1,,1.0000\n",
        "2,5.0000,3.0000\n",
    ]
    summary = log.summary()
    assert (summary["read"].mean_ms, summary["read"].frames) == (2.0, 2)
    assert (summary["backend"].median_ms, summary["backend"].frames) == (5.0, 1)


def test_frame_table_has_a_cost_for_each_step_that_was_ever_taken() -> None:
    """Frames take different numbers of steps; what is taken back of states leaves the counts."""
    table, seen = FrameTable(), FeatureObservations.empty()
    given: list[tuple[float, ...]] = [(), (8.0, 4.0), (9.0, 3.0, 1.0), (7.0, 6.0)]
    for stamp_ns, costs in enumerate(given):
        report = StepReport(costs=costs)
        report.innovations = Innovations(tested=1, passed_distance=2.0, passed_dof=2, expected=2.0)
        estimator = cast(Estimator, SimpleNamespace(window=None, report=report))
        table.append(FeatureFrame(stamp_ns, (seen,)), 0, estimator, {})
    none = np.zeros(0, np.int64)
    rows = list(csv.DictReader(table.csv_lines(none, None)))
    names = [name for name in rows[0] if name.startswith("cost")]
    assert names == ["cost_before", "cost_after_1", "cost_after_2"]
    assert [[row[name] for name in names] for row in rows] == [
        ["", "", ""],
        ["8", "4", ""],
        ["9", "3", "1"],
        ["7", "6", ""],
    ]
    table.forget_from(2)
    rows = list(csv.DictReader(table.csv_lines(none, None)))
    assert [row["cost_before"] for row in rows] == ["", "8", "", ""]
    assert "cost_after_2" not in rows[0]
    assert [row["tracked"] for row in rows] == ["0"] * 4
    assert [row["nis"] for row in rows] == ["2", "2", "", ""]


@pytest.mark.parametrize("level", [True, False])
def test_cells_of_segments_are_under_their_names(level: bool) -> None:
    """Without an IMU the joint has three rotations; yaw is the one about the vertical."""
    turns = [0.3] if level else [0.1, 0.2, 0.3]
    segments = Segments()
    segments.add(0)
    segments.end(10, "lost, as said")
    segments.add(20, np.diag(np.square([1.0, 2.0, 3.0, *turns])), joined=True)
    segments.add(30)
    segments[1].loops = 7
    poses = np.zeros((3, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    lines = segments.csv_lines(Trajectory(np.array([0, 20, 30]), *poses))
    first, second = csv.DictReader(io.StringIO("".join(lines)))
    assert all(None not in row and None not in row.values() for row in (first, second))
    assert (first["states"], first["sigma_yaw_rad"]) == ("1", "0")
    assert first["ended_by"] == "lost, as said"
    names = "sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_yaw_rad", "loops", "ended_by"
    assert [second[name] for name in names] == ["1", "2", "3", "0.3", "7", ""]
    others = [second[f"sigma_about_{axis}_rad"] for axis in "xy"]
    assert others == (["", ""] if level else ["0.1", "0.2"])
    assert second["joint_first_ns"] == second["joint_cov_55"] == ""
    assert segments[1].joint_sigmas == pytest.approx((0.3, 3.0))


def test_a_joint_is_as_unknown_as_its_worst_rotation() -> None:
    joint = np.diag(np.square([1.0, 2.0, 3.0, 0.1, 0.4, 0.3]))
    assert Segment(0, 1, "none", joint).joint_sigmas == pytest.approx((0.4, 3.0))


def test_growing_table_is_what_one_array_would_be() -> None:
    """Rows over several blocks, cut inside of a block and at its end, and gone on with."""
    rows = np.arange(3.0 * 2500).reshape(-1, 3)
    table = GrowingTable(3)
    assert table.rows().shape == (0, 3)
    table.extend(rows)
    assert np.array_equal(table.rows(), rows)
    for kept in (2049, 2048, 1024, 1023, 0):
        table.cut(kept)
        assert np.array_equal(table.rows(), rows[:kept])
        table.extend(rows[kept:2050])
        assert len(table) == 2050
        assert np.array_equal(table.rows(), rows[:2050])
        table.fill(1030, [0, 2], -1.0)
        expected = rows[:2050].copy()
        expected[1030:, [0, 2]] = -1.0
        assert np.array_equal(table.rows(), expected)
        table.cut(1030)
        table.extend(rows[1030:])


def test_stamps_in_a_growing_table_take_a_fraction_of_their_bytes() -> None:
    table = GrowingTable(1, np.int64)
    table.extend(np.arange(0, 10**12, 10**7)[:, None])
    assert len(pickle.dumps(table)) < 0.25 * table.rows().nbytes


def test_laps_of_a_stopwatch_add_up() -> None:
    watch = Stopwatch()
    watch.lap("read")
    watch.lap("frontend", {"detect": 2.0})
    times = watch.milliseconds
    assert times["total"] == pytest.approx(times["read"] + times["frontend"])
    assert times["frontend.detect"] == 2.0
    assert set(times) == {"total", "read", "frontend", "frontend.detect"}


def test_map_keeps_the_last_estimate_and_reads_back(tmp_path: Path) -> None:
    points = PointMap()
    points.update(10, np.array([1, 2]), np.array([[0.0, 0, 0], [1, 2, 3]]))
    points.update(20, np.array([1, 3]), np.array([[4.0, 5, 6], [np.nan, 0, 0]]))
    path = tmp_path / "map.ply"
    write_ply(path, points.points())
    header, _, body = path.read_bytes().partition(b"end_header\n")
    assert b"element vertex 2\n" in header
    np.testing.assert_array_equal(
        np.frombuffer(body, "<f8").reshape(-1, 3), [[4.0, 5, 6], [1, 2, 3]]
    )


def test_map_of_many_features_is_what_a_table_of_them_would_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("slam_graph.results.map_output.RECENT", 300)
    rng, points = np.random.default_rng(2), PointMap()
    table: dict[int, list[float]] = {}
    for stamp_ns in range(40):
        ids = rng.choice(2000, 50, replace=False)
        positions = rng.normal(size=(50, 3))
        points.update(stamp_ns, ids, positions)
        table.update(zip(ids.tolist(), positions.tolist(), strict=True))
    assert len(points) == len(table)
    assert sorted(points.points().tolist()) == sorted(table.values())


def test_points_of_states_that_are_taken_back_leave_the_map() -> None:
    """Those that were estimated before and not since stay; what comes afterwards is taken."""
    points = PointMap()
    for stamp_ns, ids in ((10, [1, 2, 3]), (20, [2, 3, 4]), (30, [4, 5])):
        points.update(stamp_ns, np.array(ids), np.full((len(ids), 3), float(stamp_ns)))
    points.forget_from(20)
    np.testing.assert_array_equal(points.points(), [[10.0, 10.0, 10.0]])
    points.update(40, np.array([5]), np.full((1, 3), 40.0))
    points.forget_from(50)
    assert len(points) == 2


def test_what_json_cannot_hold_becomes_null() -> None:
    table = {"a": float("nan"), "b": [1.0, float("inf")], "c": {"d": (2, "x")}}
    assert json.loads(json.dumps(finite(table), allow_nan=False)) == {
        "a": None,
        "b": [1.0, None],
        "c": {"d": [2, "x"]},
    }


def result_from(truth: Trajectory, estimate: Trajectory) -> RunResult:
    """A result whose states are a trajectory that another system estimated."""
    start, end = int(estimate.stamps_ns[0]), int(estimate.stamps_ns[-1])
    info = SequenceInfo("clip", "euroc", "images", 2, len(estimate), start, end, 0, True)
    result = RunResult(RunInput(info, load_config(), rig(), start, end, truth))
    for index in range(len(estimate)):
        stamp, zero = int(estimate.stamps_ns[index]), np.zeros(3)
        covariance = np.eye(15) * 1e-4
        biases = {"accel_bias": zero, "gyro_bias": zero}
        state = NavState(stamp, estimate.pose(index), zero, **biases, covariance=covariance)
        result.history.append(state)
        result.segments.add(stamp)
        result.logs.count_frame(stamp, {"total": 1.0}, {"tracked": 10.0, "detect_ms": 1.0})
    result.ending.wall_s = 2.0
    return result


@pytest.mark.data
def test_files_of_a_real_trajectory(tmp_path: Path, data_dir: Path) -> None:
    recording = data_dir / "euroc" / "MH_01_easy_17s"
    truth = read_groundtruth(recording / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    estimate = read_groundtruth(recording / "peers" / "openvins_stereo.tum")
    result = result_from(truth, estimate)
    files = result.save(tmp_path / "out")
    assert {path.name for path in files} == {path.name for path in (tmp_path / "out").iterdir()}
    assert all(path.stat().st_size > 0 for path in files)

    back = read_groundtruth(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_array_equal(back.stamps_ns, estimate.stamps_ns)
    np.testing.assert_allclose(back.positions, estimate.positions, atol=1e-9)
    with (tmp_path / "out" / "states.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(estimate)
    assert float(rows[0]["sigma_position_body_x_m"]) == pytest.approx(0.01)

    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["schema_version"] == SCHEMA_VERSION
    assert metrics["extent"]["coverage"] == 1.0
    assert metrics["accuracy"]["se3"]["ate"]["translation_m"]["rmse"] < 0.0061
    freer = [metrics["accuracy"][mode]["ate"] for mode in ("none", "yaw", "se3", "sim3")]
    errors = [table["translation_m"]["rmse"] for table in freer]
    assert errors == sorted(errors, reverse=True)
    assert metrics["accuracy"]["none"]["rpe"]["translation_m"]["rmse"] < 0.0117
    assert metrics["nees"]["alignment"] == "first_pose"
    assert metrics["features_per_frame"] == {"tracked": 10.0}
    assert metrics["timing"]["real_time_factor"] == pytest.approx(result.input.recorded_s / 2.0)
    assert (tmp_path / "out" / "trajectory.png").read_bytes()[:4] == b"\x89PNG"
    assert load_config(tmp_path / "out" / "config.yaml") == result.config


def test_a_folder_without_a_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no result of a run here"):
        load_result(tmp_path)
    with pytest.raises(DataError, match="no result of a run here"):
        load_result(tmp_path / "nowhere")


def test_the_latest_result_of_a_recording_is_read(tmp_path: Path) -> None:
    info = SequenceInfo("clip", "euroc", "images", 1, 0, 0, 0, 0, False)
    result = RunResult(RunInput(info, load_config(), rig(), 0, 10**9))
    with ResultFolder.of_run(tmp_path, "clip") as made:
        result.save(made.folder)
    folder = made.folder
    saved = load_result(tmp_path / "clip")
    assert (saved.status, len(saved.trajectory)) == ("ok", 0)
    assert saved.smoothed is None
    (folder / "map.ply").write_bytes(b"ply\n")
    with pytest.raises(DataError, match="not a point cloud"):
        saved.points  # noqa: B018
    (folder / "states.csv").write_text("stamp_ns,a\n1,2\n")
    with pytest.raises(DataError, match="not the states of a run"):
        load_result(folder).sigmas  # noqa: B018


def test_a_result_without_states_is_written_too(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    info = SequenceInfo("clip", "euroc", "images", 1, 0, 0, 0, 0, False)
    result = RunResult(RunInput(info, load_config(), rig(), 0, 10**9))
    result.save(tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["accuracy"] is None
    assert metrics["extent"]["coverage"] == 0.0
    assert metrics["extent"]["initialization_s"] is None
    assert (tmp_path / "trajectory.tum").read_text() == ""
