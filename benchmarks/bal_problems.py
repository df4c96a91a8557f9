# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Made-up bundle-adjustment problems: cameras on a ring around a building of points, seeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray
from slam_graph.bundle_adjustment.bal_cost import retract
from slam_graph.bundle_adjustment.bal_problem import CAMERA_DIM, BalEstimates, BalProblem, project

HALF_IMAGE_PX = (640.0, 480.0)
RING_RADIUS = 10.0
POINTS_RADIUS = 4.0
FOCAL_PX = 800.0

CAMERA_SIGMAS = np.array([*[0.01] * 3, *[0.05] * 3, 8.0, 5e-3, 1e-3])
"""How far the start is off: rad, units of length, pixels, k1, k2."""
POINT_SIGMA = 0.1


@dataclass(frozen=True, slots=True)
class MadeUp:
    """A problem and its truth."""

    problem: BalProblem
    truth: BalEstimates


def ring(
    cameras: int,
    points: int,
    noise_px: float = 1.0,
    perturbation: float = 1.0,
    views: float = 6.0,
    seed: int = 0,
) -> MadeUp:
    """A problem with cameras around points, which see those on their side.

    Args:
        cameras: number of cameras.
        points: number of points, on a cylinder.
        noise_px: standard deviation of each coordinate of a pixel.
        perturbation: factor on how far the start is off the truth.
        views: in how many cameras a point is tracked on average, at most those in which it is
            visible.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    truth = _truth(cameras, points, rng)
    camera, point = np.divmod(np.arange(cameras * points), points)
    pixels, depths = project(truth, camera, point)
    facing = _facing(truth)[camera, point]
    seen = facing & (depths > 0) & (np.abs(pixels) < HALF_IMAGE_PX).all(axis=1)
    visible = np.bincount(point[seen], minlength=points)[point]
    seen &= rng.random(len(seen)) * visible < views
    camera, point = camera[seen], point[seen]
    measured = pixels[seen] + noise_px * rng.standard_normal((len(camera), 2))
    by_camera = perturbation * CAMERA_SIGMAS * rng.standard_normal((cameras, CAMERA_DIM))
    start = retract(truth, by_camera, perturbation * POINT_SIGMA * rng.standard_normal((points, 3)))
    return MadeUp(BalProblem(start, camera, point, measured, f"ring_{cameras}_{points}"), truth)


def _truth(cameras: int, points: int, rng: np.random.Generator) -> BalEstimates:
    """Cameras on a ring that look inwards, each a little otherwise; points on a cylinder."""
    angles = 2.0 * np.pi * np.arange(cameras) / cameras
    outwards = np.stack([np.cos(angles), np.sin(angles), np.zeros(cameras)], axis=1)
    centres = RING_RADIUS * outwards + rng.normal(0.0, 0.5, (cameras, 3))
    up = np.tile([0.0, 0.0, 1.0], (cameras, 1))
    inwards = np.stack([np.cross(up, outwards), up, outwards], axis=1)  # looks along -z
    rotations = Rotation.from_rotvec(rng.normal(0.0, 0.1, (cameras, 3))).as_matrix() @ inwards
    translations = -np.einsum("cij,cj->ci", rotations, centres)
    intrinsics = np.array([FOCAL_PX, -0.05, 0.01]) + rng.normal(
        0, (20.0, 0.01, 0.002), (cameras, 3)
    )
    around, radius = rng.uniform(0, 2 * np.pi, points), rng.uniform(0.8, 1.0, points)
    cloud = np.stack(
        [np.cos(around) * radius, np.sin(around) * radius, rng.uniform(-1.0, 1.0, points)], axis=1
    )
    return BalEstimates(rotations, translations, intrinsics, POINTS_RADIUS * cloud)


def _facing(truth: BalEstimates) -> BoolArray:
    """(C, P) whether a camera is on the outer side of a point."""
    side = truth.points[:, :2] / np.linalg.norm(truth.points[:, :2], axis=1)[:, None]
    reach = np.sum(side * truth.points[:, :2], axis=1)
    facing: BoolArray = truth.centres()[:, :2] @ side.T > reach
    return facing
