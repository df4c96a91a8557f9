# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure at the end of a run: recognise places that are revisited, and correct the drift.

    keyframes → place recognition → verification → pose graph → trajectory and map

The causal and the smoothed trajectory stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import Trajectory
from slam_graph.loop_closure.loop_config import LoopClosureConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.loop_closure.loop_pose_graph import SegmentBreak, correct_keyframes
from slam_graph.loop_closure.loop_verification import Loop, LoopVerifier
from slam_graph.loop_closure.place_joint import PlaceJoint, place_joints
from slam_graph.loop_closure.place_recognition import PlaceRecognition, Vocabulary
from slam_graph.loop_closure.similarity_graph import correct_up_to_scale
from slam_graph.pose_graph import PoseGraphSolution, Poses
from slam_graph.sensors import Rig

_MAX_PASSES = 3
"""The pose graph is solved again while loop closures are rejected, at most this often: the drift of
odometry is learned from the accepted ones."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosures:
    """The loop closures of a run.

    Attributes:
        keyframes: K keyframes.
        loops: L loop closures that passed verification.
        accepted: (L,) whether the pose graph kept them.
        poses: K corrected world_T_body.
        breaks: where the trajectory was lost and starts again.
        joints: how well the place after each break is known relative to that before; None where no
            accepted loop closure joins them.
        scales: (K,) by how much lengths near each keyframe grow; None for not at all.
    """

    keyframes: list[Keyframe]
    loops: list[Loop]
    accepted: BoolArray
    poses: Poses
    breaks: Sequence[SegmentBreak] = ()
    joints: Sequence[PlaceJoint | None] = ()
    scales: FloatArray | None = None

    def correct(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory without its drift: each pose moves with the keyframes around it.

        These are the one before and the one after, as far as they are of the same segment.
        """
        if not self.accepted.any():
            return trajectory
        stamps = np.array([k.stamp_ns for k in self.keyframes])
        before = np.clip(np.searchsorted(stamps, trajectory.stamps_ns, "right") - 1, 0, None)
        after = np.minimum(before + 1, len(stamps) - 1)
        length = np.maximum(stamps[after] - stamps[before], 1)
        weight = np.clip((trajectory.stamps_ns - stamps[before]) / length, 0.0, 1.0)
        own, earlier, later = (
            np.searchsorted([gap.begin_ns for gap in self.breaks], times, "right")
            for times in (trajectory.stamps_ns, stamps[before], stamps[after])
        )
        weight = np.where(later != own, 0.0, np.where(earlier != own, 1.0, weight))
        causal = Poses.from_gtsam([k.world_T_body for k in self.keyframes])
        body = Poses(Rotation.from_quat(trajectory.quaternions).as_matrix(), trajectory.positions)
        first, second = (
            self.poses.select(at).compose(self._seen_from(causal, at, body))
            for at in (before, after)
        )
        mixed = _interpolated(first, second, weight)
        return Trajectory(
            trajectory.stamps_ns,
            mixed.translations,
            Rotation.from_matrix(mixed.rotations).as_quat(),
        )

    def _seen_from(self, causal: Poses, at: IntArray, body: Poses) -> Poses:
        """Poses (N) of the body in the frames of keyframes (N,), in corrected lengths."""
        seen = causal.select(at).inverse().compose(body)
        if self.scales is None:
            return seen
        return Poses(seen.rotations, self.scales[at, None] * seen.translations)

    def accepted_ns(self) -> IntArray:
        """(A, 2) times of the two keyframes of each loop closure that was accepted."""
        stamps = [keyframe.stamp_ns for keyframe in self.keyframes]
        kept = (self.loops[k] for k in np.flatnonzero(self.accepted))
        ends = [(stamps[loop.first], stamps[loop.second]) for loop in kept]
        return np.array(ends, np.int64).reshape(-1, 2)

    def across(self, begin_ns: int, end_ns: int) -> int:
        """How many accepted loop closures join what is before a segment with the segment.

        Args:
            begin_ns: time of its first state.
            end_ns: time of its last state.
        """
        pairs = self.accepted_ns().tolist()
        return sum(min(pair) < begin_ns <= max(pair) <= end_ns for pair in pairs)

    def csv_lines(self) -> Iterator[str]:
        """The loop closures that passed verification, as CSV."""
        yield "first_stamp_ns,second_stamp_ns,inliers,matches,accepted\n"
        for loop, accepted in zip(self.loops, self.accepted.tolist(), strict=True):
            stamps = (self.keyframes[k].stamp_ns for k in (loop.first, loop.second))
            row = (*stamps, loop.inliers, loop.matches, int(accepted))
            yield ",".join(map(str, row)) + "\n"

    def points(self) -> FloatArray:
        """(P, 3) world points of all features, each from its last keyframe."""
        last: dict[int, FloatArray] = {}
        scales = np.ones(len(self.keyframes)) if self.scales is None else self.scales
        for keyframe, R, p, scale in zip(
            self.keyframes, self.poses.rotations, self.poses.translations, scales, strict=True
        ):
            keyframe = replace(keyframe, points=scale * keyframe.points)
            ids, points = keyframe.world_points(gtsam.Pose3(gtsam.Rot3(R), p))
            last.update(zip(ids.tolist(), points, strict=True))
        return np.array(list(last.values())).reshape(-1, 3)


