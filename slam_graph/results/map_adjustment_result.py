# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""All that the bundle adjustment of a map found out, and its files."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.maps.map_adjustment import MapAdjustment
from slam_graph.results.bundle_result import BalResult
from slam_graph.results.map_output import MAP_NAME, export_tum, save_map
from slam_graph.results.metrics import Table, finite
from slam_graph.results.result_files import ResultFolder

__all__ = ["MapBalResult"]


@dataclass(eq=False, repr=False)
class MapBalResult(BalResult):
    """What the bundle adjustment of a map found out.

    Attributes:
        adjustment: the map before and after.
    """

    adjustment: MapAdjustment = field(kw_only=True)

    @cached_property
    def metrics(self) -> Table:
        """The content of `metrics.json`: as of a BAL problem, and what became of the map."""
        before, after = self.adjustment.before, self.adjustment.after
        away = np.linalg.norm(after.poses.translations - before.poses.translations, axis=1)
        turns = before.poses.rotations.transpose(0, 2, 1) @ after.poses.rotations
        angles = np.degrees(Rotation.from_matrix(turns).magnitude())
        moved = np.linalg.norm(after.points - before.points, axis=1)
        found = {
            "recordings": [recording.name for recording in after.recordings],
            "keyframes_moved_m": {"rms": _rms(away), "max": float(away.max())},
            "keyframes_turned_deg": {"rms": _rms(angles), "max": float(angles.max())},
            "features_moved_m": {"median": float(np.median(moved)), "max": float(moved.max())},
            "intrinsics": self._intrinsics(),
        }
        return {**super().metrics, "map": finite(found)}

    def _intrinsics(self) -> list[Table]:
        """Of each recording: focal length beyond the calibrated one, and distortion left by it."""
        content, problem = self.adjustment.after, self.solution.problem
        _, first = np.unique(content.recording_of, return_index=True)
        before, after = problem.estimates.intrinsics[first], self.solution.estimates.intrinsics
        return [
            {"focal_ratio": f / f_before, "k1": k1, "k2": k2}
            for (f, k1, k2), (f_before, _, _) in zip(
                after[first].tolist(), before.tolist(), strict=True
            )
        ]

    def save_estimates(self, files: ResultFolder) -> None:
        """Write the map, and the poses of its keyframes, one file for each recording."""
        path = files.path(MAP_NAME)
        self.save_problem(path)
        files.files += export_tum(self.adjustment.after, path.with_name("trajectory.tum"))

    def save_problem(self, path: Path | str) -> None:
        """Write the map, over what is there."""
        save_map(self.adjustment.after, path, force=True)


def _rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))
