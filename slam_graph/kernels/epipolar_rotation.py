# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Rotation between two frames from the bearings f₁, f₂ of their features, by Gauss-Newton.

With the direction of the translation t, e = t · (f₁ × R f₂) is divided by its standard deviation.
Its derivatives are by R ⊕ δ and by t ⊕ ε on the sphere. Papers: `epipolar_rotation_numpy.py`.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = ["find_directions", "refine_rotation"]

STEPS = 10
"""Most Gauss-Newton steps."""
CONVERGED_RAD = 1e-5
"""A smaller step of the rotation is the last."""
CAUCHY_WIDTH = 2.4
"""Residual with half the weight, in units of the noise."""
MEDIAN = 0.455 / CAUCHY_WIDTH**2
"""Median of the squared residuals if they are noise, in units of the width."""
REWEIGHTINGS = 3
"""How often the first direction is found again without wrong matches."""
MAX_STEP_RAD = 0.1
"""Longest step of the rotation."""
FLOOR_RAD = 0.5e-3
"""No rotation is better known than this: tracks have errors that are common to many features."""
DAMPING = 1e-6
"""Added to the diagonal, in units of the trace."""
WEAK = 1e-3
"""Information on the direction where the parallax shows none."""
TINY = 1e-12
"""Keeps divisions finite."""
_JACOBI_STEPS = 24
"""Eight sweeps over a (3, 3) matrix: they converge quadratically, and five are enough."""


@compiled()
def _diagonalize(A: FloatArray, V: FloatArray) -> None:
    """Make a symmetric A (3, 3) diagonal by Jacobi's rotations; V (3, 3): its eigenvectors."""
    for i in range(3):
        for k in range(3):
            V[i, k] = 1.0 if i == k else 0.0
    for step in range(_JACOBI_STEPS):
        p, q, r = step % 3, (step + 1) % 3, (step + 2) % 3
        off = A[p, q]
        if off == 0.0:
            continue
        ratio = (A[q, q] - A[p, p]) / (2.0 * off)
        tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
        cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
        sine = tangent * cosine
        A[p, p] -= tangent * off
        A[q, q] += tangent * off
        A[p, q] = A[q, p] = 0.0
        a, b = A[r, p], A[r, q]
        A[r, p] = A[p, r] = cosine * a - sine * b
        A[r, q] = A[q, r] = sine * a + cosine * b
        for i in range(3):
            a, b = V[i, p], V[i, q]
            V[i, p] = cosine * a - sine * b
            V[i, q] = sine * a + cosine * b


@compiled()
def _median(values: FloatArray) -> float:
    """The median of values (N,), whose order changes (Hoare's selection)."""
    half, low, high = (len(values) - 1) // 2, 0, len(values) - 1
    while low < high:
        pivot, i, j = values[half], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < half:
            low = i
        if half < i:
            high = j
    middle: float = values[half]
    if len(values) % 2 == 1:
        return middle
    after = np.inf
    for n in range(half + 1, len(values)):
        after = min(after, values[n])
    return 0.5 * (middle + after)


@compiled()
def _smallest(scatter: FloatArray, noise: FloatArray, t: FloatArray) -> float:
    """The smallest λ of S t = λ N t, and its t (3,) with tᵀ N t = 1; NaN if N is singular."""
    L, whitened, V = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):  # Cholesky's L of the noise
        for k in range(i + 1):
            value = noise[i, k]
            for m in range(k):
                value -= L[i, m] * L[k, m]
            if k < i:
                L[i, k] = value / L[k, k]
            elif value > 0.0:
                L[i, i] = math.sqrt(value)
            else:
                return np.nan
    for i in range(3):  # L⁻¹ S
        for k in range(3):
            value = scatter[i, k]
            for m in range(i):
                value -= L[i, m] * whitened[m, k]
            whitened[i, k] = value / L[i, i]
    for i in range(3):  # and L⁻¹ S L⁻ᵀ
        for k in range(3):
            for m in range(i):
                whitened[k, i] -= L[i, m] * whitened[k, m]
            whitened[k, i] /= L[i, i]
    _diagonalize(whitened, V)
    least = 0
    for k in range(1, 3):
        if whitened[k, k] < whitened[least, least]:
            least = k
    for i in range(2, -1, -1):
        t[i] = V[i, least]
        for m in range(i + 1, 3):
            t[i] -= L[m, i] * t[m]
        t[i] /= L[i, i]
    smallest: float = whitened[least, least]
    return smallest


