# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph frontend` as users meet it: reports, pictures, recordings, tables."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from slam_graph.cli.main import app
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.errors import ConfigError, DataError
from slam_graph.simulation.simulator import simulate


def frontend(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["frontend", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(data_dir: Path) -> Path:
    return data_dir / "euroc" / "MH_01_easy_17s"


@pytest.mark.data
def test_tracks_are_reported_drawn_filmed_and_recorded(folder: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("tracks.png", "tracks.mp4", "recorded")]
    picture, video, record = files
    options = ("--picture", picture, "--video", video, "--record", record)
    done = frontend(folder, "--start", "3", "--duration", "0.5", "--json", *options)
    assert done.exit_code == 0
    report = json.loads(done.stdout[done.stdout.index("{") :])
    assert report["files"] == [str(file) for file in files]
    assert report["tracks"]["frames"] == 11
    assert report["tracks"]["epipolar_px"] < 0.6
    assert 0.9 < report["inliers"] <= 1.0
    assert {"total", "temporal", "ransac", "detect", "stereo"} <= report["ms"].keys()
    drawn = cv2.imread(str(picture))
    assert drawn.shape == (480, 2 * 752, 3)
    colourful = np.ptp(drawn.astype(int), axis=2) > 60
    assert all(np.count_nonzero(half) > 200 for half in np.split(colourful, 2, axis=1))
    film = cv2.VideoCapture(str(video))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 11
    recorded = open_dataset(record)
    assert (recorded.info().content, recorded.info().frames) == ("tracks", 11)


@pytest.mark.data
def test_front_ends_are_compared_in_a_table(folder: Path) -> None:
    short = ("--start", "3", "--duration", "0.5", "--cameras", "mono")
    done = frontend("compare", folder, "--frontends", "klt/fast,orb", *short)
    assert done.exit_code == 0
    rows = [line.split() for line in done.stdout.splitlines() if line.startswith(("klt", "orb "))]
    assert [row[0] for row in rows] == ["klt/fast", "orb"]
    assert all(float(row[6]) < 2.0 for row in rows)


def test_pictures_are_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture that nobody named is given a number, one that was named is not replaced."""
    monkeypatch.chdir(tmp_path)
    simulate(kind="images", duration_s=0.5, rate_hz=4.0, cameras=1).save(tmp_path / "flight")
    for _ in range(2):
        assert frontend("flight").exit_code == 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"tracks.png", "tracks-2.png"}
    assert "exists already" in str(frontend("flight", "--picture", "tracks.png").exception)
    (tmp_path / "a.mp4").write_text("kept")
    assert "exists already" in str(frontend("flight", "--video", "a.mp4").exception)
    Path("tracks.png").write_text("of before")
    assert frontend("flight", "--picture", "tracks.png", "--force").exit_code == 0
    assert Path("tracks.png").read_bytes().startswith(b"\x89PNG")


def test_faults_are_told() -> None:
    assert isinstance(frontend("demo").exception, DataError)
    unknown = frontend("compare", "demo", "--frontends", "magic").exception
    assert isinstance(unknown, ConfigError)
    assert "unknown front end 'magic'" in str(unknown)
    assert frontend("run", "--help").exit_code == 0
