# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The gyroscope bias of a short window, from epipolar geometry alone.

With the right rotation all epipolar planes of two frames share the line of the translation. For a
pair of frames with relative rotation R, the normals n = f₁ × R f₂ of the epipolar planes are all
orthogonal to the translation, so the smallest eigenvalue of Σ n nᵀ vanishes (Kneip & Lynen 2013).
With R integrated from the gyroscope this is a cost in its bias only: no depth, velocity or gravity
is needed (He, Xu, Ouyang & Li 2023).

The normals are linear in the products of the bearings, n = A(R) (f₁ ⊗ f₂). So the sum over all
features is formed once, K = Σ (f₁ ⊗ f₂)(f₁ ⊗ f₂)ᵀ, and Σ n nᵀ = A(R) K A(R)ᵀ for every R.

Noise increases that eigenvalue, but hardly for a translation along the optical axis. So the plain
smallest eigenvalue is biased towards rotations under which the camera seems to move straight ahead.
The eigenvalue relative to the part that noise adds is not (Kanatani 1996, renormalization).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, skew
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.initialization.inertial_motion import Intervals
from slam_graph.backend.solve.damped_steps import Attempt, TenfoldDamping, levenberg_marquardt
from slam_graph.sensors import FeatureFrame, FeatureObservations

_MIN_COMMON = 8
"""Pairs of frames with fewer common features than this are left out."""
_ROBUST_WIDTH = 0.02
"""Width of the robust loss on the whitened residual of a pair."""
_ROUNDS, _LINEAR_RAD_S = 2, 1e-3
"""How often the bias is estimated at most; a change below this needs no other linearisation."""
_MAX_STEPS, _CONVERGED = 30, 1e-6
"""Most steps of each time, and the relative change of the cost at which they end: a thousandth of
the bias's noise."""
_TINY = 1e-12
"""Keeps divisions finite."""
_CROSS = skew(np.eye(3))
"""(3, 3, 3) the matrices [e_a]ₓ of the cross products with the axes."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of frames with their common features.

    Attributes:
        interval: (P,) which two frames each pair is of.
        moments: (P, 9, 9) Σ (f₁ ⊗ f₂)(f₁ ⊗ f₂)ᵀ over the bearings f in the orientation of the body.
        R: (P, 3, 3) rotation from the second body to the first.
        by_bias: (P, 3, 3) its derivative by the bias.
        whitening: (P, 3, 3) makes the noise of Σ n nᵀ the same in all directions.
    """

    interval: NDArray[np.intp]
    moments: FloatArray
    R: FloatArray
    by_bias: FloatArray
    whitening: FloatArray


def estimate_gyro_bias(
    frames: list[FeatureFrame],
    intervals: Intervals,
    rig: RigProjection,
    near: FloatArray | None = None,
) -> FloatArray | None:
    """The constant gyroscope bias (3,) rad/s over some frames, None without enough features.

    Args:
        frames: in the order of time.
        intervals: IMU samples between each frame and the next.
        rig: mounting of the cameras.
        near: (3,) a bias to begin with; zero if not given.
    """
    bias = np.zeros(3) if near is None else near
    pairs = _pairs(frames, intervals, rig, bias)
    if pairs is None:
        return None
    for _ in range(_ROUNDS):  # the rotation is linearised in the bias: once more at the solution
        problem = _BiasProblem(pairs)
        damping = TenfoldDamping(1e-3, 1e6)
        levenberg_marquardt(problem, _MAX_STEPS, _converged, damping)
        bias = bias + problem.change
        if np.linalg.norm(problem.change) < _LINEAR_RAD_S:
            break
        rotations, by_bias = intervals.rotations(bias)
        pairs = replace(pairs, R=rotations[pairs.interval], by_bias=by_bias[pairs.interval])
    return bias


def _converged(attempt: Attempt) -> bool:
    """Whether a step is the last: little is gained, or was to be gained where it was refused."""
    gain = attempt.before - attempt.after if attempt.accepted else attempt.predicted
    return gain < _CONVERGED * attempt.before


class _BiasProblem:
    """The robust cost of all pairs as `levenberg_marquardt` takes it (see `DampedProblem`).

    Attributes:
        change: (3,) of the bias.
    """

    def __init__(self, pairs: _Pairs) -> None:
        self.change = np.zeros(3)
        self._pairs, self._loss = pairs, RobustLoss("huber", _ROBUST_WIDTH)
        self._planes = _Planes(self.change, pairs)

    def value(self) -> float:
        """The sum of the loss over the pairs."""
        return float(np.sum(self._loss.value(self._planes.distances)))

    def linearize(self) -> None:
        """Gradient and Hessian with the weights of the loss."""
        weights = self._loss.weights(self._planes.distances)[:, None]
        gradients, self._hessian, self._scale = self._planes.derivatives(weights)
        self._gradient = gradients.sum(axis=0)

    def solve(self, damping: float) -> float:
        """A damped Newton step; the decrease that it promises."""
        damped = self._hessian + damping * np.diag(self._scale)
        try:
            root = np.linalg.cholesky(damped)
        except np.linalg.LinAlgError:
            return math.inf  # not convex here
        self._step = -np.linalg.solve(damped, self._gradient)
        return 0.5 * float(np.sum((root.T @ self._step) ** 2))

    def apply(self) -> None:
        """Move the bias."""
        self._before = self.change, self._planes
        self.change = self.change + self._step
        self._planes = _Planes(self.change, self._pairs)

    def undo(self) -> None:
        """Move it back."""
        self.change, self._planes = self._before


