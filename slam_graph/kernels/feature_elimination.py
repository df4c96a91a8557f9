# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Elimination of many features from normal equations over many poses (Schur complement)."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["eliminate_features", "eliminate_features_numpy"]


@compiled()
def _inverse_root(V: FloatArray, inverse: FloatArray) -> None:
    """L⁻¹ of V = L Lᵀ, both (3, 3)."""
    L = np.zeros((3, 3))
    for a in range(3):
        for b in range(a + 1):
            rest = V[a, b]
            for k in range(b):
                rest -= L[a, k] * L[b, k]
            L[a, b] = math.sqrt(rest) if a == b else rest / L[b, b]
    for b in range(3):
        for a in range(3):
            rest = 1.0 if a == b else 0.0
            for k in range(b, a):
                rest -= L[a, k] * inverse[k, b]
            inverse[a, b] = rest / L[a, a] if a >= b else 0.0


@compiled(
    "void(f8[:, :, ::1], f8[:, :, ::1], i8[::1], i8[::1], i8[::1], f8, f8[:, ::1],"
    " f8[:, :, ::1], f8[:, :, ::1])"
)
def eliminate_features(
    by_pose: FloatArray,
    by_point: FloatArray,
    frame: IntArray,
    views: IntArray,
    starts: IntArray,
    damping: float,
    information: FloatArray,
    inverse_roots: FloatArray,
    T: FloatArray,
) -> None:
    """Add to the information of poses what the observations of J features say of them.

    With V = L Lᵀ the information of a feature, and W = Σ Jₚᵀ Jₓ of a view, T = L⁻¹ W; the
    information is Σ Jₓᵀ Jₓ - Tᵀ T.

    Args:
        by_pose: (N, 2, 6) derivatives Jₓ of the observations by the observing pose; sorted by
            feature, then by frame.
        by_point: (N, 2, 3) derivatives Jₚ by the position of the feature.
        frame: (M,) number of the pose of each view: a feature in a frame, by any camera.
        views: (M + 1,) first observation of each view, and N.
        starts: (J + 1,) first view of each feature, and M.
        damping: is added to the diagonal of V.
        information: (n, n) of the poses, 6 for each, and anything behind them; its lower triangle
            is added to. What is above is undefined afterwards. Nothing is added where n is zero.
        inverse_roots: (J, 3, 3), filled: L⁻¹; not finite where V is not positive definite.
        T: (M, 3, 6), filled.
    """
    longest, reduces = 0, len(information) > 0
    for j in range(len(inverse_roots)):
        longest = max(longest, starts[j + 1] - starts[j])
    rows, V, W = np.empty((3, 6 * longest)), np.empty((3, 3)), np.empty((3, 6))
    for j in range(len(inverse_roots)):
        first, stop = starts[j], starts[j + 1]
        for a in range(3):
            for b in range(3):
                V[a, b] = damping if a == b else 0.0
        for n in range(views[first], views[stop]):
            for i in range(2):
                for a in range(3):
                    for b in range(a + 1):
                        V[a, b] += by_point[n, i, a] * by_point[n, i, b]
        inverse = inverse_roots[j]
        _inverse_root(V, inverse)
        for v in range(first, stop):
            pose = 6 * frame[v]
            W[:] = 0.0
            for n in range(views[v], views[v + 1]):
                for i in range(2):
                    for a in range(6):
                        x = by_pose[n, i, a]
                        for k in range(3):
                            W[k, a] += by_point[n, i, k] * x
                        if reduces:
                            for b in range(a + 1):
                                information[pose + a, pose + b] += x * by_pose[n, i, b]
            for k in range(3):
                for a in range(6):
                    x = 0.0
                    for i in range(k + 1):
                        x += inverse[k, i] * W[i, a]
                    T[v, k, a] = x
                    rows[k, 6 * (v - first) + a] = x
        u = first if reduces else stop
        while u < stop:  # views by consecutive frames are consecutive columns
            end = u + 1
            while end < stop and frame[end] == frame[end - 1] + 1:
                end += 1
            left = 6 * (u - first)
            for v in range(u, stop):
                width = 6 * (min(end, v + 1) - u)
                for a in range(6):
                    t0, t1, t2 = T[v, 0, a], T[v, 1, a], T[v, 2, a]
                    row = information[6 * frame[v] + a, 6 * frame[u] : 6 * frame[u] + width]
                    for c in range(width):
                        row[c] -= (
                            t0 * rows[0, left + c] + t1 * rows[1, left + c] + t2 * rows[2, left + c]
                        )
            u = end


def eliminate_features_numpy(
    by_pose: FloatArray,
    by_point: FloatArray,
    frame: IntArray,
    views: IntArray,
    starts: IntArray,
    damping: float,
    information: FloatArray,
    inverse_roots: FloatArray,
    T: FloatArray,
) -> None:
    """`eliminate_features` in NumPy, feature by feature."""
    size = 6 * (int(np.max(frame, initial=-1)) + 1)
    for j in range(len(inverse_roots)):
        first, stop = starts[j], starts[j + 1]
        seen = range(views[first], views[stop])
        owner = np.repeat(np.arange(first, stop), np.diff(views[first : stop + 1]))
        H = np.zeros((2 * len(seen), len(information) or size))
        for k, (n, v) in enumerate(zip(seen, owner, strict=True)):
            pose = 6 * frame[v]
            H[2 * k : 2 * k + 2, pose : pose + 6] = by_pose[n]
        F = by_point[seen.start : seen.stop].reshape(-1, 3)
        inverse_roots[j] = np.linalg.inv(np.linalg.cholesky(F.T @ F + damping * np.eye(3)))
        whole = inverse_roots[j] @ F.T @ H
        for v in range(first, stop):
            T[v] = whole[:, 6 * frame[v] : 6 * frame[v] + 6]
        if len(information) > 0:
            information += H.T @ H - whole.T @ whole
