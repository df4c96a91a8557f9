# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A batch: recordings are found, run in processes of their own, resumed and summarized."""

import csv
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from commands import slam_graph
from limits import HANG_S
from recordings_loose import write_image_folder

import slam_graph as sg
from slam_graph.errors import ConfigError, DataError
from slam_graph.experiment import executors
from slam_graph.experiment.batch_plan import Entry, _names, plan
from slam_graph.experiment.batch_task import MARK, BatchTask
from slam_graph.files import Files

CONFIG = sg.load_config()
FAST = ["final_ba.enabled=false"]


def flight(folder: Path, seed: int = 0, duration_s: float = 2.0) -> Path:
    """A short simulated recording."""
    sequence = sg.simulate(
        seed=seed, duration_s=duration_s, rate_hz=10, tracks={"features": 40}, trajectory="rooms"
    )
    sequence.save(folder)
    return folder


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three recordings, one of them damaged, and things that are none."""
    root = tmp_path_factory.mktemp("flights")
    flight(root / "monday" / "first", 0)
    flight(root / "tuesday" / "first", 1)
    damaged = root / "damaged"
    shutil.copytree(root / "monday" / "first", damaged)
    (damaged / "features.bin").write_bytes(b"too short")
    (root / "notes.md").write_text("no recording")
    shutil.copytree(root / "monday" / "first", root / ".hidden")
    return root


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "slam_graph.cli.main", "batch", *map(str, arguments)]


def batch(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return slam_graph("batch", *arguments)


def tasks(what: Path | str, output: Path, **options: Any) -> list[BatchTask]:
    common = {"format": options.pop("format", None), "calibration": None, "sources": {}}
    return plan([str(what)], output, None, options.pop("overrides", ()), options, common, {})


def test_a_folder_is_run_and_only_what_is_left_is_run_again(flights: Path, tmp_path: Path) -> None:
    """One recording is damaged: the others are done, and a second call tries it alone."""
    out = tmp_path / "out"
    first = batch(flights, "--output", out, "--jobs", "2", "--no-final-ba")
    assert first.returncode == 1
    assert "1 of 3 recordings could not be run" in first.stderr
    assert len([line for line in first.stderr.splitlines() if re.match(r"[123]/3 ", line)]) == 3
    assert "3 recordings: 2 ok, 1 not_done" in first.stdout
    assert "aligned in" in first.stdout
    assert "aligned in yaw and position" not in " ".join(first.stdout.split())
    assert all(len(line) <= 100 for line in first.stdout.splitlines() if "100.0%" in line)
    names = ["damaged", "monday_first", "tuesday_first"]
    with (out / "summary.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert list(rows) == names
    assert "features.bin: 9 bytes long" in rows["damaged"]["message"]
    for name in names[1:]:
        row, metrics = rows[name], json.loads((out / name / "metrics.json").read_text())
        assert row["status"] == metrics["status"] == "ok"
        truth = metrics["accuracy"]["yaw"]["ate"]["translation_m"]["rmse"]
        assert float(row["ate_m"]) == truth
        assert row["alignment"] == metrics["extent"]["unmeasured"] == "yaw"
        ordinary = {"feature_rejected_by_gate", "feature_not_triangulated"}
        assert set(metrics["warnings"]) <= ordinary, "single features that a gate rejects"
        assert row["warnings"] == "0"
        assert row["warning_kinds"] == ""
        assert sg.load_result(out / name).status == "ok"
        assert not (out / name / "progress").exists()
    page = (out / "index.html").read_text()
    assert page.count("<svg") == 2
    assert not re.findall(r"(?:src|href)=\"(?:https?:|/)", page), "the page holds what it shows"

    written = {name: (out / name / "metrics.json").stat().st_mtime_ns for name in names[1:]}
    again = batch(flights, "--output", out, "--no-final-ba", "--json")
    assert again.returncode == 1
    assert again.stderr.splitlines()[0].startswith("1/1 damaged: failed: ")
    answer = json.loads(again.stdout)
    assert [row["name"] for row in answer["rows"]] == names
    assert list(answer["failures"]) == ["damaged"]
    for name, time_ns in written.items():
        assert (out / name / "metrics.json").stat().st_mtime_ns == time_ns


def test_recordings_for_the_viewer_and_factor_graphs_are_written(tmp_path: Path) -> None:
    what, out = flight(tmp_path / "flight"), tmp_path / "out"
    watched = ("--rerun", "save", "--rerun-images", "none", "--save-graph", "1.0")
    done = batch(what, "--output", out, "--no-final-ba", *watched)
    assert done.returncode == 0, done.stderr
    assert (out / "flight" / "recording.rrd").read_bytes()[:3] == b"RRF"
    assert list((out / "flight").glob("graph_*"))
    wrong = batch(what, "--output", out, "--save-graph", "soon")
    assert wrong.returncode == 2


@pytest.mark.slow
def test_a_killed_process_stops_no_other_and_is_done_by_the_next_call(tmp_path: Path) -> None:
    for seed in range(2):
        flight(tmp_path / "data" / f"flight_{seed}", seed)
    out = tmp_path / "out"
    arguments = command(tmp_path / "data", "--output", out, "--jobs", "1", "--no-final-ba")
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    os.kill(worker_of(out, "flight_0"), signal.SIGKILL)
    _, said = process.communicate(timeout=HANG_S)
    assert process.returncode == 1
    assert "1/2 flight_0: failed: ended by signal 9" in said
    assert [path.name for path in out.glob("flight_*")] == ["flight_1"]
    again = batch(tmp_path / "data", "--output", out, "--no-final-ba")
    assert again.returncode == 0, again.stderr
    assert again.stderr.splitlines() == ["1/1 flight_0"]
    assert "1 recordings had been done before" in again.stdout
    assert not list(out.glob(".*")), "what the killed process left is removed"


def worker_of(out: Path, name: str) -> int:
    """The process that runs a recording, as soon as there is one."""
    deadline = time.monotonic() + HANG_S
    while time.monotonic() < deadline:
        for folder in out.glob(f".{name}.*.partial"):
            return int(folder.name.split(".")[-2])
        time.sleep(0.01)
    raise AssertionError("no worker")


@pytest.mark.slow
def test_an_interruption_keeps_what_is_done_and_writes_the_summary(tmp_path: Path) -> None:
    for seed in range(2):
        flight(tmp_path / "data" / f"flight_{seed}", seed)
    out = tmp_path / "out"
    process = subprocess.Popen(
        command(tmp_path / "data", "--output", out, "--jobs", "1", "--no-final-ba"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    )
    worker_of(out, "flight_1")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    assert "interrupted; finished runs are kept" in said
    with (out / "summary.csv").open(newline="") as file:
        states = [row["status"] for row in csv.DictReader(file)]
    assert states == ["ok", "not_done"]
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["flight_0"]


@pytest.mark.slow
def test_an_interruption_stops_all_runs_that_go_on(tmp_path: Path) -> None:
    """Three at once: one has ended, two leave nothing, and the next call does these two."""
    flight(tmp_path / "data" / "flight_0", 0, 1.0)
    long = flight(tmp_path / "data" / "flight_1", 1, 90.0)
    shutil.copytree(long, long.with_name("flight_2"))
    out = tmp_path / "out"
    process = subprocess.Popen(
        command(tmp_path / "data", "--output", out, "--jobs", "3", "--no-final-ba"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    workers = [worker_of(out, f"flight_{seed}") for seed in (1, 2)]
    assert wait_for(lambda: (out / "flight_0" / MARK).is_file())
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]
    with (out / "summary.csv").open(newline="") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["ok", "not_done", "not_done"]
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["flight_0"]
    assert sg.load_result(out / "flight_0").status == "ok"
    left = tasks(tmp_path / "data", out, overrides=FAST)
    assert [task.is_done() for task in left] == [True, False, False]


def test_a_process_that_is_killed_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The slow test of a killed process has a whole batch around it, and calls it once more."""

    class Process(subprocess.Popen[str]):
        def __init__(self, task: str) -> None:
            dies = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
            code = dies if "recording_0" in task else "raise SystemExit(0)"
            super().__init__([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)

        def release(self) -> None:
            """Nothing is held."""

    monkeypatch.setattr(executors, "_TaskProcess", Process)
    names = [tmp_path / f"recording_{number}" for number in range(2)]
    some = [BatchTask(name=n.name, data=str(n), config=CONFIG, output=tmp_path) for n in names]
    told = {task.name: said for task, said in executors.LocalProcesses(1).do(some)}
    assert told == {"recording_0": "ended by signal 9", "recording_1": None}


WAITS_FOR_OTHERS = """
import pathlib, signal, sys, time
folder, name, count = pathlib.Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
def told(*_):
    (folder / f"{name}.told").touch()
    while len(list(folder.glob("*.told"))) < count:
        time.sleep(0.01)
    (folder / f"{name}.ended").touch()
    sys.exit(1)
signal.signal(signal.SIGTERM, told)
(folder / f"{name}.began").touch()
time.sleep(600)
"""
"""A process that ends upon SIGTERM when all others have been told, too."""


def test_all_processes_are_told_before_one_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = itertools.count()

    class Process(subprocess.Popen[str]):
        def __init__(self, _: str) -> None:
            waits = [sys.executable, "-c", WAITS_FOR_OTHERS, str(tmp_path), str(next(numbers)), "3"]
            super().__init__(waits, stderr=subprocess.PIPE, text=True)

        def release(self) -> None:
            """Nothing is held."""

    monkeypatch.setattr(executors, "_TaskProcess", Process)

    def began() -> bool:
        return len(list(tmp_path.glob("*.began"))) == 3

    def interrupted(*_: object) -> Iterator[None]:
        assert wait_for(began)
        raise KeyboardInterrupt

    monkeypatch.setattr(executors, "as_completed", interrupted)
    names = [tmp_path / f"recording_{number}" for number in range(3)]
    some = [BatchTask(name=n.name, data=str(n), config=CONFIG, output=tmp_path) for n in names]
    with pytest.raises(KeyboardInterrupt):
        list(executors.LocalProcesses(3).do(some))
    assert len(list(tmp_path.glob("*.ended"))) == 3, "none had to be killed"


def wait_for(holds: Callable[[], bool]) -> bool:
    """Whether something holds before the time is over."""
    deadline = time.monotonic() + HANG_S
    while time.monotonic() < deadline and not holds():
        time.sleep(0.01)
    return holds()


def test_other_settings_and_changed_recordings_are_run_again(tmp_path: Path) -> None:
    recording = flight(tmp_path / "data" / "flight")
    options: dict[str, Any] = {"output": tmp_path / "out", "overrides": FAST, "jobs": 1}
    done = sg.batch(tmp_path / "data", **options)
    assert [row["status"] for row in done.rows] == ["ok"]
    assert sg.batch(tmp_path / "data", **options).skipped == 1
    (other,) = tasks(tmp_path / "data", tmp_path / "out", overrides=FAST, algorithm="swf")
    (same,) = tasks(tmp_path / "data", tmp_path / "out", overrides=FAST)
    assert (same.is_done(), other.is_done()) == (True, False)
    assert BatchTask.model_validate_json(same.model_dump_json()).key == same.key
    meta = recording / "meta.yaml"
    os.utime(meta, ns=(0, meta.stat().st_mtime_ns + 1))
    (changed,) = tasks(tmp_path / "data", tmp_path / "out", overrides=FAST)
    assert not changed.is_done()


def test_a_list_has_settings_of_its_own(flights: Path, tmp_path: Path) -> None:
    """Those of a recording replace those of the list; options of the command replace both."""
    (tmp_path / "list.yaml").write_text(
        f"""
settings: {{algorithm: swf, duration_s: 1, backend: {{noise: {{pixel_sigma: 2}}}}}}
recordings:
  - {os.path.relpath(flights / "monday" / "first", tmp_path)}
  - data: {flights / "tuesday" / "first"}
    name: slow
    settings: {{algorithm: msckf, backend: {{noise: {{gravity: 9.8}}}}}}
  - missing
"""
    )
    first, slow, missing = tasks(tmp_path / "list.yaml", tmp_path, seed=3)
    assert [first.name, slow.name, missing.name] == ["first", "slow", "missing"]
    assert Path(first.data).resolve() == (flights / "monday" / "first").resolve()
    assert [task.config.algorithm.name for task in (first, slow)] == ["swf", "msckf"]
    noise = slow.config.backend.noise
    assert (noise.pixel_sigma, noise.gravity) == (2, 9.8)
    assert {task.config.seed for task in (first, slow, missing)} == {3}
    replaced = tasks(tmp_path / "list.yaml", tmp_path, algorithm="ekf", overrides=["duration_s=2"])
    assert {task.config.algorithm.name for task in replaced} == {"ekf"}
    assert {task.config.duration_s for task in replaced} == {2}


def names_of(*data: str, order: int = 1) -> dict[str, list[str]]:
    """The names that recordings of a list are given, by their paths."""
    found: dict[str, list[str]] = {}
    entries = [Entry(data=path) for path in data][::order]
    for entry, name in zip(entries, _names(entries), strict=True):
        found.setdefault(entry.data, []).append(name)
    return {path: sorted(names) for path, names in found.items()}


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (("/d/a", "/d/a", "/d/a_1"), {"/d/a": ["a", "a_2"], "/d/a_1": ["a_1"]}),
        (("/d/a", "/d/a", "/d/a_2"), {"/d/a": ["a", "a_3"], "/d/a_2": ["a_2"]}),
        (("/d/a", "/e/a", "/d/a_1"), {"/d/a": ["d_a"], "/e/a": ["e_a"], "/d/a_1": ["a_1"]}),
        (("/d/a", "/e/a", "/d_a"), {"/d/a": ["d_a_2"], "/e/a": ["e_a"], "/d_a": ["d_a"]}),
        (("/d/a b", "/d/a_b"), {"/d/a b": ["a_b"], "/d/a_b": ["a_b_2"]}),
    ],
)
def test_recordings_have_folders_of_their_own(
    data: tuple[str, ...], expected: dict[str, list[str]]
) -> None:
    """Whatever they are called, and in whatever order they come."""
    assert names_of(*data) == names_of(*data, order=-1) == expected
    assert len({name for names in expected.values() for name in names}) == len(data)


