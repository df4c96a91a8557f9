# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The unit of length of a start by two views, from odometry of the same time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray
from slam_graph.backend.aiding.odometry_factors import motion_sigmas
from slam_graph.backend.engine_protocol import EngineContext
from slam_graph.backend.initialization.start_diagnosis import Refusal

Motion = tuple[FloatArray, FloatArray]
"""Rotation vector (3,) and translation (3,) of the body from one frame to the next."""

_MAX_SIGMA = 0.2
"""Largest accepted standard deviation of the unit of length, relative to it, for a first guess."""


def motions_by_odometry(context: EngineContext, stamps_ns: Sequence[int]) -> list[Motion] | None:
    """How the body moved from frame to frame; None where the odometry does not cover them all."""
    aiding = context.propagation.aiding
    if aiding is None:
        return None
    motions = [aiding.odometry.between(*ends) for ends in pairwise(stamps_ns)]
    known = [motion for motion in motions if motion is not None]
    return known if len(known) == len(motions) else None


def in_metres(
    poses: Sequence[gtsam.Pose3], motions: Sequence[Motion], context: EngineContext
) -> list[gtsam.Pose3] | Refusal:
    """Poses whose unit of length is not known, in metres.

    The camera moves by s c in the unit s, and the body, whose camera is at a, by
    s c - (R - 1) a = t where the odometry has the translation t, with the rotation R. This is
    linear in s; its least squares are weighted by the noise of the odometry.

    Args:
        poses: world_T_body of frames, so that the path of the first camera is right up to its unit.
        motions: from each to the next.
        context: of the rig, and of the noise of the odometry.

    Returns:
        The poses, or what is missing if the odometry does not tell the unit.
    """
    arm = context.rig.cameras[0].body_T_camera.translation()
    turns = [a.rotation().between(b.rotation()) for a, b in pairwise(poses)]
    shifts = [
        a.rotation().unrotate(b.transformFrom(arm) - a.transformFrom(arm))
        for a, b in pairwise(poses)
    ]
    seen = np.array(shifts)
    measured = np.array(
        [t + turn.rotate(arm) - arm for turn, (_, t) in zip(turns, motions, strict=True)]
    )
    ways = np.linalg.norm(seen, axis=1)
    rough = np.linalg.norm(measured, axis=1).sum() / max(ways.sum(), np.finfo(float).tiny)
    angles = [float(np.linalg.norm(turn)) for turn, _ in motions]
    noise = context.config.odometry
    sigmas = [
        motion_sigmas(angle, rough * way, noise)[1] for angle, way in zip(angles, ways, strict=True)
    ]
    weights = np.array(sigmas)[:, None] ** -2.0
    information = float(np.sum(weights * seen**2))
    unit = float(np.sum(weights * seen * measured)) / max(information, np.finfo(float).tiny)
    if not unit * np.sqrt(information) > 1.0 / _MAX_SIGMA:
        return Refusal("motion", "odometry of a longer way, which tells the scale")
    origin = poses[0].transformFrom(arm)
    found = []
    for pose in poses:
        camera = origin + unit * (pose.transformFrom(arm) - origin)
        found.append(gtsam.Pose3(pose.rotation(), camera - pose.rotation().rotate(arm)))
    return found
