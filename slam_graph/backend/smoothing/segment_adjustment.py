# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The minimum of one segment of a recording, with features fused, if it fits the observations."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from slam_graph.backend.smoothing.adjustment_progress import SegmentProgress
from slam_graph.backend.smoothing.recording_problem import BundleAdjustment
from slam_graph.backend.smoothing.smoothing_task import AdjustedSegment, SegmentStart, SmoothingTask
from slam_graph.backend.smoothing.track_fusion import with_fused_features
from slam_graph.errors import EstimationError
from slam_graph.kernels.free_memory import give_back

logger = logging.getLogger(__name__)

_MIN_OBSERVATIONS_PER_KEYFRAME = 2.0
MAX_PIXEL_RESIDUAL = 3.0
"""Root mean square of the reprojection residuals in σ beyond which a minimum is refused."""


class UndeterminedError(EstimationError):
    """There are too few observations to improve on the causal estimate."""


def adjust_segment(
    start: SegmentStart, task: SmoothingTask, progress: SegmentProgress
) -> AdjustedSegment:
    """The minimum of a segment with fused features; if fusion fails, with the original tracks."""
    give_back()  # what the segment before took
    if task.config.fuse_features:
        try:
            fused, steps = with_fused_features(start, task, progress.fusing)
            give_back()  # the arrays of the fusion are too small for what follows

            def report(step: int, passes: int) -> None:
                progress.solving(steps + step, passes)

            solved = BundleAdjustment(fused, task, report).solve()
            check_minimum(solved)
            figures = solved.figures
            return replace(solved, figures=replace(figures, iterations=figures.iterations + steps))
        except UndeterminedError:
            raise
        except (EstimationError, RuntimeError, np.linalg.LinAlgError) as error:
            logger.warning("features are not fused: %s", " ".join(str(error).split())[:200])
    solved = BundleAdjustment(start, task, progress.solving).solve()
    check_minimum(solved)
    return solved


def check_minimum(solved: AdjustedSegment) -> None:
    """Refuse a minimum that does not fit the observations."""
    found = solved.figures
    if found.observations < _MIN_OBSERVATIONS_PER_KEYFRAME * found.keyframes:
        raise UndeterminedError(
            f"{found.observations} observations in {found.keyframes} keyframes are too few"
        )
    if not found.pixel_residual < MAX_PIXEL_RESIDUAL:
        raise EstimationError(f"images do not fit: residuals of {found.pixel_residual:.1f} σ")
    if not all(np.isfinite(state.world_T_body.matrix()).all() for state in solved.states):
        raise EstimationError("a pose is not finite")
