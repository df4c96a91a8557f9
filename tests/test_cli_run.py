# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph run` as a process: files, exit codes, and nothing lost when it is cut short."""

import json
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from commands import slam_graph
from limits import HANG_S

from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.pipeline.run_recording import run as run_pipeline

COMMAND = [sys.executable, "-m", "slam_graph.cli.main", "run"]

FILES = {
    "trajectory.tum",
    "states.csv",
    "segments.csv",
    "map.ply",
    "trajectory.png",
    "timing.csv",
    "frames.csv",
    "config.yaml",
    "calibration.yaml",
    "metrics.json",
    "run.log",
}

TOO_FAST = ("--set", "limits.max_speed=1e-9", "--set", "limits.recovery=false")
STATIC = ("--set", "backend.initialization.mode=static", "--no-progress")
SHORT = ("--duration", "3", "--set", "min_coverage=0.1", *STATIC)
"""The demo stands still when it begins: looking for a motion there would only take time."""


def run(
    tmp_path: Path, *arguments: str | Path, rendered: bool = False
) -> subprocess.CompletedProcess:
    return slam_graph("run", *arguments, cwd=tmp_path, rendered=rendered)


def latest(tmp_path: Path) -> Path:
    (link,) = tmp_path.glob("results/*/latest")
    return link


def metrics_of(tmp_path: Path) -> dict:
    return json.loads((latest(tmp_path) / "metrics.json").read_text())


def test_a_run_writes_its_files_and_says_where(tmp_path: Path) -> None:
    done = run(tmp_path, "demo", *SHORT, rendered=True)
    assert (done.returncode, done.stderr) == (0, "")
    folder = latest(tmp_path)
    assert {path.name for path in folder.iterdir()} == FILES
    assert (folder / "trajectory.png").stat().st_size > 10_000
    last = done.stdout.splitlines()[-2:]
    assert last[0] == str(folder.resolve().relative_to(tmp_path)) + "/"
    assert set(last[1].split()) == FILES
    metrics = metrics_of(tmp_path)
    assert metrics["status"] == "ok"
    rows = (folder / "trajectory.tum").read_text().splitlines()
    assert len(rows) == metrics["extent"]["estimated_frames"]
    assert all(len(cell.partition(".")[2]) == 9 for cell in rows[0].split())


def test_json_is_all_of_stdout_and_the_settings_run_again(tmp_path: Path) -> None:
    first = json.loads(run(tmp_path, "demo", *SHORT, "--seed", "3", "--json").stdout)
    assert first["seed"] == 3
    folder = tmp_path / first["folder"]
    again = run_pipeline(open_dataset("demo"), load_config(folder / "config.yaml"))
    again.save(tmp_path / "again")
    rows = [(path / "trajectory.tum").read_text() for path in (folder, tmp_path / "again")]
    assert rows[0] == rows[1]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (("--duration", "0.5"), "not_initialized", "error: never initialised in 11 frames: "),
        (("--duration", "3", "--set", "min_coverage=0.99"), "low_coverage", "less than min_cov"),
        (("--duration", "3", *TOO_FAST), "diverged", "error: diverged at"),
    ],
)
def test_a_run_that_fails_its_job_is_exit_code_3_and_written(
    tmp_path: Path, arguments: tuple[str, ...], status: str, message: str
) -> None:
    done = run(tmp_path, "demo", *STATIC, *arguments)
    assert done.returncode == 3
    assert len(done.stderr.splitlines()) == 1
    assert message in done.stderr
    assert metrics_of(tmp_path)["status"] == status
    assert {path.name for path in latest(tmp_path).iterdir()} == FILES
    assert message.removeprefix("error: ") in (latest(tmp_path) / "run.log").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--start", "1000"), "cannot start at 1000 s, it is 30.000 s long"),
        (("--set", "backend.initialization.mode=groundtruth"), "no ground truth to start from"),
        (("--set", "backend.initialization.mode=given"), "no start state comes with the data"),
        (("--cameras", "stereo"), "2 cameras"),
        (("--start", "1000", "--rerun", "save"), "cannot start at 1000 s"),  # nor is a recording
    ],
)
def test_what_the_data_cannot_give_is_exit_code_1(
    tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    done = run(tmp_path, "demo", *arguments)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert message in done.stderr
    assert not list(tmp_path.glob("results/*/*"))


def test_an_interrupted_run_keeps_what_was_done(tmp_path: Path) -> None:
    with subprocess.Popen(
        [*COMMAND, "demo", "--no-progress"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    ) as process:
        deadline = time.monotonic() + HANG_S
        while not list(tmp_path.glob("results/*/*")) and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(0.4)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=HANG_S)
    assert process.returncode == 130, stderr
    assert stderr == "interrupted before the end; what was done so far is written\n"
    metrics = metrics_of(tmp_path)
    assert metrics["status"] == "interrupted"
    assert 0 < metrics["extent"]["frames"] < 601
    assert {path.name for path in latest(tmp_path).iterdir()} == FILES


def test_a_run_can_be_saved_for_rerun(tmp_path: Path) -> None:
    done = run(tmp_path, "demo", *SHORT, "--rerun", "save")
    assert done.returncode == 0
    recording = latest(tmp_path) / "recording.rrd"
    assert recording.read_bytes()[:3] == b"RRF"
    assert recording.stat().st_size > 10_000
    assert {path.name for path in latest(tmp_path).iterdir()} == FILES | {"recording.rrd"}


@pytest.mark.data
def test_ground_truth_is_compared_and_pictured(tmp_path: Path, data_dir: Path) -> None:
    recording = data_dir / "openvins_sim" / "euroc_V1_01"
    done = run(tmp_path, recording, "--cameras", "mono", "--duration", "3", "--no-progress")
    assert done.returncode == 0
    extra = {"groundtruth.tum", "trajectory_smoothed.tum", "states_smoothed.csv"}
    assert {path.name for path in latest(tmp_path).iterdir()} == FILES | extra
    metrics = metrics_of(tmp_path)
    assert metrics["extent"]["start_was_given"] is True
    assert metrics["nees"]["alignment"] == "none"
    ours = metrics["accuracy"]["se3"]["ate"]["translation_m"]["rmse"]
    folder = latest(tmp_path)
    ape = slam_graph("ape", folder / "groundtruth.tum", folder / "trajectory.tum", "-a", "--json")
    assert ape.returncode == 0
    # the files are rounded to 1e-9 m
    assert json.loads(ape.stdout)["statistics"]["rmse"] == pytest.approx(ours, abs=1e-8)
