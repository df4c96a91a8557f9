# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Localization of a run in a map, frame by frame.

    frame → similar places → match (P3P) → consistency → filter → pose in the map

A filter starts from several matches that are consistent with each other and the run's own motion in
between. From then on frames are matched with the nearest places. A match that contradicts the
filter is rejected. If several rejected matches are consistent with each other, the filter restarts
from these; if they are not, the run is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from slam_graph.arrays import FloatArray
from slam_graph.loop_closure import Keyframe
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_places import MapPlaces, PlaceMatch
from slam_graph.maps.pose_filter import CONSISTENT_CHI2, MapPoseFilter

MIN_CONSISTENT = 3
"""Number of consistent matches from which the filter starts."""
MAX_REJECTED = 6
"""The run is lost after this many rejected matches in a row."""
MAX_PENDING = 30
"""Number of recent rejected matches among which consistent ones are searched."""


@dataclass(frozen=True, slots=True, eq=False)
class _Measurement:
    """A match with the map, and the run's own pose at that time."""

    stamp_ns: int
    odom_T_body: gtsam.Pose3
    map_T_body: gtsam.Pose3
    covariance: FloatArray


class MapLocalizer:
    """Estimates the pose of a run in a map.

    Args:
        places: of the map.
        config: settings.

    Attributes:
        filter: the pose in the map at the last frame; None where it is unknown.
        queries: number of frames that were compared with the map.
        matches: number of these that matched a place.
        accepted: number of matches that corrected the pose.
        starts: how often the filter started.
    """

    def __init__(self, places: MapPlaces, config: LocalizationConfig) -> None:
        self.filter: MapPoseFilter | None = None
        self.queries = self.matches = self.accepted = self.starts = 0
        self._places, self._config = places, config
        self._level = places.map.gravity_aligned
        self._pending: list[_Measurement] = []
        self._rejected = 0
        self._queried_ns: int | None = None

    @property
    def located(self) -> bool:
        """Whether the pose in the map is known well enough."""
        return (
            self.filter is not None
            and self.filter.position_sigma <= self._config.max_position_sigma
        )

    def wants(self, stamp_ns: int) -> bool:
        """Whether a frame at this time should be matched with the map."""
        if self._queried_ns is None or not self.located:
            return True
        return stamp_ns - self._queried_ns >= self._config.period_s * 1e9

    def move(self, stamp_ns: int, odom_T_body: gtsam.Pose3) -> None:
        """Propagate to the next frame, given the run's pose in its own world."""
        if self.filter is not None:
            self.filter.move(stamp_ns, odom_T_body)

    def match(self, view: Keyframe) -> None:
        """Match a frame with the map; its pose is that in the run's own world."""
        self.queries += 1
        self._queried_ns = view.stamp_ns
        found = self._place_match(view)
        if found is None:
            return
        self.matches += 1
        measured = _Measurement(
            view.stamp_ns, view.world_T_body, found.world_T_body, found.covariance
        )
        if self.filter is not None and self._is_consistent(measured):
            self.filter.correct(measured.map_T_body, measured.covariance)
            self.accepted += 1
            self._rejected = 0
            self._pending.clear()
            return
        self._rejected += 1
        if self._rejected >= MAX_REJECTED:
            self.filter = None
        self._pending = [*self._pending, measured][-MAX_PENDING:]
        consistent = self._consistent_group()
        if len(consistent) >= MIN_CONSISTENT:
            self._start(consistent)

    def _place_match(self, view: Keyframe) -> PlaceMatch | None:
        """The match of a view: with the nearest place, or else with the best of similar ones."""
        places, config = self._places, self._config
        if self.located and self.filter is not None:
            for number in places.nearest(self.filter.pose, 1).tolist():
                match = places.locate(view, number, self._level)
                if match is not None:
                    return match
        found = [
            match
            for number in places.similar(view.descriptors, config.candidates).tolist()
            if (match := places.locate(view, number, self._level)) is not None
        ]
        return max(found, key=lambda match: match.loop.inliers, default=None)

    def _is_consistent(self, measured: _Measurement) -> bool:
        """Whether a match is consistent with the filter."""
        assert self.filter is not None
        return self.filter.distance(measured.map_T_body, measured.covariance) < CONSISTENT_CHI2

    def _consistent_group(self) -> list[_Measurement]:
        """Pending matches that are all consistent with each other, the last one among them."""
        group = [self._pending[-1]]
        for earlier in reversed(self._pending[:-1]):
            if all(self._compatible(earlier, later) for later in group):
                group.insert(0, earlier)
        return group

    def _compatible(self, first: _Measurement, second: _Measurement) -> bool:
        """Whether two matches are consistent with the run's motion between them."""
        filter_ = self._filter_at(first)
        filter_.move(second.stamp_ns, second.odom_T_body)
        return filter_.distance(second.map_T_body, second.covariance) < CONSISTENT_CHI2

    def _start(self, consistent: list[_Measurement]) -> None:
        """Start the filter from consistent matches."""
        first, *others = consistent
        self.filter = self._filter_at(first)
        for measured in others:
            self.filter.move(measured.stamp_ns, measured.odom_T_body)
            self.filter.correct(measured.map_T_body, measured.covariance)
        self._pending.clear()
        self._rejected = 0
        self.starts += 1
        self.accepted += len(consistent)

    def _filter_at(self, measured: _Measurement) -> MapPoseFilter:
        return MapPoseFilter(
            self._config,
            self._level,
            measured.odom_T_body,
            measured.map_T_body,
            measured.covariance,
            measured.stamp_ns,
        )
