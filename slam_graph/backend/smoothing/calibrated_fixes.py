# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes in the final adjustment where their lever arm and clock are variables.

A fix depends on one keyframe and on these few variables c, which all fixes share. With the whitened
Jacobians Jₓ, J_c and the prior of c, elimination of c leaves

    Σ Jₓᵀ Jₓ - C Λ⁻¹ Cᵀ,   C = Σ Jₓᵀ J_c,   Λ = Σ J_cᵀ J_c + prior

on the poses: as dense as what features leave, and added to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.aiding.fix_calibration import FixVariables, SeenFixes
from slam_graph.backend.aiding.fix_factors import FIX_LOSS
from slam_graph.backend.smoothing.state_elimination import STATE, EliminatedStates
from slam_graph.backend.solve.stacked_values import stacked_poses
from slam_graph.backend.solve.state import POSE_DIM
from slam_graph.sensors import AidingData


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedFixes:
    """The robust cost of N fixes on keyframes, with the prior of lever arm and clock.

    Attributes:
        seen: the fixes.
        roots: (N, 3, 3) whiten their residuals.
        keyframes: (N,) from which they are seen.
        variables: n components of lever arm and clock.
        start: (4,) time offset and lever arm to begin with; what is no variable stays.
    """

    seen: SeenFixes
    roots: FloatArray
    keyframes: IntArray
    variables: FixVariables
    start: FloatArray

    def whole(self, values: FloatArray) -> FloatArray:
        """Time offset (s) and lever arm (m), (4,), of the variables (n,)."""
        calibration = self.start.copy()
        calibration[self.variables.columns] = values
        return calibration

    def first(self) -> FloatArray:
        """The variables (n,) to begin with."""
        return self.start[self.variables.columns]

    def calibration(self, values: FloatArray, covariance: FloatArray) -> AidingData.Calibration:
        """What is known, of values (n,) and the covariance (n, n) of the variables."""
        return self.variables.calibration(self.whole(values), covariance)

    def _of_prior(self, values: FloatArray) -> FloatArray:
        """Whitened residuals (n,) of the prior."""
        variables = self.variables
        return np.asarray((variables.given[variables.columns] - values) / variables.sigmas)

    def _white(self, states: gtsam.Values, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (N, 3) as measured less predicted, and rotations (N, 3, 3)."""
        count = int(self.keyframes.max()) + 1
        rotations, positions = stacked_poses(states, range(count))
        rotations, positions = rotations[self.keyframes], positions[self.keyframes]
        residuals = -self.seen.residuals(rotations, positions, self.whole(values))
        return np.einsum("nij,nj->ni", self.roots, residuals), rotations

    def value(self, states: gtsam.Values, values: FloatArray) -> float:
        """The cost, at keyframe states X(k) and variables (n,)."""
        white, _ = self._white(states, values)
        prior = self._of_prior(values)
        return float(np.sum(FIX_LOSS.value(np.linalg.norm(white, axis=1))) + 0.5 * prior @ prior)

    def linearized(self, states: gtsam.Values, values: FloatArray) -> LinearFixes:
        """The cost linearised, weighted by the loss."""
        white, rotations = self._white(states, values)
        weights = np.sqrt(FIX_LOSS.weights(np.linalg.norm(white, axis=1)))
        by_pose, by_calibration = self.seen.jacobians(rotations, self.whole(values))
        roots = weights[:, None, None] * self.roots
        return LinearFixes(
            self.keyframes,
            weights[:, None] * white,
            roots @ by_pose,
            roots @ by_calibration[:, :, self.variables.columns],
            self._of_prior(values),
            1.0 / self.variables.sigmas,
        )


@dataclass(frozen=True, slots=True, eq=False)
class LinearFixes:
    """Linearised fixes r - Jₓ δₓ - J_c δ_c, whitened, and the prior of the n variables c.

    Attributes:
        keyframes: (N,).
        r: (N, 3).
        by_pose: (N, 3, 6) Jₓ.
        by_calibration: (N, 3, n) J_c.
        r_prior: (n,).
        by_prior: (n,) its derivatives.
    """

    keyframes: IntArray
    r: FloatArray
    by_pose: FloatArray
    by_calibration: FloatArray
    r_prior: FloatArray
    by_prior: FloatArray

    def gradient(self, keyframes: int) -> tuple[FloatArray, FloatArray]:
        """Jᵀ r by the poses (K, 6) and the variables (n,)."""
        of_pose = np.zeros((keyframes, POSE_DIM))
        np.add.at(of_pose, self.keyframes, np.einsum("nik,ni->nk", self.by_pose, self.r))
        of_calibration = np.einsum("nik,ni->k", self.by_calibration, self.r)
        return of_pose, of_calibration + self.by_prior * self.r_prior


class EliminatedFixes:
    """The factor of lever arm and clock in the normal equations.

    Args:
        linear: the linearised fixes.
        keyframes: number of keyframes K.
        damping: is added to the diagonal.
    """

    def __init__(self, linear: LinearFixes, keyframes: int, damping: float = 0.0) -> None:
        J, H = linear.by_calibration, linear.by_pose
        self._blocks = np.zeros((keyframes, POSE_DIM, POSE_DIM))
        np.add.at(self._blocks, linear.keyframes, H.transpose(0, 2, 1) @ H)
        self._C = np.zeros((keyframes, POSE_DIM, J.shape[2]))
        np.add.at(self._C, linear.keyframes, H.transpose(0, 2, 1) @ J)
        information = np.einsum("nik,nil->kl", J, J)
        self._factor = cho_factor(information + np.diag(linear.by_prior**2 + damping))

    def add_to(self, poses: FloatArray) -> None:
        """Add what is left to information (n, n) that begins with the poses."""
        size = self._C.shape[0] * POSE_DIM
        C = self._C.reshape(size, -1)
        poses[:size, :size] -= C @ cho_solve(self._factor, C.T)
        for k, block in enumerate(self._blocks):
            rows = slice(POSE_DIM * k, POSE_DIM * (k + 1))
            poses[rows, rows] += block

    def reduced(self, by_pose: FloatArray, by_calibration: FloatArray) -> FloatArray:
        """The gradient (K, 6) by the poses without the variables."""
        return np.asarray(by_pose - self._C @ cho_solve(self._factor, by_calibration))

    def step(self, by_calibration: FloatArray, poses: FloatArray) -> FloatArray:
        """Increments (n,) of the variables, given those (K, 6) of the poses."""
        rest = by_calibration - np.einsum("kin,ki->n", self._C, poses)
        return np.asarray(cho_solve(self._factor, rest))

    def covariance(self, states: EliminatedStates) -> FloatArray:
        """Covariance (n, n) of the variables, by the factor of all states."""
        right = np.zeros((len(self._C), STATE, self._C.shape[2]))
        right[:, :POSE_DIM] = self._C
        solved = states.times_covariance(right)[:, :POSE_DIM]
        alone = cho_solve(self._factor, np.eye(self._C.shape[2]))
        return np.asarray(alone + alone @ np.einsum("kin,kim->nm", self._C, solved) @ alone)
