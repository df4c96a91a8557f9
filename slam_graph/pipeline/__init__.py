# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A run from end to end: `run` is the table of contents, each other file one stage of it."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "Tracking",
    "run",
]

if TYPE_CHECKING:
    from slam_graph.pipeline.run_recording import run
    from slam_graph.pipeline.tracking import Tracking
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "run_recording": ("run",),
            "tracking": ("Tracking",),
        },
    )
