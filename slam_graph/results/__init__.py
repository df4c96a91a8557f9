# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind, and all writers of files."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "BalResult",
    "PoseGraphResult",
    "ResultFolder",
    "RunInput",
    "RunResult",
    "SavedRun",
    "export_map",
    "load_map",
    "load_result",
    "save_map",
]

if TYPE_CHECKING:
    from slam_graph.results.map_output import export_map, load_map, save_map
    from slam_graph.results.optimization_result import BalResult, PoseGraphResult
    from slam_graph.results.result_files import ResultFolder
    from slam_graph.results.run_input import RunInput
    from slam_graph.results.run_result import RunResult
    from slam_graph.results.saved_run import SavedRun, load_result
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "map_output": (
                "export_map",
                "load_map",
                "save_map",
            ),
            "optimization_result": (
                "BalResult",
                "PoseGraphResult",
            ),
            "result_files": ("ResultFolder",),
            "run_input": ("RunInput",),
            "run_result": ("RunResult",),
            "saved_run": (
                "SavedRun",
                "load_result",
            ),
        },
    )
