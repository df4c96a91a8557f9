# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled: once on a machine, and loaded from Numba's cache afterwards."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba

from slam_graph.interrupts import Interrupts
from slam_graph.kernels.second_compiler import start_second_compiler

__all__ = ["compiled"]

logger = logging.getLogger("slam_graph")

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])

_told = False


def compiled(*signatures: str) -> Callable[[_Kernel], _Kernel]:
    """Compile a function to machine code, without Python's lock while it runs.

    In double precision with the roundings of IEEE 754 in the order that is written; a division by
    zero is infinite or NaN, as in NumPy. Functions that it calls must be in its own file: Numba's
    cache looks at nothing else to see what has changed.

    Args:
        signatures: types of arguments and result in Numba's notation, e.g. `f8[::1](f8[:, ::1])`;
            none for functions that are called by kernels only, which take what they are given.
    """

    def decorate(function: _Kernel) -> _Kernel:
        # a kernel is stored with the functions that it calls; entries that nobody uses would only
        # take time to compile
        options: dict[str, Any] = {
            "cache": bool(signatures),
            "no_cpython_wrapper": not signatures,
            "no_cfunc_wrapper": True,
        }
        jit = numba.njit(list(signatures) or None, nogil=True, error_model="numpy", **options)
        # a callback of the compiler would lose Ctrl-C
        with Interrupts.completed() as begin, _without_collection():
            begin()
            kernel = cast("_Kernel", jit(function))
        if signatures:
            _tell(kernel)
        return kernel

    return decorate


@contextmanager
def _without_collection() -> Iterator[None]:
    """No search for cycles among the millions of objects of the compiler: a tenth of its time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _tell(kernel: object) -> None:
    """Say it once where a kernel was not in the cache, and get help: others will take seconds, too.

    As a warning, which is shown where nothing has been set up to show logs yet.
    """
    global _told
    stats = getattr(kernel, "stats", None)
    if not _told and stats is not None and stats.cache_misses:
        _told = True
        logger.warning("compiling kernels: once on this machine, some 15 s")
        start_second_compiler()
