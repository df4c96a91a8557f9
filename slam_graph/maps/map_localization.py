# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Locates a run in a map, frame by frame.

    frame → places that look alike → sighting (P3P) → agreement → filter → pose in the map

Sightings are believed once several agree with each other by the run's own motion between them:
then a filter starts. From then on frames are compared with the places around where they are
thought to be. A sighting that contradicts the filter is left out, and if several contradict it that
agree with each other, the filter starts anew with these. If
they contradict each other too, the run is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
from scipy.stats import chi2

from slam_graph.arrays import FloatArray
from slam_graph.loop_closure.loop_keyframes import Keyframe
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_places import MapPlaces, Sighting
from slam_graph.maps.pose_filter import MapPoseFilter


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """A sighting, and where the run took itself to be then."""

    stamp_ns: int
    odom_T_body: gtsam.Pose3
    map_T_body: gtsam.Pose3
    covariance: FloatArray


class MapLocalizer:
    """Knows where a run is in a map.

    Args:
        places: of the map.
        config: when a sighting is believed.

    Attributes:
        filter: the pose in the map at the last frame, or None where nothing is known of it.
        queries: how many frames were compared with the map.
        sightings: in how many of them a place of the map was seen.
        believed: how many of these corrected the pose.
        restarts: how often the filter started, the first time included.
    """

    def __init__(self, places: MapPlaces, config: LocalizationConfig) -> None:
        self.filter: MapPoseFilter | None = None
        self.queries = self.sightings = self.believed = self.restarts = 0
        self._places, self._config = places, config
        self._level = places.map.gravity_aligned
        self._bound = float(chi2.ppf(config.confidence, 6))
        self._doubtful: list[_Measured] = []
        self._contradictions = 0
        self._queried_ns: int | None = None

    @property
    def located(self) -> bool:
        """Whether it knows where the run is, as well as it should."""
        return (
            self.filter is not None
            and self.filter.position_sigma <= self._config.max_position_sigma
        )

    def wants(self, stamp_ns: int) -> bool:
        """Whether a frame at this time should be compared with the map."""
        if self._queried_ns is None or not self.located:
            return True
        return stamp_ns - self._queried_ns >= self._config.period_s * 1e9

    def move(self, stamp_ns: int, odom_T_body: gtsam.Pose3) -> None:
        """Go on to the next frame, where the run takes itself to be at a pose of its own world."""
        if self.filter is not None:
            self.filter.move(stamp_ns, odom_T_body)

    def see(self, view: Keyframe) -> None:
        """Compare a frame with the map; its pose is that of the run's own world."""
        self.queries += 1
        self._queried_ns = view.stamp_ns
        sighting = self._sighting(view)
        if sighting is None:
            return
        self.sightings += 1
        measured = _Measured(
            view.stamp_ns, view.world_T_body, sighting.world_T_body, sighting.covariance
        )
        if self.filter is not None and self._agrees(measured):
            self.filter.correct(measured.map_T_body, measured.covariance)
            self.believed += 1
            self._contradictions = 0
            self._doubtful.clear()
            return
        self._contradictions += 1
        if self._contradictions >= self._config.patience:
            self.filter = None
        self._doubtful = [*self._doubtful, measured][-self._config.memory :]
        agreeing = self._agreeing()
        if len(agreeing) >= self._config.agreeing:
            self._start(agreeing)

    def _sighting(self, view: Keyframe) -> Sighting | None:
        """Where the view was taken: by the place where it should be, or by one that looks alike."""
        places, config = self._places, self._config
        if self.located and self.filter is not None:
            for number in places.nearest(self.filter.pose, 1).tolist():
                sighting = places.locate(view, number, self._level)
                if sighting is not None:
                    return sighting
        found = [
            sighting
            for number in places.alike(view.descriptors, config.candidates).tolist()
            if (sighting := places.locate(view, number, self._level)) is not None
        ]
        return max(found, key=lambda sighting: sighting.loop.inliers, default=None)

    def _agrees(self, measured: _Measured) -> bool:
        """Whether a sighting is where the filter has the run."""
        assert self.filter is not None
        return self.filter.distance(measured.map_T_body, measured.covariance) < self._bound

    def _agreeing(self) -> list[_Measured]:
        """Doubtful sightings that all agree with each other, the last one among them."""
        group = [self._doubtful[-1]]
        for earlier in reversed(self._doubtful[:-1]):
            if all(self._compatible(earlier, later) for later in group):
                group.insert(0, earlier)
        return group

    def _compatible(self, first: _Measured, second: _Measured) -> bool:
        """Whether two sightings are as far apart as the run has moved between them."""
        filter_ = self._filter_at(first)
        filter_.move(second.stamp_ns, second.odom_T_body)
        return filter_.distance(second.map_T_body, second.covariance) < self._bound

    def _start(self, agreeing: list[_Measured]) -> None:
        """Start the filter from sightings that agree."""
        first, *others = agreeing
        self.filter = self._filter_at(first)
        for measured in others:
            self.filter.move(measured.stamp_ns, measured.odom_T_body)
            self.filter.correct(measured.map_T_body, measured.covariance)
        self._doubtful.clear()
        self._contradictions = 0
        self.restarts += 1
        self.believed += len(agreeing)

    def _filter_at(self, measured: _Measured) -> MapPoseFilter:
        return MapPoseFilter(
            self._config,
            self._level,
            measured.odom_T_body,
            measured.map_T_body,
            measured.covariance,
            measured.stamp_ns,
        )
