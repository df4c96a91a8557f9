# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A second process that compiles kernels while the first one does, into the same cache.

python -m slam_graph.kernels.second_compiler
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pkgutil import iter_modules
from threading import Thread

import slam_graph.kernels

__all__ = ["start_second_compiler"]

_ITSELF = "SLAM_GRAPH_SECOND_COMPILER"
"""Set in its environment, so that it starts none of its own."""


def start_second_compiler() -> None:
    """Compile kernels from the last to the first, on another core, if there is one.

    Who imports kernels from the first to the last finds them in the cache from about the middle on;
    one that both compile at the same time is stored twice, with the same content. Nobody waits for
    the process, and where it cannot be started kernels are compiled as without it.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if sys.executable and (cores or 1) > 1 and _ITSELF not in os.environ:
        Thread(target=_run, name="second compiler", daemon=True).start()


def _run() -> None:
    """Run it to its end; what it imports is what this process imports."""
    paths = os.pathsep.join(path for path in sys.path if path)
    with suppress(OSError):
        subprocess.run(
            [sys.executable, "-P", "-m", __spec__.name],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths, _ITSELF: "1"},
            check=False,
        )


def main() -> None:
    """Import the modules of all kernels, in the reverse of their order in the folder."""
    names = (module.name for module in iter_modules(slam_graph.kernels.__path__))
    for name in sorted(names, reverse=True):
        import_module(f"slam_graph.kernels.{name}")


if __name__ == "__main__":
    main()
