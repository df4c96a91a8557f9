# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure of a run: find places that were come back to, and take the drift out.

    keyframes → place recognition → verification → pose graph → trajectory and map

It works on what a run has collected and leaves the causal trajectory as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.loop_closure.loop_config import LoopClosureConfig, PlaceConfig
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.loop_closure.loop_pose_graph import corrected, loop_graph, stacked
from slam_graph.loop_closure.loop_verification import Loop, LoopVerifier
from slam_graph.loop_closure.place_recognition import PlaceDatabase, Vocabulary, best_places
from slam_graph.pose_graph.graph import Poses
from slam_graph.pose_graph.optimize import optimize_pose_graph
from slam_graph.pose_graph.pose_graph_policy import PoseGraphCostPolicy, PoseGraphPolicy
from slam_graph.sensors.rig import Rig

PASSES = 3
"""How often the pose graph is solved at most, until no loop closure is rejected any more: what
odometry drifts is learned from those that are left."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosures:
    """What became of the loops of a run.

    Attributes:
        keyframes: K places.
        loops: that passed verification.
        accepted: (L,) those that the pose graph did not reject.
        poses: K corrected world_T_body.
    """

    keyframes: list[Keyframe]
    loops: list[Loop]
    accepted: NDArray[np.bool_]
    poses: Poses

    def correct(self, trajectory: Trajectory) -> Trajectory:
        """The causal trajectory without its drift: each pose goes with the keyframes around it."""
        if not self.accepted.any():
            return trajectory
        stamps = np.array([k.stamp_ns for k in self.keyframes])
        before = np.clip(np.searchsorted(stamps, trajectory.stamps_ns, "right") - 1, 0, None)
        after = np.minimum(before + 1, len(stamps) - 1)
        length = np.maximum(stamps[after] - stamps[before], 1)
        weight = np.clip((trajectory.stamps_ns - stamps[before]) / length, 0.0, 1.0)
        causal = stacked([k.world_T_body for k in self.keyframes])
        body = Poses(Rotation.from_quat(trajectory.quaternions).as_matrix(), trajectory.positions)
        first, second = (
            self.poses.select(at).compose(causal.select(at).inverse()).compose(body)
            for at in (before, after)
        )
        mixed = _between(first, second, weight)
        return Trajectory(
            trajectory.stamps_ns,
            mixed.translations,
            Rotation.from_matrix(mixed.rotations).as_quat(),
        )

    def csv_lines(self) -> Iterator[str]:
        """A table of all loop closures that passed verification."""
        yield "first_stamp_ns,second_stamp_ns,inliers,matches,accepted\n"
        for loop, accepted in zip(self.loops, self.accepted.tolist(), strict=True):
            stamps = (self.keyframes[k].stamp_ns for k in (loop.first, loop.second))
            row = (*stamps, loop.inliers, loop.matches, int(accepted))
            yield ",".join(map(str, row)) + "\n"

    def points(self) -> FloatArray:
        """(P, 3) points of the map in the world, each where its last keyframe has it."""
        last: dict[int, FloatArray] = {}
        for keyframe, R, p in zip(
            self.keyframes, self.poses.rotations, self.poses.translations, strict=True
        ):
            ids, points = keyframe.world_points(gtsam.Pose3(gtsam.Rot3(R), p))
            last.update(zip(ids.tolist(), points, strict=True))
        return np.array(list(last.values())).reshape(-1, 3)


def _between(first: Poses, second: Poses, weight: FloatArray) -> Poses:
    """Poses on the way from one to the other, by a weight (N,) from 0 to 1."""
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
) -> LoopClosures:
    """Find the loops of a run and correct its keyframes.

    Args:
        keyframes: in the order of time.
        rig: the cameras.
        config: all settings.
        seed: of the training of the vocabulary.
        diagnostics: counts what is rejected.
    """
    return correct_by(keyframes, find_loops(keyframes, rig, config, seed), config, diagnostics)


def correct_by(
    keyframes: list[Keyframe],
    loops: list[Loop],
    config: LoopClosureConfig,
    diagnostics: Diagnostics | None = None,
) -> LoopClosures:
    """Correct keyframes by loop closures, some of which may be false."""
    causal = stacked([k.world_T_body for k in keyframes])
    if not loops:
        return LoopClosures(keyframes, [], np.zeros(0, np.bool_), causal)
    stamps = np.array([k.stamp_ns for k in keyframes])
    policy = PoseGraphPolicy(cost=PoseGraphCostPolicy(robust="gnc"))
    accepted = np.ones(len(loops), np.bool_)
    for _ in range(PASSES):
        held = np.flatnonzero(accepted)
        graph = loop_graph(stamps, causal, [loops[k] for k in held], config)
        solution = optimize_pose_graph(graph, policy, diagnostics)
        fits = solution.weights[len(solution.weights) - len(held) :] > 0.5
        accepted[held[~fits]] = False
        if fits.all():
            break
    poses = corrected(graph, solution.poses, causal, config.degrees_of_freedom)
    return LoopClosures(keyframes, loops, accepted, poses)


def find_loops(
    keyframes: list[Keyframe], rig: Rig, config: LoopClosureConfig, seed: int = 0
) -> list[Loop]:
    """The loop closures that pass verification, in the order of time."""
    if len(keyframes) < 2:
        return []
    places = config.places
    vocabulary = Vocabulary.train(
        [k.descriptors for k in keyframes],
        places.words,
        places.training_descriptors,
        places.training_iterations,
        np.random.default_rng(seed),
    )
    recognition = PlaceRecognition(vocabulary, places)
    verifier = LoopVerifier(rig.cameras[0], config.verification)
    loops = []
    for number, keyframe in enumerate(keyframes):
        for candidate in recognition.add(keyframe).tolist():
            gravity = config.degrees_of_freedom == 4
            loop = verifier.verify(keyframes, candidate, number, gravity)
            if loop is not None:
                loops.append(loop)
    return loops


class PlaceRecognition:
    """Candidates for loop closures, keyframe by keyframe.

    A candidate must be similar, and keyframes just before must have had candidates of the same
    place.

    Args:
        vocabulary: of words.
        config: thresholds.
    """

    def __init__(self, vocabulary: Vocabulary, config: PlaceConfig) -> None:
        self._vocabulary = vocabulary
        self._database = PlaceDatabase(len(vocabulary.words))
        self._config = config
        self._stamps_ns: list[int] = []
        self._similar: list[IntArray] = []

    def add(self, keyframe: Keyframe) -> IntArray:
        """Add the next keyframe, and numbers of earlier ones that may show the same place."""
        config = self._config
        bag = self._vocabulary.words_of(keyframe.descriptors)
        scores = self._database.query(bag)
        old = np.searchsorted(self._stamps_ns, keyframe.stamp_ns - config.min_gap_s * 1e9)
        # what the keyframe just before scores says how similar views of one place are here
        least = config.min_score_ratio * scores[-1] if len(scores) else 0.0
        similar = best_places(scores[:old], least, config.candidates, config.same_place)
        consistent = [place for place in similar.tolist() if self._was_similar(place)]
        self._database.add(bag)
        self._stamps_ns.append(keyframe.stamp_ns)
        self._similar.append(similar)
        return np.array(consistent, dtype=np.int64)

    def _was_similar(self, place: int) -> bool:
        """Whether the keyframes just before had candidates of this place too."""
        count, apart = self._config.consecutive, self._config.same_place
        before = self._similar[len(self._similar) - count :]
        return len(before) == count and all(
            bool(np.any(np.abs(similar - place) <= apart)) for similar in before
        )
