# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The solution of a pose graph: the estimates, how well they fit, and how certain they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.display import Displayed
from slam_graph.errors import EstimationError
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.graph_cost import chi2_of_edges, chi2_table
from slam_graph.pose_graph.graph_files import g2o_lines
from slam_graph.pose_graph.graph_initialization import along_tree
from slam_graph.pose_graph.gtsam_graph import (
    ROTATION_FIRST,
    anchor_factors,
    edge_factors,
    factor_graph,
    values_of,
)


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where the steps ended.

    Attributes:
        poses: all poses.
        cost: their cost.
        steps: number of steps.
        converged: whether the cost stopped falling before the number of steps was used up.
    """

    poses: Poses
    cost: float
    steps: int
    converged: bool


@dataclass(frozen=True, eq=False, repr=False)
class PoseGraphSolution(Displayed):
    """The result of an optimisation.

    Attributes:
        graph: the problem.
        start: initial estimates.
        minimum: where the steps ended.
        weights: (M,) of the edges, from 0 (rejected) to 1.
    """

    graph: PoseGraph
    start: Poses
    minimum: Minimum
    weights: FloatArray

    @staticmethod
    def of(graph: PoseGraph, poses: Poses, weights: FloatArray | None = None) -> PoseGraphSolution:
        """Poses that come from elsewhere, e.g. from a file, as a solution.

        Args:
            graph: the problem.
            poses: of all its keys.
            weights: (M,) of the edges; 1 if not given.
        """
        if weights is None:
            weights = np.ones(len(graph.edges))
        return PoseGraphSolution(graph, poses, Minimum(poses, np.nan, 0, True), weights)

    def __repr__(self) -> str:
        minimum = self.minimum
        return (
            f"PoseGraphSolution({self.graph.name}: {len(self.graph.keys)} poses, "
            f"cost {minimum.cost:.6g}, {'' if minimum.converged else 'not '}converged)"
        )

    def _facts(self) -> dict[str, object]:
        minimum, rejected = self.minimum, int(np.count_nonzero(self.weights < 0.5))
        return {
            "graph": self.graph,
            "cost": f"{minimum.cost:.6g}",
            "steps": f"{minimum.steps}, {'' if minimum.converged else 'not '}converged",
            "rejected edges": rejected or None,
        }

    def plot(self) -> Any:
        """The graph before and after, with its edges, as a figure."""
        graph = self.graph
        return self._drawn_by("pose_graph_picture").pose_graph_figure(
            f"{graph.name}  ·  {len(graph.keys)} poses, {len(graph.edges)} edges, "
            f"cost {self.minimum.cost:.6g}",
            {"before": self.before.translations, "after": self.poses.translations},
            graph.edges,
            graph.is_odometry,
            self.weights < 0.5,
        )

    def _sketch(self) -> Any:
        return self.plot()

    @property
    def poses(self) -> Poses:
        """The estimates."""
        return self.minimum.poses

    def weighted_graph(self) -> PoseGraph:
        """The problem with the final weights, without rejected edges."""
        rows = np.flatnonzero(self.weights > 0)
        return self.graph.keep_edges(rows).weighted(self.weights[rows])

    @cached_property
    def before(self) -> Poses:
        """The poses before the optimisation: those of the file, or odometry."""
        graph = self.graph
        return along_tree(graph) if graph.estimates is None else graph.estimates

    def chi2_of_edges(self) -> FloatArray:
        """(M,) squared whitened residual of each edge, without weights."""
        return chi2_of_edges(self.graph, self.poses)

    def chi2(self) -> dict[str, dict[str, float]]:
        """χ² before (without weights), at the start and after, as three programs count it.

        Returns:
            For each stage what `chi2_table` says.
        """
        return {
            "before": chi2_table(self.graph, self.before),
            "start": chi2_table(self.graph, self.start, self.weights),
            "after": chi2_table(self.graph, self.poses, self.weights),
        }

    def g2o_lines(self, poses: Poses | None = None) -> Iterator[str]:
        """The problem as a g2o file, with the estimates or with other poses."""
        return g2o_lines(self.graph, self.poses if poses is None else poses)

    def covariances(
        self, rows: Sequence[int] | None = None, relative_to: int | None = None
    ) -> FloatArray:
        """(K, k, k) marginal covariances of some poses, or of all.

        In the tangent at each pose, T exp(δ), in the order of files: translation (m), then rotation
        (rad), both in the frame of the pose. The first pose of each connected component is fixed:
        its covariance is zero.

        Args:
            rows: of the poses; all if not given.
            relative_to: row of a pose that is fixed in place of the first of all, in a graph of
                one component.

        Raises:
            EstimationError: if a pose is not determined.
        """
        weighted = self.weighted_graph()
        factors = edge_factors(weighted)
        held = factor_graph([*factors, *anchor_factors(weighted, True, relative_to)])
        rows = range(len(self.poses)) if rows is None else rows
        try:
            marginals = gtsam.Marginals(held, values_of(self.poses))
            found = np.array([marginals.marginalCovariance(row) for row in rows])
        except RuntimeError as error:
            raise EstimationError(f"{self.graph.name}: a pose is not determined") from error
        if self.graph.dimension == 3:
            translation_first = np.argsort(ROTATION_FIRST)
            found = found[:, translation_first[:, None], translation_first]
        return found
