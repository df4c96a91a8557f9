# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""ROS bags: every encoding and kind of bag, topics found or named, and bags that are broken."""

import sqlite3
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from recordings import FRAME_PERIOD_NS, START_NS, edit_text
from recordings_ros import (
    DISTORTION,
    INTRINSICS,
    KINDS,
    LAG_NS,
    SIZE,
    BagWriter,
    bag_writer,
    encoded,
    write_bag,
)

from slam_graph.datasets.calibration.kalibr_calibration import write_kalibr
from slam_graph.datasets.dataset_registry import open_dataset
from slam_graph.datasets.sequence import Sequence
from slam_graph.errors import DataError
from slam_graph.sensors.measurements import CameraFrame


def frames_of(sequence: Sequence) -> list[CameraFrame]:
    frames = [packet.frame for packet in sequence.packets()]
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    return frames  # type: ignore[return-value]


def counts(sequence: Sequence) -> dict[str, int]:
    return {k: n for k, n in sequence.diagnostics.counts.items() if k != "imu_noise_assumed"}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_says_the_same(tmp_path: Path, kind: str) -> None:
    sequence = open_dataset(write_bag(tmp_path, kind), sources={"groundtruth": "/truth"})
    info, truth, frames = sequence.info(), sequence.groundtruth(), frames_of(sequence)
    assert (info.format, info.cameras, info.frames, info.imu_samples) == ("rosbag", 2, 8, 95)
    rng = np.random.default_rng(1)
    for k, frame in enumerate(frames):
        assert frame.stamp_ns == START_NS + k * FRAME_PERIOD_NS
        for image in frame.images:
            expected = rng.integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)
            assert np.array_equal(image, expected)
    assert truth is not None
    np.testing.assert_allclose(truth.positions, [[k, 2, 3] for k in range(20, 100, 10)])
    np.testing.assert_allclose(truth.quaternions[0], [0.5, 0.5, -0.5, 0.5])
    np.testing.assert_allclose(sequence.imu().accel[:, 2], 9.81, atol=0.01)  # type: ignore[attr-defined]
    assert sequence.diagnostics.counts == {"imu_noise_assumed": 1}


def test_calibration_in_the_bag(tmp_path: Path) -> None:
    sequence = open_dataset(write_bag(tmp_path))
    left, right = sequence.rig.cameras
    camera = left.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == INTRINSICS
    assert (camera.distortion, camera.coefficients) == ("radtan", DISTORTION)
    np.testing.assert_allclose(left.body_T_camera.translation(), [0.1, 0, 0], atol=1e-12)
    # the right camera is 0.1 m along the x axis of the left one, which points along y of the body
    np.testing.assert_allclose(right.body_T_camera.translation(), [0.1, 0.1, 0], atol=1e-12)


@pytest.mark.parametrize("transport", ["", "/compressed"])
@pytest.mark.parametrize("kind", ["ros1", "sqlite"])
def test_rectified_images_have_axes_of_their_own(tmp_path: Path, kind: str, transport: str) -> None:
    """A direction x along the axes of the camera is R x along those of rectified images."""
    R = gtsam.Rot3.Ypr(0.02, 0.09, -0.03).matrix()
    topics = ("/cam0/image_raw", f"/left/image_rect{transport}")

    def extra(bag: BagWriter) -> None:
        image = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        message = bag.image(START_NS, image, "mono8", "cam0")
        if transport:
            message = bag.compressed(START_NS, encoded(image, ".png"), "png", "cam0")
        bag.write(topics[1], message, START_NS)
        bag.write("/left/camera_info", bag.camera_info(START_NS, "cam0", R=R), START_NS)

    path = write_bag(tmp_path, kind, extra=extra)
    raw, rectified = (open_dataset(path, sources={"cam0": t}).rig.cameras[0] for t in topics)
    expected = R @ raw.body_T_camera.rotation().matrix().T
    found = rectified.body_T_camera.rotation().matrix().T
    np.testing.assert_allclose(found, expected, atol=1e-12)
    moved = rectified.body_T_camera.translation() - raw.body_T_camera.translation()
    np.testing.assert_allclose(moved, np.zeros(3), atol=1e-12)


