# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes, known poses and odometry in a bag: `NavSatFix`, poses of any type, `Odometry`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.datasets.rosbag.bag import Bag, Message
from slam_graph.datasets.rosbag.messages import POSES, covariance_of, pose_of, sigmas_of
from slam_graph.datasets.rosbag.ros_topics import frame_of, path_between
from slam_graph.datasets.streams.aiding_files import fixes_from, kept_of, known_poses_from
from slam_graph.datasets.streams.vector_lengths import lengths_of
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.files import Files
from slam_graph.sensors import AidingData

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
ODOMETRY = "nav_msgs/msg/Odometry"

_UNKNOWN = np.diag([25.0, 25.0, 100.0])
"""Covariance where a message has none: sigmas of 5 m, 10 m upwards."""
_TYPE_UNKNOWN, _TYPE_KNOWN = 0, 3
"""Constants of `NavSatFix`; between them only the diagonal is known."""
_SMALLEST_RATIO = 1e-12
"""Of the eigenvalues of a covariance: matrices beyond that are not positive definite in numbers."""
_SHORTEST_QUATERNION = 0.5
"""Quaternions that are shorter were never set."""
_POSE_SIGMAS = np.array([0.05] * 3 + [0.05] * 3)
"""Of known poses (m and rad) where a message has none: those of a hand-measured tag, say."""
_ASSUMED = "poses without a covariance are taken as known to 0.05 m and 0.05 rad"
_TYPES = {"gnss": (NAV_SAT_FIX,), "odometry": (ODOMETRY,), "poses": tuple(POSES)}
"""Of the messages of each sensor."""

Messages = Callable[[list[str]], Iterable[Message]]


class BagAiding:
    """Finds the topics of fixes, known poses and odometry.

    Fixes are taken from the only topic of `NavSatFix` where none is named; known poses and odometry
    only if their topic is named, as messages of these types may as well be the ground truth.

    Args:
        bag: the bag.
        named: topics or files of ``gnss``, ``poses`` and ``odometry``; others are left as they are.
        body: the topic whose frame is the body.
        diagnostics: counts fixes and samples that are dropped, and fixes on several topics of
            which none was named (`gnss_left_out`).

    Attributes:
        in_files: what of `named` is not a topic.

    Raises:
        DataError: if a topic is of another type, or what was named is neither topic nor file.
    """

    def __init__(
        self, bag: Bag, named: Mapping[str, str], body: str, diagnostics: Diagnostics
    ) -> None:
        self._bag, self._body, self._diagnostics = bag, body, diagnostics
        topics = {sensor: place for sensor, place in named.items() if place in bag.topics}
        self.in_files = {s: place for s, place in named.items() if place not in bag.topics}
        for sensor, kinds in _TYPES.items():
            if sensor in topics and bag.topics[topics[sensor]] not in kinds:
                other, known = bag.topics[topics[sensor]], " or ".join(kinds)
                raise DataError(
                    f"{bag.path}: '{topics[sensor]}' is of type {other}; expected {known}"
                )
            place = self.in_files.get(sensor)
            if place is not None and not Path(place).is_file():
                what = f"no topic and no file '{place}' of '{sensor}'"
                raise DataError(f"{bag.path}: {what}; the bag has {bag.listed()}")
        found = bag.of_type(NAV_SAT_FIX)
        if "gnss" not in named and len(found) == 1:
            topics["gnss"] = found[0]
        elif "gnss" not in named and found:
            several = f"fixes are on several topics ({', '.join(found)})"
            diagnostics.warn("gnss_left_out", f"{bag.path}: {several}; choose with --topic gnss=…")
        self._topics = topics

    def read(
        self, files: AidingData, messages: Messages, stamp_ns: Callable[[Message], int]
    ) -> AidingData:
        """What topics and files have.

        Args:
            files: what the files have.
            messages: gives the messages of some topics.
            stamp_ns: gives the time of one.
        """
        if "gnss" in self._topics:
            fixes = self._fixes(messages([self._topics["gnss"]]), stamp_ns)
            files = AidingData.concatenate([fixes, files.without_fixes()])
        if "poses" in self._topics:
            files = self._with_poses(files, messages([self._topics["poses"]]), stamp_ns)
        if "odometry" in self._topics:
            files = self._with_odometry(files, messages([self._topics["odometry"]]), stamp_ns)
        return files

    def _fixes(self, messages: Iterable[Message], stamp_ns: Callable[[Message], int]) -> AidingData:
        stamps: list[int] = []
        places: list[list[float]] = []
        covariances: list[FloatArray] = []
        for message in messages:
            stamps.append(stamp_ns(message))
            fix = message.decode_or(_fix_of, _NO_FIX)
            places.append(fix.place if fix.status >= 0 else [np.nan] * 3)
            covariances.append(_covariance_of(fix))
        return fixes_from(
            np.array(stamps, np.int64),
            np.array(places).reshape(-1, 3),
            np.array(covariances).reshape(-1, 3, 3),
            self._bag.path,
            self._diagnostics,
        )

    def _with_poses(
        self, data: AidingData, messages: Iterable[Message], stamp_ns: Callable[[Message], int]
    ) -> AidingData:
        """With the poses of the sensor that `backend.known_poses` mounts on the body."""
        take = partial(_known_pose_of, msgtype=self._bag.topics[self._topics["poses"]])
        damaged = [np.nan] * 7, np.full((6, 6), np.nan)
        stamps: list[int] = []
        rows: list[list[float]] = []
        sigmas: list[FloatArray] = []
        for message in messages:
            stamps.append(stamp_ns(message))
            pose, covariance = message.decode_or(take, damaged)
            rows.append(pose)
            sigmas.append(sigmas_of(covariance))
        if not stamps:
            raise DataError(f"{self._bag.path}: no poses on '{self._topics['poses']}'")
        poses, known = np.array(rows), np.array(sigmas)
        assumed = np.isnan(known)
        if assumed.any():
            self._diagnostics.warn("pose_sigma_assumed", f"{self._bag.path}: {_ASSUMED}")
        known_poses = known_poses_from(
            np.array(stamps, np.int64),
            poses[:, :3],
            poses[:, 3:],
            np.where(assumed, _POSE_SIGMAS, known),
            f"{self._bag.path}: pose",
            self._diagnostics,
        )
        return data.with_poses(*known_poses)

    def _with_odometry(
        self, data: AidingData, messages: Iterable[Message], stamp_ns: Callable[[Message], int]
    ) -> AidingData:
        """With the poses of the body that the poses of the base mean."""
        stamps: list[int] = []
        rows: list[list[float]] = []
        base: str | None = None
        damaged: tuple[list[float], str | None] = ([np.nan] * 7, None)
        for message in messages:
            stamps.append(stamp_ns(message))
            pose, frame = message.decode_or(_odometry_of, damaged)
            rows.append(pose)
            base = frame if base is None else base
        stamps_ns, poses = np.array(stamps, np.int64), np.array(rows).reshape(-1, 7)
        lengths = lengths_of(poses[:, 3:])
        good = Files.are_measurable(poses).all(axis=1) & np.isfinite(lengths)
        good &= lengths >= _SHORTEST_QUATERNION
        what = f"{self._bag.path}: odometry"
        kept = kept_of(stamps_ns, good, "odometry_dropped", what, self._diagnostics)
        if not len(kept):
            return data
        base_T_body = self._mounting(base) if base else gtsam.Pose3()
        turns = Rotation.from_quat(poses[kept, 3:])  # of length 1 from here on
        places = poses[kept, :3] + turns.apply(np.array(base_T_body.translation()))
        turns = turns * Rotation.from_matrix(np.array(base_T_body.rotation().matrix()))
        return data.with_odometry(stamps_ns[kept], places, turns.as_quat())

    def _mounting(self, base: str) -> gtsam.Pose3:
        """base_T_body of the frame whose poses the odometry has."""
        otherwise = "the odometry cannot be used, leave out --topic odometry=…"
        return path_between(self._bag, base, frame_of(self._bag, self._body), otherwise)


