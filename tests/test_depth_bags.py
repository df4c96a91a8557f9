# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Depth in ROS bags: each encoding gives the depth that was written, registered to its camera."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from recordings import FRAME_PERIOD_NS, SIZE, START_NS
from recordings_ros import LAG_NS, BagWriter, write_bag

from slam_graph.datasets import open_dataset
from slam_graph.datasets.sequence import RecordedSequence
from slam_graph.errors import DataError
from slam_graph.sensors import CameraFrame

FRAMES = 6
APART_NS = 4_000_000
"""The depth is measured this much after the image."""

Make = Callable[[BagWriter, int, NDArray[np.float32], str], Any]


def depth_at(frame: int) -> NDArray[np.float32]:
    """A slope of 1 to 3 m in whole mm, with a hole."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    depth = (1000 + 20 * u + 3 * v + 10 * frame).astype(np.float32) / np.float32(1000)
    depth[10:14, 20:26] = np.nan
    return depth


def millimetres(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    return np.nan_to_num(np.rint(depth * 1000)).astype(np.uint16)


def png(image: NDArray[Any]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def as_16uc1(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
    return bag.image(stamp_ns, millimetres(depth), "16UC1", frame)


def as_big_endian(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
    return bag.image(stamp_ns, millimetres(depth).astype(">u2"), "16UC1", frame, big_endian=1)


def as_32fc1(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
    return bag.image(stamp_ns, depth, "32FC1", frame)


def as_png(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
    return bag.compressed(stamp_ns, png(millimetres(depth)), "16UC1; png compressed ", frame)


def as_compressed(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
    data = struct.pack("<iff", 0, 0.0, 0.0) + png(millimetres(depth))
    return bag.compressed(stamp_ns, data, "16UC1; compressedDepth png", frame)


def as_quantised(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
    """As the transport does: the finest steps of inverse depth up to 10 m."""
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0
    inverse = np.nan_to_num(np.rint(a / depth + b)).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + png(inverse)
    return bag.compressed(stamp_ns, data, "32FC1; compressedDepth", frame)


def write_depth_bag(
    folder: Path,
    make: Make,
    topic: str = "/aligned_depth_to_color/image_raw",
    frame: str = "cam0",
    kind: str = "ros1",
    calibrate: Callable[[BagWriter], None] | None = None,
) -> Path:
    """The usual bag, with depth in the frame of a camera."""

    def add(bag: BagWriter) -> None:
        if calibrate is not None:
            calibrate(bag)
        for k in range(FRAMES):
            stamp_ns = START_NS + k * FRAME_PERIOD_NS + APART_NS
            bag.write(topic, make(bag, stamp_ns, depth_at(k), frame), stamp_ns + LAG_NS)

    return write_bag(folder, kind, FRAMES, extra=add)


def frames_of(sequence: RecordedSequence) -> list[CameraFrame]:
    frames = [packet.frame for packet in sequence.packets()]
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    return [frame for frame in frames if isinstance(frame, CameraFrame)]


@pytest.mark.parametrize(
    ("make", "tolerance"),
    [
        (as_16uc1, 1e-6),
        (as_big_endian, 1e-6),
        (as_32fc1, 0.0),
        (as_png, 1e-6),
        (as_compressed, 1e-6),
        (as_quantised, 1e-3),  # half a step of z² / a at 3 m
    ],
)
def test_depth_is_what_was_written(tmp_path: Path, make: Make, tolerance: float) -> None:
    topic = "/aligned_depth_to_color/image_raw"
    if make in (as_png, as_compressed, as_quantised):
        topic += "/compressedDepth"
    sequence = open_dataset(write_depth_bag(tmp_path, make, topic))
    info = sequence.info()
    assert (info.has_imu, info.has_depth, info.depth_frames) == (True, True, FRAMES)
    frames = frames_of(sequence)
    assert len(frames) == FRAMES
    for k, frame in enumerate(frames):
        assert frame.depth is not None
        assert frame.depth_ns == frame.stamp_ns + APART_NS
        np.testing.assert_allclose(frame.depth, depth_at(k), rtol=0, atol=tolerance)
        assert frame.images[0] is not None


def test_part_of_a_bag_has_the_same_depth(tmp_path: Path) -> None:
    sequence = open_dataset(write_depth_bag(tmp_path, as_16uc1, kind="mcap"))
    whole = frames_of(sequence)
    part = [
        packet.frame
        for packet in sequence.packets(whole[2].stamp_ns, whole[4].stamp_ns)
        if isinstance(packet.frame, CameraFrame)
    ]
    assert [frame.stamp_ns for frame in part] == [frame.stamp_ns for frame in whole[2:5]]
    for one, other in zip(part, whole[2:5], strict=True):
        assert one.depth is not None
        np.testing.assert_array_equal(one.depth, other.depth)


def test_depth_of_a_camera_of_its_own_is_registered(tmp_path: Path) -> None:
    """The second camera's frame, 0.1 m to the right: a wall at 2 m moves by f b / z pixels."""

    def wall(bag: BagWriter, stamp_ns: int, depth: NDArray[np.float32], frame: str) -> Any:
        flat = np.full_like(depth, 2.0)
        flat[:, : depth.shape[1] // 2] = 1.5
        return bag.image(stamp_ns, flat, "32FC1", frame)

    def calibrate(bag: BagWriter) -> None:
        message = bag.camera_info(START_NS - 10**9, "cam1")
        bag.write("/depth/camera_info", message, START_NS - 10**9)

    path = write_depth_bag(tmp_path, wall, "/depth/image", "cam1", calibrate=calibrate)
    # of both cameras the depth is that of the second one; of the first one alone, registered
    assert (both := open_dataset(path).rig.depth) is not None
    assert (both.camera, both.lens) == (1, None)
    sequence = open_dataset(path, cameras=1)
    sensor = sequence.rig.depth
    assert sensor is not None
    assert sensor.lens is not None
    np.testing.assert_allclose(sensor.camera_T_depth.translation(), [0.1, 0.0, 0.0], atol=1e-12)
    frame = frames_of(sequence)[0]
    assert frame.depth is not None
    camera = sequence.rig.cameras[0].camera
    for v in (12, 24, 36):
        row = frame.depth[v]
        for u in np.flatnonzero(np.isfinite(row)).tolist():
            x, y = camera.undistort(np.array([[u, v]], np.float64))[0]
            z = float(row[u])
            back = camera.distort(np.array([[x - 0.1 / z, y]]))[0][0]  # in the depth camera
            edge = SIZE[0] // 2 - 0.5
            assert z == pytest.approx(1.5 if back[0] < edge else 2.0) or abs(back[0] - edge) < 1.1


def test_depth_that_cannot_be_used_is_left_out_or_refused_by_name(tmp_path: Path) -> None:
    path = write_depth_bag(tmp_path, as_16uc1, "/depth/image", "elsewhere")
    sequence = open_dataset(path)
    assert sequence.diagnostics.counts["depth_left_out"] == 1
    assert not sequence.info().has_depth
    assert frames_of(sequence)[0].depth is None
    with pytest.raises(DataError, match="/depth/camera_info"):
        open_dataset(path, sources={"depth": "/depth/image"})
    with pytest.raises(DataError, match="no depth on '/none'"):
        open_dataset(path, sources={"depth": "/none"})
