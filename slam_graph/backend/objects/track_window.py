# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The features of the last frames, static or not, and how well they fit given poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from slam_graph.arrays import FloatArray, IntArray
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import FeatureTracks, Observations, is_in
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.cost.triangulation import Triangulation, triangulate
from slam_graph.backend.objects.ego_motion import EgoMotion, pose_arrays
from slam_graph.backend.objects.row_motions import row_motions
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.sensors import FeatureFrame, Rig

_SPACING_S = 0.08
"""Past frames nearer to one another than this say the same: an object estimated anew over two
seconds of 20 Hz costs twice what it does with every second frame, and is not more accurate."""


class TrackWindow:
    """Features of the last frame and of past ones at a least spacing.

    Args:
        rig: the cameras.
        backend: thresholds of triangulation.
    """

    def __init__(self, rig: Rig, backend: BackendConfig) -> None:
        self.rig = rig
        self._projection = RigProjection(rig)
        self._ego: EgoMotion | None = None
        self.frames: deque[FeatureFrame] = deque()
        self._backend = backend
        self._tracks = FeatureTracks()
        self._numbers: deque[int] = deque()  # of the frames in the tracks
        self._count = 0
        self._known: dict[tuple[int, ...], Observations] = {}  # of what the last frame saw

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the frames, ascending."""
        return [frame.stamp_ns for frame in self.frames]

    @property
    def seen(self) -> IntArray:
        """Ids (N,) of all features that the last frame saw, ascending."""
        return self._tracks.seen

    def add(self, frame: FeatureFrame, since_ns: int, ego: EgoMotion | None = None) -> None:
        """Add a frame; forget those before a time, and the last one if it is near to the others.

        Args:
            frame: its features.
            since_ns: the time.
            ego: the motion of the platform, which counts for rolling shutters only.
        """
        self._ego = ego
        self._tracks.add(self._count, frame)
        self._known.clear()
        self.frames.append(frame)
        self._numbers.append(self._count)
        self._count += 1
        if len(self.frames) > 2:
            past, last = self.frames[-3].stamp_ns, self.frames[-2].stamp_ns
            if last - past < _SPACING_S * 1e9:
                del self.frames[-2]
                del self._numbers[-2]
        while self.frames[0].stamp_ns < since_ns:
            self.frames.popleft()
            self._numbers.popleft()
        self._tracks.keep_frames(list(self._numbers))

    def projection(
        self, stamps_ns: Sequence[int] = (), poses: Sequence[gtsam.Pose3] = ()
    ) -> RigProjection:
        """The cameras; rows of rolling shutters are exposed while the platform moves.

        Args:
            stamps_ns: of frames; observations have their numbers.
            poses: of the platform in each, in the world or in the frame of an object.
        """
        if self._ego is None or not self._projection.rolling:
            return self._projection
        return self._projection.moving(row_motions(self._ego, stamps_ns, poses))

    @property
    def motions(self) -> Mapping[int, FrameMotion]:
        """Of the platform within frames, by their stamps; none with global shutters."""
        return {} if self._ego is None else self._ego.motions

    def pixels(self, ids: IntArray) -> tuple[IntArray, FloatArray]:
        """Those of some features that the last frame saw, and where its first camera did.

        Args:
            ids: of the features, ascending.

        Returns:
            Their ids (N,), ascending, and pixels (N, 2): of the next camera where the first one
            did not see them.
        """
        cameras = self.frames[-1].cameras
        seen, rows = np.unique(np.concatenate([c.ids for c in cameras]), return_index=True)
        wanted = is_in(seen, ids)
        pixels = np.concatenate([c.pixels for c in cameras])
        return seen[wanted], pixels[rows[wanted]]

    def observations(self, ids: IntArray, least: int, stamps_ns: list[int]) -> Observations:
        """Observations in some frames of the features (ascending ids) that enough of them saw.

        Args:
            ids: of the features; those that the last frame did not see are left out.
            least: how many frames must have seen a feature.
            stamps_ns: of the frames; `frame` and `frames` of the result are numbers among them.
        """
        asked = least, *stamps_ns
        known = self._known.get(asked)  # all tests of a frame ask for the same frames
        if known is None:
            known = self._known[asked] = self._observations(self.seen, least, stamps_ns)
        obs = known.subset(is_in(known.ids, ids))
        idle = not np.bincount(obs.frame, minlength=len(obs.frames)).all()
        return obs.without_idle_frames() if idle else obs

    def _observations(self, ids: IntArray, least: int, stamps_ns: list[int]) -> Observations:
        here = dict(zip(self.stamps_ns, self._numbers, strict=True))
        chosen = [here[stamp] for stamp in stamps_ns if stamp in here]
        obs = self._tracks.observations(ids, chosen)
        frames = np.zeros((len(ids), len(obs.frames)), np.bool_)
        frames[obs.feature, obs.frame] = True
        enough = (frames.sum(axis=1) >= least) & (obs.counts >= 2)
        obs = obs.subset(enough)
        order = {here[stamp]: row for row, stamp in enumerate(stamps_ns) if stamp in here}
        numbers = tuple(order[number] for number in obs.frames)
        return Observations(
            obs.ids, numbers, obs.feature, obs.frame, obs.camera, obs.pixels, obs.normalized
        )

    def misfit(
        self, ids: IntArray, poses: dict[int, gtsam.Pose3], sigma_px: float, least: int = 3
    ) -> tuple[IntArray, FloatArray, IntArray]:
        """How well features fit as static points of a world in which the platform moved so.

        Args:
            ids: of the features, ascending.
            poses: world_T_body by the stamps of frames.
            sigma_px: standard deviation of the observations.
            least: how many of these frames must have seen a feature.

        Returns:
            Ids (J,) of those that were seen often enough, their squared errors (J,) over σ², and
            degrees of freedom (J,).
        """
        stamps = [stamp for stamp in self.stamps_ns if stamp in poses]
        obs = self.observations(ids, least, stamps)
        found = self.triangulated(obs, stamps, [poses[stamp] for stamp in stamps])
        return obs.ids, squared_errors(obs, found, sigma_px), 2 * obs.counts - 3

    def triangulated(
        self, obs: Observations, stamps_ns: Sequence[int], poses: Sequence[gtsam.Pose3]
    ) -> Triangulation:
        """Some of the observations as static points of a world.

        Args:
            obs: as `observations` gives them.
            stamps_ns: of the frames that were asked for there.
            poses: world_T_body in each.
        """
        if len(obs) == 0:
            none = np.zeros(0)
            return Triangulation(none.reshape(0, 3), none.astype(np.bool_), none, none)
        rotations, positions = pose_arrays(tuple(poses[row] for row in obs.frames))
        rig, config = self.projection(stamps_ns, poses), self._backend.triangulation
        return triangulate(obs, rig, rotations, positions, config)


def squared_errors(obs: Observations, found: Triangulation, sigma_px: float) -> FloatArray:
    """(J,) squared errors of features over σ²; infinite for those without a position."""
    squares = obs.counts * (found.reprojection_px / sigma_px) ** 2
    return np.asarray(np.where(np.isfinite(squares), squares, np.inf))


def quantile(values: FloatArray, share: float) -> float:
    """A quantile of some values (N,), N at least one; NumPy's takes many times as long.

    Linear between values, with NumPy's roundings.
    """
    ascending = np.sort(values)
    place = share * (len(ascending) - 1)
    row = int(place)
    a, b = float(ascending[row]), float(ascending[min(row + 1, len(ascending) - 1)])
    part = place - row
    return b - (b - a) * (1.0 - part) if part >= 0.5 else a + (b - a) * part
