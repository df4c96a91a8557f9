# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a run: a wrong calibration does not end `ok`, a right one does."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import pytest
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.datasets import kalibr_text
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.pipeline import verdict
from slam_graph.pipeline.run_recording import run
from slam_graph.sensors.rig import Rig, RigCamera
from slam_graph.simulation.simulator import simulate

CAUSAL = ("final_ba.enabled=false",)


def changed(rig: Rig, change: Callable[[RigCamera], RigCamera], first: int = 0) -> Rig:
    """A rig whose cameras from one number on are changed."""
    cameras = [c if k < first else change(c) for k, c in enumerate(rig.cameras)]
    return Rig(tuple(cameras), rig.imu)


def with_double_baseline(rig: Rig) -> Rig:
    origin = rig.cameras[0].body_T_camera.translation()

    def away(camera: RigCamera) -> RigCamera:
        pose = camera.body_T_camera
        place = origin + 2.0 * (pose.translation() - origin)
        return replace(camera, body_T_camera=gtsam.Pose3(pose.rotation(), place))

    return changed(rig, away, 1)


def with_longer_lenses(rig: Rig) -> Rig:
    def longer(camera: RigCamera) -> RigCamera:
        lens = camera.camera
        return replace(camera, camera=replace(lens, fx=1.1 * lens.fx, fy=1.1 * lens.fy))

    return changed(rig, longer)


@pytest.mark.data
@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (with_double_baseline, "calibrated baseline is"),
        (with_longer_lenses, "calibrated focal length is"),
    ],
)
def test_a_wrong_calibration_is_suspect(
    wrong: Callable[[Rig], Rig], named: str, data_dir: Path, tmp_path: Path
) -> None:
    recording = data_dir / "euroc" / "MH_01_easy_17s"
    calibration = tmp_path / "wrong.yaml"
    calibration.write_text(kalibr_text(wrong(open_dataset(recording).rig)), encoding="utf-8")
    done = CliRunner().invoke(
        app,
        [
            *("run", str(recording), "--calibration", str(calibration), "--no-final-ba"),
            *("--no-progress", "--output", str(tmp_path)),
        ],
    )
    assert done.exit_code == 4, done.output
    assert named in done.stderr
    assert "slam-graph doctor" in done.stderr


@pytest.mark.parametrize(("trajectory", "seed", "cameras"), [("figure8", 2, 2), ("random", 3, 1)])
def test_a_right_one_is_not_even_if_it_is_doubted(
    trajectory: str, seed: int, cameras: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verdict, "_MAX_REJECTED", -1.0)  # every run is diagnosed
    sequence = simulate(trajectory=trajectory, cameras=cameras, duration_s=14.0, seed=seed)
    result = run(sequence, overrides=CAUSAL)
    assert result.status == "ok", result.message


def test_a_failed_run_names_the_likeliest_cause() -> None:
    sequence = simulate(trajectory="figure8", cameras=2, duration_s=10.0, seed=1)
    sequence.rig = changed(
        sequence.rig, lambda camera: replace(camera, body_T_camera=camera.body_T_camera.inverse())
    )
    result = run(sequence, overrides=CAUSAL)
    assert result.status in ("not_initialized", "diverged", "low_coverage")
    assert "slam-graph doctor says: the camera is turned" in result.message
