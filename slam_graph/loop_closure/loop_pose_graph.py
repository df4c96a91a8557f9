# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a run with loop closures, in four degrees of freedom or six.

An accelerometer and a gyroscope see the vertical, so roll and pitch of a visual-inertial estimate
do not drift; yaw and position do. With world_R_body = R_z(ψ) A, where R_z(ψ) is the turn about the
vertical and A the rest, each body has a *level* frame with orientation R_z(ψ), and a relative pose
i_T_j becomes one of level frames, A_i i_T_j A_j⁻¹, whose rotation is a turn about the vertical, up
to noise. Only that turn is kept. A graph of level measurements has its optimum at level poses: ψ
and the position are estimated, A stays exactly as it was. What solves any pose graph in space so
solves this one (Qin, Li and Shen 2018 write the four degrees of freedom out instead).

How much odometry drifts, from what loop closures say of it.

Where a place is seen again after t seconds, odometry is off by its drift, of variance σ² t if that
is a random walk, and by the error of the loop closure. σ is what makes the median of all squared
errors, in units of these variances, the median of χ². False loop closures hardly change a median.
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_verification import Loop
from slam_graph.pose_graph.graph import PoseGraph, Poses
from slam_graph.pose_graph.gtsam_graph import ROTATION_FIRST

MIN_LOOPS = 10
"""With fewer the settings hold."""
LEAST, MOST = 0.03, 10.0
"""What is learned is not less, nor more, than so many times what the settings say."""


def drift_sigmas(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    measured: Poses,
    config: LoopClosureConfig,
) -> tuple[float, float]:
    """Drift of the yaw (rad/√s) and of the position on each axis (m/√s).

    Args:
        stamps_ns: (N,) of the keyframes.
        poses: world_T_body of these by odometry.
        loops: between them.
        measured: (L,) relative poses of the loops.
        config: what holds if there are few loops.
    """
    said = config.odometry_rotation_sigma, config.odometry_position_sigma
    if len(loops) < MIN_LOOPS or not config.learn_drift:
        return said
    first, second = np.array([(x.first, x.second) for x in loops]).T
    seconds = np.abs(stamps_ns[second] - stamps_ns[first]) * 1e-9
    expected = poses.select(first).inverse().compose(poses.select(second))
    shift = measured.translations - expected.translations
    turn = measured.rotations.transpose(0, 2, 1) @ expected.rotations
    # of the turn, in the frame of the second body, the part about the vertical
    up = poses.rotations[second][:, 2]
    yaw = np.sum(up * Rotation.from_matrix(turn).as_rotvec(), axis=1)
    covariances = np.array([x.covariance for x in loops])
    of_yaw = np.einsum("ni,nij,nj->n", up, covariances[:, :3, :3], up)
    of_shift = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    return (
        _sigma(yaw**2, of_yaw, seconds, 1, said[0]),
        _sigma(np.sum(shift**2, axis=1), of_shift, seconds, 3, said[1]),
    )


def _sigma(
    squares: FloatArray, variances: FloatArray, seconds: FloatArray, freedom: int, said: float
) -> float:
    """σ of a random walk over some seconds that explains squared errors beside their variances."""

    def excess(log_sigma: float) -> float:
        whole = variances + np.exp(2.0 * log_sigma) * seconds
        return float(np.median(squares / whole) - chi2.median(freedom))

    low, high = np.log(LEAST * said), np.log(MOST * said)
    if excess(low) <= 0.0:
        return float(np.exp(low))
    if excess(high) >= 0.0:
        return float(np.exp(high))
    return float(np.exp(brentq(excess, low, high)))


LEVEL_SIGMA_RAD = 1e-4
"""How far from level the poses of a level graph may be."""


