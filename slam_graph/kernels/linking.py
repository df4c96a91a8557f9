# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Makes one of the shared libraries of kernels, in a process of its own.

python -m slam_graph.kernels.linking PART FILE QUEUE
"""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from slam_graph.interrupts import Interrupts
from slam_graph.kernels import compilation
from slam_graph.kernels.library_files import kernel_modules, module_name, processor
from slam_graph.kernels.shortcuts import shorten_compilation

__all__: list[str] = []


def main(part: int, path: Path, names: Iterable[str]) -> None:
    """Compile kernels, and link them.

    Args:
        part: which of the libraries.
        path: the file to make.
        names: modules of the kernels that go into it.
    """
    gc.disable()  # searching the compiler's objects for cycles takes a tenth of the time
    os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"  # in what Numba tries in vain
    # what Numba has in C converts arguments: not worth being optimised for seconds
    os.environ["CFLAGS"] = os.environ["CXXFLAGS"] = "-O1 -g0"
    with warnings.catch_warnings():  # of a successor that is still to come
        warnings.simplefilter("ignore")
        pycc: Any = import_module("numba.pycc")
    library = pycc.CC(module_name(part), source_module="slam_graph.kernels")
    library.target_cpu = processor() if processor() != "generic" else ""
    library._mixin_sources = library._mixin_sources[:1]  # the others are for dicts, lists and sets
    exported = shorten_compilation(library.target_cpu)
    for kernel, signature in _kernels(names):
        kernel.compile(signature)
        exported[kernel.py_func] = kernel
        library.export(kernel.__name__, signature)(kernel.py_func)
    with TemporaryDirectory(dir=path.parent, prefix="kernels-") as folder:
        library.output_dir, library.output_file = folder, path.name
        library.compile()
        os.replace(Path(folder) / path.name, path)


def _kernels(names: Iterable[str]) -> Iterator[tuple[Any, str]]:
    """The kernels of modules and their signatures.

    A module may have been imported by one before it, of which its kernels are no part.
    """
    collected = compilation.collected = []
    for name in names:
        module = import_module(f"slam_graph.kernels.{name}").__name__
        yield from [k for k in collected if k[0].py_func.__module__ == module]


def _taken(queue: int) -> Iterator[str]:
    """Names of modules, each of which one process takes from a pipe when it has time for it."""
    names = kernel_modules()
    while index := os.read(queue, 1):
        yield names[index[0]]


if __name__ == "__main__":
    Interrupts.end_with(0)
    main(int(sys.argv[1]), Path(sys.argv[2]), _taken(int(sys.argv[3])))
