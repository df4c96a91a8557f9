# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How good an estimate is: ATE, RPE, NEES, and the report of a run."""

from typing import TYPE_CHECKING

from slam_graph.lazy import lazy_exports

__all__ = [
    "ERROR_UNITS",
    "STEP_UNITS",
    "DeltaUnit",
    "ErrorSeries",
    "Pairing",
    "PoseRelation",
    "TrackQuality",
    "TrackSummary",
    "accuracy_report",
    "ape",
    "consistency_report",
    "innovation_report",
    "mean_bounds",
    "nees",
    "rpe",
    "select",
    "synchronize",
    "truth_from_estimate",
]

if TYPE_CHECKING:
    from slam_graph.evaluation.absolute_pose_error import ErrorSeries, ape
    from slam_graph.evaluation.choices import (
        ERROR_UNITS,
        STEP_UNITS,
        DeltaUnit,
        Pairing,
        PoseRelation,
    )
    from slam_graph.evaluation.consistency import mean_bounds, nees
    from slam_graph.evaluation.evaluation_report import (
        accuracy_report,
        consistency_report,
        innovation_report,
        truth_from_estimate,
    )
    from slam_graph.evaluation.relative_pose_error import rpe
    from slam_graph.evaluation.track_quality import TrackQuality, TrackSummary
    from slam_graph.evaluation.truth_pairing import select, synchronize
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "absolute_pose_error": ("ErrorSeries", "ape"),
            "choices": ("DeltaUnit", "ERROR_UNITS", "Pairing", "PoseRelation", "STEP_UNITS"),
            "consistency": ("mean_bounds", "nees"),
            "evaluation_report": (
                "accuracy_report",
                "consistency_report",
                "innovation_report",
                "truth_from_estimate",
            ),
            "relative_pose_error": ("rpe",),
            "track_quality": ("TrackQuality", "TrackSummary"),
            "truth_pairing": ("select", "synchronize"),
        },
    )
