# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Files of results, damaged in many ways: each gives one line of ours, or is read.

`view`, `export` and `batch` take them, and they may come from anywhere.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import CAMPAIGN, tried
from groups import slow
from sound import sound_rig, sound_stamps, sound_table, sound_trajectory

import slam_graph as sg
from slam_graph.cli import view_files
from slam_graph.errors import DataError
from slam_graph.experiment.batch_summary import _measured
from slam_graph.experiment.batch_task import MARK, SCHEMA_VERSION, _read_mark
from slam_graph.experiment.comparison_report import _cells, _row
from slam_graph.experiment.comparison_results import read_result, read_series, write_result
from slam_graph.experiment.path_thumbnail import thumbnail
from slam_graph.results import SavedRun
from slam_graph.results.map_output import read_ply
from slam_graph.results.result_files import read_table

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]

FRAMES = 5
"""Tables are cut to so many rows: damage then meets what is special more often."""


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


def read_run(run: SavedRun) -> None:
    """Everything that commands take from the estimates and metrics of a result."""
    paths = (run.trajectory, run.smoothed, run.loop_closed, run.in_map, run.groundtruth)
    for path in paths:
        if path is not None and len(path):
            sound_trajectory(path)
    for sigmas in (run.sigmas, run.smoothed_sigmas):
        assert sigmas is None or sigmas.shape[1] == 15
        assert sigmas is None or np.isfinite(sigmas[~np.isnan(sigmas)] ** 2).all()
    assert np.isfinite(run.points**2).all()
    for text in (repr(run), thumbnail(run), run.status, run.message, str(run._facts())):
        assert isinstance(text, str)
    view = run._view()
    assert all(np.isfinite(path.positions).all() for path in view.paths.values())
    for table in (run.timing, run.by_frame):
        sound_stamps(table["stamp_ns"])
        assert {len(column) for column in table.values()} == {len(table["stamp_ns"])}
        for values in (column for title, column in table.items() if title != "stamp_ns"):
            assert np.isfinite(values[~np.isnan(values)] ** 2).all()
    sound_stamps(run.keyframes_ns, *run.loop_ends_ns.reshape(-1, 1))
    nees = run.nees_series
    if nees is not None:
        sound_stamps(nees[0])
        assert np.isfinite(nees[1]).all()
    _measured(run.metrics)
    if CAMPAIGN and run.metrics["status"] != "ok":  # it takes a second
        run.plot()


@pytest.mark.usefixtures("half")
@pytest.mark.parametrize(
    "name",
    [
        *("metrics.json", "map.ply", "trajectory.tum", slow("trajectory_smoothed.tum")),
        *(slow("trajectory_loop.tum"), slow("trajectory_map.tum"), "groundtruth.tum"),
        *("states.csv", slow("states_smoothed.csv"), "frames.csv", "timing.csv", "loops.csv"),
    ],
)
def test_runs(saved: Path, tmp_path: Path, name: str) -> None:
    folder = shutil.copytree(saved, tmp_path / "run")
    tried(folder / name, lambda: read_run(SavedRun(folder)))


