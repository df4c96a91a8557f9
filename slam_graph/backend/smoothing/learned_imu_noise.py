# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a recording at its minimum, eliminated under the noise of the IMU that it shows."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.smoothing.recording_cost import (
    EliminatedFeatures,
    Estimates,
    Factor,
    RecordingCost,
)
from slam_graph.backend.smoothing.recording_factors import RecordingFactors
from slam_graph.backend.smoothing.state_elimination import ChainEquations, EliminatedStates
from slam_graph.errors import EstimationError
from slam_graph.sensors import AidingData

logger = logging.getLogger(__name__)

_ROUNDS = 3
"""The noise is estimated this many times at most, each at the minimum under the last estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where a cost was minimised.

    Attributes:
        cost: the cost.
        estimates: the minimum.
    """

    cost: RecordingCost
    estimates: Estimates


@dataclass(frozen=True, slots=True, eq=False)
class ImageEquations:
    """What images say of the poses at a minimum, features eliminated.

    Attributes:
        information: (n, n), see `EliminatedFeatures.poses`.
        gradient: (K, 6) right-hand side.
    """

    information: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class EliminatedMinimum:
    """The normal equations at a minimum, with a fixed gauge, and their factor.

    Attributes:
        images: one part of the equations; None where it is not kept, as it is large.
        inertial: the other factors.
        values: X(k), V(k) and B(k) at the minimum. The parts are linearised within the last step of
            it, and agree to first order.
        states: the factor.
        fixes: lever arm and clock of position fixes; None where they are no variables.
    """

    images: ImageEquations | None
    inertial: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    states: EliminatedStates
    fixes: AidingData.Calibration | None = None

    def chain(self) -> ChainEquations:
        """The equations of the other factors."""
        keyframes = self.values.size() // 3
        return ChainEquations.of(self.inertial.linearize(self.values), keyframes)


def equations_at_minimum(
    found: Minimum,
    near: EliminatedStates | None,
    factors: RecordingFactors,
    learn: bool,
    keep: bool,
    count_step: Callable[[], None],
) -> EliminatedMinimum:
    """The normal equations with a fixed gauge, which covariances follow from.

    After each estimate of the noise one Gauss-Newton step goes to the minimum under it. What images
    say of the states hardly changes on the way, so that their Jacobians remain those of the given
    minimum.

    Args:
        found: the minimum.
        near: the factor of the cost somewhere near, if there is one. It is good enough to say how
            much of the residuals the images can contradict.
        factors: of the IMU; their noise becomes what was learned.
        learn: whether to estimate the noise of the IMU.
        keep: whether to keep what images say.
        count_step: is called after each step.

    Raises:
        RuntimeError: if GTSAM cannot linearise a factor.
        LinAlgError: if the cost does not determine all variables.
    """
    cost, estimates = found.cost, found.estimates
    features = cost.linearized(estimates).eliminated()
    inertial, states = cost.inertial, None
    known = near or _eliminated(features, cost, factors, estimates)
    for _ in range(_ROUNDS if learn else 0):
        assumed = factors.noise
        if not factors.learn_noise(inertial, estimates.states, known.times_covariance):
            break
        try:
            changed = factors.inertial(estimates.states)
            under = cost.with_inertial(_with_gauge(changed, factors, estimates))
            linear = under.linearized(estimates)
            known = EliminatedStates(features.poses.copy(), linear.chain)
            moved = estimates.moved(Factor(features, known).step(linear))
            if not under.value(moved) <= under.value(estimates):
                raise EstimationError("a step under it raises the cost")
        except (EstimationError, RuntimeError, np.linalg.LinAlgError) as error:
            logger.info("the noise of the IMU is not learned: %s", error)
            factors.noise = assumed
            break
        inertial, estimates, states = changed, moved, known
        count_step()
    states = states or _eliminated(features, cost, factors, estimates)
    inertial = _with_gauge(inertial, factors, estimates)
    images = None
    if keep:
        linear = cost.linearized(estimates)
        gradient = features.reduced(*linear.images.gradient(cost.keyframes))[0]
        if linear.fixes is not None and features.fixes is not None:
            gradient += features.fixes.reduced(*linear.fixes.gradient(cost.keyframes))
        images = ImageEquations(features.poses, gradient)
    fixes = None
    if cost.fixes is not None and features.fixes is not None:
        covariance = features.fixes.covariance(states)
        fixes = cost.fixes.calibration(estimates.fixes, covariance)
    return EliminatedMinimum(images, inertial, estimates.states, states, fixes)


def _eliminated(
    features: EliminatedFeatures,
    cost: RecordingCost,
    factors: RecordingFactors,
    estimates: Estimates,
) -> EliminatedStates:
    """The factor of the states with a fixed gauge."""
    inertial = _with_gauge(cost.inertial, factors, estimates)
    chain = ChainEquations.of(inertial.linearize(estimates.states), cost.keyframes)
    return EliminatedStates(features.poses.copy(), chain)


def _with_gauge(
    inertial: gtsam.NonlinearFactorGraph, factors: RecordingFactors, estimates: Estimates
) -> gtsam.NonlinearFactorGraph:
    """Priors, IMU and zero-velocity factors with a fixed gauge."""
    graph = gtsam.NonlinearFactorGraph(inertial)
    graph.push_back(factors.gauge(estimates.states))
    return graph
