# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Properties of the readers of KITTI's raw data and odometry benchmark.

As `test_parser_properties`: what is written is read again, and anything is judged.
"""

import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from damage import MOST_MB, memory_mb
from hypothesis import given
from hypothesis import strategies as st
from properties import (
    ANYTHING,
    LARGEST_STAMP_NS,
    dressed,
    edited,
    examples,
    finite,
    in_seconds,
    instead,
    parsed,
    poses,
    rows_as_bytes,
    stamps,
    vectors,
)
from recordings_public import (
    TAKEN,
    date,
    random_image,
    write_kitti_odometry,
    write_kitti_raw,
)
from sound import sound_dataset, sound_recording, sound_stamps

from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.formats.kitti_files import (
    read_calibration,
    read_dates,
    read_seconds,
    rectified_camera,
)
from slam_graph.errors import DataError
from slam_graph.sensors import AidingData

pytestmark = [
    pytest.mark.filterwarnings("error::RuntimeWarning"),
    pytest.mark.usefixtures("quiet"),
]


# --- times ----------------------------------------------------------------------------------------


@examples()
@given(data=st.data())
def test_dates(folder: Path, data: st.DataObject) -> None:
    """To the nanosecond, from 1823 to 2116."""
    written = data.draw(stamps(fewest=1))
    path = folder / "timestamps.txt"
    path.write_bytes(data.draw(dressed("\n".join(map(date, written.tolist())))))
    np.testing.assert_array_equal(read_dates(path), written)


@examples()
@given(when=st.datetimes(), fraction=st.from_regex(r"(\.[0-9]{0,12})?", fullmatch=True))
def test_dates_of_any_year(folder: Path, when: datetime, fraction: str) -> None:
    """Those that do not fit are refused."""
    when = when.replace(microsecond=0, tzinfo=UTC)
    path = folder / "years.txt"
    path.write_text(f"{when:%Y-%m-%d %H:%M:%S}{fraction}\n")
    found = parsed(read_dates, path)
    seconds = (when - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()
    assert (found is not None) == (abs(seconds * 1e9) < LARGEST_STAMP_NS) or when.year < 1000
    if found is not None:
        sound_stamps(found)
        assert found[0] - int(seconds) * 10**9 == int((fraction[1:10] or "0").ljust(9, "0"))


@examples()
@given(data=st.data())
def test_seconds(folder: Path, data: st.DataObject) -> None:
    end = LARGEST_STAMP_NS // 10**9 * 10**9
    written = data.draw(stamps(1, 5, 1 - end, end))
    path = folder / "times.txt"
    path.write_bytes(data.draw(dressed("\n".join(map(in_seconds, written.tolist())))))
    np.testing.assert_array_equal(read_seconds(path), written)


# --- calibrations ---------------------------------------------------------------------------------


def numbers(values: Any) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


@examples()
@given(data=st.data())
def test_poses_of_sensors(folder: Path, data: st.DataObject) -> None:
    pose = data.draw(poses(1e5))
    path = folder / "calib.txt"
    text = f"calib_time: 09-Jan-2012 13:57:47\nR: {numbers(pose.rotation().matrix())}\n"
    text += f"T: {numbers(pose.translation())}\ndelta_f: 0 0"
    path.write_bytes(data.draw(dressed(text)))
    np.testing.assert_allclose(read_calibration(path).pose().matrix(), pose.matrix(), atol=1e-12)


@examples()
@given(
    focal=st.floats(1.0, 1e5), centre=vectors(2, 1e5), shift=vectors(3, 1e5), size=st.integers(1, 9)
)
def test_rectified_cameras(
    focal: float, centre: list[float], shift: list[float], size: int
) -> None:
    """The camera is where its projection is, K [I | t]."""
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    t = np.array(shift) / focal
    camera, camera_T_first = rectified_camera(np.column_stack([K, K @ t]), size, 2 * size, "here")
    np.testing.assert_array_equal(camera.K, K)
    assert (camera.width, camera.height) == (size, 2 * size)
    np.testing.assert_allclose(camera_T_first.translation(), t, rtol=1e-9, atol=1e-6)


# --- raw data -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of two frames, whose navigation unit has twelve samples."""
    return write_kitti_raw(tmp_path_factory.mktemp("kitti") / "2011_09_26", 2, extract=False)


