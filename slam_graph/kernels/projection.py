# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Projection of features into the cameras that observed them.

From the world to the frame of the camera, and the chain rule back to pose and point. Between the
two the camera model of each camera distorts; for the commonest ones that is a kernel, too.
"""

from __future__ import annotations

import math

import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.kernels.compilation import compiled

__all__ = [
    "chain_rule",
    "chain_rule_numpy",
    "distort_equidistant",
    "distort_radtan",
    "points_ahead",
    "points_ahead_numpy",
    "to_cameras",
    "to_cameras_numpy",
]


@compiled("i8(f8[:, :], b1[:], f8[:, :], f8[:], f8, f8, f8[:, :], i8[::1], f8[:, ::1])")
def points_ahead(
    points: FloatArray,
    used: BoolArray,
    world_R_camera: FloatArray,
    centre: FloatArray,
    nearest: float,
    square: float,
    bounds: FloatArray,
    rows: IntArray,
    normalized: FloatArray,
) -> int:
    """Points that a camera may see, on the plane z = 1 in front of it.

    Args:
        points: (J, 3) in the world.
        used: (J,) which of them to look at.
        world_R_camera: (3, 3).
        centre: (3,) of the camera in the world.
        nearest: least depth, m.
        square: squared length of the longest normalised point that is seen.
        bounds: (2, 2) least and largest coordinates of normalised points.
        rows: (J,), filled from the beginning with the rows of these points.
        normalized: (J, 2), filled likewise.

    Returns:
        How many there are.
    """
    R, count = world_R_camera, 0
    left, top, right, bottom = bounds[0, 0], bounds[0, 1], bounds[1, 0], bounds[1, 1]
    for j in range(len(points)):
        if not used[j]:
            continue
        x, y, z = points[j, 0] - centre[0], points[j, 1] - centre[1], points[j, 2] - centre[2]
        depth = x * R[0, 2] + y * R[1, 2] + z * R[2, 2]
        if not depth > nearest:
            continue
        u = (x * R[0, 0] + y * R[1, 0] + z * R[2, 0]) / depth
        v = (x * R[0, 1] + y * R[1, 1] + z * R[2, 1]) / depth
        if left <= u <= right and top <= v <= bottom and u * u + v * v < square:
            rows[count], normalized[count, 0], normalized[count, 1] = j, u, v
            count += 1
    return count


def points_ahead_numpy(
    points: FloatArray,
    used: BoolArray,
    world_R_camera: FloatArray,
    centre: FloatArray,
    nearest: float,
    square: float,
    bounds: FloatArray,
    rows: IntArray,
    normalized: FloatArray,
) -> int:
    """`points_ahead` in NumPy."""
    in_camera = (points - centre) @ world_R_camera
    ahead = np.flatnonzero(used & (in_camera[:, 2] > nearest))
    found = in_camera[ahead, :2] / in_camera[ahead, 2:]
    inside = np.sum(found**2, axis=1) < square
    inside &= ((bounds[0] <= found) & (found <= bounds[1])).all(axis=1)
    count = int(np.count_nonzero(inside))
    rows[:count], normalized[:count] = ahead[inside], found[inside]
    return count


@compiled(
    "void(f8[:, :, :], f8[:, :], f8[:, :], f8[:, :, :], f8[:, :], i8[:], i8[:], i8[:], f8,"
    " f8[:, ::1], f8[:, ::1], f8[:, ::1])"
)
def to_cameras(
    rotations: FloatArray,
    positions: FloatArray,
    points: FloatArray,
    mount_R: FloatArray,
    mount_p: FloatArray,
    frame: IntArray,
    feature: IntArray,
    mount: IntArray,
    nearest: float,
    in_body: FloatArray,
    in_camera: FloatArray,
    normalized: FloatArray,
) -> None:
    """Observed points in the frames of body and camera, and on the plane z = 1.

    Args:
        rotations: (F, 3, 3) world_R_body of each frame.
        positions: (F, 3) of the body in the world.
        points: (J, 3) features in the world.
        mount_R: (M, 3, 3) rotations of cameras in the body.
        mount_p: (M, 3) their positions.
        frame: (N,) rows of the observations in `rotations`.
        feature: (N,) rows in `points`.
        mount: (N,) rows in `mount_R`.
        nearest: points nearer than this (m) are projected as if at this depth.
        in_body: (N, 3), filled.
        in_camera: (N, 3), filled.
        normalized: (N, 2), filled.
    """
    offset = np.empty(3)
    for n in range(len(frame)):
        f, j, c = frame[n], feature[n], mount[n]
        for i in range(3):
            offset[i] = points[j, i] - positions[f, i]
        for i in range(3):
            in_body[n, i] = (
                rotations[f, 0, i] * offset[0]
                + rotations[f, 1, i] * offset[1]
                + rotations[f, 2, i] * offset[2]
            )
        for i in range(3):
            offset[i] = in_body[n, i] - mount_p[c, i]
        for i in range(3):
            in_camera[n, i] = (
                mount_R[c, 0, i] * offset[0]
                + mount_R[c, 1, i] * offset[1]
                + mount_R[c, 2, i] * offset[2]
            )
        depth = max(in_camera[n, 2], nearest)
        normalized[n, 0] = in_camera[n, 0] / depth
        normalized[n, 1] = in_camera[n, 1] / depth


def to_cameras_numpy(
    rotations: FloatArray,
    positions: FloatArray,
    points: FloatArray,
    mount_R: FloatArray,
    mount_p: FloatArray,
    frame: IntArray,
    feature: IntArray,
    mount: IntArray,
    nearest: float,
    in_body: FloatArray,
    in_camera: FloatArray,
    normalized: FloatArray,
) -> None:
    """`to_cameras` in NumPy."""
    offset = points[feature] - positions[frame]
    in_body[:] = np.einsum("nji,nj->ni", rotations[frame], offset)
    in_camera[:] = np.einsum("nji,nj->ni", mount_R[mount], in_body - mount_p[mount])
    normalized[:] = in_camera[:, :2] / np.maximum(in_camera[:, 2:], nearest)


@compiled("void(f8[:, ::1], i8[:], f8[:, ::1], f8[:, ::1], f8[:, :, ::1])")
def distort_radtan(
    normalized: FloatArray,
    camera: IntArray,
    lenses: FloatArray,
    pixels: FloatArray,
    slopes: FloatArray,
) -> None:
    """Pixels of normalised points under Brown's model, and their derivatives.

    Its NumPy form is `Camera.distort` of each camera.

    Args:
        normalized: (N, 2).
        camera: (N,) rows of `lenses`.
        lenses: (C, 8) fx, fy, cx, cy, k1, k2, p1, p2.
        pixels: (N, 2), filled.
        slopes: (N, 2, 2), filled.
    """
    for n in range(len(camera)):
        fx, fy, cx, cy, k1, k2, p1, p2 = lenses[camera[n]]
        x, y = normalized[n]
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + k2 * r2)
        slope = 2.0 * k1 + 4.0 * k2 * r2  # d radial / d x = slope * x
        pixels[n, 0] = (x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)) * fx + cx
        pixels[n, 1] = (y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy) * fy + cy
        across = slope * xy + 2.0 * p1 * x + 2.0 * p2 * y
        slopes[n, 0, 0] = (radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x) * fx
        slopes[n, 0, 1] = across * fx
        slopes[n, 1, 0] = across * fy
        slopes[n, 1, 1] = (radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x) * fy


@compiled("void(f8[:, ::1], i8[:], f8[:, ::1], f8[:, ::1], f8[:, :, ::1])")
def distort_equidistant(
    normalized: FloatArray,
    camera: IntArray,
    lenses: FloatArray,
    pixels: FloatArray,
    slopes: FloatArray,
) -> None:
    """Pixels of normalised points under Kannala and Brandt's model, and their derivatives.

    Its NumPy form is `Camera.distort` of each camera.

    Args:
        normalized: (N, 2).
        camera: (N,) rows of `lenses`.
        lenses: (C, 8) fx, fy, cx, cy, k1, k2, k3, k4.
        pixels: (N, 2), filled.
        slopes: (N, 2, 2), filled.
    """
    for n in range(len(camera)):
        fx, fy, cx, cy, k1, k2, k3, k4 = lenses[camera[n]]
        x, y = normalized[n]
        r = math.hypot(x, y)
        theta = math.atan(r)
        t2 = theta * theta
        scale, radial = 1.0, 0.0
        if not r <= 1e-9:
            scale = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        if not r <= 1e-6:  # d scale / d x = radial * x
            slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
            radial = (slope / (1.0 + r * r) - scale) / (r * r)
        across = radial * x * y
        pixels[n, 0] = x * scale * fx + cx
        pixels[n, 1] = y * scale * fy + cy
        slopes[n, 0, 0] = (scale + radial * x * x) * fx
        slopes[n, 0, 1] = across * fx
        slopes[n, 1, 0] = across * fy
        slopes[n, 1, 1] = (scale + radial * y * y) * fy


@compiled(
    "void(f8[:, ::1], f8[:, ::1], f8[:, :, :], f8[:, :, :], f8[:, :, :], i8[:], i8[:], f8,"
    " f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1])"
)
def chain_rule(
    in_body: FloatArray,
    in_camera: FloatArray,
    slopes: FloatArray,
    rotations: FloatArray,
    mount_R: FloatArray,
    frame: IntArray,
    mount: IntArray,
    nearest: float,
    by_camera_point: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
) -> None:
    """Derivatives of the pixels by the point in the camera frame, the pose, and the point.

    Args:
        in_body: (N, 3) the points, by `to_cameras`.
        in_camera: (N, 3) the same.
        slopes: (N, 2, 2) derivatives of the pixels by the normalised coordinates.
        rotations: (F, 3, 3) world_R_body of each frame.
        mount_R: (M, 3, 3) rotations of cameras in the body.
        frame: (N,) rows of the observations in `rotations`.
        mount: (N,) rows in `mount_R`.
        nearest: points nearer than this (m) are projected as if at this depth.
        by_camera_point: (N, 2, 3), filled.
        by_pose: (N, 2, 6), filled: rotation and translation in the frame of the body.
        by_point: (N, 2, 3), filled: the position in the world.
    """
    row, body = np.empty(3), np.empty(3)
    for n in range(len(frame)):
        f, c = frame[n], mount[n]
        depth = max(in_camera[n, 2], nearest)
        x, y = in_camera[n, 0] / depth**2, in_camera[n, 1] / depth**2
        px, py, pz = in_body[n, 0], in_body[n, 1], in_body[n, 2]
        for i in range(2):
            row[0] = slopes[n, i, 0] / depth
            row[1] = slopes[n, i, 1] / depth
            row[2] = -(slopes[n, i, 0] * x + slopes[n, i, 1] * y)
            for k in range(3):
                by_camera_point[n, i, k] = row[k]
                body[k] = (
                    row[0] * mount_R[c, k, 0]
                    + row[1] * mount_R[c, k, 1]
                    + row[2] * mount_R[c, k, 2]
                )
            # rotating the body by θ moves the point by p × θ in the body frame
            by_pose[n, i, 0] = body[1] * pz - body[2] * py
            by_pose[n, i, 1] = body[2] * px - body[0] * pz
            by_pose[n, i, 2] = body[0] * py - body[1] * px
            for k in range(3):
                by_pose[n, i, 3 + k] = -body[k]
                by_point[n, i, k] = (
                    body[0] * rotations[f, k, 0]
                    + body[1] * rotations[f, k, 1]
                    + body[2] * rotations[f, k, 2]
                )


def chain_rule_numpy(
    in_body: FloatArray,
    in_camera: FloatArray,
    slopes: FloatArray,
    rotations: FloatArray,
    mount_R: FloatArray,
    frame: IntArray,
    mount: IntArray,
    nearest: float,
    by_camera_point: FloatArray,
    by_pose: FloatArray,
    by_point: FloatArray,
) -> None:
    """`chain_rule` in NumPy."""
    depth = np.maximum(in_camera[:, 2], nearest)
    by_camera_point[:, :, :2] = slopes / depth[:, None, None]
    ratio = in_camera[:, :2] / depth[:, None] ** 2
    by_camera_point[:, :, 2] = -np.einsum("nij,nj->ni", slopes, ratio)
    by_body_point = by_camera_point @ mount_R.transpose(0, 2, 1)[mount]
    by_pose[:, :, :3] = np.cross(by_body_point, in_body[:, None, :])
    by_pose[:, :, 3:] = -by_body_point
    by_point[:] = by_body_point @ rotations.transpose(0, 2, 1)[frame]
