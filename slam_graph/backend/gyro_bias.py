# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope bias from images alone: the rotation that makes epipolar planes meet in one line.

For a pair of frames with relative rotation R, the normals n = f₁ × R f₂ of the epipolar planes are
all orthogonal to the translation, so the smallest eigenvalue of Σ n nᵀ vanishes (Kneip & Lynen
2013). With R integrated from the gyroscope this is a cost in its bias only: no depth, velocity or
gravity is needed (He, Xu, Ouyang & Li 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from slam_graph.backend.imu import preintegrate
from slam_graph.backend.reprojection import RigProjection
from slam_graph.sensors.measurements import FeatureFrame, FeatureObservations, ImuData

FloatArray = NDArray[np.float64]

MIN_COMMON = 8
"""Fewer common features than this say nothing about the rotation of a pair."""
STEP_RAD_S = 1e-4
"""Step of the numerical derivative by the bias."""
ROBUST_WIDTH = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """A pair of frames: bearings (N, 3) in the body's orientation, and the rotation between."""

    first: FloatArray
    second: FloatArray
    R: FloatArray
    by_bias: FloatArray


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
        if not pairs:
            return None
        result = least_squares(
            _residuals, np.zeros(3), args=(pairs,), loss="huber", f_scale=ROBUST_WIDTH
        )
        bias = bias + result.x
    return bias


def _residuals(change: FloatArray, pairs: list[_Pair]) -> FloatArray:
    """Root mean squared distance of each pair's normals from the plane that fits them best."""
    errors = np.empty(len(pairs))
    for k, pair in enumerate(pairs):
        R = pair.R @ Rotation.from_rotvec(pair.by_bias @ change).as_matrix()
        normals = np.cross(pair.first, pair.second @ R.T)
        errors[k] = np.sqrt(max(np.linalg.eigvalsh(normals.T @ normals)[0], 0.0))
    return errors


def _pairs(
    frames: list[FeatureFrame],
    imu: list[ImuData],
    rig: RigProjection,
    params: gtsam.PreintegrationCombinedParams,
    bias: FloatArray,
) -> list[_Pair]:
    pairs = []
    for before, after, samples in zip(frames[:-1], frames[1:], imu, strict=True):
        R = _rotation(samples, bias, params)
        by_bias = np.empty((3, 3))
        for axis in range(3):
            moved = _rotation(samples, bias + STEP_RAD_S * np.eye(3)[axis], params)
            by_bias[:, axis] = Rotation.from_matrix(R.T @ moved).as_rotvec() / STEP_RAD_S
        for camera, (one, two) in enumerate(zip(before.cameras, after.cameras, strict=True)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) >= MIN_COMMON:
                mounting = rig.body_R_camera[camera]
                pairs.append(
                    _Pair(_bearings(one, i, mounting), _bearings(two, j, mounting), R, by_bias)
                )
    return pairs


def _rotation(
    samples: ImuData, gyro_bias: FloatArray, params: gtsam.PreintegrationCombinedParams
) -> FloatArray:
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
    return np.asarray(preintegrate(samples, bias, params).deltaRij().matrix())


def _bearings(obs: FeatureObservations, rows: NDArray[np.intp], R: FloatArray) -> FloatArray:
    bearings = np.concatenate([obs.normalized[rows], np.ones((len(rows), 1))], axis=1)
    return (bearings / np.linalg.norm(bearings, axis=1, keepdims=True)) @ R.T
