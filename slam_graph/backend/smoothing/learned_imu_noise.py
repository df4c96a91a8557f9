# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a recording at its minimum, eliminated under the noise of the IMU that it shows."""

from __future__ import annotations

import logging
from collections.abc import Callable

import gtsam

from slam_graph.backend.smoothing.recording_cost import (
    EliminatedFeatures,
    Estimates,
    Factor,
    LinearCost,
    RecordingCost,
)
from slam_graph.backend.smoothing.recording_factors import RecordingFactors
from slam_graph.backend.smoothing.state_elimination import ChainEquations, EliminatedStates
from slam_graph.errors import EstimationError

logger = logging.getLogger(__name__)

_ROUNDS = 3
"""The noise is estimated this many times at most, each at the minimum under the last estimate."""


def states_at_minimum(
    cost: RecordingCost,
    factors: RecordingFactors,
    estimates: Estimates,
    learn: bool,
    count_step: Callable[[], None],
) -> EliminatedStates:
    """The factor of the cost with its gauge fixed, which its covariances follow from.

    After each estimate of the noise one Gauss-Newton step goes to the minimum under it. The states
    that are reported stay those of the given minimum. What images say of them hardly changes on the
    way, so that their Jacobians remain those of the minimum.

    Args:
        cost: that was minimised.
        factors: of the IMU; their noise becomes what was learned.
        estimates: the minimum.
        learn: whether to estimate the noise of the IMU.
        count_step: is called after each step.

    Raises:
        RuntimeError: if GTSAM cannot linearise a factor.
        LinAlgError: if the cost does not determine all variables.
    """
    features = EliminatedFeatures(cost.images.linearized(estimates), cost.keyframes)
    inertial = _with_gauge(cost.inertial, factors, estimates)
    chain = ChainEquations.of(inertial.linearize(estimates.states), cost.keyframes)
    states = EliminatedStates(features.poses, chain)
    for _ in range(_ROUNDS if learn else 0):
        assumed = factors.noise
        if not factors.learn_noise(inertial, estimates.states, states.times_covariance):
            break
        try:
            inertial = _with_gauge(factors.inertial(estimates.states), factors, estimates)
            under = cost.with_inertial(inertial)
            chain = ChainEquations.of(inertial.linearize(estimates.states), cost.keyframes)
            linear = LinearCost(chain, cost.images.linearized(estimates))
            known = EliminatedStates(features.poses, chain)
            moved = estimates.moved(Factor(features, known).step(linear))
            if not under.value(moved) <= under.value(estimates):
                raise EstimationError("a step under it raises the cost")
        except (EstimationError, RuntimeError) as error:
            logger.info("the noise of the IMU is not learned: %s", error)
            factors.noise = assumed
            break
        estimates, states = moved, known
        count_step()
    return states


def _with_gauge(
    inertial: gtsam.NonlinearFactorGraph, factors: RecordingFactors, estimates: Estimates
) -> gtsam.NonlinearFactorGraph:
    """Priors, IMU and zero-velocity factors with a fixed gauge."""
    graph = gtsam.NonlinearFactorGraph(inertial)
    graph.push_back(factors.gauge(estimates.states))
    return graph
