# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A front end in a process of its own: the same results, errors and warnings, and no remains.

That all algorithms write the same bytes is in `test_repeats.py`.
"""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from groups import slow

from slam_graph.config import load_config
from slam_graph.datasets.formats.euroc import EurocSequence
from slam_graph.datasets.sequence import FrameStream, ReaderOptions
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError, EstimationError
from slam_graph.pipeline import run, run_recording
from slam_graph.pipeline.forked_call import ForkedCall
from slam_graph.results import RunResult
from slam_graph.simulation.simulator import simulate

HANG_S = 120

pytestmark = pytest.mark.skipif(not ForkedCall.is_possible(), reason="no processes to fork here")


class Spoilt(EurocSequence):
    """A recording that warns at every frame, and does something at the fifth.

    Args:
        path: of the recording.
        at_fifth: called there.
    """

    def __init__(self, path: Path, at_fifth: Callable[[], object]) -> None:
        super().__init__(path, ReaderOptions())
        self._at_fifth = at_fifth

    def frames(self, start_ns: int | None = None, end_ns: int | None = None) -> FrameStream:
        for number, frame in enumerate(super().frames(start_ns, end_ns)):
            self.diagnostics.warn("frame_read", f"frame {number}")
            if number == 5:
                self._at_fifth()
            yield frame


class Unsendable(Exception):  # noqa: N818
    """An error that cannot be pickled."""

    def __init__(self, message: str, more: Callable[[], object]) -> None:
        super().__init__(message)
        self.more = more


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("overlap") / "flight"
    simulate(kind="images", duration_s=2.0, rate_hz=10.0).save(path)
    return path


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process is started also where there is one core."""
    monkeypatch.setattr(run_recording, "can_overlap", lambda: True)


def run_of(flight: Path, at_fifth: Callable[[], object], overlap: bool) -> RunResult:
    config = load_config(overrides={"overlap": overlap, "final_ba.enabled": False})
    return run(Spoilt(flight, at_fifth), config)


def fail(error: Exception) -> None:
    raise error


def both(flight: Path, at_fifth: Callable[[], object]) -> tuple[RunResult, RunResult]:
    return run_of(flight, at_fifth, True), run_of(flight, at_fifth, False)


def test_a_front_end_works_in_another_process(flight: Path) -> None:
    with pytest.raises(DataError) as told:
        run_of(flight, lambda: fail(DataError(f"process {os.getpid()}")), True).check()
    assert str(told.value).startswith("process ")
    assert str(told.value) != f"process {os.getpid()}"


def test_warnings_are_counted_and_logged_by_the_run(
    flight: Path, caplog: pytest.LogCaptureFixture
) -> None:
    said = []
    for overlap in (True, False):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            result = run_of(flight, lambda: None, overlap)
        result.check()
        assert result.warnings["frame_read"] == result.logs.frames == result.input.info.frames
        said.append([record.getMessage() for record in caplog.records])
    assert said[0] == said[1]
    assert sum("frame_read" in line for line in said[0]) == 5  # the others are only counted


def test_an_error_arrives_in_its_turn(flight: Path) -> None:
    beside, in_turn = both(flight, lambda: fail(DataError("frame 5 is torn")))
    assert beside.status == in_turn.status == "failed"
    assert beside.ending.message == in_turn.ending.message == "frame 5 is torn"
    assert isinstance(beside.ending.error, DataError)
    assert beside.logs.frames == in_turn.logs.frames == 5


def test_an_internal_error_says_where_it_was_raised(
    flight: Path, caplog: pytest.LogCaptureFixture
) -> None:
    beside, in_turn = both(flight, lambda: fail(ZeroDivisionError("by zero")))
    assert (
        beside.ending.message
        == in_turn.ending.message
        == ("internal error: ZeroDivisionError: by zero")
    )
    assert caplog.text.count("in fail") >= 2
    result = run_of(flight, lambda: fail(Unsendable("no way", lambda: None)), True)
    assert result.ending.message == "internal error: RuntimeError: Unsendable: no way"


def test_a_process_that_is_killed_ends_the_run_with_one_line(flight: Path) -> None:
    parent = os.getpid()

    def end() -> None:
        assert os.getpid() != parent
        os.kill(os.getpid(), signal.SIGKILL)

    result = run_of(flight, end, True)
    assert result.status == "failed"
    with pytest.raises(EstimationError, match=r"has ended \(signal 9\); overlap=false runs it"):
        result.check()
    assert result.logs.frames == 5


def test_sigterm_to_the_process_interrupts_the_run(flight: Path) -> None:
    result = run_of(flight, lambda: os.kill(os.getpid(), signal.SIGTERM), True)
    assert (result.status, result.logs.frames) == ("interrupted", 5)


def test_results_are_complete_and_of_their_own() -> None:
    """Also arrays for which there is no room in the shared memory, and many results in a row."""

    def made(size: int) -> dict[str, np.ndarray]:
        return {"large": np.full(size, size), "turned": np.ones((200, 300)).T * size}

    sizes = [10, 5000, 20_000, 200_000, 100]
    with closing(ForkedCall(made, 300_000, Diagnostics())) as process:
        results = []
        for size in sizes:
            process.begin(size)
            results.append(process.result())
    for size, result in zip(sizes, results, strict=True):
        for name, array in made(size).items():
            np.testing.assert_array_equal(result[name], array)
            assert result[name].strides == array.strides


SLEEPY = """
import os, time
from pathlib import Path
from slam_graph.interrupts import Interrupts
from test_overlap import run_of
def sleep():
    Path("frontend").write_text(f"{os.getpid()} ")
    time.sleep(1.0)
Interrupts.terminate_like_interrupt()
result = run_of(Path("flight"), sleep, True)
print(result.status, result.logs.frames)
result.check()
"""
"""A run whose front end says who it is at the fifth frame, and then takes a while."""


@pytest.mark.parametrize(
    ("number", "to_all"),
    [(signal.SIGINT, True), slow(signal.SIGTERM, True), slow(signal.SIGKILL, False)],
)
def test_no_process_is_left(flight: Path, number: signal.Signals, to_all: bool) -> None:
    """After a signal to the whole group, as from a terminal, or to the back end alone."""
    told = flight.parent / "frontend"
    told.unlink(missing_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-c", SLEEPY],
        cwd=flight.parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    )
    wait_for(lambda: told.exists() and told.read_text().endswith(" "), process)
    frontend = int(told.read_text())
    assert frontend != process.pid
    if to_all:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    said = process.communicate(timeout=HANG_S)[0]
    wait_for(lambda: has_ended(frontend))
    if number != signal.SIGKILL:
        assert said.split()[0] == "interrupted"
        assert int(said.split()[1]) in (5, 6)  # the back end was at work on the fifth, or waited
    assert process.returncode in (-signal.SIGINT, -signal.SIGKILL)


def has_ended(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return "zombie" in Path(f"/proc/{pid}/status").read_text()  # nobody waits for orphans here


def wait_for(what: Callable[[], object], process: "subprocess.Popen[str] | None" = None) -> None:
    deadline = time.monotonic() + HANG_S
    while not what():
        assert time.monotonic() < deadline
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.01)
