# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Where tasks are done: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from typing import Protocol

from slam_graph.errors import ConfigError, DataError
from slam_graph.experiment.tasks import Task

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Tasks share the cores among them; BLAS reads these when it is loaded."""

PATIENCE_S = 10.0
CONNECT_S = 10.0

Outcome = tuple[Task, str | None]
"""A task that has ended, and why it failed if it did."""


class Executor(Protocol):
    """Does tasks."""

    def do(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Do all tasks, and give each when it has ended. Closing the iterator stops the others."""
        ...


class LocalProcesses:
    """Each task in a fresh process of this machine.

    Args:
        workers: how many at a time; as many as there are cores if None.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or os.cpu_count() or 1
        self._running: set[subprocess.Popen[str]] = set()
        self._stopped = False

    def do(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Do all tasks."""
        with ThreadPoolExecutor(self.workers) as pool:
            futures = {pool.submit(self._do, task.model_dump_json()): task for task in tasks}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            except BaseException:
                self._stopped = True
                pool.shutdown(wait=False, cancel_futures=True)
                for process in list(self._running):
                    stop(process)
                raise

    def _do(self, task: str) -> str | None:
        if self._stopped:
            return "stopped"
        process = start(task)
        self._running.add(process)
        try:
            return outcome(process)
        finally:
            self._running.discard(process)


class DaskCluster:
    """Each task in a fresh process that a worker of a Dask cluster starts.

    The workers need this package and the folders of data and results under the same paths.

    Args:
        address: of the scheduler, e.g. ``tcp://127.0.0.1:8786``.

    Raises:
        ConfigError: if Dask is not installed.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise ConfigError(
                "--scheduler needs Dask; install it with: pip install 'slam-graph[compare]'"
            ) from error
        self.address = address

    def do(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Do all tasks.

        Raises:
            DataError: if the scheduler cannot be reached.
        """
        from distributed import Client, as_completed

        try:
            client = Client(self.address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise DataError(f"no Dask scheduler answers at '{self.address}'") from error
        with client:
            texts = [task.model_dump_json() for task in tasks]
            futures = client.map(do_in_process, texts, pure=False, retries=0)
            named = {future.key: task for future, task in zip(futures, tasks, strict=True)}
            try:
                for future in as_completed(futures, loop=client.loop):
                    lost = future.exception()
                    said = future.result() if lost is None else f"{type(lost).__name__}: {lost}"
                    yield named[future.key], said
            except BaseException:
                client.cancel(futures)
                raise


def do_in_process(task: str) -> str | None:
    """Do a task in a process of its own.

    Returns:
        Why it failed, or None if it did not.
    """
    return outcome(start(task))


def start(task: str) -> subprocess.Popen[str]:
    """Start the process of a task; Ctrl-C in the terminal does not reach it."""
    return subprocess.Popen(
        [sys.executable, "-m", "slam_graph.experiment.tasks", task],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **ONE_THREAD},
        start_new_session=True,
    )


def stop(process: subprocess.Popen[str]) -> None:
    """End the process of a task: by an interruption, which leaves nothing half done."""
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()


def outcome(process: subprocess.Popen[str]) -> str | None:
    """Wait for the process of a task; why it failed, or None."""
    _, said = process.communicate()
    if process.returncode == 0:
        return None
    if process.returncode < 0:
        return f"ended by signal {-process.returncode}"
    lines = said.strip().splitlines()
    kind, _, message = lines[-1].partition(": ") if lines else ("", "", "")
    # an error that was raised on purpose says all in its message
    return message if kind.startswith("slam_graph.errors.") else f"{kind}: {message}"
