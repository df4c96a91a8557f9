# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The NumPy form of `epipolar_rotation.py`: its specification."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import lapack
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray, median, skew
from slam_graph.kernels.epipolar_rotation import (
    CAUCHY_WIDTH,
    CONVERGED_RAD,
    DAMPING,
    FLOOR_RAD,
    MAX_STEP_RAD,
    MEDIAN,
    REWEIGHTINGS,
    STEPS,
    TINY,
    WEAK,
)

__all__ = ["find_directions_numpy", "refine_rotation_numpy"]

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
"""The axes after each axis, and before it."""


def refine_rotation_numpy(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    R: FloatArray,
    information: FloatArray,
) -> float:
    """`refine_rotation` in NumPy."""
    try:
        cost, R[:], information[:] = _refined(first, second, variances, R)
    except np.linalg.LinAlgError:
        cost = np.inf
    return cost


def find_directions_numpy(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    begins: IntArray,
    R: FloatArray,
    t: FloatArray,
) -> None:
    """`find_directions` in NumPy."""
    for p in range(len(R)):
        rows = slice(int(begins[p]), int(begins[p + 1]))
        pair = _Pair(first[rows], second[rows], variances[rows], R[p])
        try:
            t[p] = pair.first_direction(TINY)
        except np.linalg.LinAlgError:
            t[p] = np.nan


def _refined(
    first: FloatArray, second: FloatArray, variances: FloatArray, R: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Robust cost, rotation and information from a start R."""
    pair = _Pair(first, second, variances, R)
    t = pair.first_direction()
    H, of_t, cost = np.zeros((5, 5)), np.eye(2), np.inf
    for _ in range(STEPS):
        e, sigma = pair.residuals(t)
        squares = (e / (CAUCHY_WIDTH * sigma)) ** 2
        cost = float(np.sum(np.log1p(squares)))
        weights = _weights(squares)
        scale = np.sqrt(weights) / sigma
        white = pair.jacobian(t) * scale
        H = white @ white.T
        damped = H + (DAMPING * np.trace(H) + TINY) * np.eye(5)
        step = -np.linalg.solve(damped, white @ (scale * e))[:3]
        length = math.sqrt(step @ step)
        step *= min(1.0, MAX_STEP_RAD / max(length, TINY))
        R = R @ Rotation.from_rotvec(step).as_matrix()
        pair.turn(R)
        t, of_t = pair.direction(weights)
        if length < CONVERGED_RAD:
            break
    information = H[:3, :3] - H[:3, 3:] @ np.linalg.solve(of_t, H[3:, :3])
    return cost, R, _believable(information)


def _weights(squares: FloatArray) -> FloatArray:
    """Cauchy weights (N,) of squared residuals (N,) in units of the width.

    Far from the solution all residuals are large, and none is an outlier.
    """
    return np.asarray(1.0 / (1.0 + squares / max(1.0, float(median(squares)) / MEDIAN)))


def _believable(information: FloatArray) -> FloatArray:
    """The information (3, 3) without negative eigenvalues, and not above that of `FLOOR_RAD`."""
    values, vectors = np.linalg.eigh(information)
    variances = 1.0 / np.maximum(values, 1.0) + FLOOR_RAD**2
    return np.asarray((vectors / variances) @ vectors.T)


class _Pair:
    """The bearings of two frames under a rotation between them.

    Vectors are columns here, in which NumPy takes half the time for the few that there are.

    Attributes:
        normals: (3, N) f₁ × R f₂ of the epipolar planes.
    """

    def __init__(
        self, first: FloatArray, second: FloatArray, variances: FloatArray, R: FloatArray
    ) -> None:
        """Turn the second bearings (N, 3); `variances` (N, 2) of both, rad²."""
        self._first, self._second = np.ascontiguousarray(first.T), np.ascontiguousarray(second.T)
        self._variances = np.ascontiguousarray(variances.T)
        self.turn(R)

    def turn(self, R: FloatArray) -> None:
        """Take another rotation (3, 3)."""
        self._R, self._turned = R, R @ self._second
        self.normals = _cross(self._first, self._turned)

    def first_direction(self, damping: float = 0.0) -> FloatArray:
        """The direction (3,) by normals of one length, found again without wrong matches.

        Arguments and errors are those of `direction`.
        """
        # normals of one length first: those of wrong matches are the longest
        weights = 1.0 / np.maximum(np.sum(self.normals**2, axis=0), TINY)
        t, _ = self.direction(weights, damping)
        for _ in range(REWEIGHTINGS):
            e, sigma = self.residuals(t)
            weights = _weights((e / (CAUCHY_WIDTH * sigma)) ** 2)
            t, _ = self.direction(weights / sigma**2, damping)
        return t

    def direction(self, weights: FloatArray, damping: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """The direction (3,) most orthogonal to the normals, and its information (2, 2).

        Both relative to what noise adds to the normals (Kanatani 1996, renormalization): where the
        parallax is below the noise, all directions are alike.

        Args:
            weights: (N,).
            damping: part of all noise that is added in each direction.

        Raises:
            numpy.linalg.LinAlgError: if there is no noise in some direction.
        """
        first, turned = self._first, self._turned
        scatter = (self.normals * weights) @ self.normals.T
        of_first, of_second = noises = weights * self._variances
        noise = (1.0 + damping) * float(noises.sum()) * np.eye(3)
        noise -= (first * of_second) @ first.T + (turned * of_first) @ turned.T
        values, vectors, info = lapack.dsygv(scatter, noise)
        if info != 0:
            raise np.linalg.LinAlgError("the noise of the normals is singular")
        t = vectors[:, 0] / math.sqrt(vectors[:, 0] @ vectors[:, 0])
        across = _tangent(t)
        per_variance = float(weights.sum()) / float(t @ noise @ t)
        known = across @ (scatter - values[0] * noise) @ across.T * per_variance
        return t, known + WEAK * np.eye(2)

    def residuals(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The e (N,) of a direction t (3,), and its σ (N,)."""
        of_first, of_second = self._variances
        variance = of_first * (1.0 - (t @ self._turned) ** 2)
        variance += of_second * (1.0 - (t @ self._first) ** 2)
        return t @ self.normals, np.sqrt(np.maximum(variance, TINY**2))

    def jacobian(self, t: FloatArray) -> FloatArray:
        """The derivative (5, N) of e by R ⊕ δ and t ⊕ ε on the sphere."""
        across = (self._R.T @ skew(t)) @ self._first
        return np.concatenate([_cross(self._second, across), _tangent(t) @ self.normals])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (3, N) of vectors (3, N), in a third of the time of `numpy.cross`."""
    return np.asarray(a[_NEXT] * b[_LAST] - a[_LAST] * b[_NEXT])


def _tangent(t: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) orthogonal to a unit vector (3,) and to each other.

    Those of Householder's reflection to the first axis, which are the same for t and -t.
    """
    x, y, z = t.tolist()
    sign, scale = math.copysign(1.0, x), 1.0 / (1.0 + abs(x))
    mixed = -y * z * scale
    return np.array(
        [[-sign * y, 1.0 - y * y * scale, mixed], [-sign * z, mixed, 1.0 - z * z * scale]]
    )
