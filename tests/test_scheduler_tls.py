# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A Dask scheduler that asks for TLS: with the files there is a connection, without them none."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from slam_graph.cli.options import tls_files
from slam_graph.config import load_config
from slam_graph.errors import ConfigError, DataError
from slam_graph.experiment.executors import DaskCluster, executor_for
from slam_graph.experiment.tasks import RecordTask, find_sources

pytest.importorskip("distributed")

HANG_S = 120


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A certificate that proves itself, and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("needs the command openssl")
    folder = tmp_path_factory.mktemp("tls")
    key, cert = folder / "key.pem", folder / "cert.pem"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"),
            *("-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"),
            *("-keyout", str(key), "-out", str(cert)),
        ],
        check=True,
        capture_output=True,
    )
    return tls_files(cert, cert, key)


@pytest.fixture(scope="module")
def scheduler(files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler with one worker, on loopback, by TLS."""
    folder = tmp_path_factory.mktemp("dask")
    file = folder / "scheduler.json"
    given = ["--tls-ca-file", "--tls-cert", "--tls-key"]
    options = [str(one) for pair in zip(given, files.values(), strict=True) for one in pair]
    options += ["--scheduler-file", str(file), "--no-dashboard"]
    dask = [sys.executable, "-m", "dask"]
    commands = (
        [*dask, "scheduler", "--protocol", "tls", "--host", "127.0.0.1", "--port", "0", *options],
        [*dask, "worker", "--nthreads", "1", "--local-directory", str(folder), *options],
    )
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    processes = [subprocess.Popen(command, **quiet) for command in commands]  # type: ignore[call-overload]
    try:
        deadline = time.monotonic() + HANG_S
        while not file.is_file() or not file.read_text().strip():
            assert time.monotonic() < deadline, "no scheduler"
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        assert address.startswith("tls://")
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in reversed(processes):
            process.wait(HANG_S)


def task(root: Path) -> RecordTask:
    source = find_sources(["sim:figure8"], 1.0)[0]
    return RecordTask(source=source, seed=0, config=load_config(), root=root)


@pytest.mark.slow
def test_a_task_is_done_by_tls(scheduler: str, files: dict[str, Path], tmp_path: Path) -> None:
    wanted = task(tmp_path)
    assert list(executor_for(None, scheduler, files).do([wanted])) == [(wanted, None)]
    assert wanted.is_done()


@pytest.mark.slow
def test_without_the_files_there_is_no_connection(scheduler: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no Dask scheduler answers at 'tls://"):
        next(DaskCluster(scheduler).do([task(tmp_path)]))


def test_files_that_do_not_fit_are_refused(files: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.pem: no such file"):
        DaskCluster("tls://127.0.0.1:1", {**files, "key": tmp_path / "no.pem"})
    with pytest.raises(ConfigError, match="no file 'certificate'; known: ca_file, cert, key"):
        DaskCluster("tls://127.0.0.1:1", {"certificate": tmp_path})
    with pytest.raises(ConfigError, match="give its address"):
        executor_for(2, None, files)
