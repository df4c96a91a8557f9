# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels that are not in the cache: a second process compiles the last ones."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest

_ONE_KERNEL = """
import threading
import slam_graph.kernels.ascending
print(*(thread.name for thread in threading.enumerate()), sep=",", flush=True)
input()
"""


def _stored(cache: Path, name: str) -> bool:
    return any(cache.rglob(f"{name}.*.nbc"))


def _start(cache: Path, environment: dict[str, str]) -> tuple[subprocess.Popen[bytes], str]:
    """A process that has compiled one kernel into an empty cache and waits, and its threads."""
    inherited = {k: v for k, v in os.environ.items() if k != "SLAM_GRAPH_SECOND_COMPILER"}
    process = subprocess.Popen(
        [sys.executable, "-c", _ONE_KERNEL],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={
            **inherited,
            "NUMBA_CACHE_DIR": str(cache),
            "SLAM_GRAPH_KERNELS": "numba",
            **environment,
        },
        start_new_session=True,
    )
    assert process.stdout is not None
    return process, process.stdout.readline().decode()


@pytest.mark.skipif(numba.config.NUMBA_DEFAULT_NUM_THREADS < 2, reason="needs a second core")
def test_a_second_process_compiles_the_last_kernels(tmp_path: Path) -> None:
    process, threads = _start(tmp_path, {})
    try:
        assert "second compiler" in threads
        assert _stored(tmp_path, "ascending")
        until = time.monotonic() + 300.0
        while not _stored(tmp_path, "window_tracking") and time.monotonic() < until:
            time.sleep(0.1)
        assert _stored(tmp_path, "window_tracking")
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.mark.skipif(numba.config.NUMBA_DEFAULT_NUM_THREADS < 2, reason="needs a second core")
def test_the_second_process_starts_no_third(tmp_path: Path) -> None:
    process, threads = _start(tmp_path, {"SLAM_GRAPH_SECOND_COMPILER": "1"})
    process.communicate(b"\n")
    assert process.returncode == 0
    assert "MainThread" in threads
    assert "second compiler" not in threads
