# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""A pose graph as arrays: poses, and measured relative poses between them, in 2D or 3D.

Conventions: a pose is world_T_pose. An edge (i, j) measures i_T_j = world_T_i⁻¹ world_T_j.
Information matrices are in the order of files, translation before rotation. g2o means that of a 3D
rotation for the vector part of the quaternion, about half the angle; GTSAM and most programs that
read these files take it for the angle. Which one is meant goes with the graph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.geometry.trajectory import Trajectory

RotationInformation = Literal["angle", "quaternion"]

MAX_STAMP_S = 9_000_000_000
"""Ids of poses beyond this do not fit into nanoseconds as seconds."""


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

    def select(self, index: IntArray) -> Poses:
        """Some of the poses."""
        return Poses(self.rotations[index], self.translations[index])

    def compose(self, other: Poses) -> Poses:
        """Each pose times that of the same row."""
        moved = np.einsum("nij,nj->ni", self.rotations, other.translations)
        return Poses(self.rotations @ other.rotations, self.translations + moved)

    def inverse(self) -> Poses:
        """Each pose inverted."""
        back = self.rotations.transpose(0, 2, 1)
        return Poses(back, -np.einsum("nij,nj->ni", back, self.translations))

    @staticmethod
    def identity(count: int, dimension: int) -> Poses:
        """So many poses at the origin."""
        return Poses(np.tile(np.eye(dimension), (count, 1, 1)), np.zeros((count, dimension)))

    def angles(self) -> FloatArray:
        """(N,) angle of each rotation in radians; in 2D with its sign."""
        if self.dimension == 2:
            return np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        angles: FloatArray = Rotation.from_matrix(self.rotations).magnitude()
        return angles

    def in_space(self) -> Poses:
        """The same poses in 3D, on the plane z = 0 if they are in 2D."""
        if self.dimension == 3:
            return self
        rotations = np.tile(np.eye(3), (len(self), 1, 1))
        rotations[:, :2, :2] = self.rotations
        return Poses(rotations, np.pad(self.translations, ((0, 0), (0, 1))))


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """A pose graph of N poses and M edges.

    Attributes:
        keys: (N,) ids of the poses in the file, increasing.
        estimates: poses that came with the graph, or None.
        edges: (M, 2) rows of the two poses of each edge.
        measured: M relative poses i_T_j.
        information: (M, k, k), k = 3 in 2D and 6 in 3D: translation, then rotation.
        rotation_information: what that of a 3D rotation belongs to: the angle (GTSAM), or the
            vector part of the quaternion (g2o).
        name: of the graph.
    """

    keys: IntArray
    estimates: Poses | None
    edges: IntArray
    measured: Poses
    information: FloatArray
    rotation_information: RotationInformation = "angle"
    name: str = "pose graph"

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
        """(M, k, k) information of the translation and the angle, to first order."""
        if self.dimension == 2 or self.rotation_information == "angle":
            return self.information
        half = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
        information: FloatArray = self.information * half[:, None] * half
        return information

    @cached_property
    def precisions(self) -> tuple[FloatArray, FloatArray]:
        """Isotropic precisions that fit the information best: κ of rotations, τ of translations.

        Each (M,), as SE-Sync has them (`chordal_objective.py`).
        """
        d, information = self.dimension, self.angle_information
        τ = d / np.trace(np.linalg.inv(information[:, :d, :d]), axis1=1, axis2=2)
        if d == 2:
            return information[:, 2, 2], τ
        κ = 1.5 / np.trace(np.linalg.inv(information[:, 3:, 3:]), axis1=1, axis2=2)
        return κ, τ

    @property
    def is_odometry(self) -> NDArray[np.bool_]:
        """(M,) whether an edge joins a pose to the next one; all others are loop closures."""
        consecutive: NDArray[np.bool_] = np.abs(np.diff(self.edges, axis=1))[:, 0] == 1
        return consecutive

    @cached_property
    def components(self) -> IntArray:
        """(N,) number of the connected part that each pose belongs to."""
        n, (i, j) = len(self.keys), self.edges.T
        links = coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
        labels: IntArray = connected_components(links, directed=False)[1].astype(np.int64)
        return labels

    @cached_property
    def anchors(self) -> IntArray:
        """Row of the first pose of each connected part: it defines the part's frame."""
        return np.unique(self.components, return_index=True)[1].astype(np.int64)

    def anchor_poses(self) -> Poses:
        """Where the first pose of each connected part is held."""
        if self.estimates is None:
            return Poses.identity(len(self.anchors), self.dimension)
        return self.estimates.select(self.anchors)

    def keep_edges(self, kept: NDArray[np.bool_] | IntArray) -> PoseGraph:
        """The graph with all poses and only some of its edges."""
        return replace(
            self,
            edges=self.edges[kept],
            measured=Poses(self.measured.rotations[kept], self.measured.translations[kept]),
            information=self.information[kept],
        )

    def weighted(self, weights: FloatArray) -> PoseGraph:
        """The graph with factors (M,) on the information of its edges."""
        return replace(self, information=self.information * weights[:, None, None])

    def add_edges(self, edges: IntArray, measured: Poses, information: FloatArray) -> PoseGraph:
        """The graph with further edges behind its own."""
        return replace(
            self,
            edges=np.concatenate([self.edges, edges]),
            measured=Poses(
                np.concatenate([self.measured.rotations, measured.rotations]),
                np.concatenate([self.measured.translations, measured.translations]),
            ),
            information=np.concatenate([self.information, information]),
        )

    def trajectory(self, poses: Poses) -> Trajectory:
        """Poses as a trajectory: the id of a pose (or its row, if ids are too large) in seconds."""
        fits = np.abs(self.keys).max(initial=0) <= MAX_STAMP_S
        seconds = self.keys if fits else np.arange(len(self.keys))
        space = poses.in_space()
        quaternions = Rotation.from_matrix(space.rotations).as_quat()
        return Trajectory(seconds * 10**9, space.translations, quaternions)
