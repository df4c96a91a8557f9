# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a run with loop closures, in four degrees of freedom or six.

A visual-inertial estimate observes the vertical, so that roll and pitch do not drift; yaw and
position do. With world_R_body = R_z(ψ) A, where R_z(ψ) is the rotation about the vertical and A the
rest, each body has a *level* frame with orientation R_z(ψ), and a relative pose i_T_j becomes one
of level frames, A_i i_T_j A_j⁻¹, whose rotation is about the vertical, up to noise. Only that
rotation is kept. A graph of level measurements has its optimum at level poses: ψ and the position
are estimated, A stays as it was. So any pose-graph solver solves the 4-DoF problem (Qin, Li and
Shen 2018 write it out instead).

`drift_sigmas` estimates the drift of odometry from the loop closures. After t seconds odometry is
off by its drift, of variance σ² t for a random walk, and by the error of the loop closure. σ is
chosen such that the median of all squared errors, in units of these variances, is the median of χ²,
which is robust to false loop closures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import scipy  # its parts are imported when they are first used
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_verification import Loop
from slam_graph.pose_graph import (
    PoseGraph,
    PoseGraphPolicy,
    PoseGraphSolution,
    Poses,
    optimize_pose_graph,
)

MIN_LOOPS = 10
"""With fewer loop closures drift is not learned."""
_MIN_DRIFT, _MAX_DRIFT = 0.03, 10.0
"""Bounds of the learned drift relative to the configured one."""
_LEVEL_SIGMA_RAD = 1e-4
"""Standard deviation of roll and pitch in a level graph, which keeps it well conditioned."""


class SegmentBreak(Protocol):
    """Where a trajectory was lost and starts again."""

    @property
    def begin_ns(self) -> int:
        """Time of the first state of the later segment."""
        ...

    @property
    def joint_sigmas(self) -> tuple[float, float]:
        """How well its yaw (rad) and position (m) are known relative to the segment before."""
        ...


def correct_keyframes(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    config: LoopClosureConfig,
    level: bool,
    diagnostics: Diagnostics | None = None,
    recording_of: IntArray | None = None,
    breaks: Sequence[SegmentBreak] = (),
) -> tuple[Poses, BoolArray, PoseGraphSolution]:
    """Poses of keyframes without their drift, by loop closures some of which may be false.

    Args:
        stamps_ns: (N,) times of the keyframes.
        poses: drifting estimates world_T_body.
        loops: L, between them.
        config: the drift of odometry; it is learned in one recording only, because several have no
            common clock.
        level: whether gravity determines roll and pitch.
        diagnostics: counts what went wrong.
        recording_of: (N,) number of the recording of each keyframe; all are of one if not given.
        breaks: of the trajectory, in the order of time.

    Returns:
        The corrected world_T_body, (L,) whether the pose graph kept the loop closure, and the
        solution of that graph.
    """
    one = recording_of is None
    segment_of = np.searchsorted([b.begin_ns for b in breaks], stamps_ns, "right")
    inside = [x for x in loops if segment_of[x.first] == segment_of[x.second]]
    drift = drift_sigmas(stamps_ns, poses, inside, config) if one else configured_drift(config)
    graph = loop_graph(stamps_ns, poses, loops, drift, level, recording_of, breaks)
    policy = PoseGraphPolicy.with_gnc("auto" if one else "file")
    solution = optimize_pose_graph(graph, policy, diagnostics)
    kept = solution.weights[len(solution.weights) - len(loops) :] > 0.5
    return body_poses(solution.poses, poses, level), kept, solution


def loop_graph(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    drift: tuple[float, float],
    level: bool,
    recording_of: IntArray | None = None,
    breaks: Sequence[SegmentBreak] = (),
) -> PoseGraph:
    """The pose graph of keyframes, odometry between consecutive ones, and loop closures.

    Args:
        stamps_ns: (N,) times of the keyframes.
        poses: drifting estimates world_T_body.
        loops: between them.
        drift: of yaw (rad/√s) and position (m/√s), see `drift_sigmas`.
        level: whether the graph is one of level frames, with four degrees of freedom.
        recording_of: (N,) number of the recording of each keyframe; between recordings there is no
            odometry. All are of one recording if not given.
        breaks: of the trajectory; odometry across one is known as well as the break says.

    Returns:
        A graph of level frames or of bodies.
    """
    count = len(stamps_ns)
    before = np.arange(count - 1)
    if recording_of is not None:
        before = np.flatnonzero(np.diff(recording_of) == 0)
    odometry = poses.select(before).inverse().compose(poses.select(before + 1))
    seconds = np.diff(stamps_ns)[before] * 1e-9
    closures = Poses.from_gtsam([x.first_T_second for x in loops])
    yaw, shift = drift
    sigmas = [shift] * 3 + [yaw] * 3
    edges = np.column_stack([before, before + 1])
    covariances = seconds[:, None, None] * np.diag(np.square(sigmas))
    for gap in breaks:
        across = (stamps_ns[before] < gap.begin_ns) & (stamps_ns[before + 1] >= gap.begin_ns)
        turn, offset = gap.joint_sigmas
        covariances[across] += np.diag(np.square([offset] * 3 + [turn] * 3))
    name = "loop closures" if recording_of is None else "merged maps"
    graph = PoseGraph(
        np.arange(count), poses, edges, odometry, np.linalg.inv(covariances), name=name
    )
    if loops:
        # GTSAM has the rotation first, a pose graph the translation
        covariances = np.roll([x.covariance for x in loops], 3, axis=(1, 2))
        ends = np.array([(x.first, x.second) for x in loops], dtype=np.int64)
        graph = graph.add_edges(ends, closures, np.linalg.inv(covariances))
    return level_graph(graph) if level else graph