LATITUDE_DEG = 85.0
"""Mercator's coordinates go to infinity at the poles."""


@examples(30)
@given(data=st.data())
def test_navigation_units(drive: Path, folder: Path, data: st.DataObject) -> None:
    """Rates, specific forces, velocities and turns are those in the files, to the bit."""
    times = data.draw(stamps(2, 5, 10**9, 4 * 10**18))
    rows = np.array([data.draw(vectors(30, 10.0)) for _ in times])
    rows[:, 0] *= LATITUDE_DEG / 10.0
    rows[:, 17:20] *= 0.1  # no spikes
    rows[:, 23] = data.draw(st.floats(1e-3, 1e3))  # of the position, m
    root = folder / "day" / "drive"
    if not root.exists():
        shutil.copytree(drive.parent, root.parent)
        (root.parent / drive.name).rename(root)
    shutil.rmtree(root / "oxts" / "data")
    (root / "oxts" / "data").mkdir()
    (root / "oxts" / "timestamps.txt").write_text("\n".join(map(date, times.tolist())))
    for k, row in enumerate(rows.tolist()):
        (root / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(repr, row)))
    sequence = open_dataset(root, sources={"gnss": "oxts"})
    assert isinstance(sequence, RecordedSequence)
    imu, truth = sequence.imu(), sequence.groundtruth()
    np.testing.assert_array_equal(imu.stamps_ns, times)
    np.testing.assert_array_equal(imu.gyro, rows[:, 17:20])
    np.testing.assert_array_equal(imu.accel, rows[:, 11:14])
    assert truth is not None
    np.testing.assert_array_equal(truth.stamps_ns, times)
    np.testing.assert_array_equal(truth.velocities, rows[:, [7, 6, 10]])
    for k, (roll, pitch, yaw) in enumerate(rows[:, 3:6].tolist()):
        turn = gtsam.Rot3.Ypr(yaw, pitch, roll).matrix()
        np.testing.assert_allclose(truth.pose(k).rotation().matrix(), turn, atol=1e-12)
    fixes: AidingData = sequence.aiding
    np.testing.assert_array_equal(fixes.fix_stamps_ns, times)
    sound_recording(sequence)


RAW = (
    *("calib_cam_to_cam.txt", "calib_imu_to_velo.txt", "calib_velo_to_cam.txt"),
    *("image_00/timestamps.txt", "image_01/timestamps.txt", "oxts/timestamps.txt"),
    "oxts/data/0000000005.txt",
)


def named(drive: Path, name: str) -> Path:
    return next(file for file in (drive / name, drive.parent / name) if file.is_file())


@pytest.mark.parametrize("name", RAW)
@examples(40)
@given(data=st.data())
def test_edited_files_of_a_drive(drive: Path, name: str, data: st.DataObject) -> None:
    file = named(drive, name)
    with instead(file, data.draw(edited(file.read_text()) | ANYTHING)):
        parsed(sound_dataset, drive)


@pytest.mark.parametrize("number", range(0, 30, 3))
@examples(16)
@given(data=st.data())
def test_any_numbers_of_a_navigation_unit(drive: Path, number: int, data: st.DataObject) -> None:
    """Finite ones of any size: each sample is read, or left out."""
    file = drive / "oxts" / "data" / "0000000003.txt"
    cells = file.read_text().split()
    cells[number : number + 3] = map(repr, data.draw(vectors(3, 1.7e308)))
    with instead(file, " ".join(cells).encode()):
        sound_dataset(drive, sources={"gnss": "oxts"})


