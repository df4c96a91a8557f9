# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Features that are the same point of the world: tracks that broke off, and places seen again.

A front end gives a point a new identity each time that its track begins anew. Where the point of
one track is projected to where another track sees its own, the two may be one. Looks are not
compared, so this is for poses that are right to some pixels. Tracks that follow each other closely
must match exactly; tracks of an earlier visit must match but for a drift that they share with
others of that visit (`drift_consensus`).

Features that one frame sees both are different points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam_graph.backend.tracks import Observations
from slam_graph.mapping.drift_consensus import agreeing
from slam_graph.mapping.projected_matches import Matches, Scene, projected_matches

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

VISIT_S = 6.0
"""Over so short a time nothing drifts: features this near in time share one drift."""
LIMIT = 3.0
"""How far a feature may be projected beside what it is fused with, in standard deviations."""
SEED = 0
"""Of RANSAC."""


def fused(scene: Scene, reach_px: float) -> IntArray:
    """Which features are the same point.

    Args:
        scene: the features, each by its own track.
        reach_px: how far drift may have moved a projection.

    Returns:
        (J,) for each feature the row of the first one that it is the same as; its own, if none.
    """
    matches = projected_matches(scene, reach_px)
    good, left = _confirmed(matches, scene.times_s)
    return _joined(matches.select(good), left[good], scene.seen)


def relabelled(seen: Observations, label: IntArray) -> Observations:
    """The observations with fused features under the identity of the first of them.

    Args:
        seen: observations of J features.
        label: (J,) row of the feature that each is the same as.
    """
    kept = np.unique(label)
    feature = np.searchsorted(kept, label)[seen.feature]
    order = np.lexsort((seen.camera, seen.frame, feature))
    return Observations(
        seen.ids[kept],
        seen.frames,
        feature[order],
        seen.frame[order],
        seen.camera[order],
        seen.pixels[order],
        seen.normalized[order],
    )


def _confirmed(matches: Matches, times_s: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Which matches (P,) others confirm or need not, and what is left of their offsets (P,)."""
    rng = np.random.default_rng(SEED)
    first_s, second_s = times_s[matches.earlier], times_s[matches.later]
    left = np.linalg.norm(matches.offsets, axis=1)
    good = (second_s - first_s < VISIT_S) & (left < LIMIT)
    far = np.flatnonzero(second_s - first_s >= VISIT_S)
    for half in range(4):  # visits overlap by half, so that none is cut by where they begin
        first = np.floor(first_s[far] / VISIT_S + 0.5 * (half % 2)).astype(np.int64)
        second = np.floor(second_s[far] / VISIT_S + 0.5 * (half // 2)).astype(np.int64)
        order = np.lexsort((second, first))
        starts = np.flatnonzero(np.diff(first[order]) | np.diff(second[order])) + 1
        groups = [group for group in np.split(far[order], starts) if len(group) > 2]
        for group in groups:
            chance = float(np.mean(matches.chances[group]))
            J, offsets = matches.by_drift[group], matches.offsets[group]
            agree, unexplained = agreeing(J, offsets, LIMIT, chance, len(groups), rng)
            better = agree & (~good[group] | (unexplained < left[group]))
            good[group] |= agree
            left[group[better]] = unexplained[better]
    return good, left


def _joined(matches: Matches, left: FloatArray, seen: Observations) -> IntArray:
    """Labels (J,) after joining matches, the nearest first, unless a frame sees both."""
    label = np.arange(len(seen.ids))
    members = {row: [row] for row in np.union1d(matches.earlier, matches.later).tolist()}
    seen_in = np.zeros((len(seen.ids), len(seen.frames)), np.bool_)
    seen_in[seen.feature, seen.frame] = True
    for match in np.argsort(left, kind="stable"):
        a, b = sorted((int(label[matches.earlier[match]]), int(label[matches.later[match]])))
        if a == b or np.any(seen_in[a] & seen_in[b]):
            continue
        seen_in[a] |= seen_in[b]
        label[members[b]] = a
        members[a] += members.pop(b)
    return label
