# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The gyroscope bias of a short window, from epipolar geometry alone.

With the right rotation all epipolar planes of two frames share the line of the translation. For a
pair of frames with relative rotation R, the normals n = f₁ × R f₂ of the epipolar planes are all
orthogonal to the translation, so the smallest eigenvalue of Σ n nᵀ vanishes (Kneip & Lynen 2013).
With R integrated from the gyroscope this is a cost in its bias only: no depth, velocity or gravity
is needed (He, Xu, Ouyang & Li 2023).

Noise increases that eigenvalue, but hardly for a translation along the optical axis. So the plain
smallest eigenvalue is biased towards rotations under which the camera seems to move straight ahead.
The eigenvalue relative to the part that noise adds is not (Kanatani 1996, renormalization).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData

_MIN_COMMON = 8
"""Pairs of frames with fewer common features than this are left out."""
_STEP_RAD_S = 1e-4
"""Step of the numerical derivative by the bias."""
_ROBUST_WIDTH = 0.02
"""Width of the robust loss on the whitened residual of a pair."""
_ROUNDS, _LINEAR_RAD_S = 2, 1e-3
"""How often the bias is estimated at most; a change below this needs no other linearisation."""
_CONVERGED = 1e-4
"""Relative change of the bias or the cost at which the steps end: some hundredths of its noise."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of frames with their common features.

    Attributes:
        pair: (N,) which pair each feature belongs to, ascending.
        starts: (P,) first feature of each pair.
        interval: (P,) which two frames each pair is of.
        first, second: (N, 3) bearings in the orientation of the body.
        R: (P, 3, 3) rotation from the second body to the first.
        by_bias: (P, 3, 3) its derivative by the bias.
        whitening: (P, 3, 3) makes the noise of Σ n nᵀ the same in all directions.
    """

    pair: NDArray[np.intp]
    starts: NDArray[np.intp]
    interval: NDArray[np.intp]
    first: FloatArray
    second: FloatArray
    R: FloatArray
    by_bias: FloatArray
    whitening: FloatArray


def estimate_gyro_bias(
    frames: list[FeatureFrame],
    imu: list[ImuData],
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
    near: FloatArray | None = None,
) -> FloatArray | None:
    """The constant gyroscope bias (3,) rad/s over some frames, None without enough features.

    Args:
        frames: in the order of time.
        imu: samples between each frame and the next.
        rig: mounting of the cameras.
        params: of the preintegration.
        near: (3,) a bias to begin with; zero if not given.
    """
    bias = np.zeros(3) if near is None else near
    pairs = _pairs(frames, imu, rig, params, bias)
    if pairs is None:
        return None
    for _ in range(_ROUNDS):  # the rotation is linearised in the bias: once more at the solution
        result = scipy.optimize.least_squares(
            _residuals,
            np.zeros(3),
            _jacobian,
            args=(pairs,),
            loss="huber",
            f_scale=_ROBUST_WIDTH,
            xtol=_CONVERGED,
            ftol=_CONVERGED,
        )
        bias = bias + result.x
        if np.linalg.norm(result.x) < _LINEAR_RAD_S:
            break
        rotations = np.array([_rotation(samples, bias, params) for samples in imu])
        pairs = replace(pairs, R=rotations[pairs.interval])
    return bias


def _residuals(change: FloatArray, pairs: _Pairs) -> FloatArray:
    """Distance (P,) of each pair's normals from the plane that fits them best."""
    return np.asarray(_Planes(change, pairs).distances)


def _jacobian(change: FloatArray, pairs: _Pairs) -> FloatArray:
    """Derivative (P, 3) of the distances; exact at zero, where their rotations are linearised.

    The plane is the best one, so that its own change does not count. For a normal a of it in the
    original space, the change of a · (f₁ × R f₂) by a turn θ of the second body is
    θ · (R f₂ × (a × f₁)).
    """
    planes = _Planes(change, pairs)
    a, first, turned = planes.normals[pairs.pair], pairs.first, planes.turned
    along = np.sum(first * turned, axis=1)[:, None] * a
    along -= np.sum(turned * a, axis=1)[:, None] * first
    offsets = np.sum(a * planes.crossed, axis=1)[:, None]
    by_turn = np.add.reduceat(offsets * along, pairs.starts)
    by_change = planes.R @ pairs.by_bias
    slopes = np.einsum("pi,pij->pj", by_turn, by_change)
    return np.asarray(slopes / np.maximum(planes.distances, 1e-12)[:, None])


