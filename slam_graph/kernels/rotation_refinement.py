# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rotation between two sets of bearings, by Gauss-Newton on the epipolar constraint.

The error e = t · (f₁ × R f₂) of each pair of bearings is divided by its standard deviation, with
Cauchy weights (`backend/initialization/visual_rotation.py` says what for). The direction t is the
least of a generalised eigenvalue problem at each rotation (Kanatani 1996, renormalization).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, median
from slam_graph.kernels.compilation import compiled

__all__ = ["refine_rotation", "refine_rotation_numpy"]

_STEPS = 10
"""Most Gauss-Newton steps."""
_CONVERGED_RAD = 1e-5
"""A smaller step of the rotation is the last."""
_CAUCHY_WIDTH = 2.4
"""Residual with half the weight, in units of the noise."""
_MEDIAN = 0.455 / _CAUCHY_WIDTH**2
"""Median of the squared residuals if they are noise, in units of the width."""
_REWEIGHTINGS = 3
"""How often the first direction is found again without wrong matches."""
_MAX_STEP_RAD = 0.1
"""Longest step of the rotation."""
_WEAK = 1e-3
"""Information on the direction where the parallax shows none."""
_TINY = 1e-12
"""Keeps divisions finite."""
_DAMPING = 1e-6
"""Of a step, relative to the trace of its information."""
_SWEEPS = 30  # of Jacobi's rotations at most; they converge in five


@compiled()
def _turn(
    R: FloatArray, first: FloatArray, second: FloatArray, turned: FloatArray, normals: FloatArray
) -> None:
    """R f₂ and f₁ × R f₂ of all pairs."""
    for n in range(len(first)):
        for a in range(3):
            turned[n, a] = R[a, 0] * second[n, 0] + R[a, 1] * second[n, 1] + R[a, 2] * second[n, 2]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            normals[n, a] = first[n, b] * turned[n, c] - first[n, c] * turned[n, b]


