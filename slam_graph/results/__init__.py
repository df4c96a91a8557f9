# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind, and all writers of files."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "BalResult",
    "LocalizationLog",
    "PoseGraphResult",
    "RunInput",
    "RunResult",
    "SavedRun",
    "Stopwatch",
    "TimingLog",
    "appearing",
    "create_run_folder",
    "export_ply",
    "export_tum",
    "find_map",
    "finite",
    "link_latest",
    "load_map",
    "load_result",
    "milliseconds",
    "refuse_to_replace",
    "save_map",
    "versions",
    "write_text",
]

if TYPE_CHECKING:
    from slam_graph.results.localization_result import LocalizationLog
    from slam_graph.results.map_output import export_ply, export_tum, find_map, load_map, save_map
    from slam_graph.results.metrics import finite, versions
    from slam_graph.results.optimization_result import BalResult, PoseGraphResult
    from slam_graph.results.result_files import (
        appearing,
        create_run_folder,
        link_latest,
        refuse_to_replace,
        write_text,
    )
    from slam_graph.results.run_logs import Stopwatch, TimingLog, milliseconds
    from slam_graph.results.run_result import RunInput, RunResult
    from slam_graph.results.saved_run import SavedRun, load_result
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "localization_result": ("LocalizationLog",),
            "map_output": ("export_ply", "export_tum", "find_map", "load_map", "save_map"),
            "metrics": ("finite", "versions"),
            "optimization_result": ("BalResult", "PoseGraphResult"),
            "result_files": (
                "appearing",
                "create_run_folder",
                "link_latest",
                "refuse_to_replace",
                "write_text",
            ),
            "run_logs": ("Stopwatch", "TimingLog", "milliseconds"),
            "run_result": ("RunInput", "RunResult"),
            "saved_run": ("SavedRun", "load_result"),
        },
    )
