# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Where the shared libraries of kernels are stored, and who makes them."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from slam_graph.kernels.python_process import command_of, inherited_imports

__all__ = ["PARTS", "library_paths", "make", "module_name", "processor"]

logger = logging.getLogger("slam_graph")

PARTS = 2
"""Libraries that are made at the same time, each by a process of its own."""
_LINKING = "slam_graph.kernels.linking"
_SUFFIX: str = sysconfig.get_config_var("EXT_SUFFIX") or ".so"
_FAILED = ".failed"
"""Suffix of a file that says why libraries could not be made: not to be tried again each time."""
_STALE_S = 30 * 24 * 3600.0
"""Libraries of other versions are removed when they were made so long ago."""
_X86_64_V3 = frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"])
"""What x86-64-v3 has beyond the level below it, by Linux' names."""


def library_paths() -> list[Path]:
    """Where the libraries of this version of the kernels are stored, or will be."""
    name = f"kernels-{processor()}-{_digest()}"
    for folder in _folders():
        paths = [folder / f"{name}-{part}{_SUFFIX}" for part in range(PARTS)]
        if all(path.is_file() for path in paths) or _is_writable(folder):
            break
    return paths


def module_name(part: int) -> str:
    """The name that a library has as a module of Python."""
    return f"slam_graph_kernels_{part}"


@cache
def processor() -> str:
    """The processor that libraries are compiled for, by LLVM's name: this machine has all of it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("flags") and set(line.split()) >= _X86_64_V3:
                return "x86-64-v3"
    return "generic"


def make(paths: list[Path]) -> None:
    """Make the libraries, or wait until another process has made them.

    Nothing is raised: where they cannot be made they are not there afterwards.

    Args:
        paths: files to make, one for each part.
    """
    commands = [command_of(_LINKING, str(part), str(path)) for part, path in enumerate(paths)]
    if not _compiler_is_there():
        return
    with suppress(OSError), _alone_in(paths[0].parent):
        failed = paths[0].with_suffix(_FAILED)
        if failed.is_file() or all(path.is_file() for path in paths):
            return
        logger.warning("compiling kernels: once on this machine, some 15 s")
        errors = _run([command for command in commands if command is not None])
        if errors:
            failed.write_text(errors, encoding="utf-8")
        _remove_stale(paths[0].parent)


def _run(commands: list[list[str]]) -> str:
    """Run commands at the same time; what those that failed have said."""
    processes = [
        subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=inherited_imports(),
        )
        for command in commands
    ]
    try:
        said = [process.communicate()[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    # one that was killed may succeed the next time
    return "".join(t for p, t in zip(processes, said, strict=True) if (p.returncode or 0) > 0)


def _compiler_is_there() -> bool:
    """Whether there is the C compiler that this Python was built with, and Python's headers.

    On macOS the name of a compiler that is not installed opens a window, so it is not asked for.
    """
    if not sys.platform.startswith("linux"):
        return False
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "")
    headers = Path(sysconfig.get_path("include")) / "Python.h"
    return bool(compiler) and shutil.which(compiler[0]) is not None and headers.is_file()


@cache
def _digest() -> str:
    """What tells versions apart: the source of all kernels, and what compiles it."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    digest.update(f"{version('numba')} {version('llvmlite')} {platform.machine()}".encode())
    return digest.hexdigest()[:16]


def _folders() -> list[Path]:
    """Where libraries may be: with Numba's cache if that is set, by the modules, with the user."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return [Path(chosen)]
    user = os.environ.get("XDG_CACHE_HOME")
    beside = Path(__file__).parent / "__pycache__"
    return [beside, (Path(user) if user else Path.home() / ".cache") / "slam_graph"]


def _is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made itself if need be."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return os.access(folder, os.W_OK)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process makes libraries in a folder, and let none in meanwhile."""
    import fcntl  # not on Windows, where libraries are not made

    with (folder / "kernels.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _remove_stale(folder: Path) -> None:
    """Remove libraries that were made long ago, for other versions of the kernels."""
    for path in folder.glob("kernels-*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _STALE_S:
                path.unlink()
