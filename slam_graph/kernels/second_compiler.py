# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A second process that compiles kernels while the first one does, into the same cache.

python -m slam_graph.kernels.second_compiler
"""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from importlib import import_module
from pkgutil import iter_modules
from threading import Thread
from typing import Any

import numba

import slam_graph.kernels
from slam_graph.kernels.python_process import command_of, inherited_imports

__all__ = ["start_second_compiler"]

_ITSELF = "SLAM_GRAPH_SECOND_COMPILER"
"""Set in the environment once it has been started, so that no process starts another."""


def start_second_compiler() -> None:
    """Compile kernels from the last to the first, on another core, if there is one.

    A process that imports kernels from the first to the last finds them in the cache from about the
    middle on; one that both compile at the same time is stored twice, with the same content. Nobody
    waits for the process, and where it cannot be started kernels are compiled as without it.
    """
    command = command_of(__spec__.name)
    settings: Any = numba.config  # its names are made when it is imported
    several = settings.NUMBA_DEFAULT_NUM_THREADS > 1  # cores that this process may use
    if command is not None and several and _ITSELF not in os.environ:
        os.environ[_ITSELF] = "1"  # the processes of this one need none of their own
        Thread(target=_run, args=(command,), name="second compiler", daemon=True).start()


def _run(command: list[str]) -> None:
    """Run it to its end."""
    with suppress(OSError):
        subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=inherited_imports(),
            check=False,
        )


def main() -> None:
    """Import the modules of all kernels, in the reverse of their order in the folder."""
    names = (module.name for module in iter_modules(slam_graph.kernels.__path__))
    for name in sorted(names, reverse=True):
        import_module(f"slam_graph.kernels.{name}")


if __name__ == "__main__":
    main()