@compiled()
def _find_direction(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    weights: FloatArray,
    R: FloatArray,
    turned: FloatArray,
    normals: FloatArray,
    t: FloatArray,
    across: FloatArray,
    known: FloatArray,
    alike: bool,
    damping: float,
) -> bool:
    """Fill what a rotation and weights make of the bearings; whether there is noise.

    These are the second bearings turned by R, (N, 3), the normals (N, 3) of the epipolar planes,
    the direction t, two unit vectors (2, 3) across it, and the information (2, 2) along these.
    Where normals are to count alike, the weights are those that give them one length. `damping` is
    a part of all noise, which is added in each direction.
    """
    scatter, noise = np.zeros((3, 3)), np.zeros((3, 3))
    total = sum_of_noise = 0.0
    for n in range(len(first)):
        for i in range(3):
            turned[n, i] = R[i, 0] * second[n, 0] + R[i, 1] * second[n, 1] + R[i, 2] * second[n, 2]
        square = 0.0
        for i in range(3):
            k, m = (i + 1) % 3, (i + 2) % 3
            normals[n, i] = first[n, k] * turned[n, m] - first[n, m] * turned[n, k]
            square += normals[n, i] * normals[n, i]
        w = weights[n]
        if alike:
            w = 1.0 / max(square, TINY)
        of_first, of_second = w * variances[n, 0], w * variances[n, 1]
        total += w
        sum_of_noise += of_first + of_second
        for i in range(3):
            for k in range(3):
                scatter[i, k] += w * normals[n, i] * normals[n, k]
                noise[i, k] -= (
                    of_second * first[n, i] * first[n, k] + of_first * turned[n, i] * turned[n, k]
                )
    for i in range(3):
        noise[i, i] += (1.0 + damping) * sum_of_noise
    least = _smallest(scatter, noise, t)
    if math.isnan(least):
        return False
    square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    for i in range(3):
        t[i] /= math.sqrt(square)
    sign, scale = math.copysign(1.0, t[0]), 1.0 / (1.0 + abs(t[0]))
    for i in range(2):
        across[i, 0] = -sign * t[1 + i]
        for k in range(2):
            across[i, 1 + k] = (1.0 if i == k else 0.0) - t[1 + i] * t[1 + k] * scale
    # relative to the noise along t: it was 1 before t had unit length, and is 1 / square now
    for i in range(3):
        for k in range(3):
            scatter[i, k] -= least * noise[i, k]
    for a in range(2):
        for b in range(2):
            value = 0.0
            for i in range(3):
                for k in range(3):
                    value += across[a, i] * scatter[i, k] * across[b, k]
            known[a, b] = value * total * square + (WEAK if a == b else 0.0)
    return True


@compiled()
def _set_weights(
    first: FloatArray,
    variances: FloatArray,
    turned: FloatArray,
    normals: FloatArray,
    t: FloatArray,
    squares: FloatArray,
    variance: FloatArray,
    weights: FloatArray,
) -> None:
    """Fill squared residuals (N,) in units of the width, variances (N,), and weights over these."""
    for n in range(len(first)):
        e = of_first = of_second = 0.0
        for i in range(3):
            e += t[i] * normals[n, i]
            of_first += t[i] * turned[n, i]
            of_second += t[i] * first[n, i]
        noise = variances[n, 0] * (1.0 - of_first * of_first)
        noise += variances[n, 1] * (1.0 - of_second * of_second)
        variance[n] = max(noise, TINY * TINY)
        squares[n] = e * e / (CAUCHY_WIDTH * CAUCHY_WIDTH * variance[n])
        weights[n] = squares[n]
    # far from the solution all residuals are large, and none is an outlier
    unit = max(1.0, _median(weights) / MEDIAN)
    for n in range(len(first)):
        weights[n] = 1.0 / (1.0 + squares[n] / unit) / variance[n]


@compiled()
def _step(H: FloatArray, R: FloatArray) -> float:
    """Take the step of [H gradient] (5, 6) from R (3, 3); its length before it is shortened."""
    A, step = np.empty((5, 6)), np.empty(5)
    damping = TINY
    for i in range(5):
        damping += DAMPING * H[i, i]
    for i in range(5):
        for k in range(6):
            A[i, k] = H[i, k]
        A[i, i] += damping
    for c in range(5):
        for i in range(c + 1, 5):
            part = A[i, c] / A[c, c]
            for k in range(c, 6):
                A[i, k] -= part * A[c, k]
    for c in range(4, -1, -1):
        step[c] = -A[c, 5]
        for k in range(c + 1, 5):
            step[c] -= A[c, k] * step[k]
        step[c] /= A[c, c]
    length = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    shorter = min(1.0, MAX_STEP_RAD / max(length, TINY))
    half = 0.5 * length * shorter
    w, scale = math.cos(half), math.sin(half) / max(length, TINY)
    x, y, z = scale * step[0], scale * step[1], scale * step[2]
    for i in range(3):  # R times the quaternion's matrix: rows are turned back
        a, b, c = R[i, 0], R[i, 1], R[i, 2]
        u, v, s = b * z - c * y, c * x - a * z, a * y - b * x
        R[i, 0] = a + 2.0 * (w * u + v * z - s * y)
        R[i, 1] = b + 2.0 * (w * v + s * x - u * z)
        R[i, 2] = c + 2.0 * (w * s + u * y - v * x)
    return length


