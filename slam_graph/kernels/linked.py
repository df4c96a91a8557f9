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
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

    Machine code would read them as if they were its own.

    Raises:
        TypeError: by the kernel that is returned.
    """
    name = function.__name__
    types: list[tuple[str, str]] = _ARGUMENT.findall(signature[signature.rindex("(") + 1 : -1])
    numbers = [k for k, (_, axes) in enumerate(types) if not axes]
    arrays = [
        (k, np.dtype(kind), 1 + axes.count(","), _layout(axes))
        for k, (kind, axes) in enumerate(types)
        if axes
    ]

    @wraps(function)
    def checked(*given: Any) -> object:
        if len(given) != len(types):
            raise TypeError(f"{name} takes {len(types)} arguments, not {len(given)}")
        for k, dtype, ndim, has_layout in arrays:  # for a hundred calls a frame: the cheapest way
            array = given[k]
            if not (
                isinstance(array, np.ndarray)
                and (array.dtype is dtype or array.dtype == dtype)
                and array.ndim == ndim
                and has_layout(array)
            ):
                raise TypeError(f"argument {k} of {name} does not fit {signature}")
        for k in numbers:
            if not isinstance(given[k], _NUMBERS):
                raise TypeError(f"argument {k} of {name} is no number")
        return kernel(*given)

    return checked


def _layout(axes: str) -> Callable[[Any], bool]:
    """A test whether an array is aligned, writable and laid out as its axes say."""
    if axes.endswith("::1"):
        return attrgetter("flags.carray")
    return _is_fortran if axes.startswith("::1") else attrgetter("flags.behaved")


def _is_fortran(array: NDArray[Any]) -> bool:
    return array.flags.behaved and array.flags.f_contiguous
