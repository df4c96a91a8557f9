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

from slam_graph.arrays import FloatArray, IntArray, skew
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.robust_loss import RobustLoss
from slam_graph.backend.initialization.inertial_motion import Intervals
from slam_graph.backend.solve.damped_steps import Attempt, TenfoldDamping, levenberg_marquardt
from slam_graph.sensors import FeatureFrame

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
_NORMALS = skew(np.eye(3)).transpose(2, 1, 0)[:, None, :, :, None] * np.eye(3)[:, None, None, :]
_NORMALS = _NORMALS.reshape(9, 27)
"""Makes of rotations R, as rows (9,), the products (3, 9) with which n = A(R) (f₁ ⊗ f₂)."""
_CROSSES = np.kron(np.eye(3), skew(np.eye(3)).reshape(3, 9))
"""Makes of products y (9,) those (9, 3) by which a turn of the second body changes them."""


@dataclass(frozen=True, slots=True, eq=False)
class BearingPairs:
    """Features that two frames in a row have in common, of Q pairs of frames of a camera.

    Attributes:
        interval: (Q,) which two frames each pair is of.
        counts: (Q,) number of its features.
        ids: (N,) of the features of all pairs, one pair after the other.
        products: (N, 9) f₁ ⊗ f₂ of the bearings f in the orientation of the body.
    """

    interval: NDArray[np.intp]
    counts: IntArray
    ids: IntArray
    products: FloatArray

    @staticmethod
    def between(frames: list[FeatureFrame], rig: RigProjection) -> BearingPairs:
        """Those of frames in the order of time."""
        cameras = range(len(frames[0].cameras))
        seen = [_seen_by(camera, frames, rig) for camera in cameras]
        interval, ids, first, second = [], [], [], []
        for k in range(len(frames) - 1):
            for camera in cameras:
                (one, bearings_1), (two, bearings_2) = seen[camera][k : k + 2]
                places = np.minimum(two.searchsorted(one), max(len(two) - 1, 0))
                common = two.take(places) == one if len(two) else np.zeros(len(one), np.bool_)
                interval.append(k)
                ids.append(one[common])
                first.append(bearings_1[common])
                second.append(bearings_2[places[common]])
        bearings_1, bearings_2 = np.concatenate(first), np.concatenate(second)
        products = (bearings_1[:, :, None] * bearings_2[:, None, :]).reshape(-1, 9)
        counts = np.array([len(common) for common in ids])
        return BearingPairs(np.array(interval), counts, np.concatenate(ids), products)

    def only(self, ids: IntArray) -> BearingPairs:
        """Those of some features (ascending ids)."""
        rows = is_in(self.ids, ids)
        ends = np.append(0, rows.cumsum())[np.append(0, self.counts.cumsum())]
        return BearingPairs(self.interval, np.diff(ends), self.ids[rows], self.products[rows])

    def moments(self) -> tuple[NDArray[np.intp], FloatArray, IntArray]:
        """Of the P pairs with enough: interval (P,), Σ (f₁ ⊗ f₂)(f₁ ⊗ f₂)ᵀ, counts (P,)."""
        enough = self.counts >= _MIN_COMMON
        ends = self.counts.cumsum()
        rows = [self.products[e - n : e] for e, n in zip(ends, self.counts, strict=True)]
        moments = [part.T @ part for part, good in zip(rows, enough, strict=True) if good]
        return self.interval[enough], np.array(moments).reshape(-1, 9, 9), self.counts[enough]


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
    common: BearingPairs, intervals: Intervals, near: FloatArray | None = None
) -> FloatArray | None:
    """The constant gyroscope bias (3,) rad/s over some frames, None without enough features.

    Args:
        common: features in common between the frames.
        intervals: IMU samples between each frame and the next.
        near: (3,) a bias to begin with; zero if not given.
    """
    bias = np.zeros(3) if near is None else near
    pairs = _pairs(common, intervals, bias)
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
        weights = self._loss.weights(self._planes.distances)
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
        white = pairs.whitening @ (R.reshape(-1, 9) @ _NORMALS).reshape(-1, 3, 9)
        self._values, self._vectors = np.linalg.eigh(
            white @ pairs.moments @ white.transpose(0, 2, 1)
        )
        self._pairs, self._white = pairs, white
        self.squares = np.maximum(self._values[:, 0], 0.0)
        self.distances = np.sqrt(self.squares)

    def derivatives(self, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of half the squared distances by the bias; exact at no change.

        With y, y₁ and y₂ the products (9,) that the normals' coordinates along the eigenvectors are
        linear in, λ₀ = yᵀ K y. A turn θ of the second body changes their rows by y × θ, and turns
        the plane, whose own change counts in the second order.

        Args:
            weights: (P,) of the pairs.

        Returns:
            Gradients (P, 3), the Hessian (3, 3), and the scales (3,) of its damping.
        """
        K, J, y = self._pairs.moments, self._pairs.by_bias, self._vectors.mT @ self._white
        by_turn = (y @ _CROSSES).reshape(-1, 3, 9, 3)
        Ky, by_first = y @ K, by_turn[:, 0]
        # (P, 3, 3): of y·Ky, y₁·Ky and y₂·Ky
        moved = (Ky[:, :1, None] @ by_turn)[:, :, 0] + Ky @ by_first
        first = by_first.mT @ (K @ by_first)
        outer = Ky[:, 0].reshape(-1, 3, 3).mT @ y[:, 0].reshape(-1, 3, 3)
        second = first + 0.5 * (outer + outer.mT) - self.squares[:, None, None] * np.eye(3)
        gaps = np.maximum(self._values[:, 1:] - self._values[:, :1], _TINY)[:, :, None]
        second -= moved[:, 1:].mT @ (moved[:, 1:] / gaps)
        across = (J * weights[:, None, None]).mT
        gradients = (moved[:, :1] @ J)[:, 0] * (0.5 * weights[:, None])
        convex = np.einsum("pik,pki->i", across, first @ J)
        return gradients, (across @ (second @ J)).sum(axis=0), convex


def _pairs(common: BearingPairs, intervals: Intervals, bias: FloatArray) -> _Pairs | None:
    interval, moments, counts = common.moments()
    if not len(interval):
        return None
    rotations, derivatives = intervals.rotations(bias)
    R, by_bias = rotations[interval], derivatives[interval]
    noise = _noise(moments, R, counts)
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(noise)), np.float64)
    return _Pairs(interval, moments, R, by_bias, whitening)


def _noise(moments: FloatArray, R: FloatArray, counts: IntArray) -> FloatArray:
    """The covariances (P, 3, 3) of the noise of the normals of pairs, on average, in σ².

    Noise σ perpendicular to the bearings adds σ² Σ (I - f₁ f₁ᵀ) + (I - R f₂ (R f₂)ᵀ) to Σ n nᵀ, the
    normals being n = f₁ × R f₂.

    Args:
        moments: (P, 9, 9) Σ (f₁ ⊗ f₂)(f₁ ⊗ f₂)ᵀ.
        R: (P, 3, 3) rotation from the second body to the first.
        counts: (P,) number of features.
    """
    of_both = moments.reshape(-1, 3, 3, 3, 3)  # bearings have the length 1
    first, second = np.einsum("pabcb->pac", of_both), np.einsum("pabac->pbc", of_both)
    outer = first + R @ second @ R.mT
    return np.asarray(2.0 * np.eye(3) - outer / counts[:, None, None], np.float64)


def _seen_by(
    camera: int, frames: list[FeatureFrame], rig: RigProjection
) -> list[tuple[IntArray, FloatArray]]:
    """Ids (N,), ascending, and bearings (N, 3) in the body, of each frame of a camera."""
    seen = [frame.cameras[camera] for frame in frames]
    orders = [obs.ids.argsort() for obs in seen]
    rays = np.ones((sum(len(obs) for obs in seen), 3))
    rays[:, :2] = np.concatenate([o.normalized[rows] for o, rows in zip(seen, orders, strict=True)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    bearings = np.split(rays @ rig.body_R_camera[camera].T, np.cumsum([len(o) for o in seen])[:-1])
    if rig.rolling:
        for k, (frame, rows) in enumerate(zip(frames, orders, strict=True)):
            turns = rig.row_turns(k, frame)[camera]
            assert turns is not None
            bearings[k] = np.einsum("nij,nj->ni", turns[rows], bearings[k])
    ids = [obs.ids[rows] for obs, rows in zip(seen, orders, strict=True)]
    return list(zip(ids, bearings, strict=True))
