# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features of a rolling shutter as a global one would have seen them.

For what takes a frame for one picture from one pose, such as PnP.
"""

from __future__ import annotations

import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.cost.feature_tracks import Observations
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.sensors import FeatureObservations, Rig


def unrolled(
    seen: FeatureObservations,
    rows: IntArray,
    rig: Rig,
    motion: FrameMotion | None,
    depths: FloatArray,
) -> FloatArray:
    """(N, 2) where the first camera would have seen features on the plane z = 1, from the pose.

    Args:
        seen: what it saw.
        rows: (N,) which of these.
        rig: the cameras.
        motion: of the body in the frame; None for a global shutter.
        depths: (N,) of the features, m; infinite where they are not known.
    """
    normalized = seen.normalized[rows]
    if motion is None or not rig.rolling or len(rows) == 0:
        return normalized
    none = np.zeros(len(rows), np.int64)
    obs = Observations(rows, (0,), np.arange(len(rows)), none, none, seen.pixels[rows], normalized)
    R, p = RigProjection(rig, {0: motion}).mounts(obs)
    camera = rig.cameras[0].body_T_camera
    rays = np.column_stack([normalized, np.ones(len(rows))])
    away = np.einsum("nij,nj->ni", R, rays) + (p - camera.translation()) / depths[:, None]
    moved = away @ camera.rotation().matrix()
    return np.asarray(moved[:, :2] / moved[:, 2:])
