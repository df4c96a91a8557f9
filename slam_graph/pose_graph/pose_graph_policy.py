# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The row of pose-graph optimisation in the table of policies, and what a solution consists of.

Cost construction: all poses, no features. Gauss-Newton: until convergence. Marginalization: none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from slam_graph.arrays import FloatArray
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.settings.base import Settings

Steps = Literal["gauss_newton", "levenberg_marquardt", "dogleg", "isam2"]


class PoseGraphCostPolicy(Settings):
    """Module 1: all poses and all edges. What is open is how far an edge is trusted."""

    initialization: Literal["auto", "chordal", "lago", "odometry", "file"] = "auto"
    """First estimates. auto: chordal; along odometry under a robust loss."""
    robust: Literal["none", "gnc", "huber", "cauchy", "geman_mcclure", "dcs", "truncated"] = "none"
    """How false loop closures are held back: by a robust loss, or by graduated non-convexity
    (`gnc`), which decides for each whether it is one."""
    robust_width: float | None = Field(None, gt=0)
    """Width of the robust loss on the whitened length of a residual (of `dcs`: Φ, on its square);
    null for the χ² quantile of `confidence`."""
    confidence: float = Field(0.99, gt=0, lt=1)
    """χ² quantile of the residuals that true edges have."""
    trust_odometry: bool = True
    """Whether edges between consecutive poses are above suspicion."""


class PoseGraphStepsPolicy(Settings):
    """Module 2: how the cost is minimised."""

    method: Steps = "gauss_newton"
    """Gauss-Newton goes over to Levenberg-Marquardt where a step does not lower the cost."""
    max_steps: int = Field(100, ge=1)
    """Number of steps at most."""
    tolerance: float = Field(1e-6, gt=0)
    """Steps end when the cost falls by less, relative to its value."""
    relinearize_threshold: float = Field(0.1, gt=0)
    """Poses of which the tangent moved by more are linearised anew (isam2)."""
    relinearize_skip: int = Field(10, ge=1)
    """How many poses from one such check to the next (isam2)."""


class PoseGraphPolicy(Settings):
    """Pose-graph optimisation as a row of the table."""

    cost: PoseGraphCostPolicy = PoseGraphCostPolicy()
    """Cost construction."""
    gauss_newton: PoseGraphStepsPolicy = PoseGraphStepsPolicy()
    """Gauss-Newton steps."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where steps have led to.

    Attributes:
        poses: all of them.
        cost: what they cost in the end.
        steps: number of steps.
        converged: whether the cost stopped falling before the number of steps was used up.
    """

    poses: Poses
    cost: float
    steps: int
    converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphSolution:
    """What came of an optimisation.

    Attributes:
        graph: the problem.
        start: first estimates.
        minimum: what the steps have led to.
        weights: (M,) of the edges, from 0 (rejected) to 1.
    """

    graph: PoseGraph
    start: Poses
    minimum: Minimum
    weights: FloatArray

    @property
    def poses(self) -> Poses:
        """The estimates."""
        return self.minimum.poses

    def weighted_graph(self) -> PoseGraph:
        """The problem that was solved in the end: with weights, and without rejected edges."""
        rows = np.flatnonzero(self.weights > 0)
        return self.graph.keep_edges(rows).weighted(self.weights[rows])
