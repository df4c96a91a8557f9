# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A map: keyframes, the features that they observe, the vocabulary.

The z axis of a gravity-aligned map is up. In a map of several recordings the keyframes are ordered
by recording, and in time within each.
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
from slam_graph.display import Displayed
from slam_graph.geometry import Trajectory
from slam_graph.loop_closure import Keyframe, Vocabulary
from slam_graph.pose_graph import Poses
from slam_graph.sensors import Rig

NO_FEATURE = -1
"""Feature index of an observation without a triangulated point."""

PoseSource = Literal["adjusted", "loop_closed", "smoothed", "causal"]
"""The estimate that the poses of a recording come from (adjusted: by an earlier version)."""


@dataclass(frozen=True, slots=True, eq=False)
class MapRecording:
    """A recording that a map was made of.

    Attributes:
        name: of the recording.
        poses: the estimate that its poses come from.
        rig: its calibration.
    """

    name: str
    poses: PoseSource
    rig: Rig


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Measured relative poses between keyframes: loop closures, and matches between maps.

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

    def concatenated(self, other: Links) -> Links:
        """These links, followed by others."""
        return Links(
            np.concatenate([self.ends, other.ends]),
            self.measured.concatenated(other.measured),
            np.concatenate([self.covariances, other.covariances]),
        )

    @staticmethod
    def none() -> Links:
        """No links."""
        return Links(np.zeros((0, 2), np.int64), Poses.identity(0, 3), np.zeros((0, 6, 6)))


@dataclass(frozen=True, eq=False, repr=False)
class SlamMap(Displayed):
    """K keyframes with N observations of P features.

    Attributes:
        recordings: that it was made of.
        created: time, ISO 8601 in UTC.
        version: of slam_graph that made it.
        gravity_aligned: whether the z axis of its world is up.
        recording_of: (K,) number of the recording of each keyframe.
        stamps_ns: (K,) times of the keyframes.
        poses: K poses world_T_body.
        points: (P, 3) positions of the features in the world, in metres.
        feature_descriptors: (P, B) majority of the descriptors of their observations, bit by bit.
        offsets: (K + 1,) first observation of each keyframe, and N.
        features: (N,) the observed feature; -1 without a triangulated point.
        normalized: (N, 2) observations of the first camera on the plane z = 1.
        descriptors: (N, B) of the observations.
        links: relative poses between keyframes of the same place.
        vocabulary: for place recognition.
    """

    recordings: tuple[MapRecording, ...]
    created: str
    version: str
    gravity_aligned: bool
    recording_of: IntArray
    stamps_ns: IntArray
    poses: Poses
    points: FloatArray
    feature_descriptors: NDArray[np.uint8]
    offsets: IntArray
    features: IntArray
    normalized: FloatArray
    descriptors: NDArray[np.uint8]
    links: Links
    vocabulary: Vocabulary

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        names = ", ".join(recording.name for recording in self.recordings)
        return f"SlamMap({names}: {len(self)} keyframes, {len(self.points)} features)"

    def _facts(self) -> dict[str, object]:
        table = self.summary()
        return {
            "recordings": ", ".join(f"{r.name} ({r.poses})" for r in self.recordings),
            "keyframes": table["keyframes"],
            "features": f"{table['features']}, {table['observations']} observations",
            "links": table["links"] or None,
            "path": f"{table['path_m']:.1f} m",
            "extent": " x ".join(f"{length:.1f}" for length in table["extent_m"]) + " m",
            "created": table["created"],
        }

    def plot(self) -> Any:
        """Features, and the keyframes of each recording, from above and from the side."""
        names = [recording.name for recording in self.recordings]
        alike = len(set(names)) < len(names)
        paths = {
            f"{name} ({k})" if alike else name: trajectory
            for k, (name, trajectory) in enumerate(zip(names, self.trajectories(), strict=True))
        }
        return self._drawn_by("notebook_figures").map_figure(self.points, paths)

    def _sketch(self) -> Any:
        return self.plot() if len(self) else None

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
        return self.poses.pose3(number)

    def descriptors_of(self, number: int) -> NDArray[np.uint8]:
        """(n, B) descriptors of a keyframe."""
        return self.descriptors[self.offsets[number] : self.offsets[number + 1]]

    def keyframe(self, number: int) -> Keyframe:
        """A keyframe with the points that it observes; ids are feature indices."""
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
        """Sizes of the map as a table; lengths in metres."""
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
    """World points (N, 3) in the frame of a body at world_T_body."""
    rotation: FloatArray = pose.rotation().matrix()
    return np.asarray((points - pose.translation()) @ rotation)


def majority_descriptors(
    descriptors: NDArray[np.uint8], features: IntArray, count: int
) -> NDArray[np.uint8]:
    """(P, B) majority of the descriptors of each feature, bit by bit; zeros without observations.

    Args:
        descriptors: (N, B) of observations.
        features: (N,) the observed features; negative ones are left out.
        count: P.
    """
    rows = np.flatnonzero(features >= 0)
    shape = (count, len(descriptors))
    observed = csr_matrix((np.ones(len(rows), np.int32), (features[rows], rows)), shape=shape)
    half = 0.5 * np.bincount(features[rows], minlength=count)[:, None]
    found = np.zeros((count, descriptors.shape[1]), np.uint8)
    # all bits of a long recording at once would take gigabytes
    for byte in range(descriptors.shape[1]):
        bits = np.unpackbits(descriptors[:, byte : byte + 1], axis=1).astype(np.int32)
        found[:, byte : byte + 1] = np.packbits(observed @ bits > half, axis=1)
    return found
