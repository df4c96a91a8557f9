# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Platform and objects as one problem: poses of both, points of both, IMU, dynamics of the objects.

With X the pose of the platform in the world and Y that in the frame of an object, static features
and the IMU depend on X alone, and the images of the object on Y alone. Both are in the dynamics of
the object, by the motions U = X_0⁻¹ X_1 of the platform between keyframes. An error e on the right
of U moves all later Y, so that they obey the dynamics as before: with δ the errors of Y as far as
they are free of this,

    δY = δ + T e,   e = δX_1 - Ad(U⁻¹) δX_0.

T e is a motion of the frame of the object, and a velocity: an object that goes on with the velocity
that it had in the world goes another way for a platform that has turned by e. The dynamics know
nothing of e then, and the images, of information S and gradient g on Y, are what remains of the
object. With the covariance P of all of its variables, and g' their gradient, its elimination leaves

    Tᵀ (S - S P S) T   and   Tᵀ (g - S P g')

on e, and δ = -P S T e. That is added to the equations of the platform (`pose_equations.py`), and
one Gauss-Newton step of the joint problem and its covariances follow. It is exact to first order,
but for what an object turns within one interval, where the velocity of the platform is concerned,
and for what the noise of the IMU adds to e between two keyframes of the platform. Tracks that the
platform has fused count under one of their numbers.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.smoothing.final_adjustment import FinalBa
from slam_graph.backend.smoothing.keyframe_states import state_at
from slam_graph.backend.smoothing.pose_equations import PoseEquations
from slam_graph.backend.smoothing.state_covariances import with_covariances
from slam_graph.backend.smoothing.state_elimination import STATE
from slam_graph.backend.solve.state import POSE_DIM
from slam_graph.geometry import NavState, Trajectory, interpolate

logger = logging.getLogger(__name__)

_MOST_SHARED = 0.1
"""An object that has a larger share of its tracks in common with the platform, which held them for
static, says nothing new of it: their errors would count twice."""


def joined(
    platform: FinalBa, objects: Mapping[int, FinalBa]
) -> tuple[FinalBa, dict[int, JointObject]]:
    """The minimum of platform and objects together.

    Args:
        platform: its adjustment.
        objects: those of the platform in the frames of objects, by number.

    Returns:
        Platform and objects after the joint step. Those whose equations are not known, or all if
        the step cannot be taken, stay as they are.
    """
    known = {number: item for number, item in objects.items() if item.equations is not None}
    together: list[JointObject] = []
    if platform.equations is not None and known:
        try:
            platform, together = _step(platform, list(known.values()))
        except (RuntimeError, np.linalg.LinAlgError) as error:
            logger.info("objects are not joined to the platform: %s", error)
    apart = {number: JointObject(platform, relative) for number, relative in objects.items()}
    return platform, apart | dict(zip(known, together, strict=False))


def _step(platform: FinalBa, objects: Sequence[FinalBa]) -> tuple[FinalBa, list[JointObject]]:
    """Platform and objects, with equations, after a Gauss-Newton step.

    Raises:
        RuntimeError: if the objects contradict the platform: they ask for a cost that is smaller by
            more than the number of motions that they measure.
    """
    parts = [_Coupling.of(platform, found) for found in objects]
    equations = platform.equations
    assert equations is not None
    size = POSE_DIM * len(equations.keyframes)
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for part in parts:
        information += part.rows.T @ (part.rows.T @ part.information).T
        gradient += part.rows.T @ part.gradient
    equations = equations.with_information(information)
    step = equations.step(gradient)
    decrease = float(step[:, :POSE_DIM].ravel() @ gradient)
    measured = sum(part.rows.shape[0] for part in parts)
    if not decrease <= measured:  # NaN is not either
        raise RuntimeError(f"they ask for a step of {decrease:.3g} instead of at most {measured}")
    best = _moved(platform, equations, step, known=True)
    moved = []
    for found, part in zip(objects, parts, strict=True):
        assert found.equations is not None
        own = np.zeros((len(found.equations.keyframes), STATE))
        own[:, :POSE_DIM] = (part.gain @ (part.rows @ step[:, :POSE_DIM].ravel())).reshape(
            -1, POSE_DIM
        )
        relative = _moved(found, found.equations.without_images(), own, known=False)
        moved.append(JointObject(best, relative, part))
    return best, moved


@dataclass(frozen=True, eq=False)
class JointObject:
    """An object after the joint step.

    Attributes:
        platform: the adjustment of the platform.
        relative: that of the platform in the frame of the object.
        coupling: what joins them; None where either was adjusted in several segments, or the joint
            step could not be taken, so that nothing is known of both.
    """

    platform: FinalBa
    relative: FinalBa
    coupling: _Coupling | None = None

    def covariance(self, stamps_ns: IntArray) -> FloatArray:
        """Joint covariance (6 M, 6 M) of the poses of the object in the world, in their tangents.

        If platform and object are not joined, that of each pose, as if they were independent, and
        NaN beside it.

        L = X Y⁻¹ has the error Ad(Y) (δx - δy), and δy that of its own adjustment and what errors
        of the platform add by the dynamics.

        Args:
            stamps_ns: (M,) ascending, on the clock of the poses, within both trajectories.
        """
        if self.coupling is None:
            return self._apart(stamps_ns)
        world, own = self.platform.equations, self.relative.equations
        assert world is not None
        assert own is not None
        X, _ = interpolate(self.platform.trajectory, stamps_ns)
        Y, _ = interpolate(self.relative.trajectory, stamps_ns)
        adjoint = _blocks([Y.pose(row).AdjointMap() for row in range(len(Y))])
        by_own = adjoint @ own.error_rows(stamps_ns, _rotations(Y))
        by_platform = adjoint @ world.error_rows(stamps_ns, _rotations(X))
        added = by_own @ self.coupling.gain
        whole = by_platform.toarray() - (self.coupling.rows.T @ added.T).T
        P = whole @ world.times_covariance(whole.T)
        P += by_own @ own.times_covariance(by_own.toarray().T)
        P += adjoint @ (adjoint @ world.noise_between(stamps_ns, _rotations(X)).T).T
        return np.asarray(0.5 * (P + P.T))

    def _apart(self, stamps_ns: IntArray) -> FloatArray:
        P = np.full((POSE_DIM * len(stamps_ns),) * 2, np.nan)
        path, own, world = self.relative.trajectory, self.relative.history, self.platform
        rows = np.searchsorted(path.stamps_ns, stamps_ns)
        of_world = np.searchsorted(world.trajectory.stamps_ns, stamps_ns)
        covariances = own.pose_covariances()[rows] + world.history.pose_covariances()[of_world]
        for k, (row, covariance) in enumerate(zip(rows, covariances, strict=True)):
            adjoint, at = path.pose(row).AdjointMap(), slice(POSE_DIM * k, POSE_DIM * (k + 1))
            P[at, at] = adjoint @ covariance @ adjoint.T
        return P


@dataclass(frozen=True, eq=False)
class _Coupling:
    """An object as information on the platform, its own variables eliminated.

    Attributes:
        rows: (6 I, 6 K) errors of the motions of the platform between keyframes of the object, by
            those of its own keyframes.
        information: (6 I, 6 I) on these motions.
        gradient: (6 I,) where the object alone is at its minimum.
        gain: (6 L, 6 I) what they add to the errors of the L poses in the object's frame.
    """

    rows: sparse.csr_array
    information: FloatArray
    gradient: FloatArray
    gain: FloatArray

    @staticmethod
    def of(platform: FinalBa, found: FinalBa) -> _Coupling:
        """That of an object, whose keyframes are within the trajectory of the platform."""
        own, world = found.equations, platform.equations
        assert own is not None
        assert world is not None
        stamps_ns = own.stamps_ns[own.keyframes]
        X, _ = interpolate(platform.trajectory, stamps_ns)
        Y = found.trajectory.select(own.keyframes)
        T = _carried(X, Y)
        S, gradient = own.images()
        ST = S @ T
        answer = own.times_covariance(ST)
        left = gradient - S @ own.rest()[:, :POSE_DIM].ravel()
        information = T.T @ ST - ST.T @ answer
        rows = _motion_rows(X) @ world.error_rows(stamps_ns, _rotations(X))
        shared = np.count_nonzero(np.isin(own.features, world.features))
        new = 0.0 if shared > _MOST_SHARED * len(own.features) else 1.0
        symmetric = 0.5 * new * (information + information.T)
        return _Coupling(rows, symmetric, new * (T.T @ left), T - answer)


def _carried(X: Trajectory, Y: Trajectory) -> FloatArray:
    """T (6 L, 6 L - 6): how the later of L poses move with the motions of the platform.

    Args:
        X: of the platform in the world, with velocities.
        Y: in the frame of the object, with velocities.
    """
    R, at = _rotations(Y), Y.stamps_ns * 1e-9
    assert X.velocities is not None
    assert Y.velocities is not None
    poses = [Y.pose(row) for row in range(len(Y))]
    forth = np.array([pose.AdjointMap() for pose in poses])
    back = np.array([pose.inverse().AdjointMap() for pose in poses])
    # the velocity of the object in the world, with axes of the platform
    own = np.einsum("nji,nj->ni", _rotations(X), X.velocities)
    own -= np.einsum("nji,nj->ni", R, Y.velocities)
    turned = -R @ np.cross(np.eye(3), own[:, None])
    T = np.zeros((len(Y), POSE_DIM, len(Y), POSE_DIM))
    for k in range(1, len(Y)):
        T[k:, :, k] = back[k:] @ forth[k]
        seconds = (at[k:] - at[k])[:, None, None]
        T[k:, 3:, k, :3] += seconds * (R[k:].transpose(0, 2, 1) @ turned[k])
    return T.reshape(POSE_DIM * len(Y), -1)[:, POSE_DIM:]


def _motion_rows(path: Trajectory) -> sparse.csr_array:
    """Errors (6 M - 6, 6 M) of the motions between M poses, by those of the poses."""
    poses = [path.pose(row) for row in range(len(path))]
    blocks = [
        block
        for before, now in pairwise(poses)
        for block in (-now.between(before).AdjointMap(), np.eye(POSE_DIM))
    ]
    columns = np.repeat(np.arange(len(poses) - 1), 2) + np.tile([0, 1], len(poses) - 1)
    starts = np.arange(0, len(blocks) + 1, 2)
    shape = (POSE_DIM * (len(poses) - 1), POSE_DIM * len(poses))
    return sparse.bsr_array((np.array(blocks), columns, starts), shape=shape).tocsr()


def _blocks(diagonal: Sequence[FloatArray]) -> sparse.csr_array:
    """A matrix of blocks (6, 6) on the diagonal."""
    count = len(diagonal)
    places = np.arange(count), np.arange(count + 1)
    return sparse.bsr_array((np.array(diagonal), *places)).tocsr()


def _rotations(path: Trajectory) -> FloatArray:
    """(N, 3, 3)."""
    return np.asarray(Rotation.from_quat(path.quaternions).as_matrix())


def _moved(found: FinalBa, equations: PoseEquations, step: FloatArray, known: bool) -> FinalBa:
    """An adjustment after a step.

    Args:
        found: before it.
        equations: with what was joined to it.
        step: (K, 15) of the states of the keyframes.
        known: whether covariances are to be those of the equations; they stay otherwise.
    """
    path, frames = found.trajectory, equations.frames
    part = frames.part[:, None]
    R, at = _rotations(path), equations.keyframes
    in_world = step.copy()
    for rows in (slice(0, 3), slice(3, 6)):
        in_world[:, rows] = np.einsum("kij,kj->ki", R[at], step[:, rows])
    moves = (1.0 - part) * in_world[frames.before] + part * in_world[frames.before + 1]
    for rows in (slice(0, 3), slice(3, 6)):
        moves[:, rows] = np.einsum("nji,nj->ni", R, moves[:, rows])
    states = [_retracted(state_at(path, row), move) for row, move in enumerate(moves)]
    aligned = found.aligned
    if known:
        states, aligned = with_covariances(states, equations.covariances(), frames)
    history = found.history.like()
    for state in states:
        history.append(state)
    return replace(found, history=history, aligned=aligned, equations=equations)


def _retracted(state: NavState, step: FloatArray) -> NavState:
    """A state moved by its error (15,)."""
    return replace(
        state,
        world_T_body=state.world_T_body.compose(gtsam.Pose3.Expmap(step[:6])),
        velocity=state.velocity + step[6:9],
        accel_bias=state.accel_bias + step[9:12],
        gyro_bias=state.gyro_bias + step[12:],
    )
