# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Makes one of the shared libraries of kernels, in a process of its own.

python -m slam_graph.kernels.linking PART FILE
"""

from __future__ import annotations

import gc
import os
import sys
import warnings
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from slam_graph.interrupts import Interrupts
from slam_graph.kernels import compilation
from slam_graph.kernels.library_files import PARTS, module_name, processor

__all__: list[str] = []


def main(part: int, path: Path) -> None:
    """Compile the kernels of a part, and link them.

    Args:
        part: which part of the kernels.
        path: the file to make.
    """
    gc.disable()  # searching the compiler's objects for cycles takes a tenth of the time
    os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"  # in what Numba tries in vain
    compilation.collected = []
    for name in _modules(part):
        import_module(f"slam_graph.kernels.{name}")
    # what Numba has in C converts arguments: not worth being optimised for seconds
    os.environ["CFLAGS"] = os.environ["CXXFLAGS"] = "-O1 -g0"
    with warnings.catch_warnings():  # of a successor that is still to come
        warnings.simplefilter("ignore")
        pycc: Any = import_module("numba.pycc")
    _divide_as_numpy_does(pycc.compiler)
    library = pycc.CC(module_name(part), source_module="slam_graph.kernels")
    library.target_cpu = processor() if processor() != "generic" else ""
    for kernel, types in compilation.collected:
        library.export(kernel.__name__, types)(kernel.py_func)
    with TemporaryDirectory(dir=path.parent, prefix="kernels-") as folder:
        library.output_dir, library.output_file = folder, path.name
        library.compile()
        os.replace(Path(folder) / path.name, path)


def _modules(part: int) -> list[str]:
    """Names of the modules of a part: all parts have about as much source."""
    sizes = {p.stem: p.stat().st_size for p in Path(__file__).parent.glob("*.py")}
    parts: list[list[str]] = [[] for _ in range(PARTS)]
    for name in sorted(sizes, key=sizes.__getitem__):
        least = min(parts, key=lambda names: sum(sizes[other] for other in names))
        least.append(name)
    return parts[part]


def _divide_as_numpy_does(exporter: Any) -> None:
    """Let Numba export functions under the error model of the kernels, for which it has no option.

    The alternative is to export functions that do no more than call the kernels: it takes a sixth
    of the time to compile.
    """
    python = exporter.Flags

    def flags() -> Any:
        made = python()
        made.error_model = compilation.SEMANTICS["error_model"]
        return made

    exporter.Flags = flags


if __name__ == "__main__":
    Interrupts.end_with(0)
    main(int(sys.argv[1]), Path(sys.argv[2]))
