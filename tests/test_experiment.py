# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The experiment: same tracks for all, done once, reported whole, here and on a Dask cluster."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import slam_graph
from documented_runs import do_tasks_here
from limits import HANG_S
from test_batch import command as batch
from test_batch import flight, wait_for, worker_of
from typer.testing import CliRunner

from slam_graph.cli.console import echo_rich_table
from slam_graph.cli.main import app
from slam_graph.config import load_config
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.errors import ConfigError, DataError
from slam_graph.evaluation.absolute_pose_error import ape
from slam_graph.experiment import tasks
from slam_graph.experiment.comparison import compare as compare_algorithms
from slam_graph.experiment.comparison_figures import binned_mean
from slam_graph.experiment.comparison_plan import load_configs, plan, with_variants
from slam_graph.experiment.comparison_results import ALIGNMENTS, read_result
from slam_graph.experiment.executors import ONE_THREAD, DaskCluster, LocalProcesses
from slam_graph.experiment.tasks import RecordTask, RunTask, find_sources
from slam_graph.frontend import Frontend, build_frontend
from slam_graph.pipeline.run_recording import run as run_pipeline
from slam_graph.results.metrics import peak_memory_mb
from slam_graph.sensors import Rig
from slam_graph.simulation.simulator import simulate

COMMAND = [sys.executable, "-m", "slam_graph.cli.main", "compare"]
STATIC = ("--set", "backend.initialization.mode=static")
SHORT_SIM = [f"--sim-set={text}" for text in ("duration_s=6", "rate_hz=10", "tracks.features=50")]


def compare(*arguments: str | Path, rendered: bool = False) -> subprocess.CompletedProcess:
    return slam_graph("compare", *arguments, rendered=rendered)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks are done in this process: not what is tested where this is used."""
    do_tasks_here(monkeypatch)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Two algorithms on six simulated seconds."""
    folder = tmp_path_factory.mktemp("simulated")
    arguments = ("--algorithms", "msckf,swf", "--output", folder, "--json")
    done = compare("sim:figure8", *SHORT_SIM, *arguments, rendered=True)
    assert done.returncode == 0, done.stderr
    return folder, json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "alignment"), [(2, "se3"), (1, "sim3")])
def test_without_an_imu_errors_are_aligned_in_what_nothing_measured(
    here: None, tmp_path: Path, cameras: int, alignment: str
) -> None:
    found = compare_algorithms(
        "sim:random",
        "msckf",
        seeds=[4],
        output=tmp_path,
        simulation=[
            f"cameras={cameras}", "with_imu=false", "duration_s=6", "tracks.features=60"
        ],
        overrides=["backend.initialization.mode=motion"],
    )  # fmt: skip
    (row,) = found.rows
    assert row["alignment"] == alignment
    assert found.table[1][found.table[0].index("aligned in")] == alignment
    assert row["ate_m"][alignment] < 0.05
    assert (row["ate_m"]["yaw"] is None) == (cameras == 1)
    assert (tmp_path / "figures" / "sim_random_errors.png").is_file()


def test_errors_in_the_world_of_the_fixes_are_beside_the_aligned_ones(
    here: None, tmp_path: Path
) -> None:
    """Yaw and position are not aligned there: both are the error of the run and of its world."""
    found = compare_algorithms(
        "sim:random",
        "msckf",
        seeds=[4],
        output=tmp_path,
        simulation=["duration_s=8", "rate_hz=10", "tracks.features=60", "gnss.sigma_m=0.05",
                    "gnss.rate_hz=5"],
        overrides=["backend.initialization.mode=motion"],
    )  # fmt: skip
    (row,), (titles, cells) = found.rows, found.table
    there = row["in_world_of_fixes"]
    assert there["ate_m"] == row["ate_m"]["none"]
    assert row["ate_m"]["yaw"] < there["ate_m"] < 0.2
    shown = dict(zip(titles, cells, strict=True))
    assert shown["ATE world of fixes [m]"] == shown["ATE none [m]"]
    assert float(shown["orientation world of fixes [deg]"]) > 0.0


