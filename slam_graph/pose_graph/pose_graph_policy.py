# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of pose-graph optimisation (a row of the table of policies).

Cost construction: all poses, no features. Gauss-Newton: until convergence. Marginalization: none.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from slam_graph.settings import Settings, expert

Initialization = Literal["auto", "chordal", "lago", "odometry", "file"]


class PoseGraphCostPolicy(Settings):
    """Module 1: all poses and all edges, and how outliers among the edges are handled."""

    initialization: Initialization = "auto"
    """Initial estimates. auto: chordal, or odometry with a robust loss. Choose file to stay in the
    basin of the estimates that the file has, or another one where --certify refuses the result."""
    robust: Literal["none", "gnc", "huber", "cauchy", "geman_mcclure", "dcs", "truncated"] = "none"
    """How false loop closures are handled: none where all are true; gnc (graduated non-convexity)
    classifies each as inlier or outlier; the others are robust losses, which only weigh down."""
    robust_width: float | None = expert(None, gt=0)
    """Width of the robust loss on the whitened residual (of `dcs`: Φ, on its square); null for the
    χ² quantile of `confidence`."""
    confidence: float = expert(0.99, gt=0, lt=1)
    """χ² quantile of the residuals of inliers."""
    trust_odometry: bool = expert(True)
    """Whether edges between poses with consecutive ids are never outliers."""


class PoseGraphStepsPolicy(Settings):
    """Module 2: how the cost is minimised."""

    method: Literal["gauss_newton", "levenberg_marquardt", "dogleg", "isam2"] = "gauss_newton"
    """Optimizer. gauss_newton is the fastest, and continues with Levenberg-Marquardt where a step
    does not lower the cost; isam2 adds pose by pose, which is slower and has the same minimum."""
    tolerance: float = Field(1e-6, gt=0)
    """Steps end when the relative decrease of the cost is less; lower it for more digits."""
    max_steps: int = expert(100, ge=1)
    """Largest number of steps."""
    relinearize_threshold: float = expert(0.1, gt=0)
    """Poses whose tangent has moved by more are relinearised (isam2)."""
    relinearize_skip: int = expert(10, ge=1)
    """Number of poses between two such checks (isam2)."""


class PoseGraphPolicy(Settings):
    """Pose-graph optimisation as a row of the table."""

    cost: PoseGraphCostPolicy = PoseGraphCostPolicy()
    """Cost construction."""
    gauss_newton: PoseGraphStepsPolicy = PoseGraphStepsPolicy()
    """Gauss-Newton steps."""

    @staticmethod
    def with_gnc(initialization: Initialization = "auto") -> PoseGraphPolicy:
        """The defaults, with false loop closures found by graduated non-convexity."""
        return PoseGraphPolicy(
            cost=PoseGraphCostPolicy(robust="gnc", initialization=initialization)
        )
