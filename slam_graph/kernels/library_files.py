# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Where the shared libraries of kernels are stored."""

from __future__ import annotations

import os
import platform
import sysconfig
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib.util import find_spec, source_hash
from pathlib import Path

__all__ = ["PARTS", "kernel_modules", "library_paths", "module_name", "processor"]

PARTS = 2
"""Libraries that are made at the same time, each by a process of its own."""
_SUFFIX: str = sysconfig.get_config_var("EXT_SUFFIX") or ".so"
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


def kernel_modules() -> list[str]:
    """Names of the modules that have kernels, at most 256, the largest first."""
    sources = {p.stem: p.read_bytes() for p in Path(__file__).parent.glob("*.py")}
    names = sorted(name for name, source in sources.items() if b"\n@compiled(" in source)
    return sorted(names, key=lambda name: len(sources[name]), reverse=True)


@cache
def processor() -> str:
    """The processor that libraries are compiled for, by LLVM's name: this machine has all of it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("flags") and set(line.split()) >= _X86_64_V3:
                return "x86-64-v3"
    return "generic"


@cache
def _digest() -> str:
    """What tells versions apart: the source of all kernels, and what compiles it."""
    parts = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    for name in ("numba", "llvmlite", "numpy"):  # `importlib.metadata` takes longer than all this
        found = find_spec(name)
        if found is not None and found.origin is not None:
            parts.append(f"{name} {Path(found.origin).stat().st_mtime_ns}".encode())
    return source_hash(b"".join([*parts, platform.machine().encode()])).hex()


def _folders() -> Iterator[Path]:
    """Where libraries may be: with Numba's cache if that is set, by the modules, with the user."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        yield Path(chosen)
        return
    yield Path(__file__).parent / "__pycache__"
    user = os.environ.get("XDG_CACHE_HOME")
    yield (Path(user) if user else Path.home() / ".cache") / "slam_graph"


def _is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made itself if need be."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return os.access(folder, os.W_OK)
