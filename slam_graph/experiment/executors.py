# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Executors of tasks: processes on this machine, or a Dask cluster."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from slam_graph.errors import ConfigError, DataError, closest
from slam_graph.experiment.tasks import Task

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a task: tasks run in parallel, so BLAS uses one thread in each."""

_STOP_TIMEOUT_S = 10.0
"""Time for a task to end after SIGTERM before it is killed."""

_CONNECT_TIMEOUT_S = 10.0

_LOOK_S = 0.3
"""A worker of Dask looks as often whether its task is still wanted."""

TLS_FILES = {
    "ca_file": "tls_ca_file",
    "cert": "tls_client_cert",
    "key": "tls_client_key",
}
"""Files for TLS, by their names in the commands of Dask, and its arguments for them."""

Outcome = tuple[Task, str | None]
"""A task that has ended, and why it failed or None."""


class Executor(Protocol):
    """Does tasks."""

    def do(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Do all tasks; yields each when it has ended. Closing the generator stops the others."""
        ...


class LocalProcesses:
    """Runs each task in a new process on this machine.

    Args:
        workers: processes at a time; the number of cores if None.
    """

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or os.cpu_count() or 1
        self._running: set[_TaskProcess] = set()
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
                _stop(list(self._running))
                raise

    def _do(self, task: str) -> str | None:
        if self._stopped:
            return "stopped"
        process = _TaskProcess(task)
        self._running.add(process)
        try:
            if self._stopped:  # since it was asked for above
                _stop([process])
            return _wait(process)
        finally:
            self._running.discard(process)


class DaskCluster:
    """Runs each task in a new process, started by a worker of a Dask cluster.

    Workers need this package, and data and results under the same paths.

    Args:
        address: of the scheduler, e.g. ``tcp://127.0.0.1:8786`` or ``tls://cluster:8786``.
        tls: paths of PEM files by Dask's names for them (`TLS_FILES`), for an encrypted
            connection; those that are not given are taken from Dask's own settings.

    Raises:
        ConfigError: if Dask is not installed, or a file is missing.
    """

    def __init__(self, address: str, tls: Mapping[str, str | Path] | None = None) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise ConfigError(
                "--scheduler needs Dask; install it with: pip install 'slam-graph[compare]'"
            ) from error
        self.address = address
        self.tls = {name: str(path) for name, path in (tls or {}).items()}
        for name, path in self.tls.items():
            if name not in TLS_FILES:
                raise ConfigError(f"tls: no file '{name}'; {closest(name, TLS_FILES)}")
            if not Path(path).is_file():
                raise ConfigError(f"{path}: no such file; it was given as {name} for TLS")

    def do(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Do all tasks.

        Raises:
            DataError: if the scheduler cannot be reached.
        """
        from distributed import Client, as_completed

        try:
            client = Client(
                self.address,
                timeout=_CONNECT_TIMEOUT_S,
                set_as_default=False,
                security=self._security(),
            )
        except (OSError, ValueError, TypeError) as error:
            secured = " with these TLS files" if self.tls else ""
            raise DataError(f"no Dask scheduler answers at '{self.address}'{secured}") from error
        with client:
            texts = [task.model_dump_json() for task in tasks]
            futures = client.map(_do_in_process, texts, pure=False, retries=0)
            named = {future.key: task for future, task in zip(futures, tasks, strict=True)}
            try:
                for future in as_completed(futures, loop=client.loop):
                    lost = future.exception()
                    failure = future.result() if lost is None else f"{type(lost).__name__}: {lost}"
                    yield named[future.key], failure
            except BaseException:
                client.cancel(futures)
                raise

    def _security(self) -> Any:
        """The security of Dask; None leaves all to its own settings."""
        from distributed.security import Security

        if not self.tls:
            return None
        named = {TLS_FILES[name]: path for name, path in self.tls.items()}
        return Security(require_encryption=True, **named)


def executor_for(
    workers: int | None, scheduler: str | None, tls: Mapping[str, str | Path] | None = None
) -> Executor:
    """Processes on this machine, or a Dask cluster if there is an address of its scheduler.

    Raises:
        ConfigError: if both are given, files for TLS without a scheduler, or Dask is not installed.
    """
    if scheduler is None:
        if tls:
            raise ConfigError("TLS is for the connection to a Dask scheduler; give its address")
        return LocalProcesses(workers)
    if workers is not None:
        raise ConfigError(
            "a number of processes is for this machine, a Dask cluster has its own; give only one"
        )
    return DaskCluster(scheduler, tls)


def _do_in_process(task: str) -> str | None:
    """Do a task of Dask in a new process, which ends when nobody waits for it any more.

    A thread of a worker cannot be stopped from outside: Dask forgets a task that was cancelled, or
    whose client is gone, and lets the thread go on. So the thread looks itself.

    Returns:
        Why it failed, or None.
    """
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def wanted() -> bool:
        known = worker.state.tasks.get(key)
        return known is not None and known.state != "cancelled"

    return _wait(_TaskProcess(task), wanted)


class _TaskProcess(subprocess.Popen[str]):
    """The process of a task, which ends with this one; Ctrl-C in the terminal does not reach it.

    Args:
        task: as JSON.
    """

    def __init__(self, task: str) -> None:
        theirs, self._lifeline = os.pipe()  # its end is closed also when this process is killed
        try:
            super().__init__(
                [sys.executable, "-m", "slam_graph.experiment.task_process", task],
                stdin=theirs,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, **ONE_THREAD},
                start_new_session=True,
            )
        finally:
            os.close(theirs)

    def release(self) -> None:
        """Close the pipe, when the process has ended."""
        os.close(self._lifeline)


def _stop(processes: Sequence[_TaskProcess]) -> None:
    """End the processes of tasks, all at once, with SIGTERM: they leave no incomplete files then.

    SIGINT would be ignored by tasks of a command in the background of a shell. What has not ended
    in time, or when there is another Ctrl-C, is killed.
    """
    for process in processes:
        with suppress(ProcessLookupError):
            process.terminate()
    deadline = time.monotonic() + _STOP_TIMEOUT_S
    try:
        for process in processes:
            process.wait(max(deadline - time.monotonic(), 0.0))
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        for process in processes:
            process.kill()


def _wait(process: _TaskProcess, wanted: Callable[[], bool] | None = None) -> str | None:
    """Wait for the process of a task.

    Args:
        process: to wait for.
        wanted: tells whether it is still wanted; it is ended if not. None if nobody is to ask.

    Returns:
        Why it failed, or None.
    """
    while True:
        try:
            _, errors = process.communicate(timeout=None if wanted is None else _LOOK_S)
            break
        except subprocess.TimeoutExpired:
            if wanted is not None and not wanted():
                _stop([process])
    process.release()
    if process.returncode == 0:
        return None
    if process.returncode < 0:
        return f"ended by signal {-process.returncode}"
    lines = errors.strip().splitlines()
    kind, _, message = lines[-1].partition(": ") if lines else ("", "", "")
    # the message of an error of this package is complete without its type
    return message if kind.startswith("slam_graph.errors.") else f"{kind}: {message}"
