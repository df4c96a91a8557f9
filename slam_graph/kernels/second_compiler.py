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
from pathlib import Path
from pkgutil import iter_modules
from threading import Thread
from typing import Any

import numba

import slam_graph.kernels

__all__ = ["start_second_compiler"]

_ITSELF = "SLAM_GRAPH_SECOND_COMPILER"
"""Set in the environment once it has been started, so that no process starts another."""


def start_second_compiler() -> None:
    """Compile kernels from the last to the first, on another core, if there is one.

    A process that imports kernels from the first to the last finds them in the cache from about the
    middle on; one that both compile at the same time is stored twice, with the same content. Nobody
    waits for the process, and where it cannot be started kernels are compiled as without it.
    """
    # within an application it would start that application again
    is_python = Path(sys.executable or "").name.startswith("python")
    settings: Any = numba.config  # its names are made when it is imported
    several = settings.NUMBA_DEFAULT_NUM_THREADS > 1  # cores that this process may use
    if is_python and not hasattr(sys, "frozen") and several and _ITSELF not in os.environ:
        os.environ[_ITSELF] = "1"  # the processes of this one need none of their own
        Thread(target=_run, name="second compiler", daemon=True).start()


def _run() -> None:
    """Run it to its end; what it imports is what this process imports."""
    paths = os.pathsep.join(str(path) or os.getcwd() for path in sys.path)
    with suppress(OSError):
        subprocess.run(
            [sys.executable, "-P", "-m", __spec__.name],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths},
            check=False,
        )


def main() -> None:
    """Import the modules of all kernels, in the reverse of their order in the folder."""
    names = (module.name for module in iter_modules(slam_graph.kernels.__path__))
    for name in sorted(names, reverse=True):
        import_module(f"slam_graph.kernels.{name}")


if __name__ == "__main__":
    main()
