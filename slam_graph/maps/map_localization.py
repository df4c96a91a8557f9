# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Localization of a run in a map, frame by frame, with a Kalman filter of its pose there.

Kalman filter of the pose of a run in a map, from its odometry and its matches with the map.
Relative poses of the odometry propagate it, with an uncertainty that grows with time, and matches
correct it. Where gravity is known to map and run, roll and pitch are those of the run, and yaw and
position are estimated; otherwise the whole pose is. The error is δ = (θ, p) in the world of the
map: R = Exp(E θ) R̂, t = t̂ + p, with E the vertical (4 degrees of freedom) or the identity (6).

    frame → similar places → match (P3P) → consistency → filter → pose in the map

A filter starts from several matches that are consistent with each other and the run's own motion in
between. From then on frames are matched with the nearest places. A match that contradicts the
filter is rejected. If several rejected matches are consistent with each other, the filter restarts
from these; if they are not, the run is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import gammaincinv

from slam_graph.arrays import FloatArray
from slam_graph.loop_closure import Keyframe, LoopClosureConfig
from slam_graph.maps.map_config import LocalizationConfig
from slam_graph.maps.map_model import SlamMap
from slam_graph.maps.map_places import MapPlaces, PlaceMatch
from slam_graph.sensors import Rig

CONFIDENCE = 0.999
"""χ² quantile of consistent matches: so high because a rejected true match costs little."""
CONSISTENT_CHI2 = float(2.0 * gammaincinv(3.0, CONFIDENCE))
"""Largest squared Mahalanobis distance of a consistent match."""
TILT_SIGMA = 5e-3
"""Standard deviation of roll and pitch of the run, rad."""
_VERTICAL = np.array([[0.0], [0.0], [1.0]])


