# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What the verdict on a run is judged by: frames around its start, without features that move."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from slam_graph.arrays import IntArray
from slam_graph.pipeline.clock_watch import SPACING_NS
from slam_graph.pipeline.stage import EstimatedFrame, NoObjects
from slam_graph.sensors import CameraFrame, FeatureFrame, ImuData

KEPT_NS = 24_000_000_000
"""So much of the recording is diagnosed: what came after the start, as far as it goes."""
_PAIRS, _PAIRS_APART_NS = 4, 1_500_000_000
"""Images of two cameras that are kept, and the time between them."""
_LEAST_LEFT = 0.6
"""Features that the gate rejects are left out where this part of the observations is left."""
_LEAST_USED = 0.4
"""Those that were used tell enough by themselves where this part of the observations is theirs."""


def _count(frames: list[FeatureFrame]) -> int:
    """Number of features of the first camera."""
    return sum(len(frame.cameras[0]) for frame in frames if frame.cameras)


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What came with some frames.

    Attributes:
        imu: samples up to the last of them.
        rejected: ids (N,) of the features that the gate rejected.
        dynamic: ids (D,) of those that the estimator knows to move by themselves.
        used: ids (M,) of those whose positions were estimated.
    """

    imu: ImuData
    rejected: IntArray
    dynamic: IntArray
    used: IntArray

    @staticmethod
    def of(frame: EstimatedFrame) -> _Known:
        """What came with one frame."""
        return _Known(frame.imu, frame.rejected, frame.dynamic, frame.landmark_ids)

    @staticmethod
    def of_all(parts: Sequence[_Known]) -> _Known:
        """What came with several frames, in their order."""
        return _Known(
            ImuData.concatenate([part.imu for part in parts]),
            np.unique(np.concatenate([part.rejected for part in parts])),
            np.unique(np.concatenate([part.dynamic for part in parts])),
            np.unique(np.concatenate([part.used for part in parts])),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """A frame that is kept.

    Attributes:
        features: what was found in it.
        known: what came with the frames since the one before, and with it.
        judged: whether it was known what moves by itself: there was a state, or no objects are
            estimated.
    """

    features: FeatureFrame
    known: list[_Known]
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
        self._since: list[_Known] = []
        self._pairs: deque[CameraFrame] | None = deque(maxlen=_PAIRS) if pairs else None

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def frames(self) -> list[FeatureFrame]:
        """Features of the frames that are kept, without those that move by themselves.

        Such are those of moving objects, and what the gate has rejected: a board before the camera
        would look like another mounting or focal length. Where more than 40 % of the observations
        are theirs, the estimate is wrong and not they.
        """
        if not self._frames:
            return []
        still, rejected = self._still(), self._known().rejected
        left = [frame.without(rejected) for frame in still]
        return left if _count(left) >= _LEAST_LEFT * _count(still) else still

    @property
    def used_frames(self) -> list[FeatureFrame]:
        """The same with those features only that the estimator used; [] where they are too few.

        On a board before the camera some features are too new to be rejected.
        """
        if not self._frames:
            return []
        still, known = self._still(), self._known()
        moving = np.concatenate([known.rejected, known.dynamic])
        used = [frame.without(moving).only(known.used) for frame in still]
        return used if _count(used) >= _LEAST_USED * _count(still) else []

    def _still(self) -> list[FeatureFrame]:
        """Features of the frames without those of moving objects, if it is known which these are.

        Where moving objects are estimated, frames before there is a state would have theirs.
        """
        judged = [kept for kept in self._frames if kept.judged] or self._frames
        return [kept.features.without(self._objects.moved) for kept in judged]

    def _known(self) -> _Known:
        kept = chain.from_iterable(kept.known for kept in self._frames)
        return _Known.of_all([*kept, *self._since])

    @property
    def imu(self) -> ImuData:
        """All samples between them."""
        kept = chain.from_iterable(kept.known for kept in self._frames)
        return ImuData.concatenate([known.imu for known in kept])

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
        self._since.append(_Known.of(frame))
        if frames and stamp_ns - frames[-1].features.stamp_ns < SPACING_NS:
            return
        judged = frame.objects is None or frame.state is not None
        frames.append(_Kept(frame.features, self._since, judged))
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
