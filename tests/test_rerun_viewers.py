# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Where a recording for Rerun goes: windows, viewers that are connected, pictures."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_flights import World
from pose_graphs import laps
from test_rerun import refused
from typer.testing import CliRunner

import slam_graph as sg
from slam_graph.cli.main import app
from slam_graph.errors import DataError
from slam_graph.pose_graph import optimize_pose_graph
from slam_graph.visualization import RerunRecording

NOBODY = "rerun+http://127.0.0.1:9/proxy"
"""An address at which no viewer listens."""


def test_a_window_is_opened_by_the_viewer_that_is_installed_beside(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: dict[str, Any] = {}
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr("rerun.spawn", lambda **arguments: opened.update(arguments))
    monkeypatch.setattr("slam_graph.visualization.rerun_stream.DEFAULT_ADDRESS", NOBODY)
    with pytest.raises(DataError, match="the viewer did not start"):
        RerunRecording("spawn", "name")
    assert Path(opened["executable_path"]).is_file()


def test_a_window_that_does_not_open_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "a.rrd"
    with RerunRecording("save", "a", recording):
        pass
    ends = [sys.executable, "-c", "raise SystemExit(1)"]
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("slam_graph.visualization.rerun_screenshot._viewer_command", lambda: ends)
    with pytest.raises(DataError, match="no window could be opened"):
        RerunRecording.open(recording)


def test_what_cannot_be_shown_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(DataError, match="no display"):
        RerunRecording("spawn", "name")
    with pytest.raises(DataError, match="no Rerun viewer can be reached"):
        RerunRecording("connect", "name", address=NOBODY)
    with pytest.raises(DataError, match="no address of a viewer"):
        RerunRecording("connect", "name", address="localhost")
    with pytest.raises(DataError, match="cannot be written"):
        RerunRecording("save", "name", tmp_path / "nowhere" / "recording.rrd")
    assert "no such file" in refused(tmp_path / "missing.rrd", "--rerun", "serve")
    assert "no such file" in refused(tmp_path / "missing")
    assert "ends with .rrd" in refused("demo", "--output", tmp_path / "file.txt")
    assert "not of the form WxH" in refused("demo", "--size", "big")


def drivers() -> Iterator[Path]:
    for folder in ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"):
        yield from Path(folder).glob("*.json")


def viewers_of(name: str) -> list[Path]:
    """Processes of viewers that show a recording of this name."""
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = process.read_bytes()
        except OSError:
            continue  # it has just ended
        if b"--headless" in words and f"/{name}.rrd".encode() in words:
            found.append(process)
    return found


@pytest.fixture
def graph_file(tmp_path: Path) -> Path:
    graph, _ = laps(2, noise=0.01)
    file = tmp_path / f"{tmp_path.parent.name}_pictured.g2o"
    file.write_text("".join(optimize_pose_graph(graph).g2o_lines()))
    return file


@pytest.mark.skipif(not list(drivers()), reason="no Vulkan driver")
def test_a_picture_is_made_without_a_display(graph_file: Path, tmp_path: Path) -> None:
    import cv2

    picture = tmp_path / "picture.png"
    arguments = ["view", str(graph_file), "--screenshot", str(picture), "--size", "640x400"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.exception
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.shape == (400, 640, 3)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100, "something is drawn"
    assert not viewers_of(graph_file.stem), "the viewer has ended"


def test_without_a_driver_the_error_says_so(
    graph_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(variable, "/nonexistent")
    monkeypatch.setenv("LIBGL_DRIVERS_PATH", "/nonexistent")
    said = refused(graph_file, "--screenshot", tmp_path / "picture.png")
    assert "Vulkan driver" in said
    assert not (tmp_path / "picture.png").exists()


def test_options_that_would_change_nothing_are_refused(tmp_path: Path) -> None:
    """Those of recordings are for what has one, and those of the viewer for what has one."""
    run = tmp_path / "run"
    flight = sg.simulate(trajectory="figure8", duration_s=1.0)
    flight.save(tmp_path / "flight")
    sg.run(flight).save(run)
    kalibr, picture = ("--calibration", run / "calibration.yaml"), ("--output", tmp_path / "a.rrd")
    assert "--calibration is for the recording of" in refused(run, *kalibr, *picture)
    truth = ("--recording", tmp_path / "flight", "--groundtruth", run / "groundtruth.tum")
    assert "--groundtruth changes nothing" in refused(run, *truth, *picture)
    assert "--format is for recordings" in refused(run, run, "--format", "euroc", *picture)
    sg.save_map(World().map(), tmp_path / "map.slam")
    assert "map.slam is none" in refused(tmp_path / "map.slam", *kalibr, *picture)
    (run / "recording.rrd").touch()
    assert "name it by --recording" in refused(run, "--topic", "imu=/imu0", *picture)
    assert "--calibration changes nothing" in refused(run / "recording.rrd", *kalibr)
    address = ("--rerun-address", "rerun+http://127.0.0.1:9876/proxy")
    assert "--rerun-address is for --rerun connect" in refused(run, *address, *picture)
    for words in (["run", "demo", *address], ["run", "demo", "--rerun-detail", "graph"]):
        error = CliRunner().invoke(app, [*words, "--duration", "1"]).exception
        assert isinstance(error, sg.SlamGraphError)
    exported = ["export", run, "--tum", tmp_path / "a.tum", *kalibr]
    error = CliRunner().invoke(app, [str(word) for word in exported]).exception
    assert "--calibration is for the recording of the run" in str(error)
    assert not (tmp_path / "a.tum").exists()