def test_every_algorithm_is_in_the_report_with_its_numbers(simulated: tuple[Path, dict]) -> None:
    folder, printed = simulated
    assert [(row["data"], row["algorithm"]) for row in printed["rows"]] == [
        ("sim_figure8", "msckf"),
        ("sim_figure8", "swf"),
    ]
    for row in printed["rows"]:
        assert row["status"] == {"ok": 1}
        assert all(0.0 < row["ate_m"][mode] < 0.0147 for mode in ALIGNMENTS)
        assert row["nees"]["position"] > 0.0
        assert row["ms_per_frame"] > 0.0
        assert row["steps"] == 1.0
        assert 50.0 < row["peak_memory_mb"] < 1000.0
    markdown = (folder / "report.md").read_text()
    html = (folder / "report.html").read_text()
    assert "world of fixes [m]" not in markdown + html  # there are none
    for name in ("msckf", "swf"):
        assert f"| {name} |" in markdown
        assert f"<td>{name}</td>" in html
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", markdown)
    kinds = ("paths", "summary", "errors", "nees", "steps")
    assert pictures == [f"figures/sim_figure8_{kind}.png" for kind in kinds]
    assert all((folder / name).read_bytes().startswith(b"\x89PNG") for name in pictures)
    assert all((folder / name).stat().st_size > 10_000 for name in pictures)
    assert html.count("data:image/png;base64,") == len(pictures)


@pytest.fixture(scope="module")
def again(simulated: tuple[Path, dict]) -> tuple[subprocess.CompletedProcess, list[int]]:
    """The same once more, printed as a table; and when its results were written before."""
    folder, _ = simulated
    files = [folder / "runs" / "sim_figure8_seed0" / f"{name}.json" for name in ("msckf", "swf")]
    before = [file.stat().st_mtime_ns for file in files]
    done = compare("sim:figure8", *SHORT_SIM, "--algorithms", "msckf,swf", "--output", folder)
    return done, before


def test_the_printed_table_fits_a_hundred_columns(
    again: tuple[subprocess.CompletedProcess, list[int]], capsys: pytest.CaptureFixture[str]
) -> None:
    lines = again[0].stdout.splitlines()
    assert max(map(len, lines)) <= 100
    assert any(line.split()[:2] == ["algorithm", "ATE"] for line in lines)
    assert any(line.split()[:1] == ["swf"] and line.rstrip().endswith("1 ok") for line in lines)
    rows = [["a_long_name_of_an_algorithm" * 3, *(["123456.789"] * 8)]]
    echo_rich_table(["algorithm", *(f"quantity {k} [m]" for k in range(8))], rows, "data", "note")
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


def test_a_job_is_what_the_pipeline_does_on_the_recorded_tracks(
    simulated: tuple[Path, dict],
) -> None:
    folder, _ = simulated
    (tracks,) = (folder / "tracks").iterdir()
    # the error of the start is drawn from its covariance, which is not to be reduced
    config = load_config(None, ["backend.initialization.fix_gauge=false"], algorithm="swf")
    result = run_pipeline(open_dataset(tracks), config)
    truth = result.groundtruth
    assert truth is not None
    file = folder / "runs" / "sim_figure8_seed0" / "swf.npz"
    with np.load(file, allow_pickle=False) as series:
        for mode in ALIGNMENTS:
            expected = ape(truth, result.trajectory, "trans_part", mode)
            np.testing.assert_allclose(series[f"translation_m_{mode}"], expected.values, atol=1e-12)
        assert np.all(np.diff(series["distance_m"]) >= 0.0)
        assert len(series["nees_position"]) == len(series["nees_time_s"]) > 0
        assert len(series["steps"]) == len(result.logs.steps) > 0
        assert np.all(series["columns"] >= 15)
        assert 0.5 < np.median(series["nis_ratio"]) < 1.5
        assert np.all(series["cost_before"] >= 0.0)
        assert len(series["ms_backend"]) == len(series["frame_time_s"]) == result.logs.frames
    table = json.loads(file.with_suffix(".json").read_text())
    ours = table["metrics"]["accuracy"]["none"]["ate"]
    assert ours == result.metrics["accuracy"]["none"]["ate"]


def test_what_is_done_is_not_done_again_but_other_settings_are(
    simulated: tuple[Path, dict], again: tuple[subprocess.CompletedProcess, list[int]]
) -> None:
    (folder, _), (done, before) = simulated, again
    names = ("msckf", "swf")
    files = [folder / "runs" / "sim_figure8_seed0" / f"{name}.json" for name in names]
    assert done.returncode == 0
    assert done.stderr == ""
    assert "3 tasks had been done before" in done.stdout
    assert [file.stat().st_mtime_ns for file in files] == before

    arguments = ("sim:figure8", *SHORT_SIM, "--output", folder, "--algorithms", "swf")
    changed = compare(*arguments, "--set", "algorithm.cost.max_past_poses=4")
    assert changed.stderr.splitlines() == ["1/1 swf on sim_figure8, seed 0"]
    assert files[0].stat().st_mtime_ns == before[0]
    assert files[1].stat().st_mtime_ns > before[1]


