# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""`slam-graph view` on damaged files: one line that names the file, and never a traceback."""

import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from map_flights import World
from pose_graphs import laps
from typer.testing import CliRunner

import slam_graph as sg
from slam_graph.bundle_adjustment import adjust_bundle, read_bal
from slam_graph.cli.main import app
from slam_graph.pose_graph import optimize_pose_graph
from slam_graph.results import BalResult, PoseGraphResult
from slam_graph.visualization import RerunRecording

SERIES = ("time_s", "translation_m", "rotation_deg")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of each that `view` can show, with all files that it reads."""
    root = tmp_path_factory.mktemp("whole")
    _run(root / "run")
    graph, _ = laps(2, noise=0.01)
    _optimized(root)
    sg.simulate(trajectory="figure8", duration_s=1.0).save(root / "flight")
    (root / "laps.g2o").write_text("".join(optimize_pose_graph(graph).g2o_lines()))
    (root / "laps.txt").write_text((root / "laps.g2o").read_text())
    sg.save_map(World().map(), root / "place.slam")
    for name in ("msckf", "swf"):
        file = root / "comparison" / "runs" / "flight" / f"{name}.npz"
        file.parent.mkdir(parents=True, exist_ok=True)
        series = dict.fromkeys(SERIES, np.linspace(0.0, 1.0, 50))
        places = np.random.default_rng(0).normal(size=(50, 3))
        np.savez_compressed(file, path=places, true_path=places, **series)
    (root / "comparison" / "summary.json").write_text("{}")
    with RerunRecording("save", "place", root / "place.rrd") as recording:
        recording.show_map(World().map())
    return root


def _run(folder: Path) -> None:
    """A run with files of all kinds; some of them are copies of others."""
    result = sg.run(sg.simulate(trajectory="figure8", duration_s=3.0, rate_hz=10.0, seed=1))
    result.check()
    result.save(folder)
    for name in ("trajectory_loop.tum", "trajectory_map.tum"):
        shutil.copy(folder / "trajectory.tum", folder / name)
    stamps = result.trajectory.stamps_ns
    row = f"{stamps[0]},{stamps[-1]},20,30,1\n"
    titles = "first_stamp_ns,second_stamp_ns,inliers,matches,accepted\n"
    (folder / "loops.csv").write_text(titles + 4 * row)
    (folder / "run.log").write_text("2026-01-01 INFO a line\n" * 4)


def _optimized(root: Path) -> None:
    """A pose graph and photographs, optimised."""
    solution = optimize_pose_graph(laps(2, noise=0.01)[0])
    PoseGraphResult(sg.PoseGraphPolicy(), solution).save(root / "graph")
    file = Path(gtsam.__file__).parent / "Data" / "dubrovnik-3-7-pre.txt"
    BalResult(sg.BalPolicy(), adjust_bundle(read_bal(file))).save(root / "bundle")


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _binary(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 8)


def _cut(path: Path) -> None:
    """Ends in the middle, of a line where there are lines."""
    data = path.read_bytes()
    middle = len(data) // 2
    if path.suffix in TEXTS:
        begin, end = data.rindex(b"\n", 0, middle) + 1, data.index(b"\n", middle)
        middle = (begin + end) // 2
    path.write_bytes(data[:middle])


def _other_titles(path: Path) -> None:
    """A table, or JSON, that lacks what is looked for."""
    text = path.read_text()
    first, _, rest = text.partition("\n")
    if path.suffix == ".json":
        path.write_text("{}")
    else:
        path.write_text(first.upper() + "\n" + rest)


def _other_arrays(path: Path) -> None:
    np.savez_compressed(path, time_s=np.zeros(3), translation_m=np.zeros(2))


def _no_mapping(path: Path) -> None:
    path.write_text("[1, 2]")


TEXTS = {".csv", ".tum", ".g2o", ".txt", ".log", ".yaml", ".json"}
ALL = (_empty, _binary, _cut)
TABLE = (*ALL, _other_titles)
READ: dict[str, tuple[Callable[[Path], None], ...]] = {
    "run/metrics.json": (*TABLE, _no_mapping),
    "run/trajectory.tum": ALL,
    "run/states.csv": TABLE,
    "run/trajectory_smoothed.tum": ALL,
    "run/states_smoothed.csv": TABLE,
    "run/trajectory_loop.tum": ALL,
    "run/loops.csv": TABLE,
    "run/trajectory_map.tum": ALL,
    "run/groundtruth.tum": ALL,
    "run/map.ply": ALL,
    "run/timing.csv": TABLE,
    "run/frames.csv": TABLE,
    "run/calibration.yaml": (*ALL, _no_mapping),
    "run/run.log": ALL,
    "graph/optimized.g2o": ALL,
    "graph/edges.csv": TABLE,
    "bundle/problem.txt": ALL,
    "bundle/optimized.txt": ALL,
    "comparison/runs/flight/msckf.npz": (*ALL, _other_arrays),
    "flight/meta.yaml": (*ALL, _no_mapping),
    "flight/calibration.yaml": (*ALL, _no_mapping),
    "flight/imu.bin": ALL,
    "flight/frames.bin": ALL,
    "flight/features.bin": ALL,
    "flight/groundtruth.npz": ALL,
    "laps.g2o": ALL,
    "laps.txt": (_cut,),  # else nothing tells that it was a graph
    "place.slam": ALL,
    "place.rrd": ALL,
}
"""What `view` reads, and how each is damaged."""

READABLE = {
    *(("run/run.log", damage) for damage in ALL),  # it is shown as it is
    *((f"run/{name}.tum", _empty) for name in ("trajectory_loop", "trajectory_map", "groundtruth")),
}
"""What is still a file of its kind: a trajectory without poses, and a log of whatever."""

CASES = [(name, damage) for name, damages in READ.items() for damage in damages]


def view(what: Path, *options: str | Path) -> tuple[int, str]:
    """The exit code and the error of a call."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = CliRunner().invoke(app, ["view", str(what), *map(str, options)])
    if done.exception is None or isinstance(done.exception, SystemExit):
        return done.exit_code, done.output
    if not isinstance(done.exception, sg.SlamGraphError):
        raise done.exception
    return done.exception.exit_code, str(done.exception)


