# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A car on plane roads: its path, the cameras of KITTI, and the landmarks beside the road."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.sensors import Camera, ImuNoise, Rig, RigCamera
from slam_graph.simulation.landmarks import Landmarks
from slam_graph.simulation.motion import Motion

_SIZE, _FOCAL_PX, _CENTRE_PX = (1241, 376), 718.856, (607.1928, 185.2157)
_BASELINE_M = 0.54
_POINTS_PER_M = 12.0
"""Landmarks per metre of road."""
_FACADES_M, _HEIGHT_M = (6.0, 18.0), (-1.65, 8.0)
"""Distances of landmarks from the middle of the road, and heights relative to the camera."""
_GROUND_SHARE, _ROAD_M = 0.25, 5.0
"""Part of the landmarks that is on the ground, and how far to either side."""
RANGE_M = 80.0
"""Landmarks farther away are not looked for."""
_STEP_NS = 50_000_000


def kitti_rig() -> Rig:
    """Two cameras as KITTI has them, at a body whose axes point ahead, left and up."""
    lens = Camera(_FOCAL_PX, _FOCAL_PX, *_CENTRE_PX, "none", (), *_SIZE)
    body_R_camera = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    cameras = tuple(
        RigCamera(lens, gtsam.Pose3(body_R_camera, np.array([0.0, -offset, 0.0])), 0.0, name)
        for offset, name in ((0.0, "cam0"), (_BASELINE_M, "cam1"))
    )
    return Rig(cameras, ImuNoise())


def beside_the_road(motion: Motion, rng: np.random.Generator) -> Landmarks:
    """Landmarks on facades on both sides of a road, and on the ground.

    Args:
        motion: of the car.
        rng: random places.
    """
    stamps = np.arange(motion.start_ns, motion.end_ns, _STEP_NS, dtype=np.int64)
    path = motion.positions(stamps)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    # it goes on where the car does not get to any more
    ahead = path[-1] - path[-2]
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    beyond = np.arange(2.0, RANGE_M, 2.0)
    path = np.concatenate([path, path[-1] + beyond[:, None] * ahead])
    way = np.concatenate([way, way[-1] + beyond])
    count = round(_POINTS_PER_M * way[-1])
    at = rng.uniform(0.0, way[-1], count)
    place = np.stack([np.interp(at, way, column) for column in path.T], axis=1)
    heading = np.stack([np.interp(at + 0.5, way, column) for column in path.T], axis=1) - place
    heading /= np.maximum(np.linalg.norm(heading, axis=1), 1e-9)[:, None]
    left = np.column_stack([-heading[:, 1], heading[:, 0], np.zeros(count)])
    side = rng.choice([-1.0, 1.0], count) * rng.uniform(*_FACADES_M, count)
    height = rng.uniform(*_HEIGHT_M, count)
    ground = rng.random(count) < _GROUND_SHARE
    side[ground] = rng.uniform(-_ROAD_M, _ROAD_M, int(ground.sum()))
    height[ground] = _HEIGHT_M[0]
    points: FloatArray = place + side[:, None] * left
    points[:, 2] += height
    return Landmarks(points, np.zeros_like(points), reach_m=RANGE_M)
