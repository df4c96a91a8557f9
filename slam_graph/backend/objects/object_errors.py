# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the estimated motions and poses of objects against their true ones.

The frame of an estimated object is not that of the true one, so motions are compared in the world:
with L the true pose of the object before a step and H = L_now L_before⁻¹ its motion in the world,
the error is E = (L⁻¹ H L)⁻¹ (L⁻¹ Ĥ L) (VDO-SLAM: Zhang et al. 2020; DynoSAM: Morris et al. 2025).
The worlds of estimate and truth are put together at every frame by the two poses of the platform,
so that its own drift does not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.objects.object_state import ObjectMotion, ObjectState
from slam_graph.geometry import Trajectory, interpolate


@dataclass(frozen=True, eq=False)
class ObjectErrors:
    """Errors of the steps that belong to a true object, N of them.

    Attributes:
        truth: (N,) number of the true object.
        tangents: (N, 6) of the motion errors: rotation (rad) and translation (m), object axes.
        nees: (N,) squared errors by their covariances, over 6: one where these are right.
        poses: (N, 2) rotation (rad) and translation (m) of the pose errors, once the constant
            difference of the two frames is taken from where each estimate began.
        switches: number of times that a true object went on under another number.
    """

    truth: IntArray
    tangents: FloatArray
    nees: FloatArray
    poses: FloatArray
    switches: int

    def table(self) -> dict[str, float | int]:
        """Root mean squares: motion and pose errors, NEES and identity switches."""
        rotation, translation = (
            np.linalg.norm(self.tangents[:, :3], axis=1),
            np.linalg.norm(self.tangents[:, 3:], axis=1),
        )
        return {
            "steps": len(self.tangents),
            "motion_rotation_deg": _rms(np.degrees(rotation)),
            "motion_translation_m": _rms(translation),
            "median_motion_rotation_deg": _middle(np.degrees(rotation)),
            "median_motion_translation_m": _middle(translation),
            "pose_rotation_deg": _rms(np.degrees(self.poses[:, 0])),
            "pose_translation_m": _rms(self.poses[:, 1]),
            "nees": float(np.mean(self.nees)) if len(self.nees) else np.nan,
            "identity_switches": self.switches,
        }


def motion_error(before: gtsam.Pose3, now: gtsam.Pose3, world_motion: gtsam.Pose3) -> gtsam.Pose3:
    """The error of an estimated motion in the world, in the frame of the true object.

    Args:
        before: true world_T_object before the step.
        now: the same after it.
        world_motion: estimated L_now L_before⁻¹ of any frame that is fixed to the object.
    """
    true = before.between(now)
    return true.between(before.inverse().compose(world_motion).compose(before))


def object_errors(
    states: Sequence[ObjectState],
    truth: Mapping[int, Trajectory],
    true_body: Trajectory,
    max_distance_m: float = 2.0,
) -> ObjectErrors:
    """Errors of all steps whose object belongs to a true one.

    Args:
        states: of all objects, in the order of time.
        truth: poses of the true objects by their numbers, at the stamps of the frames.
        true_body: true poses of the platform; states beyond them do not count.
        max_distance_m: farthest middle of the true object that an estimated one belongs to.
    """
    rows: list[tuple[int, FloatArray, float]] = []
    poses: list[tuple[float, float]] = []
    seen: list[tuple[int, int, int]] = []
    offsets: dict[tuple[int, int], gtsam.Pose3] = {}
    stamps = np.unique([state.stamp_ns for state in states])
    known, valid = interpolate(true_body, stamps.astype(np.int64))
    bodies = dict(zip(stamps[valid].tolist(), known, strict=True))
    placed = [
        (state, bodies[state.stamp_ns].compose(state.world_T_body.inverse()))
        for state in states
        if state.stamp_ns in bodies
    ]
    belongs = _matched(placed, truth, max_distance_m)
    for state, aligned in placed:
        number, step = belongs.get(state.number), state.step
        if number is None or step is None or not _known(truth[number], step):
            continue
        here = aligned.compose(state.world_T_object)
        before, now = (truth[number].at(stamp) for stamp in (step.before_ns, step.now_ns))
        was = here.compose(step.motion.inverse())
        tangent = gtsam.Pose3.Logmap(motion_error(before, now, here.compose(was.inverse())))
        adjoint = before.inverse().compose(was).AdjointMap()
        covariance = adjoint @ step.covariance @ adjoint.T
        rows.append((number, tangent, float(tangent @ np.linalg.solve(covariance, tangent)) / 6.0))
        seen.append((state.stamp_ns, number, state.number))
        offset = offsets.setdefault((state.number, number), here.between(now))
        error = now.between(here.compose(offset))
        turn = float(np.linalg.norm(gtsam.Rot3.Logmap(error.rotation())))
        poses.append((turn, float(np.linalg.norm(error.translation()))))
    return ObjectErrors(
        np.array([number for number, _, _ in rows], np.int64),
        np.array([tangent for _, tangent, _ in rows]).reshape(-1, 6),
        np.array([nees for _, _, nees in rows]),
        np.array(poses).reshape(-1, 2),
        _switches(seen),
    )


def _matched(
    placed: Sequence[tuple[ObjectState, gtsam.Pose3]],
    truth: Mapping[int, Trajectory],
    max_distance_m: float,
) -> dict[int, int]:
    """The true object of each estimated one: the one that is nearest over all of its steps."""
    distances: dict[int, dict[int, list[float]]] = {}
    for state, aligned in placed:
        middle = aligned.compose(state.world_T_object).translation()
        for number, path in truth.items():
            if state.step is not None and _known(path, state.step):
                away = float(np.linalg.norm(path.at(state.stamp_ns).translation() - middle))
                distances.setdefault(state.number, {}).setdefault(number, []).append(away)
    found = {}
    for estimated, others in distances.items():
        mean, number = min((float(np.mean(away)), number) for number, away in others.items())
        if mean <= max_distance_m:
            found[estimated] = number
    return found


def _known(path: Trajectory, step: ObjectMotion) -> bool:
    """Whether a true object is known at both times of a step."""
    return bool(path.stamps_ns[0] <= step.before_ns and step.now_ns <= path.stamps_ns[-1])


def _switches(seen: Sequence[tuple[int, int, int]]) -> int:
    """How often a true object goes on under none of the numbers that it had in its last frame.

    Args:
        seen: stamp, and numbers of the true and of the estimated object, in the order of time.
    """
    frames: dict[int, dict[int, set[int]]] = {}
    for stamp_ns, true, estimated in seen:
        frames.setdefault(true, {}).setdefault(stamp_ns, set()).add(estimated)
    return sum(
        not before & now
        for numbers in frames.values()
        for before, now in pairwise(numbers.values())
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def _middle(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else np.nan
