# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Experiments: algorithms compared on the same feature tracks, front ends, many recordings.

`compare` (in `experiment/comparison.py`) records the tracks of every recording and seed once, runs
every algorithm on them in separate processes, and writes a report. `batch` (in
`experiment/batch_run.py`) runs many recordings, each in a process of its own.
"""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "FrontendReport",
    "batch",
    "compare",
]

if TYPE_CHECKING:
    from slam_graph.experiment.batch_run import batch
    from slam_graph.experiment.comparison import compare
    from slam_graph.experiment.frontend_comparison import FrontendReport
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "batch_run": ("batch",),
            "comparison": ("compare",),
            "frontend_comparison": ("FrontendReport",),
        },
    )
