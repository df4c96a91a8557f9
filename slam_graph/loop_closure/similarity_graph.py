# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a run whose scale is unknown, in seven degrees of freedom.

One camera without an IMU measures no length, so its scale drifts as its pose does. Each keyframe i
has a similarity S_i that takes its own frame, in which its points are known in the unit of length
of that time, to the world: x ↦ s (R x + t). By odometry S_i⁻¹ S_j has a scale of one, up to the
drift; a loop closure measures it, by the depths of points that both keyframes know (Strasdat,
Montiel & Davison 2010). False loop closures are found by graduated non-convexity (Yang et al. 2020)
as GTSAM has it.

The tangent is that of GTSAM's `Similarity3`: rotation, translation, logarithm of the scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_pose_graph import (
    MIN_LOOPS,
    SegmentBreak,
    configured_drift,
    walk_sigma,
)
from slam_graph.loop_closure.loop_verification import Loop
from slam_graph.pose_graph import Poses

_ANCHOR_SIGMA = 1e-6
"""Prior on the first keyframe: it fixes pose and scale of the world."""
_UNKNOWN_SCALE = 1.0
"""Standard deviation of the logarithm of the scale of a segment relative to the one before."""


def correct_up_to_scale(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    config: LoopClosureConfig,
    breaks: Sequence[SegmentBreak] = (),
) -> tuple[Poses, FloatArray, BoolArray]:
    """Keyframes without drift of pose and scale, by loop closures some of which may be false.

    Args:
        stamps_ns: (N,) times of the keyframes.
        poses: drifting estimates world_T_body.
        loops: L, with their scales.
        config: the drift of odometry.
        breaks: of the trajectory, in the order of time.

    Returns:
        The corrected world_T_body; (N,) by how much lengths near each keyframe grow; and (L,)
        whether the pose graph kept the loop closure.
    """
    segment_of = np.searchsorted([b.begin_ns for b in breaks], stamps_ns, "right")
    graph = similarity_graph(stamps_ns, poses, loops, config, breaks)
    parameters = gtsam.GncLMParams()
    parameters.setKnownInliers(list(range(graph.size() - len(loops))))
    start = _start(poses, loops, segment_of)
    optimizer = gtsam.GncLMOptimizer(graph, start, parameters)
    solved = optimizer.optimize()
    kept = np.asarray(optimizer.getWeights())[graph.size() - len(loops) :] > 0.5
    found = [solved.atSimilarity3(k) for k in range(len(stamps_ns))]
    rotations = np.array([similarity.rotation().matrix() for similarity in found])
    scales = np.array([similarity.scale() for similarity in found])
    places = scales[:, None] * np.array([similarity.translation() for similarity in found])
    return Poses(rotations, places), scales, kept


def similarity_graph(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    config: LoopClosureConfig,
    breaks: Sequence[SegmentBreak] = (),
) -> gtsam.NonlinearFactorGraph:
    """The prior on the first keyframe, odometry, and loop closures, in this order.

    Args:
        stamps_ns: (N,) times of the keyframes.
        poses: drifting estimates world_T_body.
        loops: between them, with their scales.
        config: the drift of odometry.
        breaks: of the trajectory, in the order of time.
    """
    graph = gtsam.NonlinearFactorGraph()
    anchor = gtsam.noiseModel.Isotropic.Sigma(7, _ANCHOR_SIGMA)
    graph.add(gtsam.PriorFactorSimilarity3(0, _similarity(poses.pose3(0)), anchor))
    segment_of = np.searchsorted([b.begin_ns for b in breaks], stamps_ns, "right")
    inside = [x for x in loops if segment_of[x.first] == segment_of[x.second]]
    walk = np.repeat(_drift(stamps_ns, poses, inside, config), [3, 3, 1])
    for k in range(len(stamps_ns) - 1):
        variances = walk**2 * (stamps_ns[k + 1] - stamps_ns[k]) * 1e-9
        if segment_of[k] != segment_of[k + 1]:
            turn, offset = breaks[int(segment_of[k])].joint_sigmas
            variances += np.repeat(np.square([turn, offset, _UNKNOWN_SCALE]), [3, 3, 1])
        noise = gtsam.noiseModel.Diagonal.Variances(variances)
        moved = _similarity(poses.pose3(k).between(poses.pose3(k + 1)))
        graph.add(gtsam.BetweenFactorSimilarity3(k, k + 1, moved, noise))
    for loop in loops:
        graph.add(loop_factor(loop))
    return graph


def loop_factor(loop: Loop) -> gtsam.BetweenFactorSimilarity3:
    """A loop closure that measures the scale, too.

    A point x of the second keyframe is at R (s x) + t in the first one.
    """
    pose, scale = loop.first_T_second, loop.scale
    measured = gtsam.Similarity3(pose.rotation(), pose.translation() / scale, scale)
    # the tangent is at the second keyframe, in its own unit of length
    units = np.repeat([1.0, 1.0 / scale], 3)
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = units[:, None] * loop.covariance * units
    covariance[6, 6] = loop.scale_sigma**2
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.BetweenFactorSimilarity3(loop.first, loop.second, measured, noise)


def _similarity(pose: gtsam.Pose3) -> gtsam.Similarity3:
    """A pose, with a scale of one."""
    return gtsam.Similarity3(pose.rotation(), pose.translation(), 1.0)


def _start(poses: Poses, loops: list[Loop], segment_of: IntArray) -> gtsam.Values:
    """The keyframes as estimated; a later segment where its best loop closure puts it."""
    found = [_similarity(poses.pose3(k)) for k in range(len(poses))]
    for segment in range(1, int(segment_of[-1]) + 1):
        across = [x for x in loops if segment_of[x.first] < segment == segment_of[x.second]]
        if not across:
            continue
        best = max(across, key=lambda x: x.inliers)
        there = found[best.first].compose(loop_factor(best).measured())
        motion = there.compose(found[best.second].inverse())
        for k in np.flatnonzero(segment_of == segment).tolist():
            found[k] = motion.compose(found[k])
    values = gtsam.Values()
    for k, similarity in enumerate(found):
        values.insert(k, similarity)
    return values


def _drift(
    stamps_ns: IntArray, poses: Poses, loops: list[Loop], config: LoopClosureConfig
) -> tuple[float, float, float]:
    """Random walks of rotation (rad/√s), position (m/√s) and logarithm of the scale (1/√s).

    That of the scale is learned from the loop closures if there are enough; a position drifts by
    its scale first of all.
    """
    turn, shift = configured_drift(config)
    scale = config.odometry_scale_sigma
    if len(loops) < MIN_LOOPS or not config.learn_drift:
        return turn, shift, scale
    seconds = np.array([abs(stamps_ns[x.second] - stamps_ns[x.first]) * 1e-9 for x in loops])
    squares = np.log([x.scale for x in loops]) ** 2
    variances = np.array([x.scale_sigma**2 for x in loops])
    ends = np.array([(x.first, x.second) for x in loops])
    expected = poses.select(ends[:, 0]).inverse().compose(poses.select(ends[:, 1]))
    measured = Poses.from_gtsam([x.first_T_second for x in loops])
    turns = (
        Poses(
            measured.rotations.transpose(0, 2, 1) @ expected.rotations, expected.translations
        ).angles()
        ** 2
    )
    of_turns = np.trace([x.covariance[:3, :3] for x in loops], axis1=1, axis2=2) / 3.0
    return (
        walk_sigma(turns, of_turns, seconds, 3, turn),
        shift,
        walk_sigma(squares, variances, seconds, 1, scale),
    )