def _known_pose_of(message: Any, msgtype: str) -> tuple[list[float], FloatArray]:
    """Position and quaternion of a message with a pose, and its covariance (6, 6)."""
    return pose_of(message, msgtype), covariance_of(message)


def _odometry_of(message: Any) -> tuple[list[float], str | None]:
    """Position and quaternion of an `Odometry`, and the frame whose poses it has."""
    return pose_of(message, ODOMETRY), str(message.child_frame_id)


class _Fix(NamedTuple):
    """The fields of a `NavSatFix`.

    Attributes:
        status: negative where the receiver had no solution.
        place: latitude, longitude and altitude.
        covariance: (3, 3) east, north, up, m².
        covariance_type: what is known of the covariance.
    """

    status: int
    place: list[float]
    covariance: FloatArray
    covariance_type: int


_NO_FIX = _Fix(-1, [np.nan] * 3, _UNKNOWN, _TYPE_UNKNOWN)


def _fix_of(message: Any) -> _Fix:
    """The fields of a `NavSatFix`."""
    return _Fix(
        int(message.status.status),
        [float(message.latitude), float(message.longitude), float(message.altitude)],
        np.asarray(message.position_covariance, np.float64).reshape(3, 3),
        int(message.position_covariance_type),
    )


def _covariance_of(fix: _Fix) -> FloatArray:
    """The covariance (3, 3) of a fix, east, north, up, m².

    The correlations are used if the message says that they are known, and the matrix is one.
    """
    matrix = fix.covariance
    if fix.covariance_type == _TYPE_UNKNOWN or not (matrix.diagonal() > 0).all():
        return _UNKNOWN
    if fix.covariance_type == _TYPE_KNOWN and np.isfinite(matrix).all():
        symmetric = 0.5 * matrix + 0.5 * matrix.T
        values = np.linalg.eigvalsh(symmetric)
        if values[0] > _SMALLEST_RATIO * values[-1]:
            return np.asarray(symmetric)
    return np.diag(matrix.diagonal())
