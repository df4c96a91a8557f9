# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The policy table: what makes one algorithm differ from another, module by module.

An algorithm is a YAML file in `configs/algorithms/` with one section for each module of the loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

from pydantic import Field

from slam_graph.backend.config import Settings

PoseChoice = Callable[[Sequence[int], int], list[int]]


def most_recent(frames: Sequence[int], count: int) -> list[int]:
    """The latest `count` frames."""
    return list(frames[-count:])


def evenly_spaced(frames: Sequence[int], count: int) -> list[int]:
    """Frames thinned evenly in time once there are more than `count`, the oldest kept.

    Every third frame leaves, starting from the second oldest (Mourikis & Roumeliotis 2007, sec.
    III-E), so that some poses of the far past stay beside the recent ones.
    """
    if len(frames) <= count:
        return list(frames)
    leaving = set(frames[1:-1:3])
    return [frame for frame in frames if frame not in leaving]


POSE_CHOICES: dict[str, PoseChoice] = {
    "most_recent": most_recent,
    "evenly_spaced": evenly_spaced,
}


class CostPolicy(Settings):
    """Module 1: which variables and residuals are in the cost."""

    past_poses: Literal["most_recent", "evenly_spaced"] = "most_recent"
    """Which past poses stay in the cost beside the current IMU state."""
    max_past_poses: int = Field(11, ge=1)
    """N_max: how many past poses at most."""
    max_state_features: int = Field(40, ge=0)
    """How many long-lived features are held in the state; all others are used once."""
    state_feature_frames: int = Field(10, ge=2)
    """How many frames must have seen a feature before it may be held in the state."""
    max_features_per_step: int = Field(60, ge=1)
    """How many features at most are used once in one step (the longest tracks first)."""


class GaussNewtonPolicy(Settings):
    """Module 2: how the cost is minimised."""

    max_steps: int = Field(1, ge=1)
    """Number of steps at most."""
    tolerance: float = Field(1e-6, ge=0)
    """Steps end when no tangent moves by more (with damping: when the cost falls by less, relative
    to its value)."""
    damping: Literal["none", "levenberg_marquardt"] = "none"
    """Plain Gauss-Newton, or Levenberg-Marquardt."""


class MarginalizationPolicy(Settings):
    """Module 3: what the variables that leave the cost leave behind."""

    first_estimates: bool = True
    """First-estimates Jacobians for the variables of the prior."""


class AlgorithmConfig(Settings):
    """One row of the table."""

    name: str
    """Name of the algorithm."""
    cost: CostPolicy = CostPolicy()
    """Cost construction."""
    gauss_newton: GaussNewtonPolicy = GaussNewtonPolicy()
    """Gauss-Newton steps."""
    marginalization: MarginalizationPolicy = MarginalizationPolicy()
    """Marginalization."""
