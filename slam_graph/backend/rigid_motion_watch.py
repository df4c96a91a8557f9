# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Watches which tracks move with the world, where nothing but images tells the motion.

Without an IMU an estimate may follow a near box from the first frames on: features on it are the
first whose depths are known, and the motion from frame to frame is within the noise. So frames are
compared with those of some tenths of a second before. Tracks that move as one body, and not with
the one that covers most of the image, are left out from then on. If that is found soon after the
start, the estimate begins again without them, as what was used of them would stay in it.
"""

from __future__ import annotations

from collections import deque

import gtsam
import numpy as np

from slam_graph.arrays import IntArray, ascending_union
from slam_graph.backend.backend_config import BackendConfig
from slam_graph.backend.cost.feature_tracks import is_in
from slam_graph.backend.cost.reprojection import RigProjection
from slam_graph.backend.rigid_motions import LocatedTracks, rigid_motions
from slam_graph.backend.solve.state import FrameMotion
from slam_graph.diagnostics import Diagnostics
from slam_graph.geometry import NavState
from slam_graph.sensors import FeatureFrame, Rig

_SPACING_NS = 100_000_000
"""Between frames that are compared."""
_LEAST_NS, _WINDOW_NS = 200_000_000, 400_000_000
"""How long before a frame the one is that it is compared with."""
_REVIEW_NS, _REVIEWS, _PAUSE_NS = 1_000_000_000, 3, 200_000_000
"""So long after its start an estimate begins again without what moves, so often at most, and not
before so much time has passed since the last time."""
_MOST_NEW = 0.4
"""Where a larger part of the tracks is new, they are used at once."""
_LARGE_SHARE, _LARGE_LATER, _OFTEN = 0.3, 0.5, 2
"""Where a moving body covers this share of the image area that all bodies cover, in so many
comparisons in turn, a warning says that it may be what stands still. The first share holds soon
after the start, the second later, when the world is what the estimate has followed so far."""


class RigidMotionWatch:
    """Finds the tracks that do not move with the world.

    Args:
        rig: the cameras.
        config: settings of the estimator.
        diagnostics: is told where the world is not clear.

    Attributes:
        wanted: whether frames are compared: where the images of one time measure lengths, and
            nothing else tells the motion.
        frames: those since shortly before the start, as long as it may be made again.
        moving: ids (N,) of the tracks that were found to move and are still seen, ascending.
    """

    def __init__(self, rig: Rig, config: BackendConfig, diagnostics: Diagnostics) -> None:
        self.wanted = config.dynamics.start_at_images and rig.sees_depth and not rig.has_imu
        self._rig, self._projection = rig, RigProjection(rig)
        self._diagnostics = diagnostics
        self._large = 0
        self.forget()

    def forget(self) -> None:
        """Begin without frames."""
        self.frames: deque[FeatureFrame] = deque()
        self._last: FeatureFrame | None = None
        self.moving: IntArray = np.zeros(0, np.int64)
        self._since_ns: int | None = None
        self._reviews = 0
        self._again_after_ns, self._pending = np.iinfo(np.int64).min, False
        self._past: deque[tuple[LocatedTracks, gtsam.Pose3, IntArray]] = deque()
        self._known: IntArray | None = None
        self._found_first: IntArray = np.zeros(0, np.int64)

    def keep(self, frame: FeatureFrame) -> None:
        """Keep the next frame as long as the start may be made again; not one that is kept."""
        if not self.wanted or (self.frames and frame.stamp_ns <= self.frames[-1].stamp_ns):
            return
        if self._is_early(frame):
            self.frames.append(frame)
            while self._since_ns is None and len(self.frames) > 2:
                self.frames.popleft()
        else:
            self.frames.clear()

    def begin_again(self) -> list[FeatureFrame]:
        """The frames from which the estimate begins again, with `moving` left out."""
        self._reviews += 1
        self._past.clear()
        self._known = None
        self._again_after_ns, self._pending = self.frames[-1].stamp_ns + _PAUSE_NS, False
        return list(self.frames)

    def compare(self, state: NavState, motion: FrameMotion | None, sigma_px: float) -> bool:
        """Compare the last frame that was used, with all its features, with an earlier one.

        Args:
            state: the estimate then.
            motion: of the body within the frame.
            sigma_px: standard deviation of an observation.

        Returns:
            Whether the estimate is to begin again: something moves since its start.
        """
        frame = self._last
        if frame is None:
            return False
        if self._since_ns is None:
            self._since_ns = frame.stamp_ns
            self._again_after_ns = max(self._again_after_ns, frame.stamp_ns + _WINDOW_NS)
        if self._past and frame.stamp_ns - self._past[-1][0].stamp_ns < _SPACING_NS:
            return False
        while len(self._past) > 1 and self._past[1][0].stamp_ns <= frame.stamp_ns - _WINDOW_NS:
            self._past.popleft()
        pose = state.world_T_body
        found, static = self._found(frame, pose, motion, sigma_px)
        located = LocatedTracks.of(frame, self._rig, self._projection, motion)
        self._past.append((located, pose, np.sort(frame.cameras[0].ids)))
        if not len(self.moving):
            found, self._found_first = self._confirmed(found), found
        new = found[~is_in(found, self.moving)]
        kept = self.moving if self.frames else self._moving_of(frame)
        self.moving = ascending_union(kept[~is_in(kept, static)], new)
        self._pending |= bool(len(new))
        again = self._reviews < _REVIEWS and frame.stamp_ns >= self._again_after_ns
        return self._pending and bool(self.frames) and again and self._is_early(frame)

    def _confirmed(self, found: IntArray) -> IntArray:
        """Tracks that were found to move, if most of them were in the comparison before as well."""
        again = np.count_nonzero(is_in(found, self._found_first))
        return found if 2 * again > min(len(found), len(self._found_first)) else found[:0]

    @property
    def moving_now(self) -> IntArray:
        """Ids (N,) of the features of the last frame that were found to move, ascending."""
        return self.moving[:0] if self._last is None else self._moving_of(self._last)

    def _moving_of(self, frame: FeatureFrame) -> IntArray:
        return self.moving[is_in(self.moving, np.sort(frame.cameras[0].ids))]

    def used(self, frame: FeatureFrame) -> FeatureFrame:
        """A frame without the tracks that are not known to stand still.

        Those are the moving ones, and beside them all that are too new to have been compared, as
        long as most are not.
        """
        self._last = frame
        moving, seen = self._moving_of(frame), frame.cameras[0].ids
        if not len(moving) or self._known is None:
            return frame.without(moving)
        new = ~is_in(seen, self._known)
        if np.count_nonzero(new) > _MOST_NEW * len(seen):
            return frame.without(moving)
        return frame.without(ascending_union(moving, np.sort(seen[new])))

    def _found(
        self, frame: FeatureFrame, pose: gtsam.Pose3, motion: FrameMotion | None, sigma_px: float
    ) -> tuple[IntArray, IntArray]:
        """Ids of the tracks that move, and of those that clearly do not, ascending."""
        late, found, static = not self._is_early(frame), np.zeros(0, np.int64), None
        ages_ns = [frame.stamp_ns - before.stamp_ns for before, _, _ in self._past]
        old_enough = [k for k, age_ns in enumerate(ages_ns) if age_ns >= _LEAST_NS]
        # beside what moves, new tracks are compared as soon as that is possible
        for k in old_enough[:1] + old_enough[1:][-1:]:
            before, then, known = self._past[k]
            if k > 0 and not (len(self.moving) and self._is_newer(known, frame)):
                continue
            self._known = known
            guess = then.between(pose)
            bodies = rigid_motions(before, frame, self._rig, guess, sigma_px, motion, trusted=late)
            if k == 0:
                self._note(bodies.share if bodies is not None else 0.0, late)
            if bodies is not None:
                found = ascending_union(found, bodies.moving)
                static = bodies.static if static is None else static
        return found, found[:0] if static is None else static[~is_in(static, found)]

    def _is_newer(self, known: IntArray, frame: FeatureFrame) -> bool:
        """Whether a frame has tracks that the oldest one has not, but a later one (ids M) has."""
        assert self._known is not None
        seen = frame.cameras[0].ids
        return bool(np.any(is_in(seen, known) & ~is_in(seen, self._known)))

    def _is_early(self, frame: FeatureFrame) -> bool:
        """Whether the start may still be made again."""
        return self._since_ns is None or frame.stamp_ns - self._since_ns <= _REVIEW_NS

    def _note(self, share: float, late: bool) -> None:
        """Say so if the largest body that moves covers so much that it may be the world."""
        large = share > (_LARGE_LATER if late else _LARGE_SHARE)
        self._large = self._large + 1 if large else 0
        if self._large == _OFTEN:
            self._diagnostics.warn(
                "world_not_clear",
                "something that moves covers so much of the images that it may be the world; "
                "without an IMU nothing tells which of the two stands still",
            )
