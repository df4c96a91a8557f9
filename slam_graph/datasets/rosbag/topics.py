# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The topics of IMU and cameras in a bag: as named, as calibrated, or the only ones there are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from slam_graph.datasets.rosbag.bag import Bag
from slam_graph.datasets.rosbag.messages import COMPRESSED_IMAGE, IMAGE, IMU, POSES
from slam_graph.errors import DataError
from slam_graph.sensors import YamlValue, read_yaml


@dataclass(frozen=True, slots=True)
class Topics:
    """The topics of the sensors.

    Attributes:
        imu: topic of the IMU, None where there is none.
        cameras: topic of each camera.
        groundtruth: topic of poses, None where none was named.
    """

    imu: str | None
    cameras: tuple[str, ...]
    groundtruth: str | None


def find_topics(bag: Bag, named: Mapping[str, str], calibration: Path | None) -> Topics:
    """Find the sensors in a bag.

    Args:
        bag: the bag.
        named: topics by ``imu``, ``cam0``, ``cam1``, … and ``groundtruth``.
        calibration: a Kalibr camera chain, whose keys ``rostopic`` are used where nothing is named.

    Raises:
        DataError: if a topic is missing or of another type, or several could be meant.
    """
    unknown = [key for key in named if not re.fullmatch(r"imu|groundtruth|cam\d+", key)]
    if unknown:
        raise DataError(f"unknown sensor '{unknown[0]}'; known: imu, cam0, cam1, …, groundtruth")
    recorded = _recorded_topics(calibration) if calibration is not None else {}
    known = {key: topic for key, topic in recorded.items() if topic in bag.topics} | dict(named)
    truth = known.get("groundtruth")
    if truth is not None:
        _require(bag, truth, tuple(POSES))
    return Topics(_find_imu(bag, known), _find_cameras(bag, known), truth)


def _recorded_topics(calibration: Path) -> dict[str, str]:
    """The keys ``rostopic`` of a Kalibr file, by sensor."""
    topics = {}
    for name, value in read_yaml(calibration).items():
        if re.fullmatch(r"imu0|cam\d+", name):
            topic: YamlValue | None = value.get("rostopic")
            if topic is not None:
                topics["imu" if name == "imu0" else name] = topic.text()
    return topics


def _find_imu(bag: Bag, known: Mapping[str, str]) -> str | None:
    if "imu" in known:
        return _require(bag, known["imu"], (IMU,))
    found = bag.of_type(IMU)
    if len(found) > 1:
        raise DataError(
            f"{bag.path}: {len(found)} IMU topics ({', '.join(found)}); choose with --topic imu=…"
        )
    return found[0] if found else None


def _find_cameras(bag: Bag, known: Mapping[str, str]) -> tuple[str, ...]:
    numbers = sorted(int(key[3:]) for key in known if key.startswith("cam"))
    if numbers:
        if numbers != list(range(len(numbers))):
            raise DataError(f"{bag.path}: cameras must be named cam0, cam1, … without gaps")
        return tuple(_require(bag, known[f"cam{k}"], (IMAGE, COMPRESSED_IMAGE)) for k in numbers)
    raw = bag.of_type(IMAGE)
    compressed = [
        topic
        for topic in bag.of_type(COMPRESSED_IMAGE)
        if topic.rpartition("/")[0] not in raw and not topic.endswith("compressedDepth")
    ]
    found = sorted(topic for topic in raw + compressed if "depth" not in topic)
    if not found:
        raise DataError(f"{bag.path}: no images in this bag; it has {bag.listed()}")
    return tuple(found)


def _require(bag: Bag, topic: str, types: tuple[str, ...]) -> str:
    if topic not in bag.topics:
        raise DataError(f"{bag.path}: no topic '{topic}' in this bag; it has {bag.listed()}")
    if bag.topics[topic] not in types:
        raise DataError(
            f"{bag.path}: '{topic}' is of type {bag.topics[topic]}; expected {' or '.join(types)}"
        )
    return topic
