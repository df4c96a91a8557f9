# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A pose graph as arrays: poses, and measured relative poses between them, in 2D or 3D.

Conventions: a pose is world_T_pose. An edge (i, j) measures i_T_j = world_T_i⁻¹ world_T_j.
Information matrices have the order of the files, translation before rotation. In g2o that of a 3D
rotation belongs to the vector part of the quaternion, about half the angle; GTSAM and most programs
that read these files take it as that of the angle. `PoseGraph.rotation_information` says which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import gtsam
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial.transform import Rotation

from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.display import Displayed
from slam_graph.errors import DataError
from slam_graph.geometry import Trajectory

RotationInformation = Literal["angle", "quaternion"]

InformationRepair = Literal["nearest", "isotropic"]
"""What stands in for an information matrix that is not positive definite: the nearest one that is,
or the isotropic information of its blocks of translation and rotation, as SE-Sync takes it."""

_LONGEST_STEP = 10
"""Ids may count poses, of which a few are missing, or be times: two poses whose ids are farther
apart than so many usual steps (the median) are not consecutive."""

_MAX_STAMP_S = 9_000_000_000
"""Larger ids, taken as seconds, do not fit into nanoseconds."""


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """N poses in d dimensions.

    Attributes:
        rotations: (N, d, d).
        translations: (N, d) in metres.
    """

    rotations: FloatArray
    translations: FloatArray

    def __len__(self) -> int:
        return len(self.translations)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.translations.shape[1])

    def select(self, index: IntArray | BoolArray) -> Poses:
        """Some of the poses."""
        return Poses(self.rotations[index], self.translations[index])

    def compose(self, other: Poses) -> Poses:
        """Each pose composed with the pose of the same row."""
        moved = np.einsum("nij,nj->ni", self.rotations, other.translations)
        return Poses(self.rotations @ other.rotations, self.translations + moved)

    def inverse(self) -> Poses:
        """Each pose inverted."""
        back = self.rotations.transpose(0, 2, 1)
        return Poses(back, -np.einsum("nij,nj->ni", back, self.translations))

    @staticmethod
    def identity(count: int, dimension: int) -> Poses:
        """Identity poses."""
        return Poses(np.tile(np.eye(dimension), (count, 1, 1)), np.zeros((count, dimension)))

    @staticmethod
    def from_gtsam(poses: Sequence[gtsam.Pose3]) -> Poses:
        """Poses of GTSAM as arrays."""
        matrices = np.array([pose.matrix() for pose in poses]).reshape(-1, 4, 4)
        return Poses(matrices[:, :3, :3], matrices[:, :3, 3])

    def pose3(self, row: int) -> gtsam.Pose3:
        """One of the poses (in 3D) for GTSAM."""
        return gtsam.Pose3(gtsam.Rot3(self.rotations[row]), self.translations[row])

    def concatenated(self, other: Poses) -> Poses:
        """These poses, followed by others."""
        return Poses(
            np.concatenate([self.rotations, other.rotations]),
            np.concatenate([self.translations, other.translations]),
        )

    def angles(self) -> FloatArray:
        """(N,) angle of each rotation in radians, in 2D with its sign."""
        if self.dimension == 2:
            return np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        angles: FloatArray = Rotation.from_matrix(self.rotations).magnitude()
        return angles

    def in_space(self) -> Poses:
        """The same poses in 3D; 2D poses lie on the plane z = 0."""
        if self.dimension == 3:
            return self
        rotations = np.tile(np.eye(3), (len(self), 1, 1))
        rotations[:, :2, :2] = self.rotations
        return Poses(rotations, np.pad(self.translations, ((0, 0), (0, 1))))