def test_a_name_that_is_given_stays_with_its_recording() -> None:
    entries = [Entry(data="/d/a"), Entry(data="/e/b", name="a"), Entry(data="/d/a")]
    assert _names(entries) == ["a_2", "a", "a_3"]


def test_sources_of_a_list_are_relative_to_it(flights: Path, tmp_path: Path) -> None:
    """Files are; topics and rates are no files. What is in a file is part of the task."""
    (tmp_path / "list.yaml").write_text(
        f"""
recordings:
  - data: {flights / "monday" / "first"}
    sources: {{stamps: times.csv, imu: below/imu.csv, cam0: /cam0/image_raw, rate: "0.5"}}
"""
    )
    (task,) = tasks(tmp_path / "list.yaml", tmp_path / "out")
    assert task.sources == {
        "stamps": str(tmp_path / "times.csv"),
        "imu": str(tmp_path / "below" / "imu.csv"),
        "cam0": "/cam0/image_raw",
        "rate": "0.5",
    }
    keys = [task.key]
    for content in ("1\n", "1\n2\n"):
        (tmp_path / "times.csv").write_text(content)
        keys += [task.key for task in tasks(tmp_path / "list.yaml", tmp_path / "out")]
    assert len(set(keys)) == 3, "it is run again when the file appears, and when it changes"


