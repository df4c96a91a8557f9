# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The rig that is simulated where none is given: the calibrated stereo camera and IMU of EuRoC."""

from __future__ import annotations

import gtsam
import numpy as np

from slam_graph.sensors.camera import Camera
from slam_graph.sensors.rig import ImuNoise, Rig, RigCamera, pose_from_matrix

SIZE = (752, 480)

LEFT = Camera(
    *(458.654, 457.296, 367.215, 248.375),
    "radtan",
    (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    *SIZE,
)
RIGHT = Camera(
    *(457.587, 456.134, 379.999, 255.238),
    "radtan",
    (-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05),
    *SIZE,
)

BODY_T_LEFT = (
    (0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975),
    (0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768),
    (-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949),
    (0.0, 0.0, 0.0, 1.0),
)
BODY_T_RIGHT = (
    (0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556),
    (0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024),
    (-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038),
    (0.0, 0.0, 0.0, 1.0),
)


def euroc_rig() -> Rig:
    """Two cameras 11 cm apart, and an IMU at 200 Hz."""
    cameras = (
        RigCamera(LEFT, _pose(BODY_T_LEFT), 0.0, "cam0"),
        RigCamera(RIGHT, _pose(BODY_T_RIGHT), 0.0, "cam1"),
    )
    return Rig(cameras, ImuNoise())


def _pose(rows: tuple[tuple[float, ...], ...]) -> gtsam.Pose3:
    return pose_from_matrix(np.array(rows), "body_T_camera")
