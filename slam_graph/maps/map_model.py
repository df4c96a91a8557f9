# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A map: keyframes, the features that they see, and what recognises them again.

The world of a map has z up if it is aligned with gravity. Where several recordings went into it,
keyframes stand recording by recording, each in the order of time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.geometry.trajectory import Trajectory
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.loop_closure.place_recognition import Vocabulary, majority
from slam_graph.pose_graph.graph import Poses
from slam_graph.sensors.rig import Rig

Descriptors = NDArray[np.uint8]

NO_FEATURE = -1
"""Feature of an observation whose place is not known."""

PoseSource = Literal["adjusted", "loop_closed", "smoothed", "causal"]
"""Which estimate the poses of a recording come from."""


@dataclass(frozen=True, slots=True, eq=False)
class MapRecording:
    """A recording that went into a map.

    Attributes:
        name: of the recording.
        poses: where its poses came from.
        rig: its calibration.
    """

    name: str
    poses: PoseSource
    rig: Rig


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Measured relative poses between keyframes that are not neighbours in time.

    Attributes:
        ends: (L, 2) keyframes.
        measured: L poses first_T_second of the bodies.
        covariances: (L, 6, 6) in GTSAM's tangent: rotation (rad), translation (m).
    """

    ends: IntArray
    measured: Poses
    covariances: FloatArray

    def __len__(self) -> int:
        return len(self.ends)

    @staticmethod
    def none() -> Links:
        """No links."""
        return Links(np.zeros((0, 2), np.int64), Poses.identity(0, 3), np.zeros((0, 6, 6)))


@dataclass(frozen=True, eq=False)
class SlamMap:
    """K keyframes with N observations of P features.

    Attributes:
        recordings: that went into it.
        created: when, as ISO 8601 text in UTC.
        version: of slam_graph that made it.
        gravity_aligned: whether z of its world is up.
        recording_of: (K,) number of the recording of each keyframe.
        stamps_ns: (K,) times of the keyframes.
        poses: K poses world_T_body.
        points: (P, 3) positions of the features in the world, in metres.
        feature_descriptors: (P, B) what they look like: the bits that most observations have.
        offsets: (K + 1,) first observation of each keyframe, and N.
        features: (N,) the feature that is seen; -1 where its position is not known.
        normalized: (N, 2) where the first camera sees it, on the plane z = 1.
        descriptors: (N, B) what it looks like there.
        links: between keyframes that see the same place.
        vocabulary: that makes words of descriptors.
    """

    recordings: tuple[MapRecording, ...]
    created: str
    version: str
    gravity_aligned: bool
    recording_of: IntArray
    stamps_ns: IntArray
    poses: Poses
    points: FloatArray
    feature_descriptors: Descriptors
    offsets: IntArray
    features: IntArray
    normalized: FloatArray
    descriptors: Descriptors
    links: Links
    vocabulary: Vocabulary

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @cached_property
    def seen_by(self) -> csr_matrix:
        """(K, P) number of observations of each feature in each keyframe."""
        known = self.features >= 0
        rows, columns = self.keyframe_of[known], self.features[known]
        shape = (len(self), len(self.points))
        return csr_matrix((np.ones(len(rows), np.int64), (rows, columns)), shape=shape)

    @cached_property
    def keyframe_of(self) -> IntArray:
        """(N,) the keyframe of each observation."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    def pose(self, number: int) -> gtsam.Pose3:
        """world_T_body of a keyframe."""
        return gtsam.Pose3(
            gtsam.Rot3(self.poses.rotations[number]), self.poses.translations[number]
        )

    def descriptors_of(self, number: int) -> Descriptors:
        """(n, B) what a keyframe sees."""
        return self.descriptors[self.offsets[number] : self.offsets[number + 1]]

    def keyframe(self, number: int) -> Keyframe:
        """A keyframe with the points that it sees; its ids are those of features."""
        rows = slice(self.offsets[number], self.offsets[number + 1])
        features, pose = self.features[rows], self.pose(number)
        points = np.full((len(features), 3), np.nan)
        known = features >= 0
        points[known] = in_body(pose, self.points[features[known]])
        return Keyframe(
            int(self.stamps_ns[number]),
            pose,
            features,
            self.normalized[rows],
            self.descriptors[rows],
            points,
        )

    def trajectory(self, recording: int = 0) -> Trajectory:
        """The keyframes of one recording."""
        rows = np.flatnonzero(self.recording_of == recording)
        quaternions = Rotation.from_matrix(self.poses.rotations[rows]).as_quat()
        return Trajectory(self.stamps_ns[rows], self.poses.translations[rows], quaternions)

    def trajectories(self) -> Iterator[Trajectory]:
        """The keyframes of each recording."""
        return (self.trajectory(number) for number in range(len(self.recordings)))

    def summary(self) -> dict[str, Any]:
        """What it holds, as a table; lengths in metres."""
        low, high = (f(self.poses.translations, axis=0) for f in (np.min, np.max))
        path = sum(
            float(np.linalg.norm(np.diff(t.positions, axis=0), axis=1).sum())
            for t in self.trajectories()
        )
        return {
            "keyframes": len(self),
            "features": len(self.points),
            "observations": len(self.features),
            "links": len(self.links),
            "words": len(self.vocabulary.words),
            "descriptor_bits": 8 * self.descriptors.shape[1],
            "extent_m": (high - low).tolist(),
            "path_m": path,
            "gravity_aligned": self.gravity_aligned,
            "created": self.created,
            "slam_graph": self.version,
        }


def in_body(pose: gtsam.Pose3, points: FloatArray) -> FloatArray:
    """Points (N, 3) of the world in the frame of a body at world_T_body."""
    rotation: FloatArray = pose.rotation().matrix()
    return np.asarray((points - pose.translation()) @ rotation)


def common_look(descriptors: Descriptors, features: IntArray, count: int) -> Descriptors:
    """(P, B) bits that most observations of each feature have; features without any have zeros.

    Args:
        descriptors: (N, B) of observations.
        features: (N,) what they are of; negative ones are left out.
        count: P.
    """
    known = features >= 0
    looks = np.zeros((count, descriptors.shape[1]), np.uint8)
    if not known.any():
        return looks
    for byte in range(descriptors.shape[1]):  # all bits of a long recording at once take gigabytes
        column = slice(byte, byte + 1)
        bits = np.unpackbits(descriptors[known, column], axis=1).astype(np.int32)
        looks[:, column] = majority(bits, features[known], looks[:, column])
    return looks