@pytest.mark.slow
def test_a_list_is_run_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of images whose times and IMU are beside the list."""
    pictures = write_image_folder(tmp_path / "lists" / "pictures")
    for old, new in (("timestamps.csv", "times.csv"), ("imu.csv", "inertial.csv")):
        (pictures / old).rename(tmp_path / "lists" / new)
    (tmp_path / "lists" / "list.yaml").write_text(
        "recordings: [{data: pictures, sources: {stamps: times.csv, imu: inertial.csv}}]"
    )
    monkeypatch.chdir(tmp_path)
    done = sg.batch("lists/list.yaml", output="out", overrides=FAST, jobs=1)
    assert done.failures == {}
    assert [row["status"] for row in done.rows] == ["not_initialized"], "it has 8 frames"
    assert sg.batch(tmp_path / "lists" / "list.yaml", output="out", overrides=FAST).skipped == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("recordings: [a]\nsetings: {}", r"list.yaml:2: .*did you mean 'settings'\?"),
        ("recordings: []", "list.yaml:1"),
        (
            "recordings: [{data: a, settings: {sed: 1}}]",
            r"recording 1: .*did you mean 'seed'\?",
        ),
        ("recordings: [{data: a, name: x}, {data: b, name: x}]", "two recordings are called 'x'"),
        ("recordings: [{data: a, name: ../x}]", "list.yaml:1"),
        (
            "recordings:\n  - b\n  - data: a\n    algorithm: swf",
            r"list.yaml:4: unknown key 'recordings\.1\.algorithm'; known: data, name, .*settings$",
        ),
        ("recordings:\n  - b\n  - 5", r"list.yaml:3: recordings\.1: .*got 5"),
    ],
)
def test_faults_in_a_list(tmp_path: Path, text: str, message: str) -> None:
    folder = tmp_path / "5"  # a folder that is called as the value at fault hides nothing
    folder.mkdir()
    (folder / "list.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        tasks(folder / "list.yaml", tmp_path)


def test_what_is_searched(flights: Path, tmp_path: Path) -> None:
    """Patterns and folders; not hidden folders, the output, or the inside of recordings."""
    assert [task.name for task in tasks(flights / "*day", tmp_path)] == [
        "monday_first",
        "tuesday_first",
    ]
    assert [task.name for task in tasks(flights / "monday" / "first", tmp_path)] == ["first"]
    assert [task.name for task in tasks("demo", tmp_path)] == ["demo"]
    assert len(tasks(flights, flights / "monday")) == 2
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "1.png").write_bytes(b"")
    with pytest.raises(DataError, match="no recording found; known formats: "):
        tasks(tmp_path / "pictures", tmp_path)
    (pictures,) = tasks(tmp_path / "pictures", tmp_path, format="images")
    assert pictures.format == "images"
    with pytest.raises(DataError, match="nowhere: no such file or folder"):
        tasks("nowhere", tmp_path)


def test_a_folder_that_is_no_result_is_not_replaced(flights: Path, tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "precious.txt").write_text("keep")
    (task,) = tasks(flights / "monday" / "first", tmp_path, overrides=FAST)
    with pytest.raises(DataError, match="is no result of a batch"):
        task.do()
    assert (tmp_path / "first" / "precious.txt").read_text() == "keep"


def test_only_what_dead_processes_left_is_removed(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], **CAPTURED)
    host = os.uname().nodename.replace(".", "-")
    dead, own = (tmp_path / f".x.{host}.{pid}.partial" for pid in (int(done.stdout), os.getpid()))
    elsewhere, other = tmp_path / ".x.another.1.partial", tmp_path / ".notes.partial"
    for folder in (dead, own, elsewhere, other):
        folder.mkdir()
    Files.remove_remains(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {own.name, elsewhere.name, other.name}


CAPTURED: dict[str, Any] = {"capture_output": True, "text": True, "check": True}


def test_runs_without_an_estimate_or_a_truth_are_in_the_summary(tmp_path: Path) -> None:
    """A run that never starts is a result, with exit code 3; its row has no errors."""
    flight(tmp_path / "data" / "short", 0, 1.0)
    static = ("--set", "backend.initialization.mode=static", "--duration", "0.3")
    (tmp_path / "data" / "short" / "initial_state.npz").unlink()
    (tmp_path / "data" / "short" / "groundtruth.npz").unlink()
    done = batch(tmp_path / "data", "--output", tmp_path / "out", "--no-final-ba", *static)
    assert done.returncode == 3, done.stderr
    assert "short: never initialised" in done.stdout
    assert "1 recordings: 1 not_initialized" in done.stdout


@pytest.mark.slow
def test_a_dask_cluster_does_the_same(flights: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    )
    with cluster:
        done = sg.batch(
            [flights / "monday", flights / "damaged"],
            output=tmp_path,
            overrides=FAST,
            scheduler=cluster.scheduler_address,
        )
    assert [row["status"] for row in done.rows] == ["ok", "not_done"]
    assert list(done.failures) == ["damaged"]
