# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The inverse of the radial-tangential model, for each point by itself."""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.kernels.compilation import compiled

__all__ = ["approach_radtan", "invert_radtan", "undistort_radtan"]


@compiled("f8[:, ::1](f8[:, ::1], f8[::1], i8, f8)")
def approach_radtan(
    q: FloatArray, coefficients: FloatArray, steps: int, tolerance: float
) -> FloatArray:
    """Normalised points of distorted ones, roughly; the other form is `cv2.undistortPointsIter`.

    Each step subtracts the tangential part, and divides by the radial factor, of the point so far.
    Where a step makes the error larger OpenCV goes other ways, and this gives up.

    Args:
        q: (N, 2) points of the image plane.
        coefficients: (4,) k1, k2, p1, p2.
        steps: most that are made.
        tolerance: a point whose distortion is nearer than this to what was asked is the result.

    Returns:
        (N, 2); NaN where it gave up.
    """
    k1, k2, p1, p2 = coefficients
    m = q.copy()
    for n in range(len(q)):
        x, y = q[n]
        last = np.inf
        for _ in range(steps):
            r2 = x * x + y * y
            inverse = 1.0 / (1.0 + r2 * (k1 + k2 * r2))
            tangential_x = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
            tangential_y = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
            x, y = (q[n, 0] - tangential_x) * inverse, (q[n, 1] - tangential_y) * inverse
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + k2 * r2)
            dx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - q[n, 0]
            dy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - q[n, 1]
            error = math.sqrt(dx * dx + dy * dy)
            if not (inverse >= 0.0 and error < last):
                x = y = np.nan
                break
            if error < tolerance:
                break
            last = error
        m[n, 0], m[n, 1] = x, y
    return m


@compiled("f8[:, ::1](f8[:, ::1], f8[:, ::1], f8[::1], i8, f8)")
def undistort_radtan(
    q: FloatArray, start: FloatArray, coefficients: FloatArray, steps: int, tolerance: float
) -> FloatArray:
    """Normalised points of distorted ones; the NumPy form is `CameraModel.undistort`.

    Args:
        q: (N, 2) points of the image plane.
        start: (N, 2) guess of the result.
        coefficients: (4,) k1, k2, p1, p2.
        steps: most that are made.
        tolerance: a step from where the error is smaller than this is the last one.

    Returns:
        (N, 2).
    """
    k1, k2, p1, p2 = coefficients
    m = start.copy()
    for n in range(len(q)):
        x, y = m[n]
        for _ in range(steps):
            xx, yy, xy = x * x, y * y, x * y
            r2 = xx + yy
            radial = 1.0 + r2 * (k1 + k2 * r2)
            slope = 2.0 * k1 + 4.0 * k2 * r2
            error_x = q[n, 0] - (x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx))
            error_y = q[n, 1] - (y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy)
            a = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
            b = slope * xy + 2.0 * p1 * x + 2.0 * p2 * y
            d = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
            determinant = a * d - b * b
            if determinant == 0.0:
                x = y = np.nan
                break
            x += (d * error_x - b * error_y) / determinant
            y += (a * error_y - b * error_x) / determinant
            if max(abs(error_x), abs(error_y)) < tolerance:
                break
        m[n, 0], m[n, 1] = x, y
    return m


@compiled("Tuple((f8[:, ::1], i8))(f8[:, ::1], f8[::1], i8, f8, i8, f8)")
def invert_radtan(
    q: FloatArray,
    coefficients: FloatArray,
    rough_steps: int,
    rough_tolerance: float,
    steps: int,
    tolerance: float,
) -> tuple[FloatArray, int]:
    """`approach_radtan`, then `undistort_radtan` from there, in one call.

    In NumPy it is these two, one after the other.

    Returns:
        (N, 2) normalised points; and how many of them are NaN because the first one gave up.
    """
    start = approach_radtan(q, coefficients, rough_steps, rough_tolerance)
    given_up = 0
    for n in range(len(start)):
        given_up += int(np.isnan(start[n, 0]))
    return undistort_radtan(q, start, coefficients, steps, tolerance), given_up
