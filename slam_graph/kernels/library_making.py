# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Makes the shared libraries of kernels, by processes that compile and link them."""

from __future__ import annotations

import fcntl
import logging
import os
import shlex
import shutil
import subprocess
import sysconfig
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

from slam_graph.interrupts import Interrupts
from slam_graph.kernels.library_files import kernel_modules
from slam_graph.kernels.python_process import command_of, inherited_imports

__all__ = ["make"]

logger = logging.getLogger("slam_graph")

_LINKING = "slam_graph.kernels.linking"
_FAILED, _RETRY_S = ".failed", 24 * 3600.0
"""Suffix of a file that says why libraries could not be made: it is not tried again for so long."""
_POLL_S = 0.1
"""Time between two looks whether they are made."""
_STALE_S = 30 * 24 * 3600.0
"""Libraries that were not used for so long are removed when others are made."""


def make(paths: list[Path]) -> None:
    """Make the libraries, or wait until another process has made them.

    Where they cannot be made they are not there afterwards.

    Args:
        paths: files to make, one for each part.

    Raises:
        OSError: if nothing can be stored in their folder.
    """
    if command_of(_LINKING) is None or not _tools_are_there():
        return
    with _alone_in(paths[0].parent), _queue() as queue:
        failed = paths[0].with_suffix(_FAILED)
        if _is_recent(failed, _RETRY_S) or all(path.is_file() for path in paths):
            return
        logger.warning("compiling kernels: once on this machine, up to a minute")
        for path in paths:  # one that an interrupted process has left has other kernels
            path.unlink(missing_ok=True)
        with TemporaryDirectory(dir=paths[0].parent, prefix="kernels-") as folder:
            made = [Path(folder) / path.name for path in paths]
            commands = [
                command_of(_LINKING, str(part), str(path), str(queue))
                for part, path in enumerate(made)
            ]
            errors = _run([command for command in commands if command is not None], queue)
            if all(path.is_file() for path in made):
                for new, path in zip(made, paths, strict=True):
                    os.replace(new, path)
        if errors:
            failed.write_text(errors, encoding="utf-8")
            logger.warning("kernels cannot be linked (%s); Numba compiles them", failed)
        _remove_stale(paths[0].parent)


@contextmanager
def _queue() -> Iterator[int]:
    """A pipe from which processes take the modules of kernels, by their numbers of one byte.

    How long a kernel takes to compile is not known before.
    """
    taken, given = os.pipe()
    os.write(given, bytes(range(len(kernel_modules()))))
    os.close(given)
    try:
        yield taken
    finally:
        os.close(taken)


def _run(commands: list[list[str]], *inherited: int) -> str:
    """Run commands at the same time until one of them fails; what it has said.

    They end with this process. Ctrl-C is for this one alone, also within a block that defers it.

    Args:
        commands: program and arguments.
        inherited: file descriptors that the commands read from.

    Raises:
        KeyboardInterrupt: after Ctrl-C.
    """
    environment = {k: v for k, v in inherited_imports().items() if not k.startswith("NUMBA_")}
    with ExitStack() as stack:
        started = []
        for command in commands:
            said = stack.enter_context(TemporaryFile())
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=said,
                env=environment,
                start_new_session=True,
                pass_fds=inherited,
            )
            stack.callback(_end, process)
            started.append((process, said))
        while (codes := [process.poll() for process, _ in started]).count(None):
            if any(codes):
                break
            Interrupts.check_deferred()
            time.sleep(_POLL_S)
        errors = b""
        for process, said in started:
            if (process.returncode or 0) > 0:  # one that was killed may succeed the next time
                said.seek(0)
                errors += said.read()
    return errors.decode(errors="replace")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _tools_are_there() -> bool:
    """Whether there are the compilers that this Python was built with, its headers, setuptools."""
    if find_spec("setuptools") is None:
        return False
    compilers = [os.environ.get(name) or sysconfig.get_config_var(name) for name in ("CC", "CXX")]
    headers = Path(sysconfig.get_path("include")) / "Python.h"
    return headers.is_file() and all(
        compiler and shutil.which(shlex.split(compiler)[0]) for compiler in compilers
    )


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process makes libraries in a folder, and let none in meanwhile."""
    with (folder / "kernels.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _remove_stale(folder: Path) -> None:
    """Remove libraries that were not used for long, and folders of processes that were killed."""
    for path in folder.glob("kernels-*"):
        with suppress(OSError):
            if _is_recent(path, _STALE_S):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def _is_recent(path: Path, seconds: float) -> bool:
    """Whether a file is there and is not older than that."""
    return path.exists() and time.time() - path.stat().st_mtime < seconds
