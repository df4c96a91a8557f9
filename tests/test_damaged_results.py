# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files of results, damaged in many ways: each gives one line of ours, or is read.

`view`, `export` and `batch` take them, and they may come from anywhere.
"""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from damage import CAMPAIGN, tried
from sound import sound_rig, sound_table, sound_trajectory

import slam_graph as sg
from slam_graph.experiment.batch_summary import _measured
from slam_graph.experiment.path_thumbnail import thumbnail
from slam_graph.results import SavedRun

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

FRAMES = 5
"""Tables are cut to so many rows: damage then meets what is special more often."""


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What is dropped and counted is not written down for each of the many files."""
    caplog.set_level(logging.CRITICAL, logger="slam_graph")


@pytest.fixture(scope="module")
def result() -> sg.RunResult:
    """A short run with ground truth."""
    done = sg.run(sg.simulate(trajectory="figure8", duration_s=3.0, rate_hz=10.0, seed=1))
    done.check()
    return done


@pytest.fixture(scope="module")
def saved(result: sg.RunResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its files, with loop closures and poses in a map."""
    folder = tmp_path_factory.mktemp("saved") / "run"
    result.save(folder)
    (folder / "trajectory.png").unlink()
    for pattern, titles in (("*.tum", 0), ("*.csv", 1)):
        for file in folder.glob(pattern):
            lines = file.read_text().splitlines(keepends=True)
            file.write_text("".join(lines[: FRAMES + titles]))
    for name in ("trajectory_loop.tum", "trajectory_map.tum"):
        shutil.copy(folder / "trajectory.tum", folder / name)
    first_ns, last_ns = result.trajectory.stamps_ns[[0, FRAMES - 1]]
    titles = "first_stamp_ns,second_stamp_ns,inliers,matches,accepted\n"
    (folder / "loops.csv").write_text(f"{titles}{first_ns},{last_ns},20,30,1\n")
    (folder / "config.yaml").write_text("algorithm: msckf\nseed: 1\nbackend: {noise: {}}\n")
    header, end, body = (folder / "map.ply").read_bytes().partition(b"end_header\n")
    count = str(len(body) // 24).encode()
    (folder / "map.ply").write_bytes(header.replace(count, b"9") + end + body[: 9 * 24])
    return folder


def read_run(folder: Path) -> None:
    """Everything that commands take from a result."""
    run = SavedRun(folder)
    paths = (run.trajectory, run.smoothed, run.loop_closed, run.in_map, run.groundtruth)
    for path in paths:
        if path is not None and len(path):
            sound_trajectory(path)
    for sigmas in (run.sigmas, run.smoothed_sigmas):
        assert sigmas is None or sigmas.shape[1] == 15
    assert np.isfinite(run.points**2).all()
    sound_rig(run.rig)
    sound_table(run.config.model_dump(mode="json"))
    for text in (repr(run), thumbnail(run), run.status, run.message, str(run._facts())):
        assert isinstance(text, str)
    view = run._view()
    assert all(np.isfinite(path.positions).all() for path in view.paths.values())
    assert set(map(len, (*run.timing.values(), *run.by_frame.values()))) <= set(range(FRAMES + 3))
    assert run.keyframes_ns.dtype == run.loop_ends_ns.dtype == np.int64
    nees = run.nees_series
    assert nees is None or np.isfinite(nees[1]).all()
    _measured(run.metrics)
    if CAMPAIGN and run.metrics["status"] != "ok":  # it takes a second
        run.plot()


@pytest.mark.parametrize(
    "name",
    [
        *("metrics.json", "config.yaml", "calibration.yaml", "map.ply"),
        *("trajectory.tum", "trajectory_smoothed.tum", "trajectory_loop.tum"),
        *("trajectory_map.tum", "groundtruth.tum"),
        *("states.csv", "states_smoothed.csv", "frames.csv", "timing.csv", "loops.csv"),
    ],
)
def test_runs(saved: Path, tmp_path: Path, name: str) -> None:
    folder = shutil.copytree(saved, tmp_path / "run")
    tried(folder / name, lambda: read_run(folder))