class _Planes:
    """The plane of best fit to the normals of each pair, at a change of the bias.

    Attributes:
        squares: (P,) λ₀, the sum of the squared distances of the normals from the plane.
        distances: (P,) its root.
    """

    def __init__(self, change: FloatArray, pairs: _Pairs) -> None:
        R = pairs.R @ Rotation.from_rotvec(pairs.by_bias @ change).as_matrix()
        # n = Σ f₁ₐ [eₐ]ₓ R f₂
        of_products = (_CROSS @ R[:, None]).transpose(0, 2, 1, 3).reshape(-1, 3, 9)
        white = pairs.whitening @ of_products
        self._values, vectors = np.linalg.eigh(white @ pairs.moments @ white.transpose(0, 2, 1))
        self._pairs, self._along = pairs, vectors.transpose(0, 2, 1) @ white
        self.squares = np.maximum(self._values[:, 0], 0.0)
        self.distances = np.sqrt(self.squares)

    def derivatives(self, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of half the squared distances by the bias; exact at no change.

        With y, y₁ and y₂ the products (9,) that the normals' coordinates along the eigenvectors are
        linear in, λ₀ = yᵀ K y. A turn θ of the second body changes their rows by y × θ, and turns
        the plane, whose own change counts in the second order.

        Args:
            weights: (P, 1) of the pairs.

        Returns:
            Gradients (P, 3), the Hessian (3, 3), and the scales (3,) of its damping.
        """
        K, J, y = self._pairs.moments, self._pairs.by_bias, self._along
        by_turn = skew(y.reshape(-1, 3)).reshape(-1, 3, 9, 3)
        Ky = y @ K
        moved = by_turn.transpose(0, 1, 3, 2) @ Ky[:, 0, None, :, None]
        moved = moved[..., 0] + Ky @ by_turn[:, 0]  # (P, 3, 3): of y·Ky, y₁·Ky and y₂·Ky
        first = by_turn[:, 0].transpose(0, 2, 1) @ K @ by_turn[:, 0]
        outer = Ky[:, 0].reshape(-1, 3, 3).transpose(0, 2, 1) @ y[:, 0].reshape(-1, 3, 3)
        second = 0.5 * (outer + outer.transpose(0, 2, 1)) - self.squares[:, None, None] * np.eye(3)
        gaps = np.maximum(self._values[:, 1:] - self._values[:, :1], _TINY)[:, :, None]
        second -= moved[:, 1:].transpose(0, 2, 1) @ (moved[:, 1:] / gaps)
        across = J.transpose(0, 2, 1) * weights[:, :, None]
        gradients = (across @ (0.5 * moved[:, 0, :, None]))[..., 0]
        convex = np.sum(across @ first @ J, axis=0)
        return gradients, convex + np.sum(across @ second @ J, axis=0), np.diag(convex)


def _pairs(
    frames: list[FeatureFrame], intervals: Intervals, rig: RigProjection, bias: FloatArray
) -> _Pairs | None:
    rotations, derivatives = intervals.rotations(bias)
    turns = [rig.row_turns(k, frame) for k, frame in enumerate(frames)]
    which, moments, noise = [], [], []
    for k, R in enumerate(rotations):
        before, after = frames[k], frames[k + 1]
        for camera, (one, two) in enumerate(zip(before.cameras, after.cameras, strict=True)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) >= _MIN_COMMON:
                mounting = rig.body_R_camera[camera]
                first = _bearings(one, i, mounting, turns[k][camera])
                second = _bearings(two, j, mounting, turns[k + 1][camera])
                products = (first[:, :, None] * second[:, None, :]).reshape(-1, 9)
                moments.append(products.T @ products)
                noise.append(_noise(first, second @ R.T))
                which.append(k)
    if not which:
        return None
    interval = np.array(which)
    return _Pairs(
        interval,
        np.array(moments),
        rotations[interval],
        derivatives[interval],
        np.asarray(np.linalg.inv(np.linalg.cholesky(np.array(noise))), np.float64),
    )


def _noise(first: FloatArray, turned: FloatArray) -> FloatArray:
    """The covariance (3, 3) of the noise of the normals of a pair, on average, in σ².

    Noise σ perpendicular to the bearings adds σ² Σ (I - f₁ f₁ᵀ) + (I - R f₂ (R f₂)ᵀ) to Σ n nᵀ, the
    normals being n = f₁ × R f₂.

    Args:
        first: (N, 3) bearings.
        turned: (N, 3) R f₂, those of the same features in the second frame.
    """
    return np.asarray(
        2.0 * np.eye(3) - (first.T @ first + turned.T @ turned) / len(first), np.float64
    )


def _bearings(
    obs: FeatureObservations, rows: NDArray[np.intp], R: FloatArray, turns: FloatArray | None
) -> FloatArray:
    bearings = np.concatenate([obs.normalized[rows], np.ones((len(rows), 1))], axis=1)
    unit: FloatArray = (bearings / np.linalg.norm(bearings, axis=1, keepdims=True)) @ R.T
    return unit if turns is None else np.einsum("nij,nj->ni", turns[rows], unit)
