# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""BLAS on one thread: to wake others for small matrices costs many times what they save."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from threadpoolctl import ThreadpoolController


class SingleThread:
    """Holds the BLAS libraries that are loaded to one thread, for a while."""

    def __init__(self) -> None:
        self._blas = ThreadpoolController().select(user_api="blas")

    def held(self) -> AbstractContextManager[object]:
        """For the time of a block; it is quick where there is but one thread anyway."""
        if all(library.num_threads == 1 for library in self._blas.lib_controllers):
            return nullcontext()
        limited: AbstractContextManager[object] = self._blas.limit(limits=1)
        return limited
