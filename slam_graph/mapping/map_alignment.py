# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""How a map lies in another: keyframes that are recognised there, and the pose they agree on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.stats import chi2

from slam_graph.mapping.loop_config import LoopClosureConfig
from slam_graph.mapping.map_config import LocalizationConfig
from slam_graph.mapping.map_filter import MapPoseFilter, upright
from slam_graph.mapping.map_model import SlamMap
from slam_graph.mapping.map_places import MapPlaces, Sighting

HYPOTHESES = 50
"""How many sightings are tried as what all others should agree with."""


@dataclass(frozen=True, slots=True, eq=False)
class Recognised:
    """A keyframe of the second map that was located in the first."""

    number: int
    sighting: Sighting


def names(content: SlamMap) -> str:
    """The recordings of a map, for a message."""
    return " + ".join(recording.name for recording in content.recordings)


def recognised(
    first: SlamMap,
    second: SlamMap,
    loops: LoopClosureConfig,
    localization: LocalizationConfig,
    level: bool,
) -> Iterator[Recognised]:
    """Keyframes of the second map that show places of the first.

    Args:
        first: the map that is looked in.
        second: the map of which the keyframes are taken for views.
        loops: how places are verified.
        localization: how many candidates are tried.
        level: whether gravity is known to both.

    Raises:
        DataError: if descriptors are of different kinds.
    """
    for number, recording in enumerate(second.recordings):
        places = MapPlaces(
            first, recording.rig, loops.places, loops.verification, localization.neighbours
        )
        places.check(second.descriptors, names(second))
        for row in np.flatnonzero(second.recording_of == number).tolist():
            view = second.keyframe(row)
            found = [
                sighting
                for place in places.alike(view.descriptors, localization.candidates).tolist()
                if (sighting := places.locate(view, place, level)) is not None
            ]
            if found:
                yield Recognised(row, max(found, key=lambda sighting: sighting.loop.inliers))


def agreement(
    first: SlamMap,
    second: SlamMap,
    seen: list[Recognised],
    config: LocalizationConfig,
    level: bool,
) -> tuple[list[Recognised], gtsam.Pose3]:
    """The largest group of sightings that agree with one of them, and what that one says.

    Two agree if the ways between them in both maps are the same, up to the drift on these ways.

    Args:
        first: the map in which the keyframes were recognised.
        second: the map that they are of.
        seen: what was recognised.
        config: when sightings agree.
        level: whether gravity is known to both.

    Returns:
        The group, and world_T_world: the world of the second map in that of the first.
    """
    bound = float(chi2.ppf(config.confidence, 6))
    best: list[Recognised] = []
    alignment = gtsam.Pose3()
    step = max(len(seen) / HYPOTHESES, 1.0)
    for row in np.arange(0, len(seen), step).astype(int).tolist():
        trial = seen[row]
        body = second.pose(trial.number)
        group = []
        for other in seen:
            filter_ = MapPoseFilter(
                config, level, body, trial.sighting.world_T_body, trial.sighting.covariance, 0
            )
            filter_.move(_apart_ns(first, second, trial, other), second.pose(other.number))
            if filter_.distance(other.sighting.world_T_body, other.sighting.covariance) < bound:
                group.append(other)
        if len(group) > len(best):
            best = group
            placed = trial.sighting.world_T_body
            placed = upright(placed, body) if level else placed
            alignment = placed.compose(body.inverse())
    return best, alignment


def _apart_ns(first: SlamMap, second: SlamMap, one: Recognised, other: Recognised) -> int:
    """How much time odometry had to drift between two sightings, in both maps."""
    ways = (
        (first, one.sighting.place, other.sighting.place),
        (second, one.number, other.number),
    )
    return sum(abs(int(content.stamps_ns[a]) - int(content.stamps_ns[b])) for content, a, b in ways)
