# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the verdict on a run looks at: frames around its start, without features that move."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.pipeline.clock_watch import SPACING_NS
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData

KEPT_NS = 24_000_000_000
"""So much of the recording is looked at: what came after the start, as far as it goes."""
_PAIRS, _PAIRS_APART_NS = 4, 1_500_000_000
"""Images of two cameras that are kept, and the time between them."""
_LEAST_LEFT = 0.6
"""Features that the gate rejects are left out where this part of the observations is left."""


def _count(frames: list[FeatureFrame]) -> int:
    """Number of features of the first camera."""
    return sum(len(frame.cameras[0]) for frame in frames if frame.cameras)


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """A frame that is kept.

    Attributes:
        features: what was found in it.
        imu: the samples since the one before.
        rejected: ids (N,) of the features that were rejected by the gate since then.
        judged: whether it was known what moves by itself: there was a state, or no objects are
            estimated.
    """

    features: FeatureFrame
    imu: ImuData
    rejected: IntArray
    judged: bool


class KeptFrames:
    """What is kept of a recording: features, IMU samples and a few pairs of images."""

    def __init__(self, pairs: bool, objects: NoObjects) -> None:
        """Begin with nothing.

        Args:
            pairs: whether images of two cameras are of use.
            objects: knows what moves.
        """
        self._objects = objects
        self._frames: deque[_Kept] = deque()
        self._since: list[tuple[ImuData, IntArray]] = []
        self._pairs: deque[CameraFrame] | None = deque(maxlen=_PAIRS) if pairs else None

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def frames(self) -> list[FeatureFrame]:
        """Features of the frames that are kept, without those that move by themselves.

        Such are those of moving objects, and what the gate has rejected: a board before the camera
        would look like another mounting or focal length. Where more than 40 % of the observations
        are theirs, the estimate is wrong and not they. Where moving objects are estimated, frames
        before there is a state would have theirs.
        """
        if not self._frames:
            return []
        judged = [kept for kept in self._frames if kept.judged] or self._frames
        still = [kept.features.without(self._objects.moved) for kept in judged]
        since = [ids for _, ids in self._since]
        rejected = np.unique(np.concatenate([*(kept.rejected for kept in self._frames), *since]))
        left = [frame.without(rejected) for frame in still]
        return left if _count(left) >= _LEAST_LEFT * _count(still) else still

    @property
    def imu(self) -> ImuData:
        """All samples between them."""
        return ImuData.concatenate([kept.imu for kept in self._frames])

    @property
    def pairs(self) -> list[CameraFrame]:
        """Images of the first two cameras."""
        return list(self._pairs or ())

    @property
    def shared(self) -> float:
        """Share of the features of the first camera that the second one sees, the median."""
        seen = [frame.cameras for frame in self.frames if len(frame.cameras) > 1]
        shares = [np.isin(c[0].ids, c[1].ids).mean() for c in seen if len(c[0])]
        return float(np.median(shares)) if shares else 0.0

    def add(self, frame: EstimatedFrame) -> None:
        """Keep a frame, if the last one was long enough ago, and forget old ones."""
        stamp_ns, frames = frame.features.stamp_ns, self._frames
        self._since.append((frame.imu, frame.rejected))
        if frames and stamp_ns - frames[-1].features.stamp_ns < SPACING_NS:
            return
        samples, rejected = zip(*self._since, strict=True)
        since = ImuData.concatenate(samples), np.concatenate(rejected)
        judged = frame.objects is None or frame.state is not None
        frames.append(_Kept(frame.features, *since, judged))
        self._since = []
        while frames[0].features.stamp_ns < stamp_ns - KEPT_NS:
            frames.popleft()
        images, pairs = frame.packet.frame, self._pairs
        if pairs is None or not isinstance(images, CameraFrame):
            return
        if pairs and stamp_ns - pairs[-1].stamp_ns < _PAIRS_APART_NS:
            return
        first, second = images.images[:2]
        if first is not None and second is not None:
            pairs.append(images)
