# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes and odometry in a bag: `NavSatFix` and `Odometry`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam_graph.datasets.rosbag.bag import Bag, Message
from slam_graph.datasets.rosbag.messages import pose_of
from slam_graph.datasets.rosbag.ros_topics import frame_of, path_between
from slam_graph.datasets.streams.aiding_files import fixes_from
from slam_graph.diagnostics import Diagnostics
from slam_graph.errors import DataError
from slam_graph.sensors import AidingData

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
ODOMETRY = "nav_msgs/msg/Odometry"

_UNKNOWN_SIGMA_M = np.array([5.0, 5.0, 10.0])
"""Standard deviations where a message has no covariance."""

Messages = Callable[[list[str]], Iterable[Message]]


class BagAiding:
    """Finds the topics of fixes and odometry.

    Fixes are taken from the only topic of `NavSatFix` where none is named; odometry only if its
    topic is named, as a message of this type may as well be the ground truth.

    Args:
        bag: the bag.
        named: topics or files of ``gnss`` and ``odometry``.
        body: the topic whose frame is the body.
        diagnostics: counts fixes and samples that are dropped.

    Attributes:
        in_files: what of `named` is not a topic.

    Raises:
        DataError: if a topic is of another type.
    """

    def __init__(
        self, bag: Bag, named: Mapping[str, str], body: str, diagnostics: Diagnostics
    ) -> None:
        self._bag, self._body, self._diagnostics = bag, body, diagnostics
        topics = {sensor: place for sensor, place in named.items() if place in bag.topics}
        self.in_files = {s: place for s, place in named.items() if place not in bag.topics}
        for sensor, kind in (("gnss", NAV_SAT_FIX), ("odometry", ODOMETRY)):
            if sensor in topics and bag.topics[topics[sensor]] != kind:
                found = bag.topics[topics[sensor]]
                raise DataError(
                    f"{bag.path}: '{topics[sensor]}' is of type {found}; expected {kind}"
                )
        only = bag.of_type(NAV_SAT_FIX)
        if "gnss" not in named and len(only) == 1:
            topics["gnss"] = only[0]
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
        if "odometry" in self._topics:
            files = self._with_odometry(files, messages([self._topics["odometry"]]), stamp_ns)
        return files

    def _fixes(self, messages: Iterable[Message], stamp_ns: Callable[[Message], int]) -> AidingData:
        stamps, places, sigmas = [], [], []
        for message in messages:
            fix = message.decode()
            stamps.append(stamp_ns(message))
            solved = fix.status.status >= 0
            places.append([fix.latitude, fix.longitude, fix.altitude] if solved else [np.nan] * 3)
            variances = np.asarray(fix.position_covariance).reshape(3, 3).diagonal()
            known = fix.position_covariance_type > 0 and np.all(variances > 0)
            sigmas.append(np.sqrt(variances) if known else _UNKNOWN_SIGMA_M)
        columns = np.array(stamps, np.int64), np.array(places).reshape(-1, 3)
        return fixes_from(
            *columns, np.array(sigmas).reshape(-1, 3), self._bag.path, self._diagnostics
        )

    def _with_odometry(
        self, data: AidingData, messages: Iterable[Message], stamp_ns: Callable[[Message], int]
    ) -> AidingData:
        """With the poses of the body that the poses of the base mean."""
        stamps: list[int] = []
        positions, quaternions = [], []
        base_T_body: gtsam.Pose3 | None = None
        for message in messages:
            found, at_ns = message.decode(), stamp_ns(message)
            x, y, z, *turn = pose_of(found, ODOMETRY)
            if base_T_body is None:
                base, body = str(found.child_frame_id), frame_of(self._bag, self._body)
                base_T_body = path_between(self._bag, base, body) if base else gtsam.Pose3()
            if not np.isfinite([x, y, z, *turn]).all() or np.linalg.norm(turn) < 0.5:
                self._diagnostics.warn(
                    "odometry_dropped", f"{self._bag.path}: a pose is not finite"
                )
                continue
            if stamps and at_ns <= stamps[-1]:
                self._diagnostics.warn("odometry_dropped", f"{self._bag.path}: not in order")
                continue
            rotation = gtsam.Rot3.Quaternion(turn[3], *turn[:3])
            pose = gtsam.Pose3(rotation, np.array([x, y, z])).compose(base_T_body)
            stamps.append(at_ns)
            positions.append(pose.translation())
            quaternions.append(Rotation.from_matrix(pose.rotation().matrix()).as_quat())
        return data.with_odometry(
            np.array(stamps, np.int64),
            np.array(positions).reshape(-1, 3),
            np.array(quaternions).reshape(-1, 4),
        )
