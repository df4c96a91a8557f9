# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Position fixes and odometry in ROS bags and KITTI's raw data: what was written is read."""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import FRAME_PERIOD_NS, START_NS
from recordings_public import KITTI_START_NS, LATITUDE, write_kitti_raw
from recordings_ros import KINDS, LAG_NS, BagWriter, write_bag
from scipy.spatial.transform import Rotation

from slam_graph.arrays import FloatArray
from slam_graph.datasets import open_dataset
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.datasets.streams.geodesy import geodetic_positions
from slam_graph.errors import DataError

COUNT = 6
STAMPS = [START_NS + k * FRAME_PERIOD_NS for k in range(COUNT)]
DATUM = (49.01, 8.42, 115.0)
LOCAL = np.column_stack([np.arange(COUNT) * 7.0, np.arange(COUNT) ** 2.0, -0.5 * np.arange(COUNT)])
"""East, north, up of the first fix, m."""
CORRELATED = np.array([[4.0, 1.0, -0.3], [1.0, 3.0, 0.5], [-0.3, 0.5, 9.0]])

Edit = Callable[[int, dict[str, Any]], None]


def write_fixes(topic: str, edit: Edit | None = None) -> Callable[[BagWriter], None]:
    """Writes a fix for each frame; `edit` changes the arguments of one by its number."""

    def write(bag: BagWriter) -> None:
        for k, place in enumerate(geodetic_positions(LOCAL, DATUM)):
            values: dict[str, Any] = {"stamp_ns": STAMPS[k], "place": place.copy()}
            if edit is not None:
                edit(k, values)
            bag.write(topic, bag.fix(**values), STAMPS[k] + LAG_NS)

    return write


def write_odometry(edit: Edit | None = None) -> Callable[[BagWriter], None]:
    """Writes poses of the frame ``base`` for each frame."""

    def write(bag: BagWriter) -> None:
        for k, place in enumerate(LOCAL):
            values: dict[str, Any] = {"stamp_ns": STAMPS[k], "t": place, "q": turn_of(k).as_quat()}
            if edit is not None:
                edit(k, values)
            bag.write("/odom", bag.odometry(**values), STAMPS[k] + LAG_NS)

    return write


def turn_of(k: int) -> Rotation:
    return Rotation.from_euler("ZYX", [0.4 * k, 0.2, -0.1])


def only(k: int, **changed: Any) -> Edit:
    """Changes the arguments of one message."""
    return lambda number, values: values.update(changed) if number == k else None


def counts(sequence: RecordedSequence) -> dict[str, int]:
    return {k: n for k, n in sequence.diagnostics.counts.items() if k != "imu_noise_assumed"}


def damage(folder: Path, topic: str, number: int) -> None:
    """Cut the content of one message in a SQLite bag."""
    with sqlite3.connect(next(folder.glob("*.db3"))) as database:
        database.execute(
            "update messages set data = x'0001' where id in (select messages.id from messages "
            "join topics on topics.id = topic_id where name = ? order by timestamp "
            "limit 1 offset ?)",
            (topic, number),
        )


# --- fixes in bags --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_fixes_of_a_bag_are_those_that_were_written(tmp_path: Path, kind: str) -> None:
    """To the millimetre, at their stamps, and with their packets."""
    sequence = open_dataset(write_bag(tmp_path, kind, COUNT, extra=write_fixes("/fix")))
    data = sequence.aiding
    assert data.fix_stamps_ns.tolist() == STAMPS
    assert data.datum == pytest.approx(DATUM, abs=1e-9)
    np.testing.assert_allclose(data.fix_positions, LOCAL, atol=1e-3)
    assert counts(sequence) == {}
    carried = [packet.aiding for packet in sequence.packets()]
    assert [part.fix_stamps_ns.tolist() for part in carried if part is not None] == [
        [stamp_ns] for stamp_ns in STAMPS
    ]


@pytest.mark.parametrize(
    ("kind", "covariance", "expected"),
    [
        (0, CORRELATED, np.diag([25.0, 25.0, 100.0])),  # unknown
        (1, CORRELATED, np.diag([4.0, 3.0, 9.0])),  # approximated: only the diagonal says something
        (2, CORRELATED, np.diag([4.0, 3.0, 9.0])),  # diagonal known
        (3, CORRELATED, CORRELATED),  # known
        (3, np.zeros((3, 3)), np.diag([25.0, 25.0, 100.0])),  # said to be known, never set
        (3, CORRELATED + 50.0 * (1 - np.eye(3)), np.diag([4.0, 3.0, 9.0])),  # not positive definite
        (3, np.where(np.eye(3), CORRELATED, np.nan), np.diag([4.0, 3.0, 9.0])),
    ],
)
@pytest.mark.parametrize("generation", ["ros1", "mcap_file"])
def test_covariances_are_taken_as_far_as_they_are_known(
    tmp_path: Path, generation: str, kind: int, covariance: FloatArray, expected: FloatArray
) -> None:
    def edit(_: int, values: dict[str, Any]) -> None:
        values.update(covariance=covariance, kind=kind)

    path = write_bag(tmp_path, generation, COUNT, extra=write_fixes("/fix", edit))
    data = open_dataset(path).aiding
    np.testing.assert_allclose(data.fix_covariances, np.tile(expected, (COUNT, 1, 1)))