@pytest.mark.usefixtures("half")
def test_settings_and_calibration_of_runs(saved: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(saved, tmp_path / "run")
    tried(folder / "calibration.yaml", lambda: sound_rig(SavedRun(folder).rig))
    settings = folder / "config.yaml"
    tried(settings, lambda: sound_table(SavedRun(folder).config.model_dump(mode="json")))


class Done:
    """A run of a comparison, the settings of which are those that are wanted."""

    def __init__(self, result: Path) -> None:
        self.result = result

    def is_done(self) -> bool:
        return read_result(self.result) is not None


@pytest.mark.usefixtures("half")
def test_results_of_a_comparison(result: sg.RunResult, tmp_path: Path) -> None:
    """One that is damaged is done again; any other makes a row of the report."""
    path = tmp_path / "msckf.json"
    about = {"data": "flight", "algorithm": "msckf", "seed": 0, "settings_hash": "1"}
    write_result(path, result, about)
    assert Done(path).is_done()
    tried(path, lambda: _cells(_row("flight", "msckf", [Done(path)])))  # type: ignore[list-item]


COMPARED: dict[str, tuple[list[str], object, bool]] = {
    "no steps": (["mean_steps"], ..., False),
    "no alignment": (["metrics", "extent", "unmeasured"], ..., False),
    "steps without end": (["mean_steps"], 10**400, False),
    "a number that is none": (["metrics", "nees"], {"pose": {"mean": 10**400}}, True),
    "nothing expected": (["metrics", "nis"], {"mean": 1.0, "expected_mean": 0.0}, True),
}


@pytest.mark.parametrize("fault", COMPARED)
def test_a_comparison_is_done_again_or_has_a_row(
    result: sg.RunResult, tmp_path: Path, fault: str
) -> None:
    path = tmp_path / "msckf.json"
    about = {"data": "flight", "algorithm": "msckf", "seed": 0, "settings_hash": "1"}
    write_result(path, result, about)
    keys, value, done = COMPARED[fault]
    table = whole = json.loads(path.read_text())
    for key in keys[:-1]:
        table = table[key]
    table[keys[-1]] = value
    if value is ...:
        del table[keys[-1]]
    path.write_text(json.dumps(whole))
    assert Done(path).is_done() == done
    assert _cells(_row("flight", "msckf", [Done(path)]))  # type: ignore[list-item]


@pytest.mark.parametrize("kind", ["text", "cube", "number", "long"])
@pytest.mark.parametrize("series", ["ms_backend", "path", "nis_time_s", "steps"])
def test_series_of_a_comparison_are_checked(
    result: sg.RunResult, tmp_path: Path, series: str, kind: str
) -> None:
    path = tmp_path / "msckf.json"
    write_result(path, result, {"settings_hash": "1"})
    arrays = read_series(path)
    other = {**OTHER_SERIES, "long": np.ones(1000)}[kind]
    np.savez(path.with_suffix(".npz"), **arrays | {series: np.asarray(other)})
    with pytest.raises(DataError, match=r"msckf\.npz: not the series of a run \('"):
        read_series(path)


@pytest.mark.usefixtures("half")
def test_what_a_batch_says_of_a_run(tmp_path: Path) -> None:
    mark = {
        "schema_version": SCHEMA_VERSION,
        "name": "a",
        "data": "a",
        "status": "ok",
        "settings_hash": "1",
    }
    (tmp_path / MARK).write_text(json.dumps(mark, indent=2))
    tried(tmp_path / MARK, lambda: _read_mark(tmp_path))


OTHER_SERIES: dict[str, Any] = {
    "text": ["a"] * 4,
    "complex": np.ones(4, complex),
    "number": np.array(1.0),
    "cube": np.ones((2, 2, 2)),
}


@pytest.mark.parametrize("series", ["path", "true_path", "time_s", "rotation_deg"])
@pytest.mark.parametrize("kind", OTHER_SERIES)
def test_series_of_other_kinds_are_refused(tmp_path: Path, series: str, kind: str) -> None:
    errors = dict.fromkeys(("time_s", "translation_m", "rotation_deg"), np.linspace(0.0, 1.0, 4))
    arrays = {"path": np.ones((4, 3)), "true_path": np.ones((4, 3)), **errors}
    file = tmp_path / "runs" / "flight" / "msckf.npz"
    file.parent.mkdir(parents=True)
    (tmp_path / "summary.json").write_text("{}")
    np.savez(file, **arrays)
    assert view_files.of_folder(tmp_path) is not None
    np.savez(file, **arrays | {series: np.asarray(OTHER_SERIES[kind])})
    with pytest.raises(DataError, match=rf"msckf\.npz: .*'{series}' is not of numbers"):
        view_files.of_folder(tmp_path)


METRICS: dict[str, tuple[list[str], object]] = {
    "text for a time": (["extent", "start_ns"], "now"),
    "a time that does not fit": (["extent", "start_ns"], 2**63),
    "no table": (["accuracy"], 5),
    "a list for a number": (["accuracy", "yaw", "ate", "translation_m", "rmse"], [1.0]),
    "an alignment that there is not": (["extent", "alignment"], "tilted"),
    "text for counts": (["warnings"], {"imu_gap": "many"}),
    "a number for a name": (["dataset", "name"], 7),
    "nothing": (["timing"], None),
}


@pytest.mark.parametrize("fault", METRICS)
def test_metrics_of_another_kind_are_refused(saved: Path, tmp_path: Path, fault: str) -> None:
    folder = shutil.copytree(saved, tmp_path / "run")
    keys, value = METRICS[fault]
    table = whole = json.loads((folder / "metrics.json").read_text())
    for key in keys[:-1]:
        table = table[key]
    table[keys[-1]] = value
    (folder / "metrics.json").write_text(json.dumps(whole))
    with pytest.raises(DataError, match=rf"metrics\.json: .*\({keys[0]}.*run again"):
        sg.load_result(folder).metrics  # noqa: B018


@pytest.mark.parametrize("start_ns", [1_403_636_579_763_555_584, 2**62 - 1, 1 - 2**62])
def test_metrics_of_any_time_are_read(saved: Path, tmp_path: Path, start_ns: int) -> None:
    """Of the clock of a computer, and the first and the last that a recording may have."""
    folder = shutil.copytree(saved, tmp_path / "run")
    table = json.loads((folder / "metrics.json").read_text())
    table["extent"]["start_ns"] = table["dataset"]["start_ns"] = start_ns
    (folder / "metrics.json").write_text(json.dumps(table))
    assert sg.load_result(folder).metrics["extent"]["start_ns"] == start_ns


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' * 100_000, "1" * 5000, "NaN", "[]"])
def test_json_that_is_no_table_is_refused(saved: Path, tmp_path: Path, text: str) -> None:
    folder = shutil.copytree(saved, tmp_path / "run")
    (folder / "metrics.json").write_text(text)
    with pytest.raises(DataError, match=r"metrics\.json: not "):
        sg.load_result(folder).metrics  # noqa: B018
    (folder / MARK).write_text(text)
    assert _read_mark(folder) is None


def test_columns_of_results_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("stamp_ns,a_ms\n1,2.5\n2,\n3,inf\n4,-1e300\n")
    table = read_table(path, ["stamp_ns"], "a table")
    np.testing.assert_array_equal(table["a_ms"], [2.5, np.nan, np.nan, np.nan])
    for stamp in (2**62, -(2**63), 10**30, "1" * 5000):
        path.write_text(f"stamp_ns,a_ms\n{stamp},2.5\n")
        with pytest.raises(DataError, match=r"a\.csv: not a table"):
            read_table(path, ["stamp_ns"], "a table")


def test_points_that_are_nowhere_are_left_out(saved: Path, tmp_path: Path) -> None:
    path = shutil.copy(saved / "map.ply", tmp_path / "map.ply")
    content = path.read_bytes()
    for value in (np.nan, np.inf, -1e300):
        path.write_bytes(content[:-8] + np.array(value, "<f8").tobytes())
        assert len(read_ply(path)) == 8
