# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a recording at its minimum, eliminated under the noise of the IMU that it shows."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import blas

from slam_graph.arrays import FloatArray
from slam_graph.backend.smoothing.calibration_equations import (
    CalibrationColumns,
    CalibrationEquations,
)
from slam_graph.backend.smoothing.recording_cost import (
    Estimates,
    RecordingCost,
    moved_states,
)
from slam_graph.backend.smoothing.recording_factors import RecordingFactors
from slam_graph.backend.smoothing.state_elimination import (
    STATE,
    ChainEquations,
    EliminatedStates,
)
from slam_graph.kernels.free_memory import give_back
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


class _LinearImages:
    """What images and position fixes say of K keyframe states: linear around a minimum.

    Args:
        found: the minimum.

    Attributes:
        features: what was eliminated.
        gradient: (K, 6) right-hand side by the poses, at the states that were moved to.
    """

    def __init__(self, found: Minimum) -> None:
        self._linear = linear = found.cost.linearized(found.estimates)
        keyframes = found.cost.keyframes
        self.features = linear.eliminated()
        self.gradient, self._t = self.features.reduced(*linear.images.gradient(keyframes))
        self._by_fixes = np.zeros(0)  # gradient by clock and lever arm of the fixes
        fixes = self.features.fixes
        if linear.fixes is not None and fixes is not None:
            by_pose, self._by_fixes = linear.fixes.gradient(keyframes)
            self.gradient += fixes.reduced(by_pose, self._by_fixes)
        self._at_minimum = self.gradient.copy()
        self._moved = np.zeros((keyframes, STATE))  # increments of the states so far

    def calibration(
        self, columns: CalibrationColumns, states: EliminatedStates, chain: ChainEquations
    ) -> CalibrationEquations:
        """The equations of the calibration at the minimum.

        Args:
            columns: what their Jacobians are made of.
            states: the factor of the states.
            chain: the other factors, linearised at the minimum.
        """
        return columns.equations(replace(self._linear, chain=chain), self.features, states)

    def reset(self) -> None:
        """Go back to the minimum."""
        self.gradient, self._moved = self._at_minimum.copy(), np.zeros(self._moved.shape)

    def factor(self, chain: ChainEquations) -> EliminatedStates:
        """The factor of the states with all other factors."""
        return EliminatedStates(self.features.poses.copy(), chain)

    def step(self, states: EliminatedStates, chain: ChainEquations) -> FloatArray:
        """Moves by a Gauss-Newton step.

        Args:
            states: the factor of the states.
            chain: the other factors, linearised at the states that were moved to.

        Returns:
            The increments (K, 15) of the states.
        """
        gradient = chain.gradient.copy()
        gradient[:, :6] += self.gradient
        moved = states.times_covariance(gradient[:, :, None])[:, :, 0]
        information = self.features.poses  # its lower triangle
        poses = np.zeros(len(information))
        poses[: self.gradient.size] = moved[:, :6].ravel()
        change = blas.dsymv(1.0, information.T, poses)
        self.gradient -= change[: self.gradient.size].reshape(-1, 6)
        self._moved += moved
        return moved

    def moved(self, estimates: Estimates, states: gtsam.Values) -> Estimates:
        """The minimum with the states that were moved to, and all else where it is best."""
        poses, fixes = self._moved[:, :6], self.features.fixes
        shared = np.zeros(0) if fixes is None else fixes.step(self._by_fixes, poses)
        points = estimates.points + self.features.points(self._t, poses)
        return Estimates(states, points, estimates.fixes + shared)


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
        calibration: equations of the parameters of the rig; None if they were not wanted.
    """

    images: ImageEquations | None
    inertial: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    states: EliminatedStates
    fixes: AidingData.Calibration | None = None
    calibration: CalibrationEquations | None = None

    def chain(self) -> ChainEquations:
        """The equations of the other factors."""
        return _chain(self.inertial, self.values)


def equations_at_minimum(
    found: Minimum,
    take_near: Callable[[], EliminatedStates | None],
    factors: RecordingFactors,
    learn: bool,
    keep: bool,
    count_step: Callable[[], None],
    columns: CalibrationColumns | None = None,
) -> EliminatedMinimum:
    """The normal equations with a fixed gauge, which covariances follow from.

    After each estimate of the noise one Gauss-Newton step goes to the minimum under it. What images
    say of the states hardly changes on the way, so that their Jacobians remain those of the given
    minimum.

    Args:
        found: the minimum.
        take_near: gives the factor of the cost somewhere near, if there is one, and keeps it no
            longer, as it is large. It is good enough to say how much of the residuals the images
            can contradict.
        factors: of the IMU; their noise becomes what was learned.
        learn: whether to estimate the noise of the IMU.
        keep: whether to keep what images say.
        count_step: is called after each step.
        columns: of the calibration, if its equations are wanted.

    Raises:
        RuntimeError: if GTSAM cannot linearise a factor.
        LinAlgError: if the cost does not determine all variables.
    """
    give_back()  # arrays of the steps, before those that take most
    images, cost, given = _LinearImages(found), found.cost, factors.noise
    inertial, states, moved = cost.inertial, None, found.estimates
    if learn:
        learned = _learned(found, images, take_near, factors, count_step)
        if learned is None:
            factors.noise = given
            images.reset()
        else:
            inertial, states, moved = learned
    inertial = _with_gauge(inertial, factors, moved.states)
    states = states or images.factor(_chain(inertial, moved.states))
    fixes, features = None, images.features
    if cost.fixes is not None and features.fixes is not None:
        covariance = features.fixes.covariance(states)
        fixes = cost.fixes.calibration(moved.fixes, covariance)
    calibration = None
    if columns is not None:
        chain = _chain(inertial, found.estimates.states)
        calibration = images.calibration(columns, states, chain)
    kept = ImageEquations(features.poses, images.gradient) if keep else None
    return EliminatedMinimum(kept, inertial, moved.states, states, fixes, calibration)


def _learned(
    found: Minimum,
    images: _LinearImages,
    take_near: Callable[[], EliminatedStates | None],
    factors: RecordingFactors,
    count_step: Callable[[], None],
) -> tuple[gtsam.NonlinearFactorGraph, EliminatedStates | None, Estimates] | None:
    """The factors of the IMU under its learned noise, the factor of the states, and the minimum.

    Returns:
        None if steps under another noise cannot be taken, or raise the cost. The factor of the
        states is None where the noise is as assumed.
    """
    cost, values, inertial = found.cost, found.estimates.states, found.cost.inertial
    states: EliminatedStates | None = None
    known: EliminatedStates | None
    try:
        known = take_near() or images.factor(_chain(_with_gauge(inertial, factors, values), values))
        for _ in range(_ROUNDS):
            if not factors.learn_noise(inertial, values, known.times_covariance):
                break
            inertial = factors.reweighted(inertial, values)
            chain = _chain(_with_gauge(inertial, factors, values), values)
            known = states = None  # the one before goes before there is another: they are large
            known = states = images.factor(chain)
            values = moved_states(values, images.step(known, chain))
            count_step()
        if states is None:
            return inertial, None, found.estimates
        moved = images.moved(found.estimates, values)
        under = cost.with_inertial(_with_gauge(inertial, factors, found.estimates.states))
        if under.value(moved) <= under.value(found.estimates):
            return inertial, states, moved
        logger.info("the noise of the IMU is not learned: steps under it raise the cost")
    except (RuntimeError, np.linalg.LinAlgError) as error:
        logger.info("the noise of the IMU is not learned: %s", error)
    return None


def _chain(inertial: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> ChainEquations:
    """Factors on K states, linearised."""
    return ChainEquations.of(inertial.linearize(values), values.size() // 3)


def _with_gauge(
    inertial: gtsam.NonlinearFactorGraph, factors: RecordingFactors, values: gtsam.Values
) -> gtsam.NonlinearFactorGraph:
    """Priors, IMU and zero-velocity factors with a fixed gauge."""
    graph = gtsam.NonlinearFactorGraph(inertial)
    graph.push_back(factors.gauge(values))
    return graph