@compiled()
def _sum_up(
    first: FloatArray,
    second: FloatArray,
    normals: FloatArray,
    R: FloatArray,
    t: FloatArray,
    across: FloatArray,
    weights: FloatArray,
    H: FloatArray,
) -> None:
    """Fill H (5, 5) and, in its column 5, the gradient; `weights` over the variances."""
    row, back = np.empty(6), np.empty(3)
    H[:] = 0.0
    for n in range(len(first)):
        x, y, z = first[n, 0], first[n, 1], first[n, 2]
        u, v, w = t[1] * z - t[2] * y, t[2] * x - t[0] * z, t[0] * y - t[1] * x
        for i in range(3):
            back[i] = R[0, i] * u + R[1, i] * v + R[2, i] * w
        x, y, z = second[n, 0], second[n, 1], second[n, 2]
        row[0], row[1] = y * back[2] - z * back[1], z * back[0] - x * back[2]
        row[2] = x * back[1] - y * back[0]
        x, y, z = normals[n, 0], normals[n, 1], normals[n, 2]
        for i in range(2):
            row[3 + i] = across[i, 0] * x + across[i, 1] * y + across[i, 2] * z
        row[5] = t[0] * x + t[1] * y + t[2] * z
        for i in range(5):
            for k in range(i, 6):
                H[i, k] += weights[n] * row[i] * row[k]
    for i in range(5):
        for k in range(i):
            H[i, k] = H[k, i]


@compiled()
def _set_information(H: FloatArray, known: FloatArray, information: FloatArray) -> None:
    """Fill the information (3, 3) of the rotation, without the direction, as `_believable`."""
    A, V = np.empty((3, 3)), np.empty((3, 3))
    determinant = known[0, 0] * known[1, 1] - known[0, 1] * known[1, 0]
    for i in range(3):
        a = (known[1, 1] * H[i, 3] - known[1, 0] * H[i, 4]) / determinant
        b = (known[0, 0] * H[i, 4] - known[0, 1] * H[i, 3]) / determinant
        for k in range(3):
            A[i, k] = H[i, k] - a * H[3, k] - b * H[4, k]
    _diagonalize(A, V)
    for m in range(3):
        A[m, m] = 1.0 / max(A[m, m], 1.0) + FLOOR_RAD * FLOOR_RAD
    for i in range(3):
        for k in range(3):
            information[i, k] = 0.0
            for m in range(3):
                information[i, k] += V[i, m] * V[k, m] / A[m, m]


@compiled("f8(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def refine_rotation(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    R: FloatArray,
    information: FloatArray,
) -> float:
    """Find rotation and direction from a start, with Cauchy weights against wrong matches.

    Args:
        first: (N, 3) bearings in the first frame, with N > 0.
        second: (N, 3) of the same features in the second one.
        variances: (N, 2) of both, rad².
        R: (3, 3) first_R_second: a start, replaced by the result.
        information: (3, 3), filled: about the rotation, in the tangent at the second frame, 1/rad².

    Returns:
        The robust cost, half the squared width being its unit; infinite if noise is singular.
    """
    N = len(first)
    turned, normals, known = np.empty((N, 3)), np.empty((N, 3)), np.empty((2, 2))
    weights, squares, variance = np.empty(N), np.empty(N), np.empty(N)
    t, across, H, length = np.empty(3), np.empty((2, 3)), np.empty((5, 6)), np.inf
    for step in range(-1 - REWEIGHTINGS, STEPS):
        # normals of one length first: those of wrong matches are the longest
        alike = step == -1 - REWEIGHTINGS
        if not alike:
            _set_weights(first, variances, turned, normals, t, squares, variance, weights)
        if step >= 0:
            _sum_up(first, second, normals, R, t, across, weights, H)
            length = _step(H, R)
            for n in range(N):
                weights[n] *= variance[n]
        if not _find_direction(
            first, second, variances, weights, R, turned, normals, t, across, known, alike, 0.0
        ):
            return np.inf
        if length < CONVERGED_RAD:
            break
    _set_information(H, known, information)
    cost = 0.0
    for n in range(N):
        cost += math.log1p(squares[n])
    return cost


@compiled("void(f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1])")
def find_directions(
    first: FloatArray,
    second: FloatArray,
    variances: FloatArray,
    begins: IntArray,
    R: FloatArray,
    t: FloatArray,
) -> None:
    """Fill directions t (P, 3) of unit length for the rotations R of P pairs; NaN if there is none.

    The arguments are those of `pair_equations`.
    """
    across, known = np.empty((2, 3)), np.empty((2, 2))
    for p in range(len(R)):
        rows, N = slice(begins[p], begins[p + 1]), begins[p + 1] - begins[p]
        f, g, noises = first[rows], second[rows], variances[rows]
        turned, normals = np.empty((N, 3)), np.empty((N, 3))
        weights, squares, variance = np.empty(N), np.empty(N), np.empty(N)
        for k in range(REWEIGHTINGS + 1):
            if k > 0:
                _set_weights(f, noises, turned, normals, t[p], squares, variance, weights)
            if not _find_direction(
                f, g, noises, weights, R[p], turned, normals, t[p], across, known, k == 0, TINY
            ):
                t[p] = np.nan
