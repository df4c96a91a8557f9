# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How kernels are compiled: once on a machine, for libraries or into Numba's cache."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

from slam_graph.interrupts import Interrupts
from slam_graph.kernels.linked import are_linked, linked_kernel

__all__ = ["SEMANTICS", "collected", "compiled"]

logger = logging.getLogger("slam_graph")

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])

collected: list[tuple[Any, str]] | None = None
"""Kernels and their signatures, where a process makes libraries of them; None elsewhere."""
SEMANTICS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Without Python's lock, where kernels are compiled in the process; a division by zero is infinite
or NaN, as in NumPy."""
_told = False


def compiled(signature: str = "") -> Callable[[_Kernel], _Kernel]:
    """Compile a function to machine code.

    In double precision with the roundings of IEEE 754 in the order that is written. Functions that
    it calls must be in its own file: Numba's cache looks at nothing else to see what has changed.

    Args:
        signature: types of arguments and result in Numba's notation, e.g. `f8[::1](f8[:, ::1])`;
            none for functions that are called by kernels only, which take what they are given.
    """

    def decorate(function: _Kernel) -> _Kernel:
        if collected is not None:
            kernel = _collect(function, signature, collected)
        elif not are_linked():
            kernel = _compile(function, signature)
        elif signature:
            kernel = linked_kernel(function, signature)
        else:
            return function  # part of the kernels that call it
        return cast("_Kernel", kernel)

    return decorate


def _collect(
    function: Callable[..., object], signature: str, kernels: list[tuple[Any, str]]
) -> Callable[..., object]:
    """Leave it to the maker of a library when a function is compiled."""
    import numba  # as below

    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    kernel = numba.njit(**options, **SEMANTICS)(function)
    if signature:
        kernels.append((kernel, signature))
    return cast("Callable[..., object]", kernel)


def _compile(function: Callable[..., object], signature: str) -> Callable[..., object]:
    """Compile a function now, or load it from Numba's cache."""
    import numba  # takes half a second and 110 MB: not where kernels are linked

    # a kernel is stored with the functions that it calls; entries that nobody uses would only
    # take time to compile
    options: dict[str, Any] = {
        "cache": bool(signature),
        "no_cpython_wrapper": not signature,
        "no_cfunc_wrapper": True,
    }
    jit: Any = numba.njit([signature] if signature else None, **options, **SEMANTICS)
    # a callback of the compiler would lose Ctrl-C
    with Interrupts.completed() as begin, _without_collection():
        begin()
        kernel = jit(function)
    if signature:
        _tell(kernel)
    return cast("Callable[..., object]", kernel)


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
        logger.warning("compiling kernels: once on this machine, up to a minute")
        from slam_graph.kernels.second_compiler import start_second_compiler

        start_second_compiler()
