# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with frames as they come, beyond what a reader sees in each of them.

Nothing is changed or left out: what is noticed is counted and logged, so that a run that goes on
well says what it went through.
"""

from __future__ import annotations

from collections import deque
from statistics import median

import numpy as np
from numpy.typing import NDArray

from slam_graph.diagnostics import Diagnostics
from slam_graph.sensors import CameraFrame, FeatureFrame, FeatureObservations, Rig

_GAP_PERIODS = 2.5
"""A pause longer than so many of the usual ones: two frames or more are missing."""
_USUAL, _FEWEST_PAUSES = 31, 10
"""The usual pause is the median of the last so many, once there are so few."""
_FEW_FEATURES, _FEW_SHARE = 15, 0.25
"""Recorded tracks have ended all at once if fewer of them go on, and a smaller share."""


class FrameWatch:
    """Counts pauses between frames, images that come again, and tracks that end all at once.

    Counted kinds: `frame_gap`, `image_repeated`, and in recorded tracks `few_features`, which the
    front end counts in images.

    Args:
        rig: names its cameras.
        diagnostics: where they are counted.
    """

    def __init__(self, rig: Rig, diagnostics: Diagnostics) -> None:
        self._names = [c.name or f"camera {k}" for k, c in enumerate(rig.cameras)]
        self._diagnostics = diagnostics
        self._pauses_ns: deque[int] = deque(maxlen=_USUAL)
        self._before: CameraFrame | FeatureFrame | None = None

    def look(self, frame: CameraFrame | FeatureFrame) -> None:
        """Compare the next frame with the one before."""
        before, self._before = self._before, frame
        if before is None:
            return
        self._look_at_pause(frame.stamp_ns - before.stamp_ns, frame.stamp_ns)
        if isinstance(before, CameraFrame) and isinstance(frame, CameraFrame):
            self._look_at_images(before, frame)
        elif isinstance(before, FeatureFrame) and isinstance(frame, FeatureFrame):
            self._look_at_tracks(before, frame)

    def _look_at_pause(self, pause_ns: int, stamp_ns: int) -> None:
        known = len(self._pauses_ns) >= _FEWEST_PAUSES
        if known and pause_ns > _GAP_PERIODS * median(self._pauses_ns):
            what = f"no frame for {pause_ns * 1e-9:.3f} s before {stamp_ns}"
            self._diagnostics.warn("frame_gap", what)
        self._pauses_ns.append(pause_ns)

    def _look_at_images(self, before: CameraFrame, frame: CameraFrame) -> None:
        for name, old, new in zip(self._names, before.images, frame.images, strict=False):
            if old is not None and new is not None and _same(old, new):
                self._warn_of_repeat(f"{name} gives the image", frame.stamp_ns)

    def _look_at_tracks(self, before: FeatureFrame, frame: FeatureFrame) -> None:
        for name, seen, now in zip(self._names, before.cameras, frame.cameras, strict=False):
            followed = int(np.count_nonzero(np.isin(seen.ids, now.ids)))
            if _repeated(seen, now):
                self._warn_of_repeat(f"{name} gives the features", frame.stamp_ns)
            elif followed < min(_FEW_FEATURES, _FEW_SHARE * len(seen)):
                what = f"{followed} of {len(seen)} features of {name} go on at {frame.stamp_ns}"
                self._diagnostics.warn("few_features", what)

    def _warn_of_repeat(self, what: str, stamp_ns: int) -> None:
        self._diagnostics.warn("image_repeated", f"{what} of the frame before again at {stamp_ns}")


def _same(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> bool:
    """Whether two images are the same."""
    row = len(old) // 2  # nearly all images differ there already
    return np.array_equal(old[row : row + 1], new[row : row + 1]) and np.array_equal(old, new)


def _repeated(old: FeatureObservations, new: FeatureObservations) -> bool:
    """Whether the same features, if there are any, are at the same pixels."""
    same = len(old) > 0 and np.array_equal(old.ids, new.ids)
    return same and np.array_equal(old.pixels, new.pixels)