@pytest.mark.parametrize(
    "changed",
    [
        {"status": -1},
        {"place": [np.nan, 8.4, 115.0]},
        {"place": [49.0, np.inf, 115.0]},
        {"place": [49.0, 8.4, np.nan]},
        {"place": [1e300, 8.4, 115.0]},
        {"place": [49.0, 8.4, 1e300]},
        {"covariance": np.diag([1.0, np.inf, 1.0])},
        {"stamp_ns": STAMPS[0] - 1},
        {"stamp_ns": STAMPS[-1] + 10**12},
    ],
)
@pytest.mark.parametrize("number", [0, 2])
def test_a_fix_that_cannot_be_used_is_counted_and_the_rest_is_read(
    tmp_path: Path, number: int, changed: dict[str, Any]
) -> None:
    if number == 0 and changed.get("stamp_ns", STAMPS[-1]) < STAMPS[0]:
        changed = {"stamp_ns": STAMPS[1]}  # the first one can only be too late
    path = write_bag(tmp_path, "ros1", COUNT, extra=write_fixes("/fix", only(number, **changed)))
    sequence = open_dataset(path)
    data = sequence.aiding
    rest = [k for k in range(COUNT) if k != number]
    if changed == {"stamp_ns": STAMPS[1]}:  # of two at one time it is the second that is dropped
        rest = [k for k in range(COUNT) if k != 1]
        assert data.fix_stamps_ns.tolist() == [STAMPS[max(k, 1)] for k in rest]
    else:
        assert data.fix_stamps_ns.tolist() == [STAMPS[k] for k in rest]
    np.testing.assert_allclose(data.fix_positions, LOCAL[rest] - LOCAL[rest[0]], atol=1e-3)
    assert counts(sequence) == {"gnss_dropped": 1}


def test_each_dropped_fix_is_counted_and_none_may_be_left(tmp_path: Path) -> None:
    """A drive through a garage."""

    def edit(_: int, values: dict[str, Any]) -> None:
        values["status"] = -1

    path = write_bag(tmp_path, "ros1", COUNT, extra=write_fixes("/fix", edit))
    sequence = open_dataset(path)
    assert len(sequence.aiding.fix_stamps_ns) == 0
    assert counts(sequence) == {"gnss_dropped": COUNT}
    assert len(list(sequence.packets())) == COUNT


@pytest.mark.parametrize("number", [0, 3])
def test_a_damaged_message_costs_one_measurement(tmp_path: Path, number: int) -> None:
    def both(bag: BagWriter) -> None:
        write_fixes("/fix")(bag)
        write_odometry()(bag)

    path = write_bag(tmp_path, "sqlite", COUNT, extra=both)
    damage(path, "/fix", number)
    damage(path, "/odom", number)
    sequence = open_dataset(path, sources={"odometry": "/odom"})
    rest = [stamp for k, stamp in enumerate(STAMPS) if k != number]
    assert sequence.aiding.fix_stamps_ns.tolist() == rest
    assert sequence.aiding.odometry_stamps_ns.tolist() == rest
    dropped = {"stamp_missing": 2, "gnss_dropped": 1, "odometry_dropped": 1}
    assert counts(sequence) == dropped


def test_a_fix_without_a_stamp_has_the_time_of_its_recording(tmp_path: Path) -> None:
    extra = write_fixes("/fix", only(2, stamp_ns=0))
    sequence = open_dataset(write_bag(tmp_path, "ros1", COUNT, extra=extra))
    assert sequence.aiding.fix_stamps_ns[2] == STAMPS[2] + LAG_NS
    assert counts(sequence) == {"stamp_missing": 1}


def test_fixes_on_several_topics_are_chosen_from(tmp_path: Path) -> None:
    def both(bag: BagWriter) -> None:
        write_fixes("/left/fix")(bag)
        write_fixes("/right/fix", only(0, status=-1))(bag)

    path = write_bag(tmp_path, "ros1", COUNT, extra=both)
    unnamed = open_dataset(path)
    assert len(unnamed.aiding) == 0
    assert counts(unnamed) == {"gnss_left_out": 1}
    named = open_dataset(path, sources={"gnss": "/right/fix"})
    assert named.aiding.fix_stamps_ns.tolist() == STAMPS[1:]
    assert counts(named) == {"gnss_dropped": 1}


