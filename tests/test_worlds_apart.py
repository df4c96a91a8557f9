# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run that was lost, and whose parts nothing joins: errors are those of each world."""

from pathlib import Path

import numpy as np
import pytest
from rerun_rows import rows_of

import slam_graph as sg
from slam_graph.cli.run import echo_summary
from slam_graph.datasets.faults.injection import inject
from slam_graph.results import RunResult
from slam_graph.results.run_picture import CAUSAL, SMOOTHED, _title
from slam_graph.visualization import RerunRecording


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
    assert metrics["final_ba"]["nees"]["position"]["mean"] < 30.0
    first = lost.segments[0].part_of(lost.trajectory)
    assert metrics["nees"]["states"] <= len(first)  # the place of the second world is not known


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