@dataclass(frozen=True, eq=False, repr=False)
class PoseGraph(Displayed):
    """A pose graph of N poses and M edges.

    Attributes:
        keys: (N,) ids of the poses in the file, increasing.
        estimates: initial estimates of the file, or None.
        edges: (M, 2) rows of the two poses of each edge.
        measured: M relative poses i_T_j.
        information: (M, k, k), k = 3 in 2D and 6 in 3D: translation, then rotation.
        rotation_information: whether the information of a 3D rotation belongs to the angle (GTSAM)
            or to the vector part of the quaternion (g2o).
        name: of the graph.
        odometry: (M,) whether each edge is odometry; those between consecutive poses if not given
            (`is_odometry`). Files do not carry it.
    """

    keys: IntArray
    estimates: Poses | None
    edges: IntArray
    measured: Poses
    information: FloatArray
    rotation_information: RotationInformation = "angle"
    name: str = "pose graph"
    odometry: BoolArray | None = None

    def __repr__(self) -> str:
        loops = int(np.count_nonzero(~self.is_odometry))
        return (
            f"PoseGraph({self.name}: {len(self.keys)} poses in {self.dimension}D, "
            f"{len(self.edges)} edges, {loops} loop closures)"
        )

    def _facts(self) -> dict[str, object]:
        return {
            "name": self.name,
            "poses": f"{len(self.keys)}, in {self.dimension}D",
            "edges": len(self.edges),
            "loop closures": int(np.count_nonzero(~self.is_odometry)),
            "connected parts": len(self.anchors),
            "initial estimates": "none" if self.estimates is None else "of the file",
        }

    def plot(self) -> Any:
        """The initial estimates, joined by the edges, as a figure.

        Raises:
            DataError: if the graph has none; `optimize_pose_graph` finds some.
        """
        if self.estimates is None:
            raise DataError(f"{self.name}: no initial estimates to draw; optimise it first")
        return self._drawn_by("pose_graph_picture").pose_graph_figure(
            f"{self.name}  ·  {len(self.keys)} poses, {len(self.edges)} edges",
            {"": self.estimates.translations},
            self.edges,
            self.is_odometry,
        )

    def _sketch(self) -> Any:
        return None if self.estimates is None else self.plot()

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.measured.dimension

    @property
    def tangent_size(self) -> int:
        """Degrees of freedom of a pose: 3 or 6."""
        return 3 * (self.dimension - 1)

    @property
    def angle_information(self) -> FloatArray:
        """(M, k, k) information of the translation and the rotation angle, to first order."""
        if self.dimension == 2 or self.rotation_information == "angle":
            return self.information
        half = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
        information: FloatArray = self.information * half[:, None] * half
        return information

    @cached_property
    def precisions(self) -> tuple[FloatArray, FloatArray]:
        """Isotropic precisions (M,) that fit the information best, as in SE-Sync.

        κ of the rotations and τ of the translations, for `graph_initialization.py`.
        """
        d, information = self.dimension, self.angle_information
        τ = d / np.trace(np.linalg.inv(information[:, :d, :d]), axis1=1, axis2=2)
        if d == 2:
            return information[:, 2, 2], τ
        κ = 1.5 / np.trace(np.linalg.inv(information[:, 3:, 3:]), axis1=1, axis2=2)
        return κ, τ

    @cached_property
    def is_odometry(self) -> BoolArray:
        """(M,) whether an edge is odometry; all others are loop closures.

        Unless `odometry` says it: edges between poses that follow each other in the order of ids,
        without a gap of more than ten usual steps as between two sessions. An edge across such a
        gap is odometry, too, if without it the graph would be in two parts: nothing contradicts it.
        """
        if self.odometry is not None:
            return self.odometry
        follows = np.abs(np.diff(self.edges, axis=1))[:, 0] == 1
        steps = np.abs(np.diff(self.keys[self.edges], axis=1))[:, 0]
        usual = np.median(np.diff(self.keys)) if len(self.keys) > 1 else 1
        near: BoolArray = follows & (steps <= _LONGEST_STEP * usual)
        return near if np.array_equal(near, follows) else near | (follows & _bridges(self))

    @cached_property
    def components(self) -> IntArray:
        """(N,) number of the connected component of each pose."""
        n, (i, j) = len(self.keys), self.edges.T
        links = coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
        labels: IntArray = connected_components(links, directed=False)[1].astype(np.int64)
        return labels

    @cached_property
    def anchors(self) -> IntArray:
        """Row of the first pose of each connected component: it defines the frame."""
        return np.unique(self.components, return_index=True)[1].astype(np.int64)

    def anchor_poses(self) -> Poses:
        """The fixed poses of the anchors."""
        if self.estimates is None:
            return Poses.identity(len(self.anchors), self.dimension)
        return self.estimates.select(self.anchors)

    def keep_edges(self, kept: BoolArray | IntArray) -> PoseGraph:
        """The graph with all poses and some of its edges."""
        return replace(
            self,
            edges=self.edges[kept],
            measured=self.measured.select(kept),
            information=self.information[kept],
            odometry=None if self.odometry is None else self.odometry[kept],
        )

    def weighted(self, weights: FloatArray) -> PoseGraph:
        """The graph with the information of its edges multiplied by weights (M,)."""
        return replace(self, information=self.information * weights[:, None, None])

    def add_edges(self, edges: IntArray, measured: Poses, information: FloatArray) -> PoseGraph:
        """The graph with loop closures appended, which may join consecutive poses, too."""
        return replace(
            self,
            edges=np.concatenate([self.edges, edges]),
            measured=self.measured.concatenated(measured),
            information=np.concatenate([self.information, information]),
            odometry=np.concatenate([self.is_odometry, np.zeros(len(edges), np.bool_)]),
        )

    def trajectory(self, poses: Poses) -> Trajectory:
        """Poses as a trajectory; times are ids (or rows, if ids are too large) in seconds."""
        fits = np.abs(self.keys).max(initial=0) <= _MAX_STAMP_S
        seconds = self.keys if fits else np.arange(len(self.keys))
        space = poses.in_space()
        quaternions = Rotation.from_matrix(space.rotations).as_quat()
        return Trajectory(seconds * 10**9, space.translations, quaternions)


def _bridges(graph: PoseGraph) -> BoolArray:
    """(M,) which edges alone join two parts of the graph.

    Each edge beside a spanning tree closes a cycle and has a random label; it cancels in all
    branches that have both of its ends. So a branch without a label hangs on its tree edge alone.
    """
    n, m = len(graph.keys), len(graph.edges)
    roots = np.column_stack([graph.anchors, np.full(len(graph.anchors), n)])  # all hang on one more
    ends = np.concatenate([np.sort(graph.edges, axis=1), roots])
    links = coo_matrix((np.ones(len(ends)), tuple(ends.T)), shape=(n + 1, n + 1))
    order, before = breadth_first_order(links.tocsr(), n, directed=False)
    row_of = {pair: row for row, pair in enumerate(map(tuple, ends.tolist()))}
    children = order[:0:-1].tolist()  # leaves first
    rows = [row_of[min(i, before[i]), max(i, before[i])] for i in children]
    labels = np.random.default_rng(0).integers(1, 2**63, len(ends))
    labels[rows] = 0
    marks = np.zeros(n + 1, np.int64)
    np.bitwise_xor.at(marks, ends, labels[:, None])
    alone = np.zeros(len(ends), np.bool_)
    for child, row in zip(children, rows, strict=True):
        alone[row] = marks[child] == 0
        marks[before[child]] ^= marks[child]
    return alone[:m]