def loop_graph(
    stamps_ns: IntArray,
    poses: Poses,
    loops: list[Loop],
    config: LoopClosureConfig,
    recording_of: IntArray | None = None,
) -> PoseGraph:
    """Keyframes, the odometry between each and the next, and loop closures.

    Args:
        stamps_ns: (N,) times of the keyframes.
        poses: estimates world_T_body that drift.
        loops: between them.
        config: degrees of freedom, and how much odometry drifts if loops do not tell.
        recording_of: (N,) number of the recording of each keyframe, if there are several: there is
            no odometry from one to another.

    Returns:
        A graph of level frames if there are four degrees of freedom, else of bodies.
    """
    count = len(stamps_ns)
    before = np.arange(count - 1)
    if recording_of is not None:
        before = np.flatnonzero(np.diff(recording_of) == 0)
    odometry = poses.select(before).inverse().compose(poses.select(before + 1))
    seconds = np.diff(stamps_ns)[before] * 1e-9
    closures = stacked([x.first_T_second for x in loops])
    yaw, shift = drift_sigmas(stamps_ns, poses, loops, closures, config)
    sigmas = [shift] * 3 + [yaw] * 3
    edges = np.column_stack([before, before + 1])
    covariances = seconds[:, None, None] * np.diag(np.square(sigmas))
    graph = PoseGraph(
        np.arange(count), poses, edges, odometry, np.linalg.inv(covariances), name="loop closures"
    )
    if loops:
        back = np.argsort(ROTATION_FIRST)
        covariances = np.array([x.covariance[back[:, None], back] for x in loops])
        ends = np.array([(x.first, x.second) for x in loops], dtype=np.int64)
        graph = graph.add_edges(ends, closures, np.linalg.inv(covariances))
    return level(graph) if config.degrees_of_freedom == 4 else graph


def level(graph: PoseGraph) -> PoseGraph:
    """The graph of the level frames of all bodies.

    Args:
        graph: with estimates, the roll and pitch of which hold.
    """
    if graph.estimates is None:
        raise ValueError("level frames need estimates")
    upright, rest = split(graph.estimates)
    i, j = graph.edges.T
    A_i, A_j = rest.select(i), rest.select(j)
    measured = A_i.compose(graph.measured).compose(A_j.inverse())
    turns = split(Poses(measured.rotations, np.zeros_like(measured.translations)))[0]
    return PoseGraph(
        graph.keys,
        upright,
        graph.edges,
        Poses(turns.rotations, measured.translations),
        _level_information(graph.information, A_i.rotations, A_j.rotations),
        name=graph.name,
    )


def _level_information(information: FloatArray, A_i: FloatArray, A_j: FloatArray) -> FloatArray:
    """(M, 6, 6) of level measurements from that of the bodies': yaw and translation, tilt held.

    The tangent is that at the second end, so A_j turns it into the level frame there.
    """
    turned = np.zeros_like(information)
    turned[:, :3, :3] = turned[:, 3:, 3:] = A_j
    covariance = turned @ np.linalg.inv(information) @ turned.transpose(0, 2, 1)
    tilted = np.array([3, 4])
    covariance[:, tilted, :] = 0.0
    covariance[:, :, tilted] = 0.0
    covariance[:, tilted, tilted] = LEVEL_SIGMA_RAD**2
    return np.asarray(np.linalg.inv(covariance))


def split(poses: Poses) -> tuple[Poses, Poses]:
    """Level poses, and what the bodies are turned against them: poses = level ∘ rest."""
    R = poses.rotations
    # the turn about the vertical that is nearest to R
    yaw = np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1])
    turns = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    rest = turns.transpose(0, 2, 1) @ R
    return Poses(turns, poses.translations), Poses(rest, np.zeros_like(poses.translations))


def corrected(graph: PoseGraph, estimates: Poses, causal: Poses, dof: int) -> Poses:
    """Poses of the bodies from the estimates of a loop graph.

    Args:
        graph: what was solved.
        estimates: of its poses.
        causal: those of the bodies before.
        dof: 4 if the graph is one of level frames.
    """
    if dof == 6:
        return estimates
    upright, _ = split(estimates)
    return upright.compose(split(causal)[1])


def stacked(poses: list[gtsam.Pose3]) -> Poses:
    """GTSAM's poses as arrays."""
    matrices = np.array([pose.matrix() for pose in poses]).reshape(-1, 4, 4)
    return Poses(matrices[:, :3, :3], matrices[:, :3, 3])
