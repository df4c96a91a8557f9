# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The poses of all frames of some values in one array: one by one they take eight times as long."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """Poses X(i) of F frames.

    Attributes:
        rows: the row of each frame.
        matrices: (F, 4, 4) world_T_body.
    """

    rows: dict[int, int]
    matrices: FloatArray

    @staticmethod
    def of(values: gtsam.Values, frames: list[int]) -> PoseTable:
        """Those of values.

        Args:
            values: with a pose of each frame; other poses have smaller keys than these.
            frames: all F that have a pose X(i), ascending.
        """
        matrices = np.zeros((len(frames), 4, 4))
        if frames:
            parts = gtsam.utilities.extractPose3(values)[-len(frames) :]
            matrices[:, :3, :3] = parts[:, :9].reshape(-1, 3, 3)
            matrices[:, :3, 3] = parts[:, 9:]
            matrices[:, 3, 3] = 1.0
        return PoseTable.from_rows(frames, matrices)

    @staticmethod
    def from_rows(frames: list[int], matrices: FloatArray) -> PoseTable:
        """The poses (F, 4, 4) of frames, ascending."""
        return PoseTable(dict(zip(frames, range(len(frames)), strict=True)), matrices)

    def with_pose(self, frame: int, pose: gtsam.Pose3) -> PoseTable | None:
        """With the pose of a further frame; None if that is not the last one."""
        frames = list(self.rows)
        if frames and frame <= frames[-1]:
            return None
        matrices = np.empty((len(frames) + 1, 4, 4))
        matrices[:-1], matrices[-1] = self.matrices, pose.matrix()
        return PoseTable.from_rows([*frames, frame], matrices)

    def without(self, frames: set[int]) -> PoseTable:
        """Without the poses of some frames."""
        kept = [frame for frame in self.rows if frame not in frames]
        if len(kept) == len(self.rows):
            return self
        rows = [self.rows[frame] for frame in kept]
        return PoseTable.from_rows(kept, self.matrices.take(rows, axis=0))

    def poses(self, frames: Iterable[int]) -> tuple[FloatArray, FloatArray]:
        """Rotations (K, 3, 3) and positions (K, 3) of some of the frames, in the order given."""
        rows = [self.rows[frame] for frame in frames]
        matrices = self.matrices.take(rows, axis=0) if rows else np.empty((0, 4, 4))
        return matrices[:, :3, :3], matrices[:, :3, 3]
