# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How good an estimate is: ATE, RPE, NEES, and the report of a run."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "accuracy_report",
    "ape",
    "consistency_report",
    "innovation_report",
    "mean_bounds",
    "nees_of_run",
    "rpe",
    "synchronize",
]

if TYPE_CHECKING:
    from slam_graph.evaluation.absolute_pose_error import ape
    from slam_graph.evaluation.consistency import mean_bounds
    from slam_graph.evaluation.evaluation_report import (
        accuracy_report,
        consistency_report,
        innovation_report,
        nees_of_run,
    )
    from slam_graph.evaluation.relative_pose_error import rpe
    from slam_graph.evaluation.truth_pairing import synchronize
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "absolute_pose_error": ("ape",),
            "consistency": ("mean_bounds",),
            "evaluation_report": (
                "accuracy_report",
                "consistency_report",
                "innovation_report",
                "nees_of_run",
            ),
            "relative_pose_error": ("rpe",),
            "truth_pairing": ("synchronize",),
        },
    )
