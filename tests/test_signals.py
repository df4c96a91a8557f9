# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Signals at any moment: a valid result that says how it ended, and no process is left."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from groups import slow

from slam_graph.backend import FinalBa
from slam_graph.config import load_config
from slam_graph.experiment.comparison_results import read_result
from slam_graph.experiment.executors import _stop, _TaskProcess
from slam_graph.experiment.tasks import RecordTask, RunTask, find_sources
from slam_graph.interrupts import Interrupts
from slam_graph.pipeline import run
from slam_graph.pipeline.stage import Stage
from slam_graph.pipeline.supervision import finish
from slam_graph.results import load_result
from slam_graph.simulation.simulator import simulate

HANG_S = 300
COMMAND = [sys.executable, "-m", "slam_graph.cli.launch"]


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """Ctrl-C has its usual effect, also where the tests were started with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "flight"
    simulate(duration_s=4.0).save(path)
    return path


@pytest.fixture(scope="module")
def long_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Longer than any signal waits: at its end a run has nothing to interrupt."""
    path = tmp_path_factory.mktemp("long_flight") / "flight"
    simulate(duration_s=20.0).save(path)
    return path


def start(*arguments: str | Path, folder: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    )


def wait_for(what: Callable[[], object]) -> None:
    deadline = time.monotonic() + HANG_S
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def ended(process: "subprocess.Popen[str]") -> tuple[int, str]:
    _, said = process.communicate(timeout=HANG_S)
    assert "Traceback" not in said, said
    return process.returncode, said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("after_s", [0.15, 0.4, 0.8, 1.6, 2.4])
def test_a_signal_at_any_moment_leaves_a_valid_result_or_none(
    long_flight: Path, tmp_path: Path, number: signal.Signals, after_s: float
) -> None:
    process = start("run", long_flight, "--no-progress", folder=tmp_path)
    time.sleep(after_s)
    process.send_signal(number)
    code, said = ended(process)
    assert code in (-number, 130), said  # before the first line of ours, Python ends by itself
    made = [path for path in tmp_path.glob("results/flight/*") if not path.is_symlink()]
    for folder in made:
        saved = load_result(folder)
        assert saved.status == "interrupted"
        assert (tmp_path / "results" / "flight" / "latest").resolve() == folder
        assert len(saved.trajectory) == saved.metrics["extent"]["estimated_frames"]
    assert not list(tmp_path.rglob(".*"))


def test_a_killed_run_leaves_what_it_had_with_a_mark(flight: Path, tmp_path: Path) -> None:
    process = start("run", "demo", "--no-progress", folder=tmp_path)
    wait_for(lambda: list(tmp_path.glob("results/*/*/frames.csv")))
    process.kill()
    process.communicate(timeout=HANG_S)
    (folder,) = tmp_path.glob("results/*/*")
    saved = load_result(folder)
    assert saved.status == "unfinished"
    assert len(saved.trajectory) == saved.metrics["extent"]["estimated_frames"]
    assert saved.config.algorithm.name == "msckf"
    assert not (folder.parent / "latest").exists()


def test_snapshots_change_nothing(flight: Path, tmp_path: Path) -> None:
    from slam_graph.pipeline import observers

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observers, "_SNAPSHOT_PERIOD_S", 0.0)
        patch.setattr(observers, "_SNAPSHOT_SHARE", 1.0)
        kept = run(flight, so_far=tmp_path / "kept", duration_s=2.0)
    assert load_result(tmp_path / "kept").status == "unfinished"
    plain = run(flight, duration_s=2.0)
    np.testing.assert_array_equal(kept.trajectory.positions, plain.trajectory.positions)
    np.testing.assert_array_equal(kept.points, plain.points)
    kept.save(tmp_path / "kept")
    assert load_result(tmp_path / "kept").status == "ok"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of glibc")
