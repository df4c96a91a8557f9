# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""BLAS on one thread: to wake others for small matrices costs many times what they save.

With several threads the order of sums, and so the last digit, depends on their number.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


class SingleThread:
    """Holds the BLAS libraries that are loaded to one thread, for a while."""

    def __init__(self) -> None:
        self._blas = _blas_libraries()

    def held(self) -> AbstractContextManager[object]:
        """For the time of a block; it is quick where there is but one thread anyway."""
        if all(library.num_threads == 1 for library in self._blas.lib_controllers):
            return nullcontext()
        limited: AbstractContextManager[object] = self._blas.limit(limits=1)
        return limited


@cache
def _blas_libraries() -> ThreadpoolController:
    """BLAS libraries of NumPy and SciPy, searched for once.

    That takes milliseconds, and every moving object has an engine. Both are loaded before anything
    is solved.
    """
    return ThreadpoolController().select(user_api="blas")


def on_one_thread(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The function with the BLAS libraries held to one thread while it runs."""

    @wraps(function)
    def held(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with SingleThread().held():
            return function(*args, **kwargs)

    return held