def _interpolated(first: Poses, second: Poses, weight: FloatArray) -> Poses:
    """Poses interpolated between two, with weights (N,) from 0 to 1 of the second."""
    a = Rotation.from_matrix(first.rotations)
    step = (a.inv() * Rotation.from_matrix(second.rotations)).as_rotvec()
    rotations = a * Rotation.from_rotvec(weight[:, None] * step)
    offset = weight[:, None] * (second.translations - first.translations)
    return Poses(rotations.as_matrix(), first.translations + offset)


def close_loops(
    keyframes: list[Keyframe],
    rig: Rig,
    config: LoopClosureConfig,
    seed: int = 0,
    diagnostics: Diagnostics | None = None,
    breaks: Sequence[SegmentBreak] = (),
) -> LoopClosures:
    """Find the loop closures of a run and correct its keyframes.

    Args:
        keyframes: in the order of time.
        rig: the cameras.
        config: settings.
        seed: of the training of the vocabulary.
        diagnostics: counts rejected loop closures.
        breaks: where the trajectory was lost and starts again.
    """
    loops = _find_loops(keyframes, rig, config, seed)
    return correct_by(keyframes, loops, config, diagnostics, breaks, rig.has_scale)


def correct_by(
    keyframes: list[Keyframe],
    loops: list[Loop],
    config: LoopClosureConfig,
    diagnostics: Diagnostics | None = None,
    breaks: Sequence[SegmentBreak] = (),
    has_scale: bool = True,
) -> LoopClosures:
    """Correct keyframes by loop closures, some of which may be false.

    Args:
        keyframes: in the order of time.
        loops: between them.
        config: settings.
        diagnostics: counts rejected loop closures where there is a scale.
        breaks: where the trajectory was lost and starts again.
        has_scale: whether all keyframes have one unit of length; otherwise loops have scales.
    """
    causal = Poses.from_gtsam([k.world_T_body for k in keyframes])
    if not loops:
        return LoopClosures(keyframes, [], np.zeros(0, np.bool_), causal, breaks)
    stamps = np.array([k.stamp_ns for k in keyframes])
    level = config.degrees_of_freedom == 4
    accepted = np.ones(len(loops), np.bool_)
    scales: FloatArray | None = None
    solution: PoseGraphSolution | None = None
    for _ in range(_MAX_PASSES):
        held = np.flatnonzero(accepted)
        kept = [loops[k] for k in held]
        if has_scale:
            poses, inliers, solution = correct_keyframes(
                stamps, causal, kept, config, level, diagnostics, breaks=breaks
            )
        else:
            poses, scales, inliers = correct_up_to_scale(stamps, causal, kept, config, breaks)
        accepted[held[~inliers]] = False
        if inliers.all():
            break
    closures = LoopClosures(keyframes, loops, accepted, poses, breaks, scales=scales)
    if solution is None:
        return closures
    ends_ns = [b.begin_ns - 1 for b in breaks[1:]] + [int(stamps[-1])]
    across = [closures.across(b.begin_ns, end) > 0 for b, end in zip(breaks, ends_ns, strict=False)]
    begins_ns = [b.begin_ns for b in breaks]
    joints = place_joints(stamps, begins_ns, across, poses, solution, level)
    return replace(closures, joints=joints)


def _find_loops(
    keyframes: list[Keyframe], rig: Rig, config: LoopClosureConfig, seed: int = 0
) -> list[Loop]:
    """The loop closures that pass verification, in the order of time."""
    if len(keyframes) < 2:
        return []
    places = config.places
    vocabulary = Vocabulary.train(
        [k.descriptors for k in keyframes], places.words, np.random.default_rng(seed)
    )
    recognition = PlaceRecognition(vocabulary, places)
    verifier = LoopVerifier(rig.cameras[0], config.verification, rig.has_scale)
    loops = []
    for number, keyframe in enumerate(keyframes):
        for candidate in recognition.add(keyframe).tolist():
            gravity = config.degrees_of_freedom == 4
            loop = verifier.verify(keyframes, candidate, number, gravity)
            if loop is not None:
                loops.append(loop)
    return loops
