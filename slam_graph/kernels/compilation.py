# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled: once on a machine, and loaded from Numba's cache afterwards."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar, cast

import numba

from slam_graph.interrupts import Interrupts

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
        jit = numba.njit(list(signatures) or None, cache=True, nogil=True, error_model="numpy")
        with Interrupts.completed() as begin:  # a callback of the compiler would lose Ctrl-C
            begin()
            kernel = cast("_Kernel", jit(function))
        if signatures:
            _tell(kernel)
        return kernel

    return decorate


def _tell(kernel: object) -> None:
    """Say it once where a kernel was not in the cache: those that follow take seconds, too.

    As a warning, which is shown where nothing has been set up to show logs yet.
    """
    global _told
    stats = getattr(kernel, "stats", None)
    if not _told and stats is not None and stats.cache_misses:
        _told = True
        logger.warning("compiling kernels: once on this machine, some 15 s")