def test_calibration_that_the_bag_lacks_is_asked_for(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bare", calibrated=False)
    with pytest.raises(
        DataError, match=r"no topic '/cam0/camera_info'; give --calibration; the bag has .*/imu0"
    ):
        open_dataset(bag)
    rig = open_dataset(write_bag(tmp_path / "whole")).rig
    write_kalibr(rig, tmp_path / "chain.yaml")
    sequence = open_dataset(bag, calibration=tmp_path / "chain.yaml")
    assert len(frames_of(sequence)) == 8
    assert not sequence.diagnostics.counts


def test_topics_of_a_kalibr_file(tmp_path: Path) -> None:
    """What Kalibr wrote down as the topic of a camera goes before the order of names."""
    bag = write_bag(tmp_path)
    chain = tmp_path / "chain.yaml"
    write_kalibr(open_dataset(bag).rig.select(1), chain)
    with pytest.raises(DataError, match="1 cameras are calibrated"):
        open_dataset(bag, calibration=chain)
    edit_text(chain, "name: cam0", "name: cam0\n  rostopic: /cam1/image_raw")
    frames = frames_of(open_dataset(bag, calibration=chain))
    both = frames_of(open_dataset(bag))
    assert np.array_equal(frames[3].images[0], both[3].images[1])
    named = {"cam0": "/cam0/image_raw"}
    frames = frames_of(open_dataset(bag, calibration=chain, sources=named))
    assert np.array_equal(frames[3].images[0], both[3].images[0])


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"imu": "/imu1"}, r"no topic '/imu1' in this bag; it has .*/imu0 \(Imu\)"),
        ({"imu": "/truth"}, "'/truth' is of type .*TransformStamped; expected sensor_msgs"),
        ({"cam1": "/cam1/image_raw"}, "without gaps"),
        ({"lidar": "/points"}, "unknown sensor 'lidar'"),
        ({"groundtruth": "/imu0"}, "expected geometry_msgs"),
    ],
)
def test_wrong_topics(tmp_path: Path, sources: dict[str, str], message: str) -> None:
    with pytest.raises(DataError, match=message) as error:
        open_dataset(write_bag(tmp_path), sources=sources)
    assert "\n" not in str(error.value)


def test_two_imus_must_be_chosen_from(tmp_path: Path) -> None:
    def second(bag: BagWriter) -> None:
        bag.write("/imu1", bag.imu(START_NS, [0, 0, 0], [0, 0, 9.81]), START_NS)

    path = write_bag(tmp_path, extra=second)
    with pytest.raises(DataError, match=r"2 IMU topics \(/imu0, /imu1\); choose with --topic imu="):
        open_dataset(path)
    assert open_dataset(path, sources={"imu": "/imu0"}).info().imu_samples == 95


def test_a_bag_without_images(tmp_path: Path) -> None:
    with bag_writer(tmp_path / "a.bag", "ros1") as bag:
        bag.write("/imu0", bag.imu(START_NS, [0, 0, 0], [0, 0, 9.81]), START_NS)
    with pytest.raises(DataError, match=r"no images in this bag; it has /imu0 \(Imu\)"):
        open_dataset(tmp_path / "a.bag")


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_stamps_that_are_missing_are_those_of_recording(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path, kind, stamped=False)
    sequence = open_dataset(path, cameras=1)
    stamps = [frame.stamp_ns for frame in frames_of(sequence)]
    expected = START_NS + np.arange(1, 9) * FRAME_PERIOD_NS + 2 * LAG_NS
    assert stamps == expected.tolist()
    assert counts(sequence)["stamp_missing"] == 8 + 95


def test_an_image_from_the_future_does_not_block_the_others(tmp_path: Path) -> None:
    def early(bag: BagWriter) -> None:
        late = bag.image(START_NS + 10**10, np.zeros((48, 64), np.uint8), "mono8")
        bag.write("/cam0/image_raw", late, START_NS - 1)

    sequence = open_dataset(write_bag(tmp_path, extra=early))
    frames = frames_of(sequence)
    assert counts(sequence) == {"camera_out_of_order": 1}
    assert [len(frames), all(image is not None for f in frames for image in f.images)] == [8, True]


# --- encodings ------------------------------------------------------------------------------------

GREY = np.random.default_rng(5).integers(0, 255, (48, 64), dtype=np.uint8)
COLOUR = np.dstack([GREY, np.full_like(GREY, 90), 255 - GREY])
SMOOTH = np.add.outer(np.arange(48) * 2, np.arange(64) * 2).astype(np.uint8)


def written(folder: Path, data: np.ndarray, encoding: str, big_endian: int = 0) -> Path:
    with bag_writer(folder / "a.bag", "ros1") as bag:
        message = bag.image(START_NS, data, encoding, big_endian=big_endian)
        bag.write("/camera/image_raw", message, START_NS)
        bag.write("/camera/camera_info", bag.camera_info(START_NS, "cam0"), START_NS)
    return folder / "a.bag"


def only_image(path: Path) -> np.ndarray:
    (frame,) = frames_of(open_dataset(path))
    assert frame.images[0] is not None
    return frame.images[0]


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("mono16", GREY.astype("<u2") * 256 + 77, GREY),
        ("bgr8", COLOUR, cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)),
        ("rgb8", COLOUR, cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)),
        ("bgra8", np.dstack([COLOUR, GREY]), cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)),
        ("rgba8", np.dstack([COLOUR, GREY]), cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY)),
        ("yuv422", np.dstack([np.full_like(GREY, 128), GREY]), GREY),
        ("yuv422_yuy2", np.dstack([GREY, np.full_like(GREY, 128)]), GREY),
    ],
)
def test_encodings(tmp_path: Path, encoding: str, data: np.ndarray, expected: np.ndarray) -> None:
    assert np.array_equal(only_image(written(tmp_path, data, encoding)), expected)


