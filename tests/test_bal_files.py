# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""BAL files: round trips, everything that can be wrong with them, and the command."""

import bz2
import json
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.bal_problems import ring
from slam_graph.bundle_adjustment.bal_file import bal_lines, is_bal, read_bal
from slam_graph.cli.main import app
from slam_graph.errors import DataError, SlamGraphError

FILES = {
    "problem.txt",
    "optimized.txt",
    "config.yaml",
    "metrics.json",
    "scene.ply",
    "bundle_adjustment.png",
    "run.log",
}
SMALL = (
    "2 2 4\n"
    "0 0 10 20\n0 1 -10 20\n1 0 12 20\n1 1 -12 20\n"
    + "0 0 0 0 0 0 500 0 0\n0 0 0 1 0 0 500 0 0\n"
    + "0 0 -10\n1 1 -10\n"
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    problem = ring(6, 80).problem
    path = tmp_path / "ring.txt"
    path.write_text("".join(bal_lines(problem, problem.estimates)))
    return path


def test_a_file_holds_what_was_written(path: Path, tmp_path: Path) -> None:
    problem, expected = read_bal(path), ring(6, 80).problem
    for name in ("camera", "point", "pixels"):
        np.testing.assert_array_equal(getattr(problem, name), getattr(expected, name))
    for name in ("translations", "intrinsics", "points"):
        mine, other = (getattr(p.estimates, name) for p in (problem, expected))
        np.testing.assert_array_equal(mine, other)
    np.testing.assert_allclose(
        problem.estimates.rotations, expected.estimates.rotations, atol=1e-14
    )
    packed = tmp_path / "packed.txt.bz2"
    packed.write_bytes(bz2.compress(path.read_bytes()))
    assert read_bal(packed).name == "packed"
    np.testing.assert_array_equal(read_bal(packed).pixels, problem.pixels)
    assert is_bal(packed)
    native = gtsam.SfmData.FromBalFile(str(path))
    assert native.numberTracks() == 80
    centre = native.camera(2).pose().translation()
    np.testing.assert_allclose(centre, problem.estimates.centres()[2], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "", "empty"),
        (lambda text: text[:-6], r":9: ends after 41 of the 43 numbers"),
        (lambda text: text + "7\n", r":10: 1 numbers more"),
        (lambda text: text.replace("12 20", "nan 20", 1), r":4: a number is not finite"),
        (lambda text: text.replace("12 20", "1e200 20", 1), r":4: a number is not finite, or too"),
        (lambda text: text.replace("12 20", "oops 20", 1), r":4: not a number in '1 0 oops 20'"),
        (lambda text: text.replace("1 0 12", "2 0 12"), r":4: camera 2, but they go from 0 to 1"),
        (lambda text: text.replace("1 0 12", "1 -1 12"), r":4: point -1, but they go from 0 to 1"),
        (lambda text: text.replace("1 0 12", "1 0.5 12"), r":4: point 0.5, but"),
        (lambda text: text.replace("2 2 4", "2 2 0"), r":1: nothing to estimate"),
        (lambda text: text.replace("2 2 4", "2 -2 4"), r":1: expected three whole numbers"),
        (lambda text: text.replace("2 2 4", "2 2"), r":1: expected three whole numbers"),
        (lambda text: text.replace("2 2 4", "2 2 99999999999999"), r":9: ends after"),
    ],
)
def test_a_bad_file_is_refused_with_its_line(
    tmp_path: Path, change: Callable[[str], str], message: str
) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(change(SMALL))
    with pytest.raises(DataError, match=message):
        read_bal(path)


def test_damaged_bzip2_data_are_refused(tmp_path: Path, path: Path) -> None:
    packed = bytearray(bz2.compress(path.read_bytes()))
    damaged = tmp_path / "damaged.txt.bz2"
    damaged.write_bytes(packed[:-50])
    with pytest.raises(DataError, match="bzip2 data cut short"):
        read_bal(damaged)
    packed[len(packed) // 2] ^= 255
    damaged.write_bytes(packed)
    with pytest.raises(DataError, match="bzip2"):
        read_bal(damaged)
    with pytest.raises(DataError, match="cannot be read"):
        read_bal(tmp_path / "none.txt")


def test_the_format_is_seen_from_the_content(tmp_path: Path, path: Path) -> None:
    other = tmp_path / "graph.txt"
    for text in ("VERTEX2 0 0 0 0\n", "# a comment\nEDGE2 0 1 1 0 0\n", "", "1 2\n", "1 2 x\n"):
        other.write_text(text)
        assert not is_bal(other)
    assert is_bal(path)


def test_the_command_writes_everything(tmp_path: Path, path: Path) -> None:
    best, output = tmp_path / "best.txt.bz2", tmp_path / "results"
    arguments = ["optimize", str(path), "--output", str(output), "--save", str(best), "--json"]
    done = CliRunner().invoke(app, [*arguments, "--robust", "cauchy", "--intrinsics", "shared"])
    assert done.exit_code == 0
    metrics = json.loads(done.stdout)
    folder = output / "ring" / "latest"
    assert {file.name for file in folder.iterdir()} == FILES
    assert metrics["converged"]
    assert (metrics["robust"], metrics["intrinsics"]) == ("cauchy", "shared")
    rmse = {stage: table["rmse"] for stage, table in metrics["reprojection_px"].items()}
    assert rmse["after"] < 0.5 * rmse["before"]
    assert metrics["cost"]["after"] < metrics["cost"]["before"]
    optimized = read_bal(folder / "optimized.txt")
    assert len(np.unique(optimized.estimates.intrinsics, axis=0)) == 1
    np.testing.assert_array_equal(read_bal(best).estimates.points, optimized.estimates.points)
    scene = (folder / "scene.ply").read_bytes()
    vertices = metrics["problem"]["used_points"] + metrics["problem"]["used_cameras"]
    header, data = scene.split(b"end_header\n", 1)
    assert f"element vertex {vertices}\n".encode() in header
    assert len(data) == 27 * vertices
    refused = CliRunner().invoke(app, arguments)
    assert "--force" in str(refused.exception)
    settings = ["--config", str(folder / "config.yaml"), "--force"]
    again = CliRunner().invoke(app, [*arguments, *settings])
    assert json.loads(again.stdout)["cost"] == metrics["cost"]
    done = CliRunner().invoke(app, ["optimize", str(path), "--output", str(output)])
    assert "per_camera intrinsics" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--certify"], 2, "--certify is for pose graphs"),
        (["--method", "isam2"], 2, "--method is for pose graphs"),
        (["--robust", "gnc"], 2, "robust"),
        (["--set", "cost.robst=huber"], 2, "did you mean 'robust'"),
        (["--format", "pose_graph"], 1, "no edges"),
        (["--format", "pose_graph", "--intrinsics", "fixed"], 2, "is for bundle adjustment"),
    ],
)
def test_faults_have_their_exit_code_and_leave_nothing(
    tmp_path: Path, path: Path, arguments: list[str], code: int, text: str
) -> None:
    output = tmp_path / "results"
    command = ["optimize", str(path), "--output", str(output), *arguments]
    error = CliRunner().invoke(app, command).exception
    assert isinstance(error, SlamGraphError)
    assert error.exit_code == code
    assert text in str(error)
    assert not output.exists()