def test_a_topic_goes_before_a_file_and_a_named_file_before_a_topic(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", COUNT, extra=write_fixes("/fix"))
    row = f"{STAMPS[0]},1,2,3,1,1,1\n"
    for name in ("gnss.csv", "other.csv"):
        (tmp_path / name).write_text("#timestamp [ns],east,north,up,e,n,u\n" + row)
    assert len(open_dataset(path).aiding.fix_stamps_ns) == COUNT
    named = open_dataset(path, sources={"gnss": str(tmp_path / "other.csv")})
    assert named.aiding.fix_positions.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"gnss": "/fixx"}, r"no topic and no file '/fixx' of 'gnss'; .*/fix \(NavSatFix\)"),
        ({"gnss": "/odom"}, "'/odom' is of type .*Odometry; expected sensor_msgs/msg/NavSatFix"),
        ({"odometry": "/fix"}, "'/fix' is of type .*NavSatFix; expected nav_msgs/msg/Odometry"),
        ({"odometry": "/wheels"}, "does not connect the frame 'wheels' with 'imu'; .*--topic odom"),
    ],
)
def test_what_was_named_and_cannot_be_read_is_one_line(
    tmp_path: Path, sources: dict[str, str], message: str
) -> None:
    def all_of_it(bag: BagWriter) -> None:
        write_fixes("/fix")(bag)
        write_odometry()(bag)
        loose = bag.odometry(STAMPS[0], [0, 0, 0], [0, 0, 0, 1], "wheels")
        bag.write("/wheels", loose, STAMPS[0])

    path = write_bag(tmp_path, "ros1", COUNT, extra=all_of_it)
    with pytest.raises(DataError, match=message) as error:
        _ = open_dataset(path, sources=sources).aiding
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_masks_of_a_bag_are_a_folder_and_no_topic(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", COUNT, extra=write_fixes("/fix"))
    masks = tmp_path / "labels"
    masks.mkdir()
    (masks / "boxes.csv").write_text(f"{STAMPS[0]},1,1,1,5,5\n")
    sequence = open_dataset(path, sources={"masks": str(masks)})
    assert sequence.masks == 1
    assert len(sequence.aiding.fix_stamps_ns) == COUNT


# --- odometry in bags -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_of_a_bag_is_that_of_the_body(tmp_path: Path, kind: str) -> None:
    """The IMU is 0.1 m above the base, which is what the poses are of."""
    path = write_bag(tmp_path, kind, COUNT, extra=write_odometry())
    assert len(open_dataset(path).aiding) == 0  # such a topic may be the ground truth
    sequence = open_dataset(path, sources={"odometry": "/odom"})
    data = sequence.aiding
    assert data.odometry_stamps_ns.tolist() == STAMPS
    for k in range(COUNT):
        turn = turn_of(k)
        expected = LOCAL[k] + turn.apply([0.0, 0.0, 0.1])
        np.testing.assert_allclose(data.odometry_positions[k], expected, atol=1e-9)
        error = turn.inv() * Rotation.from_quat(data.odometry_quaternions[k])
        assert error.magnitude() < 1e-9
    assert counts(sequence) == {}


def test_odometry_is_of_the_first_camera_without_an_imu(tmp_path: Path) -> None:
    """Its axes are turned against those of the base, too."""

    def edit(_: int, values: dict[str, Any]) -> None:
        values["child"] = "cam0"

    path = write_bag(tmp_path, "ros1", COUNT, extra=write_odometry(edit))
    data = open_dataset(path, sources={"odometry": "/odom"}).aiding
    imu_T_camera = Rotation.from_quat([0.5, 0.5, 0.5, 0.5]), np.array([0.1, 0.0, 0.0])
    for k in range(COUNT):
        turn = turn_of(k) * imu_T_camera[0].inv()
        expected = LOCAL[k] - turn.apply(imu_T_camera[1])
        np.testing.assert_allclose(data.odometry_positions[k], expected, atol=1e-9)
        error = turn.inv() * Rotation.from_quat(data.odometry_quaternions[k])
        assert error.magnitude() < 1e-9


@pytest.mark.parametrize("length", [0.9, 1.001, 2.0])
def test_the_length_of_a_quaternion_turns_nothing(tmp_path: Path, length: float) -> None:
    def edit(k: int, values: dict[str, Any]) -> None:
        values["q"] = length * turn_of(k).as_quat()

    path = write_bag(tmp_path, "ros1", COUNT, extra=write_odometry(edit))
    data = open_dataset(path, sources={"odometry": "/odom"}).aiding
    for k, quaternion in enumerate(data.odometry_quaternions):
        assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
        assert (turn_of(k).inv() * Rotation.from_quat(quaternion)).magnitude() < 1e-9


@pytest.mark.parametrize(
    "changed",
    [
        {"t": [np.nan, 0.0, 0.0]},
        {"q": [0.0, 0.0, np.inf, 1.0]},
        {"q": [0.0, 0.0, 0.0, 0.0]},
        {"stamp_ns": STAMPS[0]},
        {"stamp_ns": STAMPS[-1] + 10**12},
    ],
)
def test_odometry_that_cannot_be_used_is_counted_and_the_rest_is_read(
    tmp_path: Path, changed: dict[str, Any]
) -> None:
    path = write_bag(tmp_path, "ros1", COUNT, extra=write_odometry(only(2, **changed)))
    sequence = open_dataset(path, sources={"odometry": "/odom"})
    rest = [stamp for k, stamp in enumerate(STAMPS) if k != 2]
    assert sequence.aiding.odometry_stamps_ns.tolist() == rest
    assert counts(sequence) == {"odometry_dropped": 1}


def test_odometry_may_have_no_pose_at_all(tmp_path: Path) -> None:
    def edit(_: int, values: dict[str, Any]) -> None:
        values["t"] = [np.nan] * 3

    path = write_bag(tmp_path, "ros1", COUNT, extra=write_odometry(edit))
    sequence = open_dataset(path, sources={"odometry": "/odom"})
    assert len(sequence.aiding) == 0
    assert counts(sequence) == {"odometry_dropped": COUNT}


# --- KITTI ----------------------------------------------------------------------------------------


def oxts_of(drive: Path) -> Path:
    return drive.with_name(drive.name.replace("_sync", "_extract")) / "oxts"


def edit_oxts(drive: Path, index: int, column: int, value: float) -> None:
    file = oxts_of(drive) / "data" / f"{index:010d}.txt"
    numbers = file.read_text().split()
    numbers[column] = repr(value)
    file.write_text(" ".join(numbers))


def test_fixes_of_kitti_are_its_positions_and_only_if_asked_for(tmp_path: Path) -> None:
    """10 m/s to the east on its sphere; on WGS84 a degree there is longer (Torge, 4.2)."""
    drive = write_kitti_raw(tmp_path / "2011_09_26")
    assert len(open_dataset(drive).aiding) == 0
    sequence = open_dataset(drive, sources={"gnss": "oxts"})
    data = sequence.aiding
    seconds = (data.fix_stamps_ns - data.fix_stamps_ns[0]) * 1e-9
    assert data.fix_stamps_ns[10] == KITTI_START_NS
    assert len(seconds) == sequence.info().imu_samples
    e2, a, sine = 6.69437999014e-3, 6378137.0, np.sin(np.radians(LATITUDE))
    normal = a / np.sqrt(1 - e2 * sine**2)
    east = 10.0 * seconds * (normal + 112.0) / a
    np.testing.assert_allclose(data.fix_positions[:, 0], east, atol=1e-3)
    np.testing.assert_allclose(data.fix_positions[:, 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(data.fix_positions[:, 2], seconds, atol=1e-3)
    np.testing.assert_allclose(data.fix_covariances, np.tile(0.05**2 * np.eye(3), (72, 1, 1)))
    assert counts(sequence) == {}


def test_samples_of_kitti_without_a_position_are_counted(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path / "2011_09_26")
    (oxts_of(drive) / "data" / "0000000030.txt").unlink()
    edit_oxts(drive, 0, 0, np.nan)
    edit_oxts(drive, 40, 2, 1e300)
    edit_oxts(drive, 50, 23, 0.0)  # no accuracy
    sequence = open_dataset(drive, sources={"gnss": "oxts"})
    data = sequence.aiding
    assert len(data.fix_stamps_ns) == 72 - 4
    assert counts(sequence) == {"gnss_dropped": 4}
    assert np.abs(data.fix_positions).max() < 10.0
    file = oxts_of(drive) / "data" / "0000000020.txt"
    file.write_text("49.0 8.4")
    again = open_dataset(drive, sources={"gnss": "oxts"})
    with pytest.raises(DataError, match=r"0000000020.txt: expected 30 numbers"):
        _ = again.aiding


def test_kitti_without_any_accuracy_has_no_fixes(tmp_path: Path) -> None:
    drive = write_kitti_raw(tmp_path / "2011_09_26")
    for index in range(72):
        edit_oxts(drive, index, 23, 0.0)
    sequence = open_dataset(drive, sources={"gnss": "oxts"})
    assert len(sequence.aiding) == 0
    assert counts(sequence) == {"gnss_dropped": 72}