def test_sixteen_bits_of_either_byte_order(tmp_path: Path) -> None:
    path = written(tmp_path, (GREY.astype(np.uint16) * 256 + 77).astype(">u2"), "mono16", 1)
    assert np.array_equal(only_image(path), GREY)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer(tmp_path: Path, pattern: str) -> None:
    """A coloured surface seen through the filter gives its grey."""
    levels = {"r": 200, "g": 100, "b": 30}
    tile = np.array([[levels[c] for c in pattern[:2]], [levels[c] for c in pattern[2:]]], np.uint8)
    image = only_image(written(tmp_path, np.tile(tile, (24, 32)), f"bayer_{pattern}8"))
    grey = 0.299 * 200 + 0.587 * 100 + 0.114 * 30
    assert np.max(np.abs(image.astype(float) - grey)) < 2.0


@pytest.mark.parametrize(("suffix", "tolerance"), [(".png", 0), (".jpg", 8)])
def test_compressed_images(tmp_path: Path, suffix: str, tolerance: int) -> None:
    with bag_writer(tmp_path / "a.bag", "ros1") as bag:
        message = bag.compressed(START_NS, encoded(SMOOTH, suffix), suffix[1:])
        bag.write("/camera/image_raw/compressed", message, START_NS)
        bag.write("/camera/camera_info", bag.camera_info(START_NS, "cam0"), START_NS)
    image = only_image(tmp_path / "a.bag")
    assert np.max(np.abs(image.astype(int) - SMOOTH)) <= tolerance


def test_unknown_encoding_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"unknown encoding '32FC1'; known: mono8"):
        open_dataset(written(tmp_path, GREY.astype(np.float32), "32FC1"))


def test_damaged_images_are_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    def write(bag: BagWriter, k: int, data: bytes) -> None:
        stamp_ns = START_NS + k * FRAME_PERIOD_NS
        bag.write("/camera/image_raw/compressed", bag.compressed(stamp_ns, data, "png"), stamp_ns)

    with bag_writer(tmp_path / "a.bag", "ros1") as bag:
        whole = encoded(GREY, ".png")
        bag.write("/camera/camera_info", bag.camera_info(START_NS, "cam0"), START_NS)
        for k, data in enumerate([whole, whole[:500], b"", encoded(GREY[:20], ".png"), whole]):
            write(bag, k, data)
    sequence = open_dataset(tmp_path / "a.bag")
    frames = frames_of(sequence)
    assert [frame.images[0] is None for frame in frames] == [False, True, True, True, False]
    assert counts(sequence) == {"image_unreadable": 2, "image_wrong_size": 1}


def test_calibration_of_another_size(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"128x96 \(2 times as large\).*64x48"):
        open_dataset(written(tmp_path, np.zeros((96, 128), np.uint8), "mono8"))


# --- broken bags ----------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("kind", ["ros1", "mcap_file", "sqlite"])
def test_cut_bags_end_in_one_line_or_are_used_as_far_as_they_go(
    tmp_path: Path, kind: str, share: float
) -> None:
    path = write_bag(tmp_path, kind)
    file = next(path.glob("*.db3")) if kind == "sqlite" else path
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    frames, error = opened(path)
    assert frames or (str(path) in error and "\n" not in error)


def opened(path: Path) -> tuple[int, str]:
    """How many frames could be read, or why none."""
    try:
        return len(frames_of(open_dataset(path))), ""
    except DataError as error:
        return 0, str(error)


def test_a_bag_without_index_says_what_to_do(tmp_path: Path) -> None:
    path = write_bag(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match="rosbag reindex"):
        open_dataset(path)


def test_a_damaged_message_is_dropped(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "sqlite")
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute(
            "update messages set data = x'0001' where id in (select messages.id from messages "
            "join topics on topics.id = topic_id where name = '/imu0' order by timestamp "
            "limit 1 offset 60)"
        )
    sequence = open_dataset(path)
    assert len(frames_of(sequence)) == 8
    assert counts(sequence) == {"stamp_missing": 1, "imu_not_finite": 1}


def test_damage_in_the_middle_keeps_what_comes_before(tmp_path: Path) -> None:
    path = write_bag(tmp_path)
    data = path.read_bytes()
    begin, end = len(data) // 2, 2 * len(data) // 3
    damaged = data[begin:end].replace(b"op=", b"xx=")  # in the headers of messages
    path.write_bytes(data[:begin] + damaged + data[end:])
    sequence = open_dataset(path)
    frames = frames_of(sequence)
    assert 2 <= len(frames) < 8
    assert sequence.diagnostics.counts["bag_damaged"] >= 1
    assert all(frame.images[0] is not None for frame in frames[:2])


def test_metadata_that_is_missing(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "sqlite")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    with pytest.raises(DataError, match="cannot be read"):
        open_dataset(path)
    (path / "metadata.yaml").unlink()
    with pytest.raises(DataError, match="not a recording of a known format"):
        open_dataset(path)
    assert open_dataset(next(path.glob("*.db3"))).info().frames == 8


def test_reading_stops_with_its_reader(tmp_path: Path) -> None:
    packets = open_dataset(write_bag(tmp_path)).packets()
    next(packets)
    packets.close()  # type: ignore[attr-defined]