class MapPoseFilter:
    """The pose of the body in the map, from a first match on.

    Args:
        config: standard deviations.
        level: whether roll and pitch are known.
        odom_T_body: the run's own estimate at the time of the match.
        measured: world_T_body of the match.
        covariance: (6, 6) of it in GTSAM's tangent.
        stamp_ns: time of the match.

    Attributes:
        pose: world_T_body at `stamp_ns`.
        covariance: (n, n) of δ: n = 4 or 6, position last.
        stamp_ns: time of the estimate.
    """

    def __init__(
        self,
        config: LocalizationConfig,
        level: bool,
        odom_T_body: gtsam.Pose3,
        measured: gtsam.Pose3,
        covariance: FloatArray,
        stamp_ns: int,
    ) -> None:
        self._config, self._level = config, level
        self._axes = _VERTICAL if level else np.eye(3)
        self._odom_T_body = odom_T_body
        self.stamp_ns = stamp_ns
        self.pose = with_roll_and_pitch(measured, odom_T_body) if level else measured
        # there is no prior: the covariance is that of the match
        H = self._jacobian()
        information = H.T @ np.linalg.inv(self._noise(covariance)) @ H
        self.covariance: FloatArray = np.asarray(np.linalg.inv(information))

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the position on the axis where it is largest, m."""
        return float(np.sqrt(np.diag(self.covariance)[-3:].max()))

    def move(self, stamp_ns: int, odom_T_body: gtsam.Pose3) -> None:
        """Propagate to a later time by the run's own estimate."""
        step = self._odom_T_body.between(odom_T_body)
        moved = self.pose.rotation().matrix() @ step.translation()
        size = self._axes.shape[1]
        F = np.eye(size + 3)
        F[size:, :size] = np.cross(self._axes.T, moved).T
        seconds = max(stamp_ns - self.stamp_ns, 0) * 1e-9
        config = self._config
        drift = [config.odometry_rotation_sigma] * size + [config.odometry_position_sigma] * 3
        self.covariance = F @ self.covariance @ F.T + np.diag(np.square(drift)) * seconds
        pose = self.pose.compose(step)
        self.pose = with_roll_and_pitch(pose, odom_T_body) if self._level else pose
        self._odom_T_body, self.stamp_ns = odom_T_body, stamp_ns

    def distance(self, measured: gtsam.Pose3, covariance: FloatArray) -> float:
        """Squared Mahalanobis distance of a match now; χ² with six degrees of freedom."""
        innovation, S = self._innovation(measured, covariance)
        return float(innovation @ np.linalg.solve(S, innovation))

    def correct(self, measured: gtsam.Pose3, covariance: FloatArray) -> None:
        """Update with a match.

        Args:
            measured: world_T_body at the time of the filter.
            covariance: (6, 6) of it in GTSAM's tangent.
        """
        innovation, S = self._innovation(measured, covariance)
        H = self._jacobian()
        gain = np.linalg.solve(S, H @ self.covariance).T
        δ = gain @ innovation
        rest = np.eye(len(δ)) - gain @ H
        self.covariance = rest @ self.covariance @ rest.T + gain @ self._noise(covariance) @ gain.T
        turn = gtsam.Rot3.Expmap(self._axes @ δ[:-3])
        position = self.pose.translation() + δ[-3:]
        self.pose = gtsam.Pose3(turn.compose(self.pose.rotation()), position)

    def _innovation(
        self, measured: gtsam.Pose3, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Innovation (6,) of a match, in the tangent of the body, and its covariance (6, 6)."""
        between = self.pose.between(measured)
        innovation = np.concatenate([gtsam.Rot3.Logmap(between.rotation()), between.translation()])
        H = self._jacobian()
        return innovation, H @ self.covariance @ H.T + self._noise(covariance)

    def _jacobian(self) -> FloatArray:
        """(6, n) of the pose in the tangent of the body by δ."""
        back = self.pose.rotation().matrix().T
        size = self._axes.shape[1]
        H = np.zeros((6, size + 3))
        H[:3, :size], H[3:, size:] = back @ self._axes, back
        return H

    def _noise(self, covariance: FloatArray) -> FloatArray:
        """(6, 6) covariance of a match, the uncertainty of map and run included."""
        config, noise = self._config, covariance.copy()
        noise[:3, :3] += np.eye(3) * config.map_rotation_sigma**2
        noise[3:, 3:] += np.eye(3) * config.map_position_sigma**2
        if self._level:
            back = self.pose.rotation().matrix().T
            tilt = TILT_SIGMA**2 * np.diag([1.0, 1.0, 0.0])
            noise[:3, :3] += back @ tilt @ back.T
        return noise


def with_roll_and_pitch(pose: gtsam.Pose3, odom_T_body: gtsam.Pose3) -> gtsam.Pose3:
    """The pose with roll and pitch of another that is nearest to a given one."""
    turn = pose.rotation().matrix() @ odom_T_body.rotation().matrix().T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    return gtsam.Pose3(gtsam.Rot3.Rz(yaw).compose(odom_T_body.rotation()), pose.translation())


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
        content: the map.
        rig: of the run; only its first camera is used.
        loops: settings of verification.
        config: settings of localization.

    Attributes:
        places: of the map.
        filter: the pose in the map at the last frame; None where it is unknown.
        queries: number of frames that were compared with the map.
        matches: number of these that matched a place.
        accepted: number of matches that corrected the pose.
        starts: how often the filter started.
    """

    def __init__(
        self, content: SlamMap, rig: Rig, loops: LoopClosureConfig, config: LocalizationConfig
    ) -> None:
        self.places = MapPlaces(content, rig, loops, config.neighbours)
        self.queries = self.matches = self.accepted = self.starts = 0
        self._config = config
        self.restart(rig)

    def restart(self, rig: Rig) -> None:
        """Begin anew with a run that has begun anew, perhaps with another calibration."""
        self.places.use(rig)
        self.filter: MapPoseFilter | None = None
        self._level = self.places.map.gravity_aligned and rig.has_imu
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
        places, config = self.places, self._config
        if self.located and self.filter is not None:
            match = places.locate(view, places.nearest(self.filter.pose), self._level)
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