class _Planes:
    """The plane of best fit to the normals of each pair.

    Attributes:
        R: (P, 3, 3) rotations from the second body to the first.
        turned: (N, 3) second bearings in the orientation of the first body.
        crossed: (N, 3) normals of the epipolar planes.
        distances: (P,) root of the sum of their squared distances from the plane.
        normals: (P, 3) what a normal is multiplied by for its distance.
    """

    def __init__(self, change: FloatArray, pairs: _Pairs) -> None:
        self.R = pairs.R @ Rotation.from_rotvec(pairs.by_bias @ change).as_matrix()
        f = pairs.first
        self.turned = g = np.einsum("nij,nj->ni", self.R[pairs.pair], pairs.second)
        self.crossed = np.empty_like(f)
        for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            self.crossed[:, axis] = f[:, i] * g[:, j] - f[:, j] * g[:, i]
        outer = self.crossed[:, :, None] * self.crossed[:, None, :]
        scatter = np.add.reduceat(outer, pairs.starts)
        white = pairs.whitening @ scatter @ pairs.whitening.transpose(0, 2, 1)
        values, vectors = np.linalg.eigh(white)
        self.distances = np.sqrt(np.maximum(values[:, 0], 0.0))
        self.normals = np.einsum("pij,pi->pj", pairs.whitening, vectors[:, :, 0])


def _pairs(
    frames: list[FeatureFrame],
    imu: list[ImuData],
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
    bias: FloatArray,
) -> _Pairs | None:
    first, second, rotations, derivatives, intervals = [], [], [], [], []
    turns = [rig.row_turns(k, frame) for k, frame in enumerate(frames)]
    for k, samples in enumerate(imu):
        before, after = frames[k], frames[k + 1]
        R, by_bias = _rotation_by_bias(samples, bias, params)
        for camera, (one, two) in enumerate(zip(before.cameras, after.cameras, strict=True)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) >= _MIN_COMMON:
                mounting = rig.body_R_camera[camera]
                first.append(_bearings(one, i, mounting, turns[k][camera]))
                second.append(_bearings(two, j, mounting, turns[k + 1][camera]))
                rotations.append(R)
                derivatives.append(by_bias)
                intervals.append(k)
    if not first:
        return None
    counts = np.array([len(bearings) for bearings in first])
    return _Pairs(
        np.repeat(np.arange(len(counts)), counts),
        np.cumsum(counts) - counts,
        np.array(intervals),
        np.concatenate(first),
        np.concatenate(second),
        np.array(rotations),
        np.array(derivatives),
        np.array([_whitening(*pair) for pair in zip(first, second, rotations, strict=True)]),
    )


def _whitening(first: FloatArray, second: FloatArray, R: FloatArray) -> FloatArray:
    """The matrix (3, 3) that whitens the noise of the normals of a pair, on average.

    Noise σ perpendicular to the bearings adds σ² Σ (I - f₁ f₁ᵀ) + (I - R f₂ (R f₂)ᵀ) to Σ n nᵀ, the
    normals being n = f₁ × R f₂.

    Args:
        first: (N, 3) bearings.
        second: (N, 3) those of the same features in the second frame.
        R: (3, 3) rotation from the second body to the first.
    """
    turned = second @ R.T
    noise = 2.0 * np.eye(3) - (first.T @ first + turned.T @ turned) / len(first)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(noise)))


def _rotation_by_bias(
    samples: ImuData, bias: FloatArray, params: gtsam.PreintegrationCombinedParams
) -> tuple[FloatArray, FloatArray]:
    """The rotation (3, 3) over some samples and its derivative (3, 3) by the gyroscope bias."""
    R = _rotation(samples, bias, params)
    moved = np.array([_rotation(samples, bias + step, params) for step in _STEP_RAD_S * np.eye(3)])
    return R, Rotation.from_matrix(R.T @ moved).as_rotvec().T / _STEP_RAD_S


def _rotation(
    samples: ImuData, gyro_bias: FloatArray, params: gtsam.PreintegrationCombinedParams
) -> FloatArray:
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
    return np.asarray(samples.preintegrated(bias, params).deltaRij().matrix())


def _bearings(
    obs: FeatureObservations, rows: NDArray[np.intp], R: FloatArray, turns: FloatArray | None
) -> FloatArray:
    bearings = np.concatenate([obs.normalized[rows], np.ones((len(rows), 1))], axis=1)
    unit: FloatArray = (bearings / np.linalg.norm(bearings, axis=1, keepdims=True)) @ R.T
    return unit if turns is None else np.einsum("nij,nj->ni", turns[rows], unit)