def level_graph(graph: PoseGraph) -> PoseGraph:
    """The graph of the level frames of all bodies.

    Args:
        graph: with estimates, whose roll and pitch are kept.
    """
    if graph.estimates is None:
        raise ValueError("level frames need estimates")
    upright, rest = split_yaw(graph.estimates)
    i, j = graph.edges.T
    A_i, A_j = rest.select(i), rest.select(j)
    measured = A_i.compose(graph.measured).compose(A_j.inverse())
    turns = split_yaw(Poses(measured.rotations, np.zeros_like(measured.translations)))[0]
    return replace(
        graph,
        estimates=upright,
        measured=Poses(turns.rotations, measured.translations),
        information=_level_information(graph.information, A_i.rotations, A_j.rotations),
    )


def _level_information(information: FloatArray, A_i: FloatArray, A_j: FloatArray) -> FloatArray:
    """(M, 6, 6) information of level measurements: yaw and translation; roll and pitch fixed.

    The tangent is that at the second end, so A_j rotates it into the level frame there.
    """
    rotation = np.zeros_like(information)
    rotation[:, :3, :3] = rotation[:, 3:, 3:] = A_j
    covariance = rotation @ np.linalg.inv(information) @ rotation.transpose(0, 2, 1)
    tilted = np.array([3, 4])
    covariance[:, tilted, :] = 0.0
    covariance[:, :, tilted] = 0.0
    covariance[:, tilted, tilted] = _LEVEL_SIGMA_RAD**2
    return np.asarray(np.linalg.inv(covariance))


def split_yaw(poses: Poses) -> tuple[Poses, Poses]:
    """Level poses, and the remaining rotations: poses = level ∘ rest."""
    R = poses.rotations
    # the rotation about the vertical nearest to R
    yaw = np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1])
    turns = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    rest = turns.transpose(0, 2, 1) @ R
    return Poses(turns, poses.translations), Poses(rest, np.zeros_like(poses.translations))


def body_poses(estimates: Poses, causal: Poses, level: bool) -> Poses:
    """Poses of the bodies from the estimates of a loop graph.

    Args:
        estimates: optimum of the loop graph.
        causal: poses of the bodies before, which give roll and pitch of a level graph.
        level: whether the graph is one of level frames.
    """
    return split_yaw(estimates)[0].compose(split_yaw(causal)[1]) if level else estimates


def drift_sigmas(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    config: LoopClosureConfig,
) -> tuple[float, float]:
    """Random walk of the yaw (rad/√s) and of the position on each axis (m/√s).

    Args:
        stamps_ns: (N,) of the keyframes.
        poses: world_T_body of these by odometry.
        loops: between them.
        config: the drift if there are few loops, or it is not to be learned.
    """
    configured = configured_drift(config)
    if len(loops) < MIN_LOOPS or not config.learn_drift:
        return configured
    measured = Poses.from_gtsam([x.first_T_second for x in loops])
    first, second = np.array([(x.first, x.second) for x in loops]).T
    seconds = np.abs(stamps_ns[second] - stamps_ns[first]) * 1e-9
    expected = poses.select(first).inverse().compose(poses.select(second))
    shift = measured.translations - expected.translations
    turn = measured.rotations.transpose(0, 2, 1) @ expected.rotations
    # the rotation error about the vertical, in the frame of the second body
    up = poses.rotations[second][:, 2]
    yaw = np.sum(up * Rotation.from_matrix(turn).as_rotvec(), axis=1)
    covariances = np.array([x.covariance for x in loops])
    of_yaw = np.einsum("ni,nij,nj->n", up, covariances[:, :3, :3], up)
    of_shift = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    return (
        walk_sigma(yaw**2, of_yaw, seconds, 1, configured[0]),
        walk_sigma(np.sum(shift**2, axis=1), of_shift, seconds, 3, configured[1]),
    )


def configured_drift(config: LoopClosureConfig) -> tuple[float, float]:
    """The drift of odometry that is set."""
    return config.odometry_rotation_sigma, config.odometry_position_sigma


def walk_sigma(
    squares: FloatArray, variances: FloatArray, seconds: FloatArray, freedom: int, configured: float
) -> float:
    """σ of a random walk that explains squared errors beyond their own variances."""
    median = 2.0 * gammaincinv(0.5 * freedom, 0.5)  # of chi-squared

    def excess(log_sigma: float) -> float:
        whole = variances + np.exp(2.0 * log_sigma) * seconds
        return float(np.median(squares / whole) - median)

    low, high = np.log(_MIN_DRIFT * configured), np.log(_MAX_DRIFT * configured)
    if excess(low) <= 0.0:
        return float(np.exp(low))
    if excess(high) >= 0.0:
        return float(np.exp(high))
    return float(np.exp(scipy.optimize.brentq(excess, low, high)))