@pytest.mark.parametrize(
    ("name", "damage"), CASES, ids=[f"{n}-{damage.__name__[1:]}" for n, damage in CASES]
)
def test_a_damaged_file_is_named(
    whole: Path, tmp_path: Path, name: str, damage: Callable[[Path], None]
) -> None:
    top = Path(name).parts[0]
    source, copy = whole / top, tmp_path / top
    (shutil.copytree if source.is_dir() else shutil.copy)(source, copy)
    damage(tmp_path / name)
    shown = ("--screenshot", tmp_path / "a.png") if copy.suffix == ".rrd" else ()
    code, said = view(copy, *(shown or ("--output", tmp_path / "view.rrd")))
    if (name, damage) in READABLE:
        assert code == 0, said
        return
    assert code == 1, said
    assert Path(name).name in said
    assert "\n" not in said
    assert not (tmp_path / "view.rrd").exists()
    assert not list(tmp_path.glob(".*")), "nothing half written is left"


@pytest.mark.parametrize(
    "name", ["run", "graph", "bundle", "comparison", "flight", "laps.g2o", "laps.txt", "place.slam"]
)
def test_all_of_it_can_be_shown_while_it_is_whole(whole: Path, tmp_path: Path, name: str) -> None:
    assert view(whole / name, "--output", tmp_path / "view.rrd")[0] == 0


def test_runs_that_are_compared_and_a_known_map_are_named_too(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "run", tmp_path / "run")
    out = ("--output", tmp_path / "view.rrd")
    _cut(tmp_path / "run" / "states.csv")
    code, said = view(whole / "run", tmp_path / "run", *out)
    assert (code, "states.csv" in said) == (1, True)
    shutil.copy(whole / "place.slam", tmp_path / "known.slam")
    _cut(tmp_path / "known.slam")
    code, said = view(whole / "run", "--map", tmp_path / "known.slam", *out)
    assert (code, "known.slam" in said) == (1, True)


def test_runs_without_a_pose_cannot_be_compared(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "run", tmp_path / "run")
    for name in ("trajectory.tum", "trajectory_smoothed.tum"):
        _empty(tmp_path / "run" / name)
    for name in ("states.csv", "states_smoothed.csv"):
        path = tmp_path / "run" / name
        path.write_text(path.read_text().splitlines()[0] + "\n")
    code, said = view(tmp_path / "run", tmp_path / "run", "--output", tmp_path / "view.rrd")
    assert code == 1
    assert "cannot be compared" in said


def test_a_picture_that_cannot_be_written_is_refused_before_any_work(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither is the recording read, nor the viewer started."""

    def fail(*_: object) -> None:
        raise AssertionError("work was done")

    monkeypatch.setattr("slam_graph.cli.view._shown", fail)
    monkeypatch.setattr("slam_graph.cli.view._show_existing", fail)
    (tmp_path / "file").write_text("")
    for what in (whole / "run", whole / "place.rrd"):
        code, said = view(what, "--screenshot", tmp_path / "picture.jpg")
        assert (code, "a picture ends with .png" in said) == (2, True)
        code, said = view(what, "--screenshot", tmp_path / "file" / "picture.png")
        assert (code, "picture.png: cannot be written" in said) == (1, True)
    if os.geteuid():  # root may write everywhere
        (tmp_path / "closed").mkdir(mode=0o500)
        code, said = view(whole / "run", "--screenshot", tmp_path / "closed" / "picture.png")
        assert (code, "picture.png: cannot be written" in said) == (1, True)
