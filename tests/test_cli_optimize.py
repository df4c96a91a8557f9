# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph optimize` as a process: files, exit codes, and nothing overwritten."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import slam_graph
from pose_graphs import laps
from typer.testing import CliRunner

from slam_graph.cli.main import app
from slam_graph.errors import SlamGraphError
from slam_graph.pose_graph.graph_files import g2o_lines, read_pose_graph

FILES = {
    "optimized.g2o",
    "trajectory.tum",
    "edges.csv",
    "config.yaml",
    "metrics.json",
    "pose_graph.png",
    "run.log",
}


def run(tmp_path: Path, *arguments: str | Path) -> subprocess.CompletedProcess:
    return slam_graph("optimize", *arguments, cwd=tmp_path)


def refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str | Path
) -> SlamGraphError:
    """What the command raises, without a process of its own."""
    monkeypatch.chdir(folder)
    error = CliRunner().invoke(app, ["optimize", *map(str, arguments)]).exception
    assert isinstance(error, SlamGraphError)
    return error


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    made, truth = laps(3, 0.05)
    path = tmp_path / "laps.g2o"
    path.write_text("".join(g2o_lines(made, truth)))
    return path


def test_everything_that_is_asked_for_is_written(tmp_path: Path, graph: Path) -> None:
    done = run(tmp_path, graph, "--certify", "--covariances", "--save", "best.g2o", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    metrics = json.loads(done.stdout)
    folder = tmp_path / "results" / "laps" / "latest"
    assert {path.name for path in folder.iterdir()} == FILES | {"covariances.csv", "certified.g2o"}
    assert metrics["certificate"]["certified"]
    assert metrics["chi2"]["after"]["gtsam_error"] < metrics["chi2"]["before"]["gtsam_error"]
    best = (tmp_path / "best.g2o").read_text()
    assert best == (folder / "optimized.g2o").read_text()
    tum = np.loadtxt(folder / "trajectory.tum")
    estimates = read_pose_graph(folder / "optimized.g2o").estimates
    assert estimates is not None
    np.testing.assert_allclose(tum[:, 1:4], estimates.translations, atol=1e-9)
    assert tum[:, 0].tolist() == list(range(60))
    settings, more = str(folder / "config.yaml"), str(tmp_path / "more")
    arguments = ["optimize", str(graph), "--config", settings, "--output", more, "--json"]
    again = CliRunner().invoke(app, arguments)
    assert json.loads(again.stdout)["chi2"]["after"] == metrics["chi2"]["after"]


def test_a_file_is_replaced_only_by_force(
    tmp_path: Path, graph: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.g2o").write_text("precious")
    assert "--force" in str(refused(tmp_path, monkeypatch, graph, "--save", "mine.g2o"))
    assert (tmp_path / "mine.g2o").read_text() == "precious"
    assert not (tmp_path / "results").exists()
    arguments = ["optimize", str(graph), "--save", "mine.g2o", "--force", "--robust", "gnc"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0
    assert len(read_pose_graph(tmp_path / "mine.g2o").keys) == 60
    assert "0 edges rejected" in done.stdout


def test_a_cut_file_is_one_line_on_stderr(tmp_path: Path, graph: Path) -> None:
    (tmp_path / "cut.g2o").write_text(graph.read_text()[:-30])
    done = run(tmp_path, "cut.g2o")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: cut.g2o:159: ")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["none.g2o"], 1, "cannot be read"),
        (["laps.g2o", "--set", "cost.robst=gnc"], 2, "did you mean 'robust'"),
        (["laps.g2o", "--save", "nowhere/best.g2o"], 1, "cannot be written"),
        (["laps.g2o", "--init", "lago"], 1, "lago is for 2D"),
    ],
)
def test_faults_have_their_exit_code_and_leave_nothing(
    tmp_path: Path,
    graph: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    text: str,
) -> None:
    error = refused(tmp_path, monkeypatch, *arguments)
    assert error.exit_code == code
    assert text in str(error)
    assert not (tmp_path / "results").exists()
