# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of frames of the first camera with the features that they share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.backend import visual_rotation
from slam_graph.diagnosis.gathering import Part
from slam_graph.diagnosis.gyroscope import Gyroscope
from slam_graph.sensors import Camera, FeatureFrame, FeatureObservations, RigCamera

_LONGEST_S = 0.45
"""Time between the frames of a pair; shorter if they share too few features."""
_COMMON, _FEWEST = 30, 12
"""Features that a pair should share, and must."""
_PAIRS = 110
"""Most pairs of a diagnosis."""
_FEATURES = 60
"""Most features of a pair."""
_PIXEL_SIGMA = 1.0


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames and their common features.

    Attributes:
        part: number of the part of the recording.
        first_s, second_s: times on the camera's clock, since the start of the part's gyroscope.
        first, second: (N, 2) pixels.
        turn: (3,) rotation vector of first_R_second of the camera by the lens; None
            where the features do not show it, or it is not asked for.
    """

    part: int
    first_s: float
    second_s: float
    first: FloatArray
    second: FloatArray
    turn: FloatArray | None


def frame_pairs(
    parts: list[Part], gyroscopes: list[Gyroscope], camera: RigCamera, turns: bool = True
) -> list[FramePair]:
    """Pairs that follow one another, over all parts; where there are many, every n-th.

    Args:
        parts: with frames.
        gyroscopes: of the parts.
        camera: the first one, whose lens need not be the one that undistorted the features.
        turns: whether to look how the camera turns by the features alone, which takes most time.
    """
    chosen = []
    for number, part in enumerate(parts):
        seen = [f for f in part.frames if f.cameras and len(f.cameras[0]) >= _FEWEST]
        ids = [set(frame.cameras[0].ids.tolist()) for frame in seen]
        k = 0
        while k < len(seen) - 1:
            second = _partner(seen, ids, k)
            if second > k:
                chosen.append((number, seen[k], seen[second]))
            k = max(second, k + 1)
    stride = -(-len(chosen) // _PAIRS)
    return [
        _pair(number, one, two, gyroscopes[number], camera if turns else None)
        for number, one, two in chosen[:: max(stride, 1)]
    ]


def _partner(frames: list[FeatureFrame], ids: list[set[int]], first: int) -> int:
    """The latest frame that shares enough features with a frame; that frame itself if none.

    Args:
        frames: in the order of time.
        ids: of their features; sets of so few are compared faster than arrays.
        first: number of the frame.
    """
    best = first
    for k in range(first + 1, len(frames)):
        if frames[k].stamp_ns - frames[first].stamp_ns > _LONGEST_S * 1e9:
            break
        common = len(ids[first] & ids[k])
        if common >= _COMMON or (common >= _FEWEST and best == first):
            best = k
    return best


def _pair(
    number: int,
    one: FeatureFrame,
    two: FeatureFrame,
    gyroscope: Gyroscope,
    mounted: RigCamera | None,
) -> FramePair:
    """The common features of two frames, thinned to a bounded number; a camera to see turns by."""
    a, b = one.cameras[0], two.cameras[0]
    _, i, j = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    found = None
    if mounted is not None:
        lens = mounted.camera
        found = visual_rotation(_by_lens(a, lens), _by_lens(b, lens), lens, _PIXEL_SIGMA, None)
    turn = None if found is None else Rotation.from_matrix(found.R).as_rotvec()
    times = gyroscope.seconds(np.array([one.stamp_ns, two.stamp_ns]))
    step = max(1, len(i) // _FEATURES)
    rows = slice(0, step * _FEATURES, step)
    return FramePair(
        number, float(times[0]), float(times[1]), a.pixels[i[rows]], b.pixels[j[rows]], turn
    )


def _by_lens(seen: FeatureObservations, lens: Camera) -> FeatureObservations:
    """The observations under a lens, without those beyond its edge."""
    normalized, known = lens.visible(seen.pixels)
    return replace(seen, normalized=normalized).select(known)