def test_tracks_are_recorded_anew_where_calibration_truth_or_data_have_changed(
    tmp_path: Path,
) -> None:
    recording = flight(tmp_path / "flight", duration_s=1.0)
    output = recording / "results"

    def folder(**truths: Path) -> Path:
        named = {str(recording): truth for truth in truths.values()}
        (source,) = find_sources([recording], None, (), named, None, output)
        return RecordTask(source=source, seed=0, config=load_config(), root=tmp_path).folder

    before = folder()
    output.mkdir()
    (output / "report.md").write_text("what a comparison writes is no part of the recording")
    assert folder() == before
    for name in ("imu.bin", "groundtruth.npz"):
        os.utime(recording / name, ns=(0, 0))
        before, changed = folder(), before
        assert before != changed
    rig, truth = recording / "calibration.yaml", tmp_path / "truth.tum"
    text, status = rig.read_text(), rig.stat()
    rig.write_text(text.replace("timeshift_cam_imu: 0.0", "timeshift_cam_imu: 0.1"))
    os.utime(rig, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert rig.stat().st_size == status.st_size
    assert folder() != before
    for height in (0, 1):
        truth.write_text("".join(f"{t} 0 0 {height} 0 0 0 1\n" for t in range(3)))
        before, changed = folder(truth=truth), before
        assert before != changed


@pytest.mark.data
def test_a_recording_of_tracks_with_its_truth(here: None, data_dir: Path, tmp_path: Path) -> None:
    truth = data_dir / "euroc_inertial" / "V1_01_easy"
    options = ("--groundtruth", f"demo={truth}", "--duration", "8", "--seeds", "3", *STATIC)
    words = ["compare", "demo", *options, "--algorithms", "msckf,swf", "--output", str(tmp_path)]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["rows"]
    assert [row["seeds"] for row in rows] == [1, 1]  # a seed would change nothing
    assert all(row["status"] == {"ok": 1} and row["ate_m"]["yaw"] < 0.1 for row in rows)


@pytest.mark.slow
def test_an_interruption_keeps_what_is_done(tmp_path: Path) -> None:
    arguments = [
        "sim:figure8",
        *SHORT_SIM,
        "--seeds",
        "3",
        "--algorithms",
        "msckf",
        "--workers",
        "1",
    ]
    process = subprocess.Popen(
        [*COMMAND, *arguments, "--output", tmp_path],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    )
    assert process.stderr is not None
    first = process.stderr.readline()
    assert first == "1/3 tracks of sim_figure8, seed 0\n"
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    assert "interrupted; finished tasks are kept" in said
    kept = sorted((tmp_path / "tracks").iterdir())
    assert kept[0].name.startswith("sim_figure8_seed0_")
    assert all((folder / "meta.yaml").is_file() for folder in kept), "something half done"


@pytest.mark.slow
def test_what_cannot_be_done_is_said_and_does_not_stop_the_rest(tmp_path: Path) -> None:
    sources = find_sources(["sim:figure8"], 1.0)
    broken = sources[0].model_copy(update={"simulation": None, "recording": "no_such_folder"})
    tasks = [
        RecordTask(source=source, seed=0, config=load_config(), root=tmp_path)
        for source in (broken, sources[0])
    ]
    outcomes = {task.source.recording: said for task, said in LocalProcesses(2).do(tasks)}
    assert outcomes == {"no_such_folder": "no_such_folder: no such file or folder", None: None}
    assert tasks[1].is_done()


def test_seeds_and_algorithms_make_the_plan(tmp_path: Path) -> None:
    sources = find_sources(["sim:figure8", "demo"], 6.0)
    configs = load_configs(["msckf", "ekf"], lambda name: load_config(algorithm=name))
    recordings, runs = plan(sources, configs, 3, tmp_path)
    assert len(recordings) == 4
    assert len(runs) == 8
    assert len({task.folder for task in recordings}) == 4
    assert len({(task.key, task.seed) for task in runs}) == 8
    again = RunTask.model_validate_json(runs[0].model_dump_json())
    assert again.key == runs[0].key
    first = sources[0].open(0, cameras=1).groundtruth()
    assert first is not None
    assert len(first) == 121


@pytest.mark.parametrize(
    ("names", "truths", "message"),
    [
        (["sim:no_such"], {}, "no_such: no such file or folder; known: figure8"),
        (["sim:rooms", "sim:rooms"], {}, "another source is also called 'sim_rooms'"),
        (["sim:rooms"], {"demo": "x"}, "no recording called 'demo'"),
    ],
)
def test_faults_in_what_is_named(names: list[str], truths: dict, message: str) -> None:
    with pytest.raises((ConfigError, DataError), match=re.escape(message)):
        find_sources(names, None, (), truths)


def test_bins_average_what_is_known() -> None:
    x, y = np.array([0.1, 0.2, 0.3, 1.5, 2.5]), np.array([1.0, 3.0, np.nan, 5.0, np.nan])
    means = binned_mean(x, y, np.array([0.0, 1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(means, [2.0, 5.0, np.nan])


def test_peak_memory_is_of_this_process_and_never_falls() -> None:
    before = peak_memory_mb()
    assert before is not None
    block = np.ones(8_000_000)
    after = peak_memory_mb()
    assert after is not None
    assert before <= after
    assert block.nbytes / 2**20 < after


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a real Dask scheduler with one real worker, on loopback."""
    folder = tmp_path_factory.mktemp("dask")
    file = folder / "scheduler.json"
    environment = {**os.environ, **ONE_THREAD}
    dask = [sys.executable, "-m", "dask"]
    options = ["--scheduler-file", str(file), "--no-dashboard"]
    commands = (
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", *options],
        [*dask, "worker", "--nthreads", "2", "--local-directory", str(folder), *options],
    )
    processes = [
        subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for command in commands
    ]
    try:
        deadline = time.monotonic() + HANG_S
        while not file.is_file() or not file.read_text().strip():
            assert time.monotonic() < deadline, "no scheduler"
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in reversed(processes):
            process.wait(HANG_S)


def test_a_dask_cluster_does_the_same(simulated: tuple[Path, dict], tmp_path: Path) -> None:
    """Its scheduler and worker are in this process; slow tests have them in their own."""
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=None
    )
    with cluster:
        options = ("--algorithms", "msckf", "--scheduler", cluster.scheduler_address)
        output = ("--output", tmp_path / "results", "--json")
        done = compare("sim:figure8", *SHORT_SIM, *options, *output)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(done.stdout)["rows"]
    local = simulated[1]["rows"][0]
    assert row["ate_m"] == pytest.approx(local["ate_m"], rel=1e-9)


@pytest.fixture(scope="module")
def long_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that is not done when the command ends."""
    return flight(tmp_path_factory.mktemp("long") / "flight", 0, 60.0)


def test_tracks_are_made_anew_for_another_gravity_or_without_the_imu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The front end predicts by the IMU where a run does."""
    (source,) = find_sources(["sim:figure8"], 0.5, ["tracks.features=20"])

    def task(*overrides: str) -> RecordTask:
        config = load_config(None, overrides)
        return RecordTask(source=source, seed=0, config=config, root=tmp_path)

    constant = task("backend.dynamics.model=constant_velocity")
    moon = task("backend.noise.gravity=1.6")
    assert len({task().folder, constant.folder, moon.folder}) == 3
    assert task("backend.noise.pixel_sigma=2").folder == task().folder
    given: list[tuple[bool, float]] = []
    samples: list[int] = []

    def build(rig: Rig, *rest: Any) -> Frontend:
        given.append((rig.has_imu, rest[-1]))
        frontend = build_frontend(rig, *rest)
        track = frontend.track
        frontend.track = lambda frame, imu: samples.append(len(imu)) or track(frame, imu)
        return frontend

    monkeypatch.setattr(tasks, "build_frontend", build)
    for each in (task(), moon, constant):
        samples.clear()
        each.do()
        assert (max(samples) > 0) == (each is not constant)
    assert [imu for imu, _ in given] == [True, True, False]
    assert given[1][1] == 1.6
    recorded = open_dataset(constant.folder)
    assert recorded.info().imu_samples > 0, "the recording has them all the same"


@pytest.mark.slow
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGKILL], ids=["ctrl_c", "killed"])
def test_processes_that_workers_have_started_end_with_the_command(
    scheduler: str, long_flight: Path, tmp_path: Path, by: signal.Signals
) -> None:
    """Also where the command is killed: Dask then forgets its tasks."""
    pytest.importorskip("distributed")
    for seed in range(2):
        shutil.copytree(long_flight, tmp_path / "data" / f"flight_{seed}")
    out = tmp_path / "out"
    process = subprocess.Popen(
        batch(tmp_path / "data", "--output", out, "--scheduler", scheduler, "--no-final-ba"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    started = [worker_of(out, f"flight_{seed}") for seed in range(2)]
    process.send_signal(by)
    assert process.wait(HANG_S) == (130 if by == signal.SIGINT else -by)
    assert wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started))
    assert not [path for path in out.iterdir() if path.is_dir()], "something half done"


def test_no_scheduler_is_said_in_one_line() -> None:
    pytest.importorskip("distributed")
    task = RecordTask(
        source=find_sources(["sim:figure8"], 1.0)[0], seed=0, config=load_config(), root=Path()
    )
    with pytest.raises(DataError, match="no Dask scheduler answers at 'nowhere'"):
        next(DaskCluster("nowhere").do([task]))


def test_without_dask_the_error_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"pip install 'slam-graph\[compare\]'"):
        DaskCluster("tcp://127.0.0.1:8786")


def test_the_variants_differ_in_their_jacobians_and_the_smoothers_have_none() -> None:
    names = ("msckf", "fixed_lag_isam2")
    configs = with_variants(load_configs(names, lambda name: load_config(algorithm=name)))
    assert list(configs) == ["msckf", "msckf_no_fej", "fixed_lag_isam2"]
    with_fej, without = configs["msckf"].algorithm, configs["msckf_no_fej"].algorithm
    assert with_fej.marginalization.first_estimates
    assert not without.marginalization.first_estimates
    assert without.cost == with_fej.cost


def test_a_start_with_an_error_of_its_covariance_keeps_that_covariance(tmp_path: Path) -> None:
    """Otherwise the error in position and yaw would be called zero, and every NEES be too large."""
    configs = load_configs(["msckf"], lambda name: load_config(algorithm=name))
    for error, fixed in (("true", False), ("false", True)):
        sources = find_sources(["sim:figure8"], 2.0, [f"start.error={error}"])
        _, (task,) = plan(sources, configs, 1, tmp_path)
        assert task.config.backend.initialization.fix_gauge is fixed


def test_compare_from_python(here: None, tmp_path: Path) -> None:
    """One algorithm over chosen seeds; a second call with one more does only that."""
    told: list[str] = []
    options = {"simulation": ["duration_s=4", "rate_hz=10", "tracks.features=40"]}
    arguments = {**options, "output": str(tmp_path), "workers": 1}
    first = compare_algorithms("sim:figure8", "swf", seeds=[3, 4], **arguments)
    assert [task.seed for task in first.runs] == [3, 4]
    assert first.rows[0]["algorithm"] == "swf"
    assert first.rows[0]["status"] == {"ok": 2}
    assert all(file.is_file() for file in first.files)
    second = compare_algorithms(
        ["sim:figure8"],
        ["swf"],
        seeds=[4, 5],
        progress=lambda task, *_: told.append(task),
        **arguments,
    )
    assert second.skipped == 2
    assert told == ["tracks of sim_figure8, seed 5", "swf on sim_figure8, seed 5"]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["runs"] == [f"runs/sim_figure8_seed{seed}/swf" for seed in (4, 5)]


@pytest.mark.slow
def test_fixes_that_lie_elsewhere_are_compared_with(here: None, tmp_path: Path) -> None:
    """Named as a source they are recorded with the tracks; changed ones are recorded anew."""
    drive, fixes = tmp_path / "drive", tmp_path / "fixes.csv"
    settings = {"with_imu": False, "seed": 1, "tracks": {"features": 60}}
    simulate(trajectory="car", duration_s=15.0, gnss={"sigma_m": 0.3}, **settings).save(drive)
    (drive / "gnss.csv").rename(fixes)
    arguments = {"sources": {"gnss": str(fixes)}, "workers": 1, "output": tmp_path / "compared"}
    done = compare_algorithms(drive, "msckf", **arguments)
    assert not done.failures
    (task,) = done.runs
    result = read_result(task.result)
    assert result is not None
    assert result["metrics"]["world"]["of_fixes"]
    assert compare_algorithms(drive, "msckf", **arguments).skipped == 2
    lines = fixes.read_text().splitlines(keepends=True)
    fixes.write_text("".join(lines[:-1]))
    assert compare_algorithms(drive, "msckf", **arguments).skipped == 0


def test_compare_with_unknown_names() -> None:
    with pytest.raises(ConfigError, match=r"unknown algorithm 'mskcf'; did you mean 'msckf'\?"):
        compare_algorithms("sim:figure8", "mskcf")
    with pytest.raises(DataError, match="did you mean 'figure8'"):
        compare_algorithms("sim:figure9")
    with pytest.raises(ConfigError, match="give only one"):
        compare_algorithms("sim:figure8", workers=2, scheduler="tcp://127.0.0.1:1")
