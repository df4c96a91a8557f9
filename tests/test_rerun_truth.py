# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run beside its ground truth in Rerun: in metres, and at the right frames and times."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from rerun_rows import rows_of

import slam_graph as sg
from slam_graph.datasets import kalibr_text
from slam_graph.results import SavedRun
from slam_graph.visualization import RerunRecording

CAUSAL = ["final_ba.enabled=false"]
TRUTH = "/world/path/groundtruth"
OFFSET_S = -0.012


def shown(saved: SavedRun, path: Path) -> Path:
    """What `slam-graph view` writes of a run."""
    with RerunRecording("save", "a", path) as recording:
        recording.show_run(saved, saved.points, saved.timing, saved.by_frame, saved.rig)
    return path


def test_errors_and_truth_of_an_unknown_scale_are_in_metres(tmp_path: Path) -> None:
    flight = sg.simulate(trajectory="car", duration_s=6.0, seed=1, cameras=1, with_imu=False)
    sg.run(flight, overrides=CAUSAL).save(tmp_path)
    saved = sg.load_result(tmp_path)
    accuracy = saved.metrics["accuracy"]["sim3"]
    path = shown(saved, tmp_path / "a.rrd")
    values = np.array([row["scalars"] for row in rows_of(path)["/error/position"]])
    rms_m = float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
    assert rms_m == pytest.approx(accuracy["ate"]["translation_m"]["rmse"], rel=1e-3)
    matrices = [
        value
        for chunk in RrdReader(path).stream()
        if str(chunk.entity_path) == TRUTH and chunk.is_static
        for row in chunk.to_record_batch().to_pylist()
        for name, value in row.items()
        if name.endswith("mat3x3") and value is not None
    ]
    scale = np.cbrt(np.linalg.det(np.reshape(matrices[-1], (3, 3))))
    assert accuracy["scale"] > 2.0
    assert scale == pytest.approx(1.0 / accuracy["scale"], rel=0.05)


def test_states_of_a_camera_that_is_late_are_at_their_frames_and_times(tmp_path: Path) -> None:
    """Watched and read back: a negative offset moved all rows to the frame before."""
    rig = sg.simulate(duration_s=1.0).rig
    calibration = tmp_path / "late.yaml"
    cameras = tuple(replace(camera, time_offset_s=OFFSET_S) for camera in rig.cameras)
    calibration.write_text(kalibr_text(replace(rig, cameras=cameras)))
    flight = sg.simulate(
        trajectory="figure8", duration_s=3.0, rate_hz=10.0, calibration=str(calibration)
    )
    watched = tmp_path / "watched.rrd"
    viewer = RerunRecording("save", "a", watched).viewer()
    result = sg.run(flight, overrides=CAUSAL, viewer=viewer)
    result.save(tmp_path / "run")
    saved = sg.load_result(tmp_path / "run")
    stamps_ns = np.asarray(saved.by_frame["stamp_ns"])
    assert saved.by_frame["state_ns"][0] == stamps_ns[0] + round(OFFSET_S * 1e9)
    true_ns = saved.trajectory.stamps_ns
    frames = np.searchsorted(saved.by_frame["state_ns"], true_ns)
    for path in (watched, shown(saved, tmp_path / "saved.rrd")):
        rows = rows_of(path)
        for entity in ("/world/body", "/state/velocity"):
            assert [row["frame"] for row in rows[entity]] == frames.tolist()
            times_ns = [whole_ns(row["sensor_time"]) for row in rows[entity]]
            assert times_ns == true_ns.tolist()
        judged = [row["frame"] for row in rows["/error/position"]]
        assert set(judged) <= set(frames.tolist())
        assert judged[-1] == frames[-1]


def whole_ns(time: object) -> int:
    """A time of Rerun in ns."""
    return int(np.timedelta64(time).astype("timedelta64[ns]").astype(np.int64))
