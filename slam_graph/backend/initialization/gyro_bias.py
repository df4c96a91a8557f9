# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope bias from epipolar geometry: rotations for which the epipolar planes share one line.

For a pair of frames with relative rotation R, the normals n = f₁ × R f₂ of the epipolar planes are
all orthogonal to the translation, so the smallest eigenvalue of Σ n nᵀ vanishes (Kneip & Lynen
2013). With R integrated from the gyroscope this is a cost in its bias only: no depth, velocity or
gravity is needed (He, Xu, Ouyang & Li 2023).

Noise increases that eigenvalue, but hardly for a translation along the optical axis. So the plain
smallest eigenvalue is biased towards rotations under which the camera seems to move straight ahead.
The eigenvalue relative to the part that noise adds is not (Kanatani 1996, renormalization).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.sensors import FeatureFrame, FeatureObservations, ImuData, preintegrate

_MIN_COMMON = 8
"""Pairs of frames with fewer common features than this are left out."""
_STEP_RAD_S = 1e-4
"""Step of the numerical derivative by the bias."""
_ROBUST_WIDTH = 0.02
"""Width of the robust loss on the whitened residual of a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of frames with their common features.

    Attributes:
        pair: (N,) which pair each feature belongs to, ascending.
        starts: (P,) first feature of each pair.
        first, second: (N, 3) bearings in the orientation of the body.
        R: (P, 3, 3) rotation from the second body to the first.
        by_bias: (P, 3, 3) its derivative by the bias.
        whitening: (P, 3, 3) makes the noise of Σ n nᵀ the same in all directions.
    """

    pair: NDArray[np.intp]
    starts: NDArray[np.intp]
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
) -> FloatArray | None:
    """The constant gyroscope bias (3,) rad/s over some frames, None without enough features.

    Args:
        frames: in the order of time.
        imu: samples between each frame and the next.
        rig: mounting of the cameras.
        params: of the preintegration.
    """
    bias = np.zeros(3)
    for _ in range(2):  # the rotation is linearised in the bias: once more at the solution
        pairs = _pairs(frames, imu, rig, params, bias)
        if pairs is None:
            return None
        result = least_squares(
            _residuals, np.zeros(3), args=(pairs,), loss="huber", f_scale=_ROBUST_WIDTH
        )
        bias = bias + result.x
    return bias


def _residuals(change: FloatArray, pairs: _Pairs) -> FloatArray:
    """Distance (P,) of each pair's normals from the plane that fits them best."""
    R = pairs.R @ Rotation.from_rotvec(pairs.by_bias @ change).as_matrix()
    normals = np.cross(pairs.first, np.einsum("nij,nj->ni", R[pairs.pair], pairs.second))
    scatter = np.add.reduceat(normals[:, :, None] * normals[:, None, :], pairs.starts)
    white = pairs.whitening @ scatter @ pairs.whitening.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(white)[:, 0], 0.0)))


def _pairs(
    frames: list[FeatureFrame],
    imu: list[ImuData],
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
    bias: FloatArray,
) -> _Pairs | None:
    first, second, rotations, derivatives = [], [], [], []
    for before, after, samples in zip(frames[:-1], frames[1:], imu, strict=True):
        R, by_bias = _rotation_by_bias(samples, bias, params)
        for camera, (one, two) in enumerate(zip(before.cameras, after.cameras, strict=True)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) >= _MIN_COMMON:
                mounting = rig.body_R_camera[camera]
                first.append(_bearings(one, i, mounting))
                second.append(_bearings(two, j, mounting))
                rotations.append(R)
                derivatives.append(by_bias)
    if not first:
        return None
    counts = np.array([len(bearings) for bearings in first])
    return _Pairs(
        np.repeat(np.arange(len(counts)), counts),
        np.cumsum(counts) - counts,
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
    return np.asarray(preintegrate(samples, bias, params).deltaRij().matrix())


def _bearings(obs: FeatureObservations, rows: NDArray[np.intp], R: FloatArray) -> FloatArray:
    bearings = np.concatenate([obs.normalized[rows], np.ones((len(rows), 1))], axis=1)
    unit: FloatArray = (bearings / np.linalg.norm(bearings, axis=1, keepdims=True)) @ R.T
    return unit
