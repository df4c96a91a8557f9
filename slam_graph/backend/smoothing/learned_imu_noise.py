# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a recording at its minimum, eliminated under the noise of the IMU that it shows."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gtsam

from slam_graph.backend.smoothing.bayes_tree import Clique, cliques_of, solved
from slam_graph.backend.smoothing.recording_factors import RecordingFactors
from slam_graph.errors import EstimationError

logger = logging.getLogger(__name__)

_ROUNDS = 3
"""The noise is estimated this many times at most, each at the minimum under the last estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class SolvedCost:
    """A cost that was minimised.

    Attributes:
        graph: all of it.
        inertial: priors, IMU and zero-velocity factors.
        projections: the other factors.
        ordering: of the elimination.
    """

    graph: gtsam.NonlinearFactorGraph
    inertial: gtsam.NonlinearFactorGraph
    projections: gtsam.NonlinearFactorGraph
    ordering: gtsam.Ordering


def cliques_at_minimum(
    cost: SolvedCost,
    factors: RecordingFactors,
    values: gtsam.Values,
    learn: bool,
    count_step: Callable[[], None],
) -> list[Clique]:
    """The linearised cost with its gauge fixed, which its covariances follow from.

    After each estimate of the noise one Gauss-Newton step goes to the minimum under it. It takes
    the same elimination as the covariances. The states that are reported stay those of the given
    minimum; what follows is linearised where these steps lead.

    Args:
        cost: that was minimised.
        factors: of the IMU; their noise becomes what was learned.
        values: the minimum.
        learn: whether to estimate the noise of the IMU.
        count_step: is called after each step.

    Raises:
        RuntimeError: if the cost does not determine all variables.
    """
    inertial = cost.inertial
    wanted = {k for k in values.keys() if chr(gtsam.symbolChr(k)) in "xvb"}  # noqa: SIM118
    graph, tree = _eliminated(cost, inertial, factors, values)
    cliques = cliques_of(tree, wanted)
    for _ in range(_ROUNDS if learn else 0):
        assumed = factors.noise
        if not factors.learn_noise(inertial, values, partial(solved, cliques)):
            break
        try:
            inertial = factors.inertial(values)
            graph, tree = _eliminated(cost, inertial, factors, values)
            moved = values.retract(tree.optimize())
            if not graph.error(moved) <= graph.error(values):
                raise EstimationError("a step under it raises the cost")
        except (EstimationError, RuntimeError) as error:
            logger.info("the noise of the IMU is not learned: %s", error)
            factors.noise = assumed
            break
        values, cliques = moved, cliques_of(tree, wanted)
        count_step()
    return cliques


def _eliminated(
    cost: SolvedCost,
    inertial: gtsam.NonlinearFactorGraph,
    factors: RecordingFactors,
    values: gtsam.Values,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.GaussianBayesTree]:
    """The cost with other inertial factors and a fixed gauge; its linearisation's Bayes tree."""
    graph = gtsam.NonlinearFactorGraph(inertial)
    graph.push_back(cost.projections)
    graph.push_back(factors.gauge(values))
    return graph, graph.linearize(values).eliminateMultifrontal(cost.ordering)
