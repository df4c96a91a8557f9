# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The poses of a run in a map, frame by frame, and their errors against ground truth."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np

from slam_graph import evaluation
from slam_graph.arrays import BoolArray, FloatArray, IntArray
from slam_graph.errors import DataError
from slam_graph.geometry import AlignmentMode, Similarity, Trajectory

if TYPE_CHECKING:
    from slam_graph.maps import SlamMap

_POSE_WIDTH = 7
_LEAST_SHARED = 3
"""A map is aligned with the truth by at least this many keyframes."""


class LocalizationLog:
    """A growing table with a row for each frame of a run that had an estimate.

    Args:
        known: the map.

    Attributes:
        known: the map.
        seconds: total time of localization.
        counts: of comparisons with the map, by name.
    """

    def __init__(self, known: SlamMap) -> None:
        self.known = known
        self.seconds = 0.0
        self.counts: dict[str, int] = {}
        self._stamps_ns = array("q")
        self._located = array("b")
        self._sigmas = array("d")
        self._poses = array("d")

    def append(
        self,
        stamp_ns: int,
        located: bool,
        world_T_body: gtsam.Pose3 | None = None,
        position_sigma: float = np.nan,
    ) -> None:
        """Add a frame.

        Args:
            stamp_ns: its time.
            located: whether the estimate is certain enough to count as located.
            world_T_body: estimate of the pose in the map, if there is one.
            position_sigma: its standard deviation on the axis where it is largest, m.
        """
        self._stamps_ns.append(stamp_ns)
        self._located.append(located)
        self._sigmas.append(position_sigma)
        if world_T_body is None:
            self._poses.extend([np.nan] * _POSE_WIDTH)
            return
        quaternion: Any = world_T_body.rotation().toQuaternion()  # unknown to the stubs
        self._poses.extend([*world_T_body.translation(), *quaternion.coeffs()])

    def count(self, **counts: int) -> None:
        """Add to counts, by name."""
        for name, number in counts.items():
            self.counts[name] = self.counts.get(name, 0) + number

    def forget_from(self, stamp_ns: int) -> None:
        """Forget the poses at and after a time; their frames count as not located."""
        for row in range(bisect_left(self._stamps_ns, stamp_ns), len(self._stamps_ns)):
            self._located[row], self._sigmas[row] = False, np.nan

    def __repr__(self) -> str:
        return f"LocalizationLog({int(self.located.sum())} of {len(self.located)} frames located)"

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) times of the frames."""
        return np.array(self._stamps_ns, dtype=np.int64)

    @property
    def located(self) -> BoolArray:
        """(N,) whether the pose in the map was known at that frame."""
        return np.array(self._located, dtype=np.bool_)

    def trajectory(self) -> Trajectory:
        """Poses in the world of the map, of the frames where they are known."""
        rows = np.array(self._poses, dtype=np.float64).reshape(-1, _POSE_WIDTH)[self.located]
        return Trajectory(self.stamps_ns[self.located], rows[:, :3], rows[:, 3:])

    def csv_lines(self) -> Iterator[str]:
        """A table of all frames."""
        yield "stamp_ns,located,sigma_position_m\n"
        for stamp_ns, located, sigma in zip(
            self._stamps_ns, self._located, self._sigmas, strict=True
        ):
            text = "" if np.isnan(sigma) else f"{sigma:.6g}"
            yield f"{stamp_ns},{located},{text}\n"

    def table(self, start_ns: int, frames: int, truth: Trajectory | None) -> dict[str, Any]:
        """The table for `metrics.json`.

        Args:
            start_ns: time of the state at the first frame that was asked for.
            frames: number of frames that were read.
            truth: the true trajectory, if there is one.
        """
        stamps_ns = self.stamps_ns[self.located]
        return {
            "map": [recording.name for recording in self.known.recordings],
            "frames": frames,
            "located": len(stamps_ns),
            "located_share": len(stamps_ns) / max(frames, 1),
            "first_s": float(stamps_ns[0] - start_ns) * 1e-9 if len(stamps_ns) else None,
            **self.counts,
            "ms_per_frame": 1e3 * self.seconds / max(frames, 1),
            "alignment": _unmeasured(self.known),
            "accuracy": self._accuracy(truth),
        }

    def _accuracy(self, truth: Trajectory | None) -> dict[str, Any] | None:
        """Errors under each alignment; `map`: aligned by the map's own keyframes."""
        located = self.trajectory()
        if truth is None or len(located) == 0:
            return None
        by_map: dict[str, Any]
        try:
            similarity = map_alignment(truth, self.known)
            by_map = evaluation.accuracy_report(truth, similarity.apply(located))["none"]
        except DataError as error:
            by_map = {"unavailable": str(error)}
        return {"map": by_map, **evaluation.accuracy_report(truth, located)}


def map_alignment(truth: Trajectory, known: SlamMap) -> Similarity:
    """The transformation from the world of a map to that of the truth, by the map's keyframes.

    Yaw and position are aligned, and the whole pose where the map's z axis is not vertical.

    Raises:
        DataError: if the truth does not cover the map's keyframes.
    """
    pairs = []
    for keyframes in known.trajectories():
        try:
            pairs.append(evaluation.synchronize(truth, keyframes))
        except DataError:
            continue
    if sum(len(true) for true, _ in pairs) < _LEAST_SHARED:
        raise DataError(f"the truth covers fewer than {_LEAST_SHARED} keyframes of the map")
    true, own = (np.concatenate([pair[side].positions for pair in pairs]) for side in (0, 1))
    return Similarity.of_positions(true, own, _unmeasured(known))


def _unmeasured(known: SlamMap) -> AlignmentMode:
    """The alignment of what nothing measured of the world of a map."""
    return "yaw" if known.gravity_aligned else "se3"


def errors_in_map(
    truth: Trajectory, located: Trajectory, similarity: Similarity
) -> tuple[FloatArray, FloatArray]:
    """Errors of position (N,) in metres and orientation (N,) in degrees of poses in a map.

    Args:
        truth: the true trajectory.
        located: poses in the map.
        similarity: from the world of the map to that of the truth.

    Raises:
        DataError: if the two share no time.
    """
    moved = similarity.apply(located)
    return evaluation.ape(truth, moved, "trans_part").values, evaluation.ape(
        truth, moved, "angle_deg"
    ).values
