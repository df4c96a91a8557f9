# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a bundle adjustment: sizes, costs, residuals; of a segment and of a recording."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentFigures:
    """Figures of the minimum of one segment or of several together.

    Costs and residuals are those before the noise of the IMU is learned, which moves the states.

    Attributes:
        keyframes: number of keyframes.
        features: number of features in the cost.
        observations: number of observations in the cost.
        iterations: Levenberg-Marquardt steps.
        cost_before: cost of the states before the adjustment, with features triangulated from
            them; of the same residuals and variances as `cost_after`.
        cost_after: cost at the minimum.
        imu_residual: root mean square of the whitened IMU residuals.
        pixel_residual: root mean square of the whitened reprojection residuals.
        pixel_sigma: assumed standard deviation of the observations at the end, pixels.
        inefficiency: variance of slow errors of tracks over that of white noise of this size.
    """

    keyframes: int
    features: int
    observations: int
    iterations: int
    cost_before: float
    cost_after: float
    imu_residual: float
    pixel_residual: float
    pixel_sigma: float
    inefficiency: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FinalBaSummary(AdjustmentFigures):
    """Figures of the bundle adjustment over a whole recording, summed over its segments.

    Attributes:
        segments: number of segments.
        frames: number of poses.
        seconds: wall time.
        cpu_seconds: processor time.
    """

    segments: int
    frames: int
    seconds: float
    cpu_seconds: float


def summary_of(
    solved: list[AdjustmentFigures], frames: int, began: tuple[float, float]
) -> FinalBaSummary:
    """Figures of all segments together.

    Args:
        solved: figures of the segments.
        frames: number of poses.
        began: wall and processor time at the start, s.
    """

    def total(name: str) -> int:
        return sum(getattr(part, name) for part in solved)

    def mean(name: str, weight: str, power: int = 1) -> float:
        weights = [getattr(part, weight) for part in solved]
        values = [getattr(part, name) ** power for part in solved]
        return float(np.average(values, weights=weights) ** (1.0 / power))

    def rms(name: str, weight: str) -> float:
        return mean(name, weight, 2)

    return FinalBaSummary(
        segments=len(solved),
        frames=frames,
        keyframes=total("keyframes"),
        features=total("features"),
        observations=total("observations"),
        iterations=total("iterations"),
        cost_before=sum(part.cost_before for part in solved),
        cost_after=sum(part.cost_after for part in solved),
        imu_residual=rms("imu_residual", "keyframes"),
        pixel_residual=rms("pixel_residual", "observations"),
        pixel_sigma=rms("pixel_sigma", "observations"),
        inefficiency=mean("inefficiency", "observations"),
        seconds=time.perf_counter() - began[0],
        cpu_seconds=time.process_time() - began[1],
    )


def total_of(summaries: list[FinalBaSummary]) -> FinalBaSummary:
    """Figures of several adjustments together."""
    seconds, cpu_seconds = (
        sum(getattr(part, name) for part in summaries) for name in ("seconds", "cpu_seconds")
    )
    whole = summary_of([*summaries], sum(part.frames for part in summaries), (0.0, 0.0))
    segments = sum(part.segments for part in summaries)
    return replace(whole, segments=segments, seconds=seconds, cpu_seconds=cpu_seconds)
