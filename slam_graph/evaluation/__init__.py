# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How good an estimate is: ATE, RPE, NEES, and the report of a run."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "ErrorSeries",
    "ObjectStep",
    "accuracy_report",
    "ape",
    "consistency_report",
    "innovation_report",
    "mean_bounds",
    "nees_of_run",
    "object_errors",
    "rpe",
    "synchronize",
]

if TYPE_CHECKING:
    from slam_graph.evaluation.absolute_pose_error import ErrorSeries, ape
    from slam_graph.evaluation.consistency import mean_bounds
    from slam_graph.evaluation.evaluation_report import (
        accuracy_report,
        consistency_report,
        innovation_report,
        nees_of_run,
    )
    from slam_graph.evaluation.object_motion import ObjectStep, object_errors
    from slam_graph.evaluation.relative_pose_error import rpe
    from slam_graph.evaluation.truth_pairing import synchronize
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "absolute_pose_error": (
                "ErrorSeries",
                "ape",
            ),
            "consistency": ("mean_bounds",),
            "evaluation_report": (
                "accuracy_report",
                "consistency_report",
                "innovation_report",
                "nees_of_run",
            ),
            "object_motion": ("ObjectStep", "object_errors"),
            "relative_pose_error": ("rpe",),
            "truth_pairing": ("synchronize",),
        },
    )