@compiled()
def _least_axis(M: FloatArray, axes: FloatArray) -> int:
    """Eigenvectors of a symmetric (3, 3) matrix by Jacobi's rotations, and which is the least."""
    for a in range(3):
        for b in range(3):
            axes[a, b] = 1.0 if a == b else 0.0
    for _ in range(_SWEEPS):
        off = abs(M[0, 1]) + abs(M[0, 2]) + abs(M[1, 2])
        if not off > 1e-18 * (abs(M[0, 0]) + abs(M[1, 1]) + abs(M[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if M[p, q] == 0.0:
                    continue
                theta = 0.5 * (M[q, q] - M[p, p]) / M[p, q]
                tangent = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                c = 1.0 / math.sqrt(tangent * tangent + 1.0)
                s = tangent * c
                for k in range(3):
                    x, y = M[k, p], M[k, q]
                    M[k, p], M[k, q] = c * x - s * y, s * x + c * y
                    x, y = axes[k, p], axes[k, q]
                    axes[k, p], axes[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = M[p, k], M[q, k]
                    M[p, k], M[q, k] = c * x - s * y, s * x + c * y
    least = 0
    for a in range(1, 3):
        if M[a, a] < M[least, least]:
            least = a
    return least


@compiled()
def _across(t: FloatArray, across: FloatArray) -> None:
    """Two unit vectors (2, 3) orthogonal to a unit vector (3,) and to each other.

    Those of Householder's reflection to the first axis, which are the same for t and -t.
    """
    x, y, z = t[0], t[1], t[2]
    sign, scale = math.copysign(1.0, x), 1.0 / (1.0 + abs(x))
    across[0, 0], across[0, 1], across[0, 2] = -sign * y, 1.0 - y * y * scale, -y * z * scale
    across[1, 0], across[1, 1], across[1, 2] = -sign * z, -y * z * scale, 1.0 - z * z * scale


@compiled()
def _direction(
    first: FloatArray,
    turned: FloatArray,
    normals: FloatArray,
    variances: FloatArray,
    weights: FloatArray,
    t: FloatArray,
    across: FloatArray,
    known: FloatArray,
) -> None:
    """The direction (3,) most orthogonal to the normals, its tangents, and its information (2, 2).

    Relative to what noise adds to the normals: below it, all directions are alike.
    """
    scatter, noise, total = np.zeros((3, 3)), np.zeros((3, 3)), 0.0
    for n in range(len(first)):
        of_first, of_second = weights[n] * variances[n, 0], weights[n] * variances[n, 1]
        total += weights[n]
        for a in range(3):
            noise[a, a] += of_first + of_second
            for b in range(3):
                scatter[a, b] += weights[n] * normals[n, a] * normals[n, b]
                noise[a, b] -= of_second * first[n, a] * first[n, b]
                noise[a, b] -= of_first * turned[n, a] * turned[n, b]
    # W noise Wᵀ = I, W the inverse of the lower triangular root
    l00 = math.sqrt(noise[0, 0])
    l10, l20 = noise[1, 0] / l00, noise[2, 0] / l00
    l11 = math.sqrt(noise[1, 1] - l10 * l10)
    l21 = (noise[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(noise[2, 2] - l20 * l20 - l21 * l21)
    W = np.zeros((3, 3))
    W[0, 0], W[1, 1], W[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    W[1, 0] = -l10 * W[0, 0] * W[1, 1]
    W[2, 1] = -l21 * W[1, 1] * W[2, 2]
    W[2, 0] = -(l20 * W[0, 0] + l21 * W[1, 0]) * W[2, 2]
    white, axes = np.zeros((3, 3)), np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            for c in range(3):
                for d in range(3):
                    white[a, b] += W[a, c] * scatter[c, d] * W[b, d]
    least = _least_axis(white, axes)
    length = 0.0
    for a in range(3):
        t[a] = W[0, a] * axes[0, least] + W[1, a] * axes[1, least] + W[2, a] * axes[2, least]
        length += t[a] * t[a]
    for a in range(3):
        t[a] /= math.sqrt(length)
    _across(t, across)
    per_variance = 0.0
    for a in range(3):
        for b in range(3):
            per_variance += t[a] * noise[a, b] * t[b]
    per_variance = total / per_variance
    for i in range(2):
        for j in range(2):
            known[i, j] = _WEAK if i == j else 0.0
            for a in range(3):
                for b in range(3):
                    part = scatter[a, b] - white[least, least] * noise[a, b]
                    known[i, j] += across[i, a] * part * across[j, b] * per_variance


@compiled()
def _middle(values: FloatArray) -> float:
    """The median of N values, which are sorted in place; Numba's own takes a second to compile."""
    N, gap = len(values), len(values) // 2
    while gap > 0:
        for n in range(gap, N):
            value, k = values[n], n
            while k >= gap and values[k - gap] > value:
                values[k] = values[k - gap]
                k -= gap
            values[k] = value
        gap //= 2
    return 0.5 * float(values[(N - 1) // 2] + values[N // 2])


@compiled()
def _residuals(
    first: FloatArray,
    turned: FloatArray,
    normals: FloatArray,
    variances: FloatArray,
    t: FloatArray,
    e: FloatArray,
    sigma: FloatArray,
    weights: FloatArray,
) -> float:
    """The e (N,) of a direction (3,), their σ (N,) and weights (N,); the robust cost."""
    squares = np.empty(len(e))
    for n in range(len(e)):
        e[n] = normals[n, 0] * t[0] + normals[n, 1] * t[1] + normals[n, 2] * t[2]
        one = turned[n, 0] * t[0] + turned[n, 1] * t[1] + turned[n, 2] * t[2]
        two = first[n, 0] * t[0] + first[n, 1] * t[1] + first[n, 2] * t[2]
        variance = variances[n, 0] * (1.0 - one * one) + variances[n, 1] * (1.0 - two * two)
        sigma[n] = math.sqrt(max(variance, _TINY * _TINY))
        squares[n] = (e[n] / (_CAUCHY_WIDTH * sigma[n])) ** 2
    scale, cost = max(1.0, _middle(squares.copy()) / _MEDIAN), 0.0
    for n in range(len(e)):
        cost += math.log1p(squares[n])
        weights[n] = 1.0 / (1.0 + squares[n] / scale)
    return cost


@compiled()
def _step(H: FloatArray, descent: FloatArray) -> None:
    """The damped step (5,) along a descent (5,), in its place, by Cholesky."""
    L, trace = np.zeros((5, 5)), 0.0
    for a in range(5):
        trace += H[a, a]
    for a in range(5):
        for b in range(a + 1):
            rest = H[a, b] + (_DAMPING * trace + _TINY if a == b else 0.0)
            for k in range(b):
                rest -= L[a, k] * L[b, k]
            L[a, b] = math.sqrt(rest) if a == b else rest / L[b, b]
    for a in range(5):
        for k in range(a):
            descent[a] -= L[a, k] * descent[k]
        descent[a] /= L[a, a]
    for a in range(4, -1, -1):
        for k in range(a + 1, 5):
            descent[a] -= L[k, a] * descent[k]
        descent[a] /= L[a, a]


@compiled()
def _rotate(R: FloatArray, step: FloatArray) -> float:
    """R ⊕ step, not longer than `_MAX_STEP_RAD`; the length of the step before."""
    length = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    shorter = min(1.0, _MAX_STEP_RAD / max(length, _TINY))
    x, y, z, angle = shorter * step[0], shorter * step[1], shorter * step[2], shorter * length
    half = 0.5 * angle
    # sin θ / θ and (1 - cos θ) / θ²
    s = math.sin(angle) / angle if angle > 0.0 else 1.0
    c = 0.5 * (math.sin(half) / half) ** 2 if half > 0.0 else 0.5
    turn, v = np.empty((3, 3)), (x, y, z)
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        turn[a, a] = 1.0 - c * (v[b] * v[b] + v[d] * v[d])
        turn[a, b], turn[b, a] = c * v[a] * v[b] - s * v[d], c * v[a] * v[b] + s * v[d]
    for a in range(3):
        x, y, z = R[a, 0], R[a, 1], R[a, 2]
        for b in range(3):
            R[a, b] = x * turn[0, b] + y * turn[1, b] + z * turn[2, b]
    return length


@compiled("f8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def refine_rotation(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    R: FloatArray,
    H: FloatArray,
    known: FloatArray,
) -> float:
    """Refine a rotation.

    Args:
        first: (N, 3) unit bearings in the first frame, N at least one.
        second: (N, 3) in the second one.
        variances: (N, 2) of both, rad².
        R: (3, 3) first_R_second near the right one; changed.
        H: (5, 5), filled: information on the rotation, by R ⊕ δ, and the direction.
        known: (2, 2), filled: information on the direction, above that of noise.

    Returns:
        The robust cost; not finite where the bearings determine nothing.
    """
    N = len(first)
    turned, normals, weights = np.empty((N, 3)), np.empty((N, 3)), np.empty(N)
    e, sigma, of_normals = np.empty(N), np.empty(N), np.empty(N)
    t, across, descent, row = np.empty(3), np.empty((2, 3)), np.empty(5), np.empty(5)
    _turn(R, first, second, turned, normals)
    # normals of one length first: those of wrong matches are the longest
    for n in range(N):
        squares = normals[n, 0] ** 2 + normals[n, 1] ** 2 + normals[n, 2] ** 2
        of_normals[n] = 1.0 / max(squares, _TINY)
    cost, converged = np.inf, False
    for turn in range(_REWEIGHTINGS + _STEPS + 1):
        _direction(first, turned, normals, variances, of_normals, t, across, known)
        if converged or turn == _REWEIGHTINGS + _STEPS:
            break
        cost = _residuals(first, turned, normals, variances, t, e, sigma, weights)
        if turn < _REWEIGHTINGS:
            for n in range(N):
                of_normals[n] = weights[n] / sigma[n] ** 2
            continue
        for a in range(5):
            descent[a] = 0.0
            for b in range(5):
                H[a, b] = 0.0
        for n in range(N):
            for a in range(3):  # t × f₁, in the second frame
                row[a] = 0.0
                for b in range(3):
                    c, d = (b + 1) % 3, (b + 2) % 3
                    row[a] += (t[c] * first[n, d] - t[d] * first[n, c]) * R[b, a]
            x, y, z = row[0], row[1], row[2]
            row[0] = second[n, 1] * z - second[n, 2] * y
            row[1] = second[n, 2] * x - second[n, 0] * z
            row[2] = second[n, 0] * y - second[n, 1] * x
            for i in range(2):
                row[3 + i] = 0.0
                for a in range(3):
                    row[3 + i] += normals[n, a] * across[i, a]
            weight = weights[n] / sigma[n] ** 2
            for a in range(5):
                descent[a] -= weight * row[a] * e[n]
                for b in range(5):
                    H[a, b] += weight * row[a] * row[b]
        _step(H, descent)
        converged = _rotate(R, descent) < _CONVERGED_RAD
        _turn(R, first, second, turned, normals)
        for n in range(N):
            of_normals[n] = weights[n]
    return cost if math.isfinite(R[0, 0]) else np.inf


def refine_rotation_numpy(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    R: FloatArray,
    H: FloatArray,
    known: FloatArray,
) -> float:
    """`refine_rotation` in NumPy."""
    pair = _Pair(first, second, variances, R)
    weights = 1.0 / np.maximum(np.sum(pair.normals**2, axis=1), _TINY)
    t, known[:] = pair.direction(weights)
    for _ in range(_REWEIGHTINGS):
        e, sigma = pair.residuals(t)
        weights = _cauchy((e / (_CAUCHY_WIDTH * sigma)) ** 2)
        t, known[:] = pair.direction(weights / sigma**2)
    cost = np.inf
    for _ in range(_STEPS):
        e, sigma = pair.residuals(t)
        squares = (e / (_CAUCHY_WIDTH * sigma)) ** 2
        cost = float(np.sum(np.log1p(squares)))
        weights = _cauchy(squares)
        white = pair.jacobian(t) * (np.sqrt(weights) / sigma)[:, None]
        H[:] = white.T @ white
        damped = H + (_DAMPING * np.trace(H) + _TINY) * np.eye(5)
        step = -np.linalg.solve(damped, white.T @ (np.sqrt(weights) * e / sigma))[:3]
        length = float(np.linalg.norm(step))
        step *= min(1.0, _MAX_STEP_RAD / max(length, _TINY))
        R[:] = R @ Rotation.from_rotvec(step).as_matrix()
        pair = _Pair(first, second, variances, R)
        t, known[:] = pair.direction(weights)
        if length < _CONVERGED_RAD:
            break
    return cost


def _cauchy(squares: FloatArray) -> FloatArray:
    """Weights (N,) of squares (N,); far from the solution all are large, and none an outlier."""
    return np.asarray(1.0 / (1.0 + squares / max(1.0, float(median(squares)) / _MEDIAN)))


class _Pair:
    """The bearings (N, 3) of two frames under a rotation between them, with normals f₁ × R f₂."""

    def __init__(
        self, first: FloatArray, second: FloatArray, variances: FloatArray, R: FloatArray
    ) -> None:
        self._first, self._second, self._R, self._variances = first, second, R, variances
        self._turned = second @ R.T
        self.normals = np.cross(first, self._turned)

    def direction(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction (3,), and its information (2, 2)."""
        first, turned = self._first, self._turned
        scatter = (self.normals * weights[:, None]).T @ self.normals
        of_first, of_second = weights * self._variances.T
        noise = np.sum(of_first + of_second) * np.eye(3)
        noise -= (first * of_second[:, None]).T @ first + (turned * of_first[:, None]).T @ turned
        whitening = np.linalg.inv(np.linalg.cholesky(noise))
        values, vectors = np.linalg.eigh(whitening @ scatter @ whitening.T)
        t = whitening.T @ vectors[:, 0]
        t /= np.linalg.norm(t)
        _across(t, across := np.empty((2, 3)))
        per_variance = np.sum(weights) / float(t @ noise @ t)
        information = across @ (scatter - values[0] * noise) @ across.T * per_variance
        return t, information + _WEAK * np.eye(2)

    def residuals(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The e (N,) of a direction t (3,), and its σ (N,)."""
        along = np.column_stack([self._turned @ t, self._first @ t])
        variance = np.sum(self._variances * (1.0 - along**2), axis=1)
        return self.normals @ t, np.sqrt(np.maximum(variance, _TINY**2))

    def jacobian(self, t: FloatArray) -> FloatArray:
        """The derivative (N, 5) of e by R ⊕ δ and t ⊕ ε on the sphere."""
        _across(t, across := np.empty((2, 3)))
        by_turn = np.cross(self._second, np.cross(t, self._first) @ self._R)
        return np.hstack([by_turn, self.normals @ across.T])
