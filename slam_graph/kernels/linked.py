# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels of shared libraries: a process that loads these needs neither Numba nor LLVM.

Those take half a second and some 110 MB in every process. So Numba compiles the kernels ahead of
time, and the C compiler of the machine links them (`linking`), once for each version of their
source. Without a compiler they are compiled in the process itself (`compilation`). Linked kernels
hold Python's lock while they run, for some 0.1 ms; compiled ones do not.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, wraps
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import numpy as np

from slam_graph.kernels.library_files import library_paths, module_name

__all__ = ["are_linked", "linked_kernel"]

logger = logging.getLogger("slam_graph")

_CHOICE = "SLAM_GRAPH_KERNELS"
"""If it is `numba` in the environment, kernels are compiled in the process."""
_UNAVAILABLE = (ImportError, LookupError, OSError, RuntimeError, ValueError)
"""What is raised where they cannot be made, stored or loaded."""
_NUMBERS = (int, float, np.integer, np.floating, np.bool_)
_ARGUMENT = re.compile(r"(\w+)(?:\[([^\]]*)\])?")
"""A type in Numba's notation, and the axes if it is that of an array."""


def are_linked() -> bool:
    """Whether all kernels come from libraries, which are made first if they can be."""
    return bool(_libraries())


def linked_kernel(function: Callable[..., object], signature: str) -> Callable[..., object]:
    """A kernel of the libraries, which checks its arguments.

    Args:
        function: its Python form.
        signature: types of arguments and result in Numba's notation.
    """
    name = function.__name__
    library = next(library for library in _libraries() if hasattr(library, name))
    return _checked(getattr(library, name), function, signature)


@cache
def _libraries() -> tuple[ModuleType, ...]:
    """The libraries of all kernels; none if they are not there and cannot be made."""
    # on macOS the name of a compiler that is not installed opens a window
    if os.environ.get(_CHOICE) == "numba" or not sys.platform.startswith("linux"):
        return ()
    try:
        paths = library_paths()
        if not all(path.is_file() for path in paths):
            from slam_graph.kernels.library_making import make  # what few processes need

            make(paths)
        return tuple(_loaded(path, module_name(part)) for part, path in enumerate(paths))
    except _UNAVAILABLE as error:
        logger.debug("Numba compiles the kernels: %s", error)
        return ()


def _loaded(path: Path, name: str) -> ModuleType:
    """The library in a file, as a module of that name."""
    spec = spec_from_file_location(name, path, loader=ExtensionFileLoader(name, str(path)))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    with suppress(OSError):
        os.utime(path)  # it is in use
    return module


def _checked(
    kernel: Callable[..., object], function: Callable[..., object], signature: str
) -> Callable[..., object]:
    """A kernel that refuses arguments of other types or layouts than it was compiled for.

    Machine code would read them as if they were its own. There are a hundred calls in a frame, so
    the tests of all arguments are one expression: a loop over them takes twice as long.

    Raises:
        TypeError: by the kernel that is returned.
    """
    types: list[tuple[str, str]] = _ARGUMENT.findall(signature[signature.rindex("(") + 1 : -1])
    tests = [_test(f"given[{k}]", kind, axes) for k, (kind, axes) in enumerate(types)]
    fits = " and ".join([f"len(given) == {len(types)}", *tests])

    def refuse(*given: Any) -> NoReturn:
        if len(given) != len(types):
            raise TypeError(f"{function.__name__} takes {len(types)} arguments, not {len(given)}")
        for k, test in enumerate(tests):
            if not eval(test, {**scope, "given": given}):
                fault = f"does not fit {signature}" if types[k][1] else "is no number"
                raise TypeError(f"argument {k} of {function.__name__} {fault}")
        raise AssertionError("arguments that fit were refused")

    scope: dict[str, Any] = {kind: np.dtype(kind) for kind, axes in types if axes}
    scope |= {"ndarray": np.ndarray, "numbers": _NUMBERS, "kernel": kernel, "refuse": refuse}
    checked = f"def checked(*given):\n    return kernel(*given) if {fits} else refuse(*given)"
    exec(compile(checked, __file__, "exec"), scope)
    return wraps(function)(scope["checked"])


def _test(given: str, kind: str, axes: str) -> str:
    """An expression that says whether an argument is of a type in Numba's notation.

    Arrays must also be aligned, writable and laid out as their axes say.
    """
    if not axes:
        return f"isinstance({given}, numbers)"
    layout = "array.flags.carray" if axes.endswith("::1") else "array.flags.behaved"
    if axes.startswith("::1") and "," in axes:
        layout += " and array.flags.f_contiguous"
    return (
        f"isinstance(array := {given}, ndarray) "
        f"and (array.dtype is {kind} or array.dtype == {kind}) "
        f"and array.ndim == {1 + axes.count(',')} and {layout}"
    )