def test_a_snapshot_gives_free_memory_back(flight: Path, tmp_path: Path) -> None:
    """What was freed between things that stay is kept by the allocator, if nobody asks for it."""
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("of glibc")
    result = run(flight, duration_s=1.0)
    blocks = [b"x" * 100_000 for _ in range(800)]
    stays = blocks[::2]
    del blocks
    before_mb = resident_mb()
    result.save_so_far(tmp_path, 1.0)
    assert resident_mb() < before_mb - 30.0
    assert len(stays) == 400


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_an_interrupt_in_the_final_adjustment_keeps_the_causal_result(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adjusted = FinalBa.of_worlds

    def interrupted(*arguments: object) -> None:
        adjusted(*arguments)  # type: ignore[arg-type]
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(FinalBa, "of_worlds", interrupted)
    result = run(flight, duration_s=2.0)
    assert result.status == "interrupted"
    assert result.final_ba is None
    assert len(result.trajectory) == result.logs.frames
    with pytest.raises(KeyboardInterrupt):
        result.check()


def signals(count: int, done: list[int], number: signal.Signals = signal.SIGINT) -> None:
    """Send a signal so many times while something is to be completed."""
    with Interrupts.completed() as begin:
        begin()
        for _ in range(count):
            signal.raise_signal(number)
        done.append(count)


def test_what_has_begun_is_completed_unless_there_is_a_second_signal() -> None:
    done: list[int] = []
    for count in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            signals(count, done)
    signals(0, done)
    assert done == [1, 0]


@pytest.mark.parametrize("ignored", [False, True])
def test_sigterm_waits_also_where_ctrl_c_is_ignored(ignored: bool) -> None:
    """As in a background job of a shell."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL), signal.getsignal(signal.SIGINT)
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        Interrupts.terminate_like_interrupt()
        done: list[int] = []
        with Interrupts.deferred() as deferral:
            signals(1, done, signal.SIGTERM)
            assert deferral.heard
            with pytest.raises(KeyboardInterrupt):
                deferral.check()
        assert done == [1]
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGINT, before[1])


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def workers(pid: int) -> list[int]:
    threads = [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]
    lists = (Path(f"/proc/{pid}/task/{thread}/children") for thread in threads)
    return [int(one) for path in lists if path.exists() for one in path.read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux' /proc")
@pytest.mark.parametrize("number", [slow(signal.SIGTERM), signal.SIGKILL])
def test_compare_leaves_no_worker_behind(tmp_path: Path, number: signal.Signals) -> None:
    arguments = ("sim:figure8", "--duration", "60", "--workers", "1", "--output", tmp_path / "out")
    process = start("compare", *arguments, folder=tmp_path)
    wait_for(lambda: process.poll() is not None or workers(process.pid))
    found = workers(process.pid)
    assert found
    process.send_signal(number)
    process.communicate(timeout=HANG_S)
    wait_for(lambda: not any(alive(pid) for pid in found))


def test_damaged_results_are_done_again(tmp_path: Path) -> None:
    source = find_sources(["sim:figure8"], 1.0)[0]
    config = load_config(final_ba={"enabled": False})
    record = RecordTask(source=source, seed=0, config=config, root=tmp_path / "tracks")
    run_task = RunTask(
        data=source.name,
        algorithm="msckf",
        seed=0,
        config=config,
        tracks=record.folder,
        result=tmp_path / "runs" / "msckf.json",
    )
    for task in (record, run_task):
        assert not task.is_done()
        task.do()
        assert task.is_done()
    series = run_task.result.with_suffix(".npz")
    for path, cut in ((series, 100), (series, 0), (run_task.result, 200)):
        whole = path.read_bytes()
        path.write_bytes(whole[:cut])
        assert read_result(run_task.result) is None
        path.write_bytes(whole)
    content = bytearray(series.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    series.write_bytes(content)
    features = record.folder / "features.bin"
    features.write_bytes(features.read_bytes()[:-8])
    for task in (record, run_task):
        assert not task.is_done()
        task.do()
        assert task.is_done()


@pytest.mark.parametrize("ignored", [False, slow(True)], ids=["foreground", "background"])
@pytest.mark.parametrize("by", ["pipe", slow("stop")])
def test_a_task_ends_with_the_one_who_waits_for_it(tmp_path: Path, ignored: bool, by: str) -> None:
    """When that one is gone, or stops it; also where a shell lets Ctrl-C be ignored."""
    source = find_sources(["sim:figure8"], 600.0)[0]
    task = RecordTask(source=source, seed=0, config=load_config(), root=tmp_path)
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    process = _TaskProcess(task.model_dump_json())
    wait_for(lambda: list(tmp_path.glob(".*.partial")))
    if by == "stop":
        _stop([process])
    process.release()
    process.communicate(timeout=HANG_S)
    assert process.returncode == -signal.SIGINT  # as by Ctrl-C; it was not killed
    assert not list(tmp_path.iterdir())


class ImportsBadly(Stage):
    """A stage in which Ctrl-C becomes an error of another library, or is lost in a callback."""

    def __init__(self, lost: bool) -> None:
        self.lost = lost

    def finish(self) -> None:
        """Be interrupted."""
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if not self.lost:
                raise ImportError("no such module") from None


class Fails(Stage):
    """A stage that cannot finish."""

    def finish(self) -> None:
        """Fail."""
        raise ArithmeticError("of a stage")


class Finishes(Stage):
    """A stage that finishes."""

    done = False

    def finish(self) -> None:
        """Note it."""
        self.done = True


def test_a_signal_between_the_last_frame_and_the_stages_counts(flight: Path) -> None:
    result = run(flight, duration_s=1.0, final_ba={"enabled": False})
    last = Finishes()
    with Interrupts.deferred() as interrupts:
        signal.raise_signal(signal.SIGINT)
        finish([last], result, interrupts)
    assert last.done
    assert result.status == "interrupted"


@pytest.mark.parametrize(
    ("stage", "status"),
    [
        (ImportsBadly(lost=False), "interrupted"),
        (ImportsBadly(lost=True), "interrupted"),
        (Fails(), "failed"),
    ],
)
def test_the_end_of_a_run_survives_its_stages(flight: Path, stage: Stage, status: str) -> None:
    result = run(flight, duration_s=1.0, final_ba={"enabled": False})
    assert result.status == "ok"
    last = Finishes()
    with Interrupts.deferred() as interrupts:
        finish([stage, last], result, interrupts)
    assert last.done
    assert result.status == status