@pytest.fixture(scope="module")
def extract(drive: Path) -> Path:
    """The same drive with an image that is to be rectified, as those of `…_extract` are."""
    copied = drive.with_name("2011_09_26_drive_0002_extract")
    shutil.copytree(drive, copied)
    image = random_image(0, TAKEN)
    assert cv2.imwrite(str(copied / "image_00" / "data" / "0000000000.png"), image)
    return copied


@examples(30)
@given(data=st.data())
def test_edited_calibrations_of_images_to_be_rectified(extract: Path, data: st.DataObject) -> None:
    file = named(extract, "calib_cam_to_cam.txt")
    with instead(file, data.draw(edited(file.read_text()))):
        parsed(sound_dataset, extract)


@pytest.mark.parametrize("size", ["65535 65535", "65535 48", "48 65535", "999999 999999"])
def test_rectified_images_are_bounded(extract: Path, size: str) -> None:
    """Maps that rectify images take memory for each pixel that the calibration claims."""
    file = named(extract, "calib_cam_to_cam.txt")
    lines = file.read_text().splitlines()
    text = "\n".join(f"S_rect_00: {size}" if "S_rect_00" in line else line for line in lines)
    memory_mb(reset=True)
    before_mb = memory_mb()
    with instead(file, text.encode()), pytest.raises(DataError, match="S_rect_00"):
        open_dataset(extract)
    assert memory_mb() < before_mb + MOST_MB


# --- odometry benchmark ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kitti_odometry(tmp_path_factory.mktemp("odometry"), frames=3)


@examples(40)
@given(data=st.data())
def test_poses(sequence: Path, data: st.DataObject) -> None:
    """Those of camera 0 in its first frame, in axes x forward, y left, z up."""
    written = [data.draw(poses()) for _ in range(3)]
    file = sequence.parent.parent / "poses" / "03.txt"
    text = "\n".join(numbers(pose.matrix()[:3]) for pose in written)
    with instead(file, data.draw(dressed(text))):
        opened = open_dataset(sequence)
        assert isinstance(opened, RecordedSequence)
        truth = opened.groundtruth()
        sound_recording(opened)
    assert truth is not None
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for k, pose in enumerate(written):
        np.testing.assert_array_equal(truth.positions[k], axes @ pose.translation())
        turn = axes @ pose.rotation().matrix()
        np.testing.assert_allclose(truth.pose(k).rotation().matrix(), turn, atol=1e-9)


ODOMETRY = {"calib.txt": 13, "times.txt": 1, "../../poses/03.txt": 12}


@pytest.mark.parametrize("name", ODOMETRY)
@examples()
@given(data=st.data())
def test_edited_files_of_a_sequence(sequence: Path, name: str, data: st.DataObject) -> None:
    file = sequence / name
    rows = rows_as_bytes(" ", ODOMETRY[name])
    with instead(file, data.draw(edited(file.read_text()) | rows)):
        parsed(sound_dataset, sequence)


@examples()
@given(largest=st.floats(1.0, 1.7e308), data=st.data())
def test_places_of_any_size(sequence: Path, largest: float, data: st.DataObject) -> None:
    """Poses that are too far for any measurement are left out."""
    file = sequence.parent.parent / "poses" / "03.txt"
    lines = file.read_text().splitlines()
    cells = lines[1].split()
    cells[3] = repr(data.draw(finite(largest)))
    lines[1] = " ".join(cells)
    with instead(file, "\n".join(lines).encode()):
        sound_dataset(sequence)


def test_a_calibration_with_a_projection_that_is_none_is_refused(sequence: Path) -> None:
    file = sequence / "calib.txt"
    for wrong in ("1e-9 0 0 0 0 1 0 0 0 0 1 0", "1 0 0 0 0 1 0 0 0 0 1e-30 9"):
        with instead(file, f"P0: {wrong}\nP1: {wrong}".encode()), pytest.raises(DataError):
            open_dataset(sequence)
